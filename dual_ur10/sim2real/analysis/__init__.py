"""Comparison, replay and servoj identification of recorded runs, with their plots and reports.

Imports `sim2real.recording`, `envs` and `policies`; imported by the command line.
"""
