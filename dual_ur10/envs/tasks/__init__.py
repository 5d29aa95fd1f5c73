"""Tasks as functions of `CellState`: scene requirements, reset, observation, reward and success.

A task depends on neither simulation nor interface. Each task has one folder; `task.py` defines the interface of all
tasks.
"""
