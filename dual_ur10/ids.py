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
    """Return the full id of an environment, under which everything that belongs to it is kept.

    The namespace, the version or both may be left out: "Handover", "Handover-v0" and "DualUR10/Handover-v0" are the
    same. A name without a namespace means the task of this package, if it has one. A name without a version means the
    newest.

    Raises:
        UnknownNameError: There is no such environment, or several namespaces other than that of this package have it.
    """
    if name in ENTRY_POINTS:
        return name
    fitting = [env_id for env_id in ENTRY_POINTS if name in _short_forms(env_id)]
    fitting = [env_id for env_id in fitting if env_id in ENV_IDS] or fitting
    if len({env_id.split("/")[0] for env_id in fitting}) != 1:
        raise UnknownNameError("environment", str(name), fitting or list(ENTRY_POINTS))
    return max(fitting, key=lambda env_id: int(env_id.rsplit("-v", 1)[1]))


def _short_forms(env_id: str) -> tuple[str, str, str]:
    versioned, unversioned = env_id.split("/")[1], env_id.rsplit("-v", 1)[0]
    return versioned, unversioned, unversioned.split("/")[1]
