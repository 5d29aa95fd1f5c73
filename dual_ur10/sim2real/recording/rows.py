"""Rows that an environment passes to a recorder, the same for simulated and real runs."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, Protocol

import numpy as np
from numpy.typing import NDArray

from dual_ur10.sim2real.recording.schemas import BEGIN, STEP
from ur_core.types import Array, Mask

if TYPE_CHECKING:
    from dual_ur10.sim2real.cell.cell import TickTrace

_NOTHING: Array = np.zeros(0)


@dataclass(frozen=True, kw_only=True)
class BeginRow:
    """Beginning of an episode, with the first rows of the fields of `dual_ur10.sim2real.recording.run.Episode`.

    `begin_s` None stands for the recorder's present time.
    """

    seed: int | None
    q_rad: Array
    flange_m: Array
    observation: Array | None = None
    initial_state: bytes | None = None
    begin_s: float | None = None

    def encode(self, number: int, begin_s: float) -> bytes:
        """Return the message for the run's episode `number`."""
        return BEGIN.encode(
            {
                "begin_s": begin_s,
                "number": number,
                "first_step": 0,
                "q_rad": self.q_rad,
                "flange_m": self.flange_m,
                "observation": _NOTHING if self.observation is None else self.observation,
                "initial_state": self.initial_state or b"",
                "seed": "" if self.seed is None else str(int(self.seed)),
            }
        )


@dataclass(frozen=True, kw_only=True)
class StepRow:
    """One step of an episode, with one row of the fields of `dual_ur10.sim2real.recording.run.Episode`.

    State and observation are those at the end of the step. `first_target` None: the recorder counts the targets itself.
    """

    action: NDArray[Any]
    targets_rad: Array
    gripper_m: Array | None
    gated: bool
    reward: float
    terminated: bool
    truncated: bool
    success: bool | None
    ended_by: str
    time_s: float
    q_rad: Array
    flange_m: Array
    observation: Array | None = None
    first_target: int | None = None
    commander: Mask = field(default_factory=lambda: np.zeros(2, dtype=bool))

    def encode(self, episode: int, step: int) -> bytes:
        """Return the message for step `step` of the run's episode `episode`."""
        values = {
            **self.__dict__,
            "left_by_person": self.commander[0],
            "right_by_person": self.commander[1],
            "episode": episode,
            "step": step,
            "success": -1 if self.success is None else int(self.success),
            "gripper_m": _NOTHING if self.gripper_m is None else self.gripper_m,
            "observation": _NOTHING if self.observation is None else self.observation,
        }
        return STEP.encode(values)


class RunRecorder(Protocol):
    """Recorder of a run.

    Attributes:
        failure: Reason why something was not recorded; empty: none.
    """

    failure: str

    def begin_episode(self, row: BeginRow) -> None:
        """Record the beginning of an episode."""

    def step(self, row: StepRow, trace: TickTrace | None = None) -> None:
        """Record a step; only a simulation has a trace."""

    def event(self, kind: str, text: str, arm: str = "", time_s: float | None = None) -> None:
        """Record an event; `time_s` None: now."""

    def close(self) -> None:
        """End the record. May be called twice."""
