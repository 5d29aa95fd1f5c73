"""From an action to released servoj targets: servoj law, path, limits, adapter, clearance and safety gate.

Pure functions of their inputs: no clock, no I/O. All motion of arms, simulated or real, goes through it.
"""
