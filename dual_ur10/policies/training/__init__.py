"""Training by imitation and by reinforcement, with data sets, progress and resumable training folders.

The only room that needs torch and Stable-Baselines3. Nothing that acts in an episode is here.
"""
