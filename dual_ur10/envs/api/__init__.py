"""The interfaces of the environments: Gymnasium, its vector API, PettingZoo, dm_env and Stable-Baselines3.

Each is a thin view of `envs.core.core.Core` and holds no logic of a task.
"""
