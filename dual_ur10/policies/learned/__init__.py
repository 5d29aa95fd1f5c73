"""Learned policies: checkpoints that run no code, the environment signature they carry, and conversion from SB3.

Imports `envs`. Loads neither torch nor SB3 but for conversion.
"""
