"""The simulated cell: the servoj law and MuJoCo physics, in batches.

It knows of no task, and has no clock but that of the simulation.
"""
