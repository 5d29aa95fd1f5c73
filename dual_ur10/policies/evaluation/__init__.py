"""Rollouts, evaluation over seeded episodes and its statistics, checks of policies and tasks, and export to Minari.

It trains nothing, and never looks into a policy.
"""
