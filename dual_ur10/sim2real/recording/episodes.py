"""Decoding and checks of the episodes of a record."""

from __future__ import annotations

from itertools import pairwise
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from dual_ur10.errors import RecordingError
from dual_ur10.sim2real.recording.run import LATE, Episode
from dual_ur10.sim2real.recording.schemas import BEGIN, EPISODE_TOPIC, STEP, STEP_TOPIC
from ur_core.kinematics.ur10 import ARMS

_SEED_DIGITS: Final = 100
_MOST_NUMBER: Final = 2**52
_FINITE: Final = ("time_s", "reward", "q_rad", "flange_m", "action", "targets_rad", "gripper_m")


def read_episodes(begins: list[bytes], steps: list[bytes], ticks: int, *, from_within: bool) -> list[Episode]:
    """Return all episodes of a run.

    Args:
        begins: Messages of `EPISODE_TOPIC`.
        steps: Messages of `STEP_TOPIC`.
        ticks: Control periods per step.
        from_within: Allow the first episode to lack its first steps, as in a black box.

    Raises:
        RecordingError: A message is not legal, or does not follow the one before.
    """
    heads = [_begin(row, data, from_within=from_within) for row, data in enumerate(begins)]
    for row, (before, after) in enumerate(pairwise(heads), 1):
        if after["number"] != before["number"] + 1 or after["begin_s"] < before["begin_s"]:
            raise RecordingError(f"{EPISODE_TOPIC}, row {row}: it does not follow the episode before")
    members: dict[int, list[dict[str, Any]]] = {head["number"]: [] for head in heads}
    for row, data in enumerate(steps):
        step = _step(row, data, ticks)
        own = members.get(step["episode"])
        if own is None:
            raise RecordingError(f"{STEP_TOPIC}, row {row}: there is no episode {step['episode']}")
        own.append(step | {"row": row})
    return [_episode(head, members[head["number"]], ticks) for head in heads]


def _begin(row: int, data: bytes, *, from_within: bool) -> dict[str, Any]:
    head = BEGIN.decode(data)
    what = f"{EPISODE_TOPIC}, row {row}"
    if not (np.isfinite(head["q_rad"]).all() and np.isfinite(head["flange_m"]).all() and np.isfinite(head["begin_s"])):
        raise RecordingError(f"{what}: some numbers are not finite")
    seed = head["seed"]
    if seed and not (seed.isascii() and seed.isdigit() and len(seed) <= _SEED_DIGITS):
        raise RecordingError(f"{what}: the seed {seed[:40]!r} is no whole number, 0 or above")
    if head["number"] < 0 or head["first_step"] < 0 or (not from_within and head["first_step"]):
        raise RecordingError(f"{what}: episode {head['number']} begins with step {head['first_step']}")
    return head


def _step(row: int, data: bytes, ticks: int) -> dict[str, Any]:
    step, what = STEP.decode(data), f"{STEP_TOPIC}, row {row}"
    for name in _FINITE:
        if not np.isfinite(step[name]).all():
            raise RecordingError(f"{what}: {name} is not finite")
    if step["targets_rad"].size != ticks * 12:
        raise RecordingError(
            f"{what}: there are {step['targets_rad'].size} numbers of targets, {ticks * 12} belong to {ticks} ticks"
        )
    if step["gripper_m"].size not in (0, ticks * 2):
        raise RecordingError(
            f"{what}: there are {step['gripper_m'].size} gripper widths, {ticks * 2} belong to {ticks} ticks"
        )
    if step["success"] not in (-1, 0, 1):
        raise RecordingError(f"{what}: success is {step['success']}")
    if not LATE <= step["first_target"] <= _MOST_NUMBER:
        raise RecordingError(f"{what}: first_target is {step['first_target']}")
    return step


def _episode(head: dict[str, Any], steps: list[dict[str, Any]], ticks: int) -> Episode:
    first = head["first_step"]
    time_s, target = -np.inf, -1
    for number, step in enumerate(steps, first):
        what = f"{STEP_TOPIC}, row {step['row']}"
        if step["step"] != number:
            raise RecordingError(f"{what}: it is step {step['step']} of its episode where {number} is expected")
        if not step["time_s"] > time_s:
            raise RecordingError(f"{what}: time_s goes from {time_s:.6f} to {step['time_s']:.6f}")
        time_s = step["time_s"]
        if 0 <= step["first_target"] < target:
            raise RecordingError(f"{what}: first_target is {step['first_target']}, within those of the step before")
        target = step["first_target"] + ticks if step["first_target"] >= 0 else target
        for name in ("action", "gripper_m", "observation"):
            size = head[name].size if name == "observation" else steps[0][name].size
            if step[name].size != size:
                raise RecordingError(f"{what}: {name} has {step[name].size} numbers where those before have {size}")
    last: dict[str, Any] = steps[-1] if steps else {"success": -1, "ended_by": ""}

    def all_of(name: str, *shape: int, dtype: type[Any] = np.float64, begin: bool = False) -> NDArray[Any]:
        values = [head[name]] if begin else []
        return np.array([*values, *(step[name] for step in steps)], dtype=dtype).reshape(-1, *shape)

    width = steps[0]["action"].size if steps else 0
    return Episode(
        seed=int(head["seed"]) if head["seed"] else None,
        number=head["number"],
        begin_s=head["begin_s"],
        action=all_of("action", width) if width else np.zeros((len(steps), 0)),
        targets_rad=all_of("targets_rad", ticks, 2, 6),
        gripper_m=all_of("gripper_m", ticks, 2) if steps and steps[0]["gripper_m"].size else None,
        gated=all_of("gated", dtype=np.bool_),
        reward=all_of("reward"),
        terminated=all_of("terminated", dtype=np.bool_),
        truncated=all_of("truncated", dtype=np.bool_),
        success=None if last["success"] < 0 else bool(last["success"]),
        ended_by=last["ended_by"],
        observation=all_of("observation", head["observation"].size, begin=True) if head["observation"].size else None,
        time_s=all_of("time_s"),
        q_rad=all_of("q_rad", 2, 6, begin=True),
        flange_m=all_of("flange_m", 2, 3, begin=True),
        initial_state=head["initial_state"] or None,
        first_target=all_of("first_target", dtype=np.int64),
        commander=np.stack([all_of(f"{arm}_by_person", dtype=np.bool_) for arm in ARMS], axis=1),
        first_step=first,
    )
