"""Checks and preparation of a cell by its operator: doctor, power, prompts and status view.

Imports `sim2real.{config, links, protocol}`.
"""
