"""What lets a recorder know what the stepping core of an environment does: the same for every kind of cell."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from typing import Any, Protocol, runtime_checkable

import numpy as np

from dual_ur10.sim2real.config.cell import CellState, CellStep
from dual_ur10.sim2real.control.adapter import Command
from dual_ur10.sim2real.recording.header import plain
from dual_ur10.sim2real.recording.rows import BeginRow, RunRecorder, StepRow
from dual_ur10.sim2real.recording.run import LATE
from dual_ur10.types import Array


@runtime_checkable
class RecordedCell(Protocol):
    """A cell that can keep a trace of its steps, and save the state of its simulation."""

    def record(self) -> None:
        """Keep the trace from now on."""

    def integration_state(self) -> bytes | None:
        """Return the full state of the simulation; None for real arms."""


class RecordHook:
    """Tells a recorder of every reset and step of one cell.

    Args:
        recorder: What takes note.
        cell: What is recorded.

    Raises:
        SettingsError: These are several cells.
    """

    def __init__(self, recorder: RunRecorder, cell: object) -> None:
        self.recorder = recorder
        self._cell = cell if isinstance(cell, RecordedCell) else None
        if self._cell is not None:
            self._cell.record()
        self._rng = ""
        self._seed: int | None = None
        self._step = 0

    def resetting(self, rngs: Sequence[np.random.Generator], seed: int | None) -> None:
        """A reset begins: what it will draw follows from the generator as it is now."""
        self._seed, self._step = seed, 0
        self._rng = json.dumps(plain(rngs[0].bit_generator.state))

    def reset(
        self, observation: Array, state: CellState, drawn: Mapping[str, Any], begin_s: float | None = None
    ) -> None:
        """A reset is done.

        Args:
            observation: (1, O).
            state: Of the cell.
            drawn: What was drawn by chance, by name.
            begin_s: When tick 0 is, on the run's clock; None: now, or where a simulation's clock stands.
        """
        row = BeginRow(
            seed=self._seed,
            q_rad=state.q_rad[0],
            flange_m=state.flange_m[0],
            observation=observation[0],
            initial_state=None if self._cell is None else self._cell.integration_state(),
            begin_s=begin_s,
        )
        self.recorder.begin_episode(row)
        self.recorder.event("generator", self._rng)
        if drawn:
            self.recorder.event("drawn", json.dumps(plain(dict(drawn))))

    def step(self, action: object, command: Command, step: Any, period: CellStep, ended_by: str = "") -> None:
        """A step is done.

        Args:
            action: As it was given; it was found legal.
            command: What the gate let out.
            step: A `dual_ur10.envs.core.core.Step`.
            period: The cell's, with its true state at the end.
            ended_by: Why the episode ended, where no verdict says so.
        """
        state = period.state
        terminated, truncated = bool(step.terminated[0]), bool(step.truncated[0])
        verdict = step.verdicts.get(0)
        row = StepRow(
            action=np.asarray(action).reshape(-1),
            targets_rad=command.targets_rad[0],
            gripper_m=None if command.gripper_m is None else command.gripper_m[0],
            gated=verdict is not None,
            reward=float(step.reward[0]),
            terminated=terminated,
            truncated=truncated,
            success=bool(step.info["is_success"][0]) if terminated or truncated else None,
            ended_by=str(verdict) if verdict is not None else ended_by,
            time_s=float(state.time_s[0]),
            q_rad=state.q_rad[0],
            flange_m=state.flange_m[0],
            observation=step.observation[0],
            first_target=self._first_target(period),
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
