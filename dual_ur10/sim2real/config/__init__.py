"""The `Cell` protocol, its state and configuration, and the cell file.

Imports `kinematics`, `assets` and `sim2real.control`. Reads and writes files; opens no connections.
"""
