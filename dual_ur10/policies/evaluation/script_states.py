"""States of the scripted policy between two stages of its task, from which other episodes may begin."""

from __future__ import annotations

import dataclasses
from collections.abc import Collection
from typing import Any, Final

import numpy as np

from dual_ur10.envs.core.core import Core
from dual_ur10.envs.core.setup import EnvSetup
from dual_ur10.envs.core.starts import ScriptStates
from dual_ur10.errors import SettingsError
from dual_ur10.policies.registry import load, scripts_of
from ur_core.types import Array

EPISODES: Final = 8

FIRST_SEED: Final = 900_000_000
"""Seed of the first of these episodes; no evaluation, check or training uses it."""


def script_states(setup: EnvSetup, stages: Collection[int]) -> ScriptStates:
    """Run the scripted policy of an environment, and return its states after some stages and before the next ones.

    It acts on nominal plants, by steps of the joints, whatever the environment's actions are. Only episodes that end
    with success count.

    Args:
        setup: The environment.
        stages: Numbers of stages that are passed.

    Raises:
        SettingsError: The task has no scripted policy, or no episode with success has such a state.
    """
    if not scripts_of(setup.env_id):
        raise SettingsError(
            f"{setup.env_id} has no scripted policy, from whose states episodes could begin: leave starts out, or "
            "register one for the task"
        )
    own = {each.name: getattr(setup.settings, each.name) for each in dataclasses.fields(setup.settings)}
    keywords = {"cell": setup.options.cell, "robot": setup.options.robot, **own}
    policy, core = load("scripted", setup.env_id, **keywords), Core(setup.env_id, keywords, n=EPISODES)
    try:
        found, begin = _gathered(core, policy, stages)
    finally:
        core.close()
    for number in stages:
        if not any(each["passed"] == number for each in found):
            name = setup.task_type.stages[number - 1]
            raise SettingsError(
                f"no episode of the scripted policy of {setup.env_id} has a state between the stage {name!r} and the "
                f"next one and ends with success, of {EPISODES}: leave {name!r} out of starts"
            )

    def column(name: str) -> Any:
        return np.array([each[name] for each in found])

    def by_name(kind: str) -> dict[str, Array]:
        return {name: np.array([each[kind][name] for each in found]) for name in begin[kind]}

    return ScriptStates(
        column("seed"),
        column("passed"),
        column("q_rad"),
        column("gripper_m"),
        column("commanded_m"),
        by_name("objects"),
        by_name("joints"),
        begin["objects"],
        begin["joints"],
    )


def _gathered(core: Core, policy: Any, stages: Collection[int]) -> tuple[list[dict[str, Any]], dict[str, Any]]:
    """Return the states of all cells, and the first one of the first cell."""
    seeds = [FIRST_SEED + row for row in range(core.n)]
    observation, _ = core.reset([np.random.default_rng(seed) for seed in seeds])
    policy.reset()
    begin, kept = _state(core, 0), [list[dict[str, Any]]() for _ in seeds]
    live, found = np.ones(core.n, dtype=bool), list[dict[str, Any]]()
    for _ in range(core.task.horizon or 0):
        step = core.step(policy(observation))
        observation, passed, over = step.observation, step.info["stage"], step.terminated | step.truncated
        for row in np.flatnonzero(live & ~over & np.isin(passed, [*stages])).tolist():
            kept[row].append({"seed": seeds[row], "passed": int(passed[row]), **_state(core, row)})
        for row in np.flatnonzero(live & over & step.info["is_success"]).tolist():
            found += kept[row]
        live &= ~over
        if not live.any():
            break
    return found, begin


def _state(core: Core, row: int) -> dict[str, Any]:
    """Return the present state of one cell."""
    state = core.state
    return {
        "q_rad": state.q_rad[row].copy(),
        "gripper_m": np.zeros(2) if state.gripper_m is None else state.gripper_m[row].copy(),
        "commanded_m": core.pipeline.commanded_widths_m[row],
        "objects": {name: np.concatenate([pose[0][row], pose[1][row]]) for name, pose in state.objects.items()},
        "joints": {name: np.array(value[row]) for name, value in state.joints.items()},
    }
