"""Learned policies that come with the package: checkpoints, each with a card that says how it was made.

<task>/policy.safetensors, manifest.json   the checkpoint; see `dual_ur10.policies.learned.checkpoint`
<task>/card.md, curve.png                  command, seed, time, evaluations; learning curve
"""

from __future__ import annotations

from importlib.resources import files
from pathlib import Path
from typing import Final

from dual_ur10.errors import UnknownNameError
from dual_ur10.ids import env_id_of, task_name

NAMES: Final = ("learned", "learned-two-agents")
"""Names of shipped policies: one network for both arms; networks that each see what one arm observes."""

_FOLDERS: Final = {
    "learned": {"SineTracking": "sine_tracking", "SyncCarry": "sync_carry", "Handover": "handover"},
    "learned-two-agents": {"SineTracking": "sine_tracking_two_agents"},
}


def folder_of(name: str, env_id: str) -> Path:
    """Folder of the checkpoint of a shipped policy.

    Raises:
        UnknownNameError: There is none of this name for this environment.
    """
    task = task_name(env_id_of(env_id))
    folder = _FOLDERS.get(name, {}).get(task)
    if folder is None:
        raise UnknownNameError(f"learned policy for {task}", name, names_of(env_id))
    return Path(str(files("dual_ur10.policies.learned") / "learned_policies" / folder))


def names_of(env_id: str) -> list[str]:
    """Names of the shipped policies for an environment."""
    task = task_name(env_id_of(env_id))
    return [name for name, folders in _FOLDERS.items() if task in folders]
