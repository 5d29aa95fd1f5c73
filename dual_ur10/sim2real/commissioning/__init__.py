"""Checks and preparation of a cell by its operator: doctor, power and prompts.

Imports `sim2real.{config, links, protocol}`.
"""
