"""Learned policies: checkpoints that run no code, the environment signature they carry, and conversion from SB3.

torch and SB3 are loaded for the conversion only. A checkpoint never names code.
"""
