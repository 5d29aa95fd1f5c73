"""Learned policies: checkpoints that run no code, the environment signature they carry, and conversion from SB3.

Imports `envs`. Loads torch and SB3 for the conversion only.
"""
