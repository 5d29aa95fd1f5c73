"""Probes of an audit: numbers of the action that change nothing, and randomization that changes nothing."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Iterator, Mapping
from contextlib import AbstractContextManager
from typing import Any, Final

import numpy as np

from dual_ur10.envs.api.vector_env import DualArmVectorEnv
from dual_ur10.errors import SettingsError
from dual_ur10.policies.evaluation.audit.episodes import JOINTS, AuditEpisode
from dual_ur10.policies.evaluation.audit.report import AuditFinding
from ur_core.kinematics.ur10 import ARMS
from ur_core.tools.tool import strokes_m
from ur_core.types import Array

MakeEnv = Callable[..., AbstractContextManager[DualArmVectorEnv]]

_STEPS: Final = 4
_LEAST: Final = 1e-6  # a change, in the units of what changes
_SEEDS: Final = 4
_SPREAD: Final = 1.5
_BEYOND_M: Final = 0.002  # of a closed gripper's command beyond its width, above which it holds something


def on_actions(make: MakeEnv, seed: int, script: AuditEpisode | None) -> Iterator[AuditFinding]:
    """Find numbers of the action that change neither the observation nor the state of the simulation.

    Rows of one seed begin alike, to the bit, and act with zeros. In each row another number is changed, up or down. The
    arms stand, because the adapter scales the motions of both together.

    Args:
        make: Function from a number of rows and keywords to a vector environment.
        seed: Seed of the episode.
        script: Episode of the script; None: there is none.
    """
    with make(1) as env:
        size = env.core.action_space.shape[0]
    rows = 1 + 2 * size
    with make(rows) as env:
        env.reset(seed=[seed] * rows)
        action = np.zeros((_STEPS, rows, size))
        for number in range(size):
            action[:-1, 1 + number, number], action[:-1, 1 + size + number, number] = 1.0, -1.0
        moved, shown = np.zeros(rows, dtype=bool), np.zeros(rows, dtype=bool)
        for each in action:
            observation = env.step(each.astype(np.float32))[0]
            state = np.array([env.core.cell_data(row)[1].qpos.copy() for row in range(rows)])
            shown |= np.abs(observation - observation[0]).max(axis=1) > _LEAST
            moved |= np.abs(state - state[0]).max(axis=1) > _LEAST
    for number in range(size):
        both = [1 + number, 1 + size + number]
        if moved[both].any() and shown[both].any():
            continue
        arm, place = divmod(number, size // 2)
        blind = bool(moved[both].any())
        yield AuditFinding(
            severity="warning" if blind else "error",
            rule="actions",
            subject=f"{ARMS[arm]} {f'number {place}' if place < JOINTS else 'gripper'}",
            found="it moves something, and no number of the observation changes" if blind else "it moves nothing",
            limit=f"a change within {_STEPS} steps",
            remedy="Observe what it moves" if blind else "Leave what it would move out of the task, or let it move",
        )
    if script is not None:
        yield from _on_closed(make, script)


def _on_closed(make: MakeEnv, script: AuditEpisode) -> Iterator[AuditFinding]:
    """Note how far the script closes grippers beyond what they hold: so much of their travel changes no width."""
    with make(1) as env:
        strokes, layout = strokes_m(env.core.config.equipment.tools), env.core.task.layout
    if "gripper_m" not in layout.names or script.actions.shape[2] <= JOINTS:
        return
    width_m = layout.split(script.observations[1:])["gripper_m"][..., 0]
    for arm, stroke_m in enumerate(strokes):
        command = script.actions[:, arm, JOINTS]
        beyond_m = width_m[:, arm] - stroke_m * (command + 1.0) / 2.0
        still = np.abs(np.gradient(width_m[:, arm])) < 1e-4 if script.steps > 1 else np.zeros(1, dtype=bool)
        held = still & (command < 1.0) & (beyond_m > _BEYOND_M)
        if held.sum() > _STEPS:
            yield AuditFinding(
                severity="note",
                rule="actions",
                subject=f"{ARMS[arm]} gripper",
                found=f"while it holds, {100 * float(np.median(beyond_m[held])) / stroke_m:.0f} % of its travel lie "
                "behind the contact and change no width",
            )


def on_randomization(make: MakeEnv, seed: int) -> tuple[list[AuditFinding], Array]:
    """Find ranges and presets that change nothing; return also first observations of some seeds, (n, size).

    Args:
        make: Function from a number of rows and keywords to a vector environment.
        seed: First seed.
    """
    alone, task = _begun(make, seed)
    first: Array = alone[:, 0]
    settings = task.settings
    known = {each.name for each in dataclasses.fields(settings)} if dataclasses.is_dataclass(settings) else set()
    ranges = {name: getattr(settings, name) for name in dict.fromkeys((*task.sampled, *task.ranges)) if name in known}
    wide = {name: value for name, value in ranges.items() if value}
    found = [*_on_ranges(make, seed, alone, wide)]
    if np.ptp(first, axis=0).max() == 0.0:
        text = ", ".join(f"{name}={value:g}" for name, value in wide.items())
        found.append(
            AuditFinding(
                severity="error" if wide else "note",
                rule="randomization",
                subject="start",
                found=f"{_SEEDS} seeds begin alike" + (f", with {text}" if wide else ""),
                limit="they differ" if wide else "",
                remedy="Sample from the generators that `start` gets" if wide else "",
            )
        )
    for preset in ("mild", "wide"):
        if np.array_equal(_begun(make, seed, randomization=preset)[0], alone):
            found.append(
                AuditFinding(
                    severity="error",
                    rule="randomization",
                    subject=preset,
                    found=f"the observations of {_STEPS} steps equal those without randomization",
                    limit="they differ",
                    remedy="Observe the state that `observe` gets",
                )
            )
    widened = [name for name in task.ranges if name in wide]
    spread = {"object_spread": _SPREAD}
    if widened and "start" not in {each.subject for each in found}:
        if np.array_equal(_begun(make, seed, randomization=spread)[0][:, 0], first):
            found.append(
                AuditFinding(
                    severity="warning",
                    rule="randomization",
                    subject="object_spread",
                    found=f"a factor of {_SPREAD:g} on {', '.join(widened)} changes no start",
                    limit="a change",
                    remedy="Use these settings in `start`",
                )
            )
    elif not widened:
        found.append(
            AuditFinding(
                severity="note",
                rule="randomization",
                subject="object_spread",
                found="it widens nothing: none of the task's `ranges` is a setting above 0",
            )
        )
    return found, first


def _on_ranges(make: MakeEnv, seed: int, alone: Array, ranges: Mapping[str, Any]) -> Iterator[AuditFinding]:
    """Find settings that bound what is sampled, and without which the same episodes begin."""
    for name in ranges:
        try:
            without = _begun(make, seed, **{name: 0.0})[0]
        except SettingsError:
            continue  # the task refuses 0
        if np.array_equal(without, alone):
            yield AuditFinding(
                severity="warning",
                rule="randomization",
                subject=name,
                found=f"{name}=0 begins the same episodes as {name}={ranges[name]:g}",
                limit="a change",
                remedy="Use it in `start`, or remove it",
            )


def _begun(make: MakeEnv, seed: int, **keywords: Any) -> tuple[Array, Any]:
    """Return the first observations of some episodes with zero actions, (seeds, steps + 1, size), and their task."""
    with make(_SEEDS, **keywords) as env:
        seen = [env.reset(seed=seed)[0]]
        for _ in range(_STEPS):
            seen.append(env.step(np.zeros((_SEEDS, *env.core.action_space.shape), dtype=np.float32))[0])
        return np.stack(seen, axis=1), env.core.task
