"""Tasks, the simulated cell, and the environments that combine them.

    from dual_ur10.envs import aec_env, dm_env, parallel_env

    env = parallel_env("SineTracking", reward="individual", max_cycles=100)

These three take the name of a task or an id, and load MuJoCo only when called. Their classes are in the modules of the
same names (`from dual_ur10.envs.api.parallel_env import DualArmParallelEnv`).
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from dual_ur10.envs.api.parallel_env import aec_env, parallel_env

if TYPE_CHECKING:
    from dual_ur10.envs.api.dm_env import dm_env

__all__ = ["aec_env", "dm_env", "parallel_env"]


def __getattr__(name: str) -> Any:
    if name == "dm_env":  # it needs the extra `dm`
        from dual_ur10.envs.api.dm_env import dm_env

        return dm_env
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")


def __dir__() -> list[str]:
    return sorted(__all__)
