"""What a recorder is told, and by whom it is told it: the same for simulated and real runs."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Protocol

import numpy as np
from numpy.typing import NDArray

from dual_ur10.sim2real.recording.schemas import BEGIN, STEP
from dual_ur10.types import Array

if TYPE_CHECKING:
    from dual_ur10.sim2real.config.cell import TickTrace

_NOTHING: Array = np.zeros(0)


@dataclass(frozen=True, kw_only=True)
class BeginRow:
    """How an episode begins.

    Attributes:
        seed: Of the reset; None: none was given.
        q_rad: (2, 6).
        flange_m: (2, 3).
        observation: (O,) or None.
        initial_state: Of MuJoCo, or None.
        begin_s: When tick 0 is, on the run's clock; None: where the recorder stands.
    """

    seed: int | None
    q_rad: Array
    flange_m: Array
    observation: Array | None = None
    initial_state: bytes | None = None
    begin_s: float | None = None

    def encode(self, number: int, begin_s: float) -> bytes:
        """The message of the run's episode `number`."""
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
    """One step of an episode.

    Attributes:
        action: (A,) as the policy gave it.
        targets_rad: (ticks, 2, 6) what the gate let out.
        gripper_m: (ticks, 2) openings asked for, or None.
        gated: Whether the gate held the step back.
        reward: Of both arms.
        terminated: Whether the episode ended with it.
        truncated: Whether its time ran out.
        success: Whether the task is done well; None: not known.
        ended_by: Why it ended, if there is more to say.
        time_s: Task time at its end.
        q_rad: (2, 6) at its end.
        flange_m: (2, 3) at its end.
        observation: (O,) at its end, or None.
        first_target: Number of the first of `targets_rad` among those that are sent; `LATE`: none of them is; None: the
            recorder counts the targets itself.
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

    def encode(self, episode: int, step: int) -> bytes:
        """The message of step `step` of the run's episode `episode`."""
        values = {
            **self.__dict__,
            "episode": episode,
            "step": step,
            "success": -1 if self.success is None else int(self.success),
            "gripper_m": _NOTHING if self.gripper_m is None else self.gripper_m,
            "observation": _NOTHING if self.observation is None else self.observation,
        }
        return STEP.encode(values)


class RunRecorder(Protocol):
    """What takes note of a run.

    Attributes:
        failure: Why it does not any more; empty: all is well.
    """

    failure: str

    def begin_episode(self, row: BeginRow) -> None:
        """An episode begins."""

    def step(self, row: StepRow, trace: TickTrace | None = None) -> None:
        """A step is done; `trace` is what only a simulation knows of it."""

    def event(self, kind: str, text: str, arm: str = "", time_s: float | None = None) -> None:
        """Something happened; `time_s` None: now."""

    def close(self) -> None:
        """The run is over. May be called twice."""
