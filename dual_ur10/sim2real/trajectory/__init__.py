"""Joint trajectories of one arm or both, and goals that follow them.

Trajectories, interpolation, timing, reduction, files, and the executor of goals on any `Cell`. Imports `control` and
`config`, and no clock or connection. Imported by `runtime`, `envs` and `cli`.
"""
