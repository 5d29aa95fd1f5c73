"""Training by imitation and by reinforcement, with data sets, progress and resumable training folders.

Imports `envs` and the other rooms of `policies`. The only room that loads torch and Stable-Baselines3.
"""
