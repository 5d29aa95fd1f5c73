"""Grippers, object trackers and the object placer beside the controllers of a cell.

A fault of one is reported, never mended in silence.
"""
