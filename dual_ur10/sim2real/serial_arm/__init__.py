"""Arm whose controller is a microcontroller on a serial line: protocol, line, arm, and an emulated firmware.

It has no feedback and no servo targets, and shares nothing with UR's controllers but the trajectories that it follows.
"""
