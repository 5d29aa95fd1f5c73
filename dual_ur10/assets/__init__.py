"""MuJoCo models: arm, tools, props, obstacles, the scene composed of them, and the collision model of the gate.

Imports `kinematics` only. Imported by `sim2real` (clearance, scene settings) and `envs` (simulation, rendering).
"""
