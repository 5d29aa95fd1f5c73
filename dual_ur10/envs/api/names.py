"""The names by which environments are asked for: an id, or a part of it that says as much."""

from __future__ import annotations

from dual_ur10.errors import UnknownNameError
from dual_ur10.ids import ENV_IDS


def env_id_of(name: str) -> str:
    """The id that a name means: "Handover", "Handover-v0" and "DualUR10/Handover-v0" are the same.

    A name without a version means the newest.

    Raises:
        UnknownNameError: There is no such environment.
    """
    known = {short: env_id for env_id in ENV_IDS for short in (env_id, env_id.split("/")[1], task_name(env_id))}
    if name not in known:
        raise UnknownNameError("environment", str(name), list(ENV_IDS))
    return known[name]


def task_name(name: str) -> str:
    """The name of the task in an id or a part of it, whether or not there is such a task."""
    return name.split("/")[-1].rsplit("-v", 1)[0]
