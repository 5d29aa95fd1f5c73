"""Demonstrations: episodes that a person leads, keeps or throws away, and the dataset of those that were kept."""

from __future__ import annotations

import json
import re
import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Final

from dual_ur10.envs.core.options import MOVE_TO_START
from dual_ur10.errors import DatasetError, DualUR10Error
from dual_ur10.policies.evaluation.minari_export import to_minari
from dual_ur10.policies.evaluation.rollout import act
from dual_ur10.policies.operators.operator import Operator
from dual_ur10.policies.operators.takeover import Takeover
from dual_ur10.sim2real.recording.reader import read_run
from dual_ur10.sim2real.recording.run import Episode, Run
from dual_ur10.sim2real.recording.run_folder import RUN_FILE

KEPT: Final = "kept"
"""Kind of the event of a record that says which episode was kept, and whether it succeeded."""

_POLL_S: Final = 0.02
_BEGINS, _SUCCEEDS, _DISCARDS, _AGAIN = "record", "success", "discard", "reset"


@dataclass(frozen=True)
class Demonstration:
    """End of a demonstrated episode.

    Attributes:
        steps: Number of its steps.
        time_s: Length.
        kept: The person kept it, or the task succeeded.
        ended_by: Button or reason of the end.
    """

    steps: int
    time_s: float
    kept: bool
    ended_by: str


def demonstrate(
    env: Any,
    actor: Operator | Takeover,
    *,
    episodes: int,
    seed: int = 0,
    on_end: Callable[[Demonstration], None] = lambda demonstration: None,
    wait: Callable[[float], None] = time.sleep,
) -> None:
    """Let a person demonstrate in a recorded environment, until some episodes are kept.

    The button "record" begins an episode; on two controllers the arms then move to the start. "success" ends and keeps
    it. "discard" throws it away, and "reset" also begins the next one. One in which the task succeeds is kept, and one
    that ends otherwise is thrown away. The record has them all, and an event for each kept one from that instant on.

    Args:
        env: Environment with the keyword `record`.
        actor: Operator, or a policy that a person may take over.
        episodes: Number of episodes to keep.
        seed: Seed of the first episode; the others count on.
        on_end: Called after each episode.
        wait: Sleep between two readings of the device, while nothing moves.

    Raises:
        DeviceError: One of its kinds: the device is gone, silent, or not understood.
        DualUR10Error: The environment failed.
        Exception: As raised by the policy.
    """
    operator = actor.operator if isinstance(actor, Takeover) else actor
    kept, number, begins = 0, 0, False
    while kept < episodes:
        while not begins and _BEGINS not in operator.poll():
            wait(_POLL_S)
        found = _episode(env, actor, operator, seed + number)
        if found.kept:
            kept += 1
            env.unwrapped.core.note(KEPT, json.dumps({"episode": number, "success": True}))
        number, begins = number + 1, found.ended_by == _AGAIN
        on_end(found)


def _episode(env: Any, actor: Operator | Takeover, operator: Operator, seed: int) -> Demonstration:
    observation, _ = env.reset(seed=seed, options={MOVE_TO_START: True})
    actor.reset()
    core, steps = env.unwrapped.core, 0
    while True:
        action = act(actor, observation, env, env.action_space.dtype)
        pressed = next((each for each in (_DISCARDS, _AGAIN, _SUCCEEDS) if each in operator.buttons), "")
        if pressed and steps:
            core.finish()
            return Demonstration(steps, steps * core.timing.period_s, pressed == _SUCCEEDS, pressed)
        observation, _, terminated, truncated, info = env.step(action)
        steps += 1
        if terminated or truncated:
            reason = str(info.get("end_reason", ""))
            return Demonstration(steps, steps * core.timing.period_s, bool(info["is_success"]), reason)


def folder_of(root: Path, dataset_id: str) -> Path:
    """Return the folder of the runs of a dataset, in that of all runs."""
    return root / re.sub(r"[^A-Za-z0-9_.-]", "-", dataset_id)


def runs_in(root: Path) -> list[Path]:
    """Return the folders of the runs in a folder, in their order.

    A run without a byte is left out: the program was killed, or the disk was full, before anything was recorded.
    """
    files = sorted(root.glob(f"*/{RUN_FILE}"))
    return [each.parent for each in files if each.stat().st_size]


def kept_of(run: Run) -> Run:
    """Return a run with those of its episodes that a person kept."""
    states = [json.loads(event.text) for event in run.events if event.kind == KEPT]
    success = {each["episode"]: bool(each["success"]) for each in states}
    episodes: list[Episode] = [
        replace(each, success=success[each.number]) for each in run.episodes if each.number in success
    ]
    return replace(run, episodes=episodes)


def make_dataset(folder: Path, dataset_id: str, **about: str | None) -> Any:
    """Make a Minari dataset of all kept episodes of the runs in a folder, also of runs that were cut off.

    Args:
        folder: Folder of runs.
        dataset_id: Name in Minari's form; it must not exist.
        **about: As for `dual_ur10.policies.evaluation.minari_export.to_minari`.

    Returns:
        The `minari.MinariDataset`; None: nothing was kept.

    Raises:
        DatasetError: Minari refuses it, or the runs are of different environments.
        RecordingError: A run cannot be read.
    """
    runs = [run for each in runs_in(folder) if (run := kept_of(read_run(each, allow_partial=True))).episodes]
    if not runs:
        return None
    try:
        return to_minari(runs, dataset_id, **about)
    except DualUR10Error as error:
        raise DatasetError(f"{error}. What was kept is in {folder}") from error
