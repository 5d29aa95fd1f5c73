"""The stepping core of all environments: set-up from keywords, the loop, sensing and randomization.

Every interface in `envs.api` is a view of its `Core`. A cell of controllers is loaded by its name, never imported.
"""
