"""Grippers, object trackers and the object placer beside the controllers of a cell.

Imports `assets`, `sim2real.{config, links, protocol}`; imported by `sim2real.{commissioning, runtime}`.
"""
