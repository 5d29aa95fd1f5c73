"""Version of the package, ids of the registered environments, and their shorter names."""

from __future__ import annotations

from typing import Final

from dual_ur10.errors import UnknownNameError

__version__ = "0.1.0"

ENTRY_POINTS: Final = {
    "DualUR10/SineTracking-v0": "dual_ur10.envs.tasks.sine_tracking.task:SineTracking",
    "DualUR10/SyncCarry-v0": "dual_ur10.envs.tasks.sync_carry.task:SyncCarry",
    "DualUR10/Handover-v0": "dual_ur10.envs.tasks.handover.task:Handover",
}
"""Task class of each id, as "module:class"; `dual_ur10.registration.register_task` adds to them."""

ENV_IDS: Final = tuple(ENTRY_POINTS)
"""Ids of this package. An id is a promise: any change of results gets a new version."""


def env_id_of(name: str) -> str:
    """Return the id of an environment: "Handover", "Handover-v0" and "DualUR10/Handover-v0" are the same.

    A name without a version means the newest.

    Raises:
        UnknownNameError: There is no such environment.
    """
    known = {short: env_id for env_id in ENTRY_POINTS for short in (env_id, env_id.split("/")[1], task_name(env_id))}
    if name not in known:
        raise UnknownNameError("environment", str(name), list(ENTRY_POINTS))
    return known[name]


def task_name(name: str) -> str:
    """Return the task's name from an id or a part of one, whether or not such a task exists."""
    return name.split("/")[-1].rsplit("-v", 1)[0]
