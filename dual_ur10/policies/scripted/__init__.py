"""Scripted policies, one file per task, and the motion primitives that they share.

Imports `envs.tasks`, `kinematics` and `sim2real.control`. A scripted policy acts from observations only.
"""
