"""Checks and preparation of a cell by its operator: doctor, power and prompts.

Imports `sim2real.{config, control, links, peripherals, protocol}`; imported by `sim2real.runtime` and `cli`.
"""
