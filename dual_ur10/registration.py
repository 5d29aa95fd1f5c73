"""Registration of the environments with Gymnasium and PettingZoo, done when `dual_ur10` is imported."""

from __future__ import annotations

import re

import pettingzoo  # type: ignore[import-untyped]  # has no types
from gymnasium.envs.registration import register, registry

from dual_ur10.errors import SettingsError
from dual_ur10.ids import ENTRY_POINTS


def register_task(env_id: str, entry_point: str) -> None:
    """Register a task of your own with every interface: Gymnasium, its vector API, and PettingZoo.

    Call it where your package is imported. Versions of a task are tasks of their own: "MyLab/Reach-v1" may have another
    class than "MyLab/Reach-v0" beside it, and records, checkpoints and policies belong to one of them.

    Args:
        env_id: New id, "Namespace/Name-vN".
        entry_point: The subclass of `dual_ur10.envs.tasks.task.Task`, "module:class".

    Raises:
        SettingsError: The id or the entry point has another form, or another task has the id.
    """
    if re.fullmatch(r"\w+/\w+-v(0|[1-9][0-9]*)", env_id) is None or re.fullmatch(r"[\w.]+:\w+", entry_point) is None:
        raise SettingsError(f'{env_id!r} as {entry_point!r}: expected "Namespace/Name-vN" and "module:class"')
    known = ENTRY_POINTS.setdefault(env_id, entry_point)
    if known != entry_point:
        raise SettingsError(f"{env_id!r} is {known!r}, and cannot be {entry_point!r}: register a new version")
    _register(env_id)


def _register(env_id: str) -> None:
    if env_id not in registry:
        register(
            env_id,
            entry_point="dual_ur10.envs.api.dual_arm_env:DualArmEnv",
            vector_entry_point="dual_ur10.envs.api.vector_env:DualArmVectorEnv",
            kwargs={"task": env_id},
        )
    # PettingZoo's registries warn of an id that they know.
    if env_id not in pettingzoo.parallel_registry:
        pettingzoo.register("parallel", env_id, "dual_ur10.envs:parallel_env", kwargs={"task": env_id})
    if env_id not in pettingzoo.aec_registry:
        pettingzoo.register("aec", env_id, "dual_ur10.envs:aec_env", kwargs={"task": env_id})


for _id in ENTRY_POINTS:
    _register(_id)
