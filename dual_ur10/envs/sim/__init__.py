"""The simulated cell: MuJoCo physics in batches, behind the servoj law.

Imports `assets` and `sim2real.{config, control}`. Imported by `envs.core` and, for its physics, by the emulator.
"""
