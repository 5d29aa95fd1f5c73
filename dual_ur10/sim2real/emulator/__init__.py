"""Emulated UR controllers: URScript, motion, safety, all ports, their MuJoCo world and fault injection.

Imports `sim2real.protocol`, `envs.sim` and `kinematics`. Nothing that moves real arms imports it.
"""
