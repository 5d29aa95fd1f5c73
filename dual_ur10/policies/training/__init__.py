"""Training by imitation and by reinforcement, with data sets, progress and resumable training folders.

Imports `envs` and the other packages of `policies`. Loads torch and Stable-Baselines3.
"""
