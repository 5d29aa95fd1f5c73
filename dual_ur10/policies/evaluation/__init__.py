"""Rollouts, evaluation over seeded episodes, its statistics, the check of a policy, and export to Minari.

It trains nothing, and never looks into a policy.
"""
