"""Adapter that forwards the resets and steps of an environment's stepping core to a recorder."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from typing import Any, Protocol, runtime_checkable

import numpy as np

from dual_ur10.sim2real.cell.cell import CellState, CellStep
from dual_ur10.sim2real.control.adapter import Command
from dual_ur10.sim2real.recording.header import plain
from dual_ur10.sim2real.recording.rows import BeginRow, RunRecorder, StepRow
from dual_ur10.sim2real.recording.run import LATE
from ur_core.types import Array, Mask


@runtime_checkable
class RecordedCell(Protocol):
    """A cell that can keep a trace of its steps, and save the state of its simulation."""

    def record(self) -> None:
        """Keep the trace from now on."""

    def integration_state(self) -> bytes | None:
        """Return the full state of the simulation; None for real arms."""


class RecordHook:
    """Adapter between the stepping core of one cell and a recorder.

    Args:
        recorder: The recorder.
        cell: The recorded cell.
    """

    def __init__(self, recorder: RunRecorder, cell: object) -> None:
        self.recorder = recorder
        self._cell = cell if isinstance(cell, RecordedCell) else None
        if self._cell is not None:
            self._cell.record()
        self._rng = ""
        self._seed: int | None = None
        self._step = 0

    @property
    def failure(self) -> str:
        """Reason why something was not recorded; empty: none."""
        return self.recorder.failure

    def event(self, kind: str, text: str) -> None:
        """Record an event that happens now."""
        self.recorder.event(kind, text)

    def close(self) -> None:
        """End the record. May be called twice."""
        self.recorder.close()

    def resetting(self, rngs: Sequence[np.random.Generator], seed: int | None) -> None:
        """Keep the state of the generator before a reset samples from it."""
        self._seed, self._step = seed, 0
        self._rng = json.dumps(plain(rngs[0].bit_generator.state))

    def reset(self, observation: Array, state: CellState, sampled: Mapping[str, Any]) -> None:
        """Record a reset.

        Args:
            observation: (1, O).
            state: State of the cell.
            sampled: Randomized values, by name.
        """
        row = BeginRow(
            seed=self._seed,
            q_rad=state.q_rad[0],
            flange_m=state.flange_m[0],
            observation=observation[0],
            initial_state=None if self._cell is None else self._cell.integration_state(),
        )
        self.recorder.begin_episode(row)
        self.recorder.event("generator", self._rng)
        if sampled:
            self.recorder.event("drawn", json.dumps(plain(dict(sampled))))

    def step(
        self, action: object, command: Command, step: Any, period: CellStep, ended_by: str, commander: Mask
    ) -> None:
        """Record a step; see `dual_ur10.envs.core.cells.StepHook`."""
        state = period.state
        terminated, truncated = bool(step.terminated[0]), bool(step.truncated[0])
        row = StepRow(
            action=np.asarray(action).reshape(-1),
            targets_rad=command.targets_rad[0],
            gripper_m=None if command.gripper_m is None else command.gripper_m[0],
            gated=0 in step.verdicts,
            reward=float(step.reward[0]),
            terminated=terminated,
            truncated=truncated,
            success=bool(step.info["is_success"][0]) if terminated or truncated else None,
            ended_by=ended_by,
            time_s=float(state.time_s[0]),
            q_rad=state.q_rad[0],
            flange_m=state.flange_m[0],
            observation=step.observation[0],
            first_target=self._first_target(period),
            commander=commander.copy(),
        )
        self._step += 1
        self.recorder.step(row, period.trace)

    def _first_target(self, period: CellStep) -> int | None:
        """Return the number of the step's first target, or its stand-in; record a missed deadline as an event."""
        if not period.late:
            return period.first_target
        self.recorder.event(
            "late",
            f"the action of step {self._step} missed the deadline of target {period.first_target}: both arms stopped, "
            "and continue from there",
        )
        return LATE
