"""Interfaces of the environments: Gymnasium, its vector API, PettingZoo, dm_env and Stable-Baselines3.

Each is a thin view of `envs.core.core.Core` and contains no task logic.
"""
