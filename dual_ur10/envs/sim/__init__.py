"""The simulated cell: the servoj law and MuJoCo physics, in batches.

Imports `assets` and `sim2real.{config, control}`. Imported by `envs.core` and, for its physics, by `ur_emulator`.
"""
