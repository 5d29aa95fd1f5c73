"""Registration of the environments with Gymnasium and PettingZoo, done when `dual_ur10` is imported."""

from __future__ import annotations

import re

import pettingzoo  # type: ignore[import-untyped]  # has no types
from gymnasium.envs.registration import register, registry

from dual_ur10.errors import SettingsError
from dual_ur10.ids import ENTRY_POINTS, task_name


def register_task(env_id: str, entry_point: str) -> None:
    """Register a task of your own with every interface: Gymnasium, its vector API, and PettingZoo.

    The name in the id is the task's `name`. Call it where your package is imported.

    Args:
        env_id: New id, "Namespace/Name-vN".
        entry_point: The subclass of `dual_ur10.envs.tasks.task.Task`, "module:class".

    Raises:
        SettingsError: The id or the entry point has another form, or another task has the id or name.
    """
    if re.fullmatch(r"\w+/\w+-v\d+", env_id) is None or re.fullmatch(r"[\w.]+:\w+", entry_point) is None:
        raise SettingsError(f'{env_id!r} as {entry_point!r}: expected "Namespace/Name-vN" and "module:class"')
    others = {task_name(each) for each, known in ENTRY_POINTS.items() if (each, known) != (env_id, entry_point)}
    if task_name(env_id) in others:
        raise SettingsError(f"{env_id!r}: another task has the name {task_name(env_id)!r}. Choose a different one")
    ENTRY_POINTS[env_id] = entry_point
    _register(env_id)


def _register(env_id: str) -> None:
    if env_id not in registry:
        register(
            env_id,
            entry_point="dual_ur10.envs.api.dual_arm_env:DualArmEnv",
            vector_entry_point="dual_ur10.envs.api.vector_env:DualArmVectorEnv",
            kwargs={"task": task_name(env_id)},
        )
    # PettingZoo's registries warn of an id that they know.
    if env_id not in pettingzoo.parallel_registry:
        pettingzoo.register("parallel", env_id, "dual_ur10.envs:parallel_env", kwargs={"task": env_id})
    if env_id not in pettingzoo.aec_registry:
        pettingzoo.register("aec", env_id, "dual_ur10.envs:aec_env", kwargs={"task": env_id})


for _id in ENTRY_POINTS:
    _register(_id)
