"""Grippers and object trackers beside the controllers of a cell.

Imports `sim2real.{config, links}`; imported by `sim2real.runtime`.
"""
