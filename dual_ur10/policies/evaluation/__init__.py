"""Rollouts, evaluation over seeded episodes, its statistics, the check of a policy, and export to Minari.

Imports `envs` and `policies.{scripted, learned}`.
"""
