"""Cheats that are generic for any task with a script: none may succeed."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Final

import numpy as np

from dual_ur10.policies.evaluation.audit.episodes import (
    JOINTS,
    AuditEpisode,
    Behaviour,
    Change,
    RunningEpisode,
    hold,
    release,
    stage,
)
from ur_core.kinematics.ur10 import ARMS
from ur_core.types import Array

LATE_S: Final = 2.0
HELD_S: Final = 1.0
ONE_ARM: Final = "{} arm alone"
REPLAY: Final = "actions of another seed"


def cheats_of(stages: Sequence[str], script: AuditEpisode, *, quick: bool = False) -> dict[str, Behaviour]:
    """Return the cheats of a task by name.

    Args:
        stages: Names of its stages, or none.
        script: Episode of the script with another seed.
        quick: Fewer of them.
    """
    grippers = script.actions.shape[2] > JOINTS
    found: dict[str, Change] = {ONE_ARM.format(ARMS[arm]): alone(arm) for arm in (0, 1)}
    if grippers:
        found |= {"grippers open": gripping(1.0), "grippers closed": gripping(-1.0)}
    if grippers and not quick:
        found |= {f"{ARMS[arm]} gripper open": gripping(1.0, arm) for arm in (0, 1)}
    if not grippers or not quick:
        found["full speed"] = saturated
    found |= {"arms exchanged": exchanged, "both as the left arm": alike}
    found |= {f"{ARMS[arm]} arm {LATE_S:g} s late": late(arm) for arm in ((1,) if quick else (0, 1))}
    every = {name: Behaviour("cheat", change) for name, change in found.items()}
    every |= _stops(stages, script.steps, grippers=grippers, quick=quick)
    if grippers and not quick and len(stages) > 1 and "stage" in script.numbers:
        begun = int(np.argmax(script.numbers["stage"] >= len(stages) - 1))
        half_way = still(after((begun + script.steps) / 2), release)
        every[f"releases half-way to {stages[-1]}"] = Behaviour("cheat", half_way)
    if not quick:
        every["random, for 1 s each"] = Behaviour("cheat", held, scripted=False)
    return {**every, REPLAY: Behaviour("cheat", replay(script.actions), scripted=False)}


def _stops(stages: Sequence[str], steps: int, *, grippers: bool, quick: bool) -> dict[str, Behaviour]:
    """Return stops before each stage but the first, or after parts of the script's steps, and an early release.

    A script may be done with a task without stages some time before its episode ends: there a stop is no cheat.
    """
    places: Mapping[str, Callable[[RunningEpisode], bool]] = {
        f"before {stages[number]}": stage(number) for number in range(1, len(stages))
    }
    group = "cheat"
    if len(stages) < 2:
        places = {f"after {100 * share:g} %": after(share * steps) for share in (0.25, 0.5, 0.75)}
        group = "disturbed"
    text, over = list(places.items())[-1]
    if quick:  # what a stage earns that is held is computed, too
        places = {} if grippers else {text: over}
    found = {f"still {each}": Behaviour(group, still(place)) for each, place in places.items()}
    if grippers:
        found[f"releases {text}"] = Behaviour(group, still(over, release))
    return found


def alone(arm: int) -> Change:
    """Return a change by which the other arm keeps its place and its first gripper command."""

    def act(row: RunningEpisode) -> None:
        row.joints[1 - arm] = 0.0
        row.grippers[1 - arm] = row.memory.setdefault("kept", row.grippers[1 - arm].copy())

    return act


def gripping(command: float, arm: int | None = None) -> Change:
    """Return a change by which a gripper, or both, have one command for ever."""

    def act(row: RunningEpisode) -> None:
        row.grippers[slice(None) if arm is None else arm] = command

    return act


def exchanged(row: RunningEpisode) -> None:
    """Let each arm act as the other one should."""
    row.action[:] = row.action[::-1].copy()


def alike(row: RunningEpisode) -> None:
    """Let the right arm act as the left one should."""
    row.action[1] = row.action[0]


def saturated(row: RunningEpisode) -> None:
    """Move in the script's direction, at full speed."""
    row.joints[:] = np.sign(row.joints)


def late(arm: int) -> Change:
    """Return a change by which an arm acts late."""

    def act(row: RunningEpisode) -> None:
        due = row.memory.setdefault("due", [np.concatenate([np.zeros(len(row.joints[arm])), row.grippers[arm]])])
        if row.step == 0:
            due *= round(LATE_S / row.period_s)
        due.append(row.action[arm].copy())
        row.action[arm] = due[row.step]

    return act


def after(steps: float) -> Callable[[RunningEpisode], bool]:
    """Return the condition that a number of steps is over."""
    return lambda row: row.step >= steps


def still(over: Callable[[RunningEpisode], bool], then: Change = hold) -> Change:
    """Return a change that stops all joints from when a condition is first true, and keeps the grippers' commands."""

    def act(row: RunningEpisode) -> None:
        if "kept" not in row.memory and not over(row):
            row.memory["last"] = row.grippers.copy()
            return
        row.grippers[:] = row.memory.setdefault("kept", row.memory.get("last", row.grippers.copy()))
        then(row)

    return act


def replay(actions: Array) -> Change:
    """Return a change that repeats recorded actions, (k, 2, size), and then stops."""

    def act(row: RunningEpisode) -> None:
        row.action[:] = actions[min(row.step, len(actions) - 1)]
        if row.step >= len(actions):
            hold(row)

    return act


def held(row: RunningEpisode) -> None:
    """Act at random, with each action for some time."""
    if row.step % round(HELD_S / row.period_s) == 0:
        row.memory["held"] = row.rng.uniform(-1.0, 1.0, row.action.shape)
    row.action[:] = row.memory["held"]
