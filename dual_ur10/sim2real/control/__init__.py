"""From an action to released servoj targets: servoj law, path, limits, adapter, clearance and safety gate.

Pure functions of their inputs: no clock, no I/O. Imports `kinematics` and `assets`; imported by all code that moves
arms, simulated or real.
"""
