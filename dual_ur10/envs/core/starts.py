"""Starts of episodes after some stages: states that the scripted policy has passed through, at rest."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any, Final, NamedTuple

import numpy as np

from dual_ur10.envs.core.setup import EnvSetup
from dual_ur10.sim2real.cell.cell import Start
from ur_core.objects import load_object
from ur_core.types import Array, Rows

if TYPE_CHECKING:
    from dual_ur10.envs.tasks.staged import StagedTask

SCRIPT_STATES: Final = "dual_ur10.policies.evaluation.script_states:script_states"
"""Function that gathers the states. It loads only for an environment with `starts`."""


class ScriptStates(NamedTuple):
    """States of m instants of successful episodes of the scripted policy.

    Attributes:
        seeds: (m,) seeds of the generators with which the task began these episodes.
        passed: (m,) number of stages passed.
        q_rad: (m, 2, 6) joint positions.
        gripper_m: (m, 2) width of each gripper; `commanded_m`: that commanded.
        objects: Poses of the props by their names, (m, 7) each.
        joints: Positions of the props' joints by their names, (m,) each.
        begin_objects, begin_joints: The same at the begin of one episode, (7,) and (): where a task leaves out a prop
            or a joint, it begins there in every episode.
    """

    seeds: Rows
    passed: Rows
    q_rad: Array
    gripper_m: Array
    commanded_m: Array
    objects: Mapping[str, Array]
    joints: Mapping[str, Array]
    begin_objects: Mapping[str, Array]
    begin_joints: Mapping[str, Array]


class MixedStarts:
    """Starts of which given ratios are states of the scripted policy.

    Args:
        setup: The environment, whose options have `starts`.

    Raises:
        SettingsError: The task has no scripted policy, or it does not pass a stage in time.
    """

    def __init__(self, setup: EnvSetup) -> None:
        starts = setup.options.starts or {}
        stages = [setup.task_type.stages.index(name) + 1 for name in starts]
        self._most = np.cumsum(list(starts.values()))
        gather: Any = load_object(SCRIPT_STATES, "the states of the scripted policy", registered=True)
        self.states: ScriptStates = gather(setup, stages)
        self._of_stage = [np.flatnonzero(self.states.passed == number) for number in stages]

    def _draw(self, rng: np.random.Generator) -> int:
        """Return the index of a state, or -1 for the normal start."""
        kind = int(np.searchsorted(self._most, rng.random(), side="right"))
        return -1 if kind == len(self._of_stage) else int(rng.choice(self._of_stage[kind]))

    def begin(self, task: StagedTask[Any, Any, Any], rows: Rows, rngs: Sequence[np.random.Generator]) -> Start:
        """Begin episodes in `rows`, as `Task.start` does, some of them after a stage."""
        chosen, states = np.array([self._draw(rng) for rng in rngs]), self.states
        # A task begins the same episode with an equal generator, that of the script's episode here.
        begun = [
            rng if index < 0 else np.random.default_rng(int(states.seeds[index]))
            for rng, index in zip(rngs, chosen.tolist(), strict=True)
        ]
        start, held = task.start(rows, begun), np.flatnonzero(chosen >= 0)
        if not held.size:
            return start
        of = chosen[held]
        task.skip(rows[held], states.passed[of])

        def replaced(values: Array, found: Array) -> Array:
            both = np.array(values)
            both[held] = found[of]
            return both

        def by_name(
            given: Mapping[str, Array], begin: Mapping[str, Array], found: Mapping[str, Array]
        ) -> dict[str, Array]:
            usual = {name: np.tile(value, (len(rows), *[1] * value.ndim)) for name, value in begin.items()}
            return {name: replaced(given.get(name, usual[name]), values) for name, values in found.items()}

        grippers = start.gripper_m
        return start._replace(
            q_rad=replaced(start.q_rad, states.q_rad),
            gripper_m=None if grippers is None else replaced(grippers, states.gripper_m),
            commanded_m=None if grippers is None else replaced(grippers, states.commanded_m),
            objects=by_name(start.objects, states.begin_objects, states.objects),
            joints=by_name(start.joints, states.begin_joints, states.joints),
            payload_kg=task.declared_kg[rows],
        )
