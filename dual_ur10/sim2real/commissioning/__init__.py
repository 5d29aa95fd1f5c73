"""Checks and preparation of a cell: doctor, power, and prompts to the operator.

Imports `sim2real.{config, control, links, peripherals, protocol}`; imported by `sim2real.runtime` and `cli`.
"""
