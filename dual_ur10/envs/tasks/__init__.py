"""Tasks as functions of `CellState`: scene requirements, reset, observation, reward and success.

Imports `kinematics`, `assets` and `sim2real.control`; a task knows neither simulation nor interface. One folder per
task; `task.py` holds what all of them share.
"""
