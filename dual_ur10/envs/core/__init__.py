"""The stepping core of all environments: set-up from keywords, the loop, sensing and randomization.

Imports `envs.tasks`, `envs.sim` and `sim2real`. Every interface in `envs.api` is a view of its `Core`.
"""
