"""Content of a recorded run, the same for simulated, emulated and real arms.

All times named `..._s` are seconds since the run began: on the host's monotonic clock or, in simulation, simulated time
with the run's episodes one after the other.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Annotated, Any, ClassVar, Final, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import AfterValidator, ConfigDict, Field, with_config
from typing_extensions import TypedDict

from ur_core.kinematics.ur10 import Family
from ur_core.types import Array, Mask

LATE: Final = -1
"""Number of a target whose action missed its deadline: nothing of the action was sent."""

Source = Annotated[str, Field(pattern=r"^[A-Za-z]\w{0,39}$")]

_STRICT: Final = ConfigDict(strict=True, extra="forbid", allow_inf_nan=False)
_MOST_TICKS: Final = 10_000
_MOST_SERVOJ: Final = 1e6


def _check_finite(value: Any) -> Any:
    if isinstance(value, dict):
        for each in value.values():
            _check_finite(each)
    elif isinstance(value, list):
        for each in value:
            _check_finite(each)
    elif isinstance(value, float) and not math.isfinite(value):
        raise ValueError(f"{value} is not finite")
    return value


_Json = Annotated[dict[str, Any], AfterValidator(_check_finite)]
_Vector = Annotated[list[float], Field(max_length=6)]


@with_config(_STRICT)
class Mount(TypedDict, total=False):
    """Pose and kinematics of an arm, with the fields of `dual_ur10.ArmMount`."""

    position_m: _Vector
    yaw_rad: float
    tilt_rad: _Vector
    robot: Annotated[str, Field(max_length=40)]
    dh: dict[Literal["a_m", "d_m", "alpha_rad", "theta_rad"], _Vector]


@with_config(_STRICT)
class ServojSettings(TypedDict):
    """Settings of `servoj` for an arm."""

    lookahead_s: Annotated[float, Field(gt=0.0, lt=_MOST_SERVOJ)]
    gain: Annotated[float, Field(gt=0.0, lt=_MOST_SERVOJ)]


_Pair = Field(min_length=2, max_length=2)


@dataclass(frozen=True)
class Header:
    """Description of a run, complete enough to repeat it and to compare it.

    Attributes:
        env_id: Id of the environment, as `gymnasium.make` takes it.
        kwargs: Keywords of the environment, as far as JSON can hold them.
        seed: Seed of the first reset; None: no seed was given. A file's header is written before the first reset, so
            the reader takes the seed from the first episode.
        source: Kind of the cell: "mujoco", "echo" (its states are what was commanded), "emulated", "real", or one that
            was registered.
        family: "cb3" or "e-series".
        tick_s: Length of a control period.
        period_ticks: Control periods per step.
        latency_ticks: Control periods between an action's step and its first target.
        speed_factor: Fraction of the full speed, at most 1.
        mounts: Per arm `position_m`, `yaw_rad`, `tilt_rad` and `dh` (`a_m`, `d_m`, `alpha_rad`, `theta_rad`).
        servoj: Per arm `lookahead_s` and `gain`.
        versions: Versions of this package and of its dependencies, by name.
        started_utc: Start of the run, ISO 8601.
        policy: Name of the policy; empty: none was given.
        policy_sha256: Hash of a checkpoint's manifest, which holds the hash of the weights. None: it is no checkpoint;
            `versions` identify a scripted policy.
        cell_file: Text of the cell file.
        cell_sha256: Hash of the cell file.
        extra: Further entries, as far as JSON can hold them. In a replay, "replays" holds the source: "run" (the name
            of its folder), "sha256" of its file, and "episode".
    """

    __pydantic_config__: ClassVar[ConfigDict] = _STRICT

    env_id: str
    kwargs: _Json
    seed: int | None
    source: Source
    family: Family
    tick_s: Annotated[float, Field(ge=1e-4, le=1.0)]
    period_ticks: Annotated[int, Field(ge=1, le=_MOST_TICKS)]
    latency_ticks: Annotated[int, Field(ge=0, le=_MOST_TICKS)]
    speed_factor: Annotated[float, Field(ge=0.0, le=1.0)]
    mounts: Annotated[list[Mount], _Pair]
    servoj: Annotated[list[ServojSettings], _Pair]
    versions: dict[str, str]
    started_utc: str
    policy: str
    policy_sha256: str | None
    cell_file: str | None
    cell_sha256: str | None
    extra: _Json


@dataclass(frozen=True)
class ArmLog:
    """States and targets of one arm, a row per control period.

    Attributes:
        state: Field of `ArmStatus` -> (k,) or (k, m), in order of arrival.
        sent: Targets that were sent: "period", "index", "sent_s", "late_s" (k,) and "target_rad" (k, 6).
    """

    state: dict[str, Array]
    sent: dict[str, Array]


@dataclass(frozen=True)
class Episode:
    """One episode of m steps, at the rate of the policy; row j is step j.

    Attributes:
        seed: Seed of the reset that began it; None: no seed was given.
        number: Number within the run, from 0 on.
        begin_s: Time of tick 0.
        action: (m, A) actions as the policy gave them.
        targets_rad: (m, ticks, 2, 6) targets that the gate released.
        gripper_m: (m, ticks, 2) commanded gripper widths; None: no grippers.
        gated: (m,) mask of steps that the gate refused.
        reward: (m,) rewards of both arms together.
        terminated: (m,) mask of the step that ended the episode.
        truncated: (m,) mask of the step at which its time ran out.
        success: True if the task succeeded; None: not known.
        ended_by: Reason of its end; empty: not known.
        observation: (m+1, O) observations, row 0 of the reset; None: not kept.
        time_s: (m,) task time at the end of each step.
        q_rad: (m+1, 2, 6) joint positions.
        flange_m: (m+1, 2, 3) flange positions in the cell frame.
        initial_state: MuJoCo's state after the reset; None outside simulation.
        first_target: (m,) number of the first of each step's targets among those that were sent (`ArmLog.sent`,
            "index"); `LATE` where none of them was sent.
        commander: (m, 2) True for an arm that a person commanded; None: no person did.
        first_step: Number of row 0 in the episode: above 0 in a black box that begins within one.
    """

    seed: int | None
    number: int
    begin_s: float
    action: NDArray[Any]
    targets_rad: Array
    gripper_m: Array | None
    gated: Mask
    reward: Array
    terminated: Mask
    truncated: Mask
    success: bool | None
    ended_by: str
    observation: Array | None
    time_s: Array
    q_rad: Array
    flange_m: Array
    initial_state: bytes | None
    first_target: NDArray[np.int64]
    commander: Mask | None = None
    first_step: int = 0


@dataclass(frozen=True)
class RunEvent:
    """An event of a run.

    Attributes:
        time_s: Time of the event.
        kind: Kind in one word.
        text: Description for a reader.
        arm: "left" or "right"; empty: both or neither.
    """

    time_s: float
    kind: str
    text: str
    arm: str = ""


@dataclass(frozen=True)
class Run:
    """A whole record.

    Attributes:
        header: Description of the run.
        arms: Logs of the left and the right arm.
        episodes: Episodes in order.
        events: Events in order.
        complete: False if the file was cut off; all that is whole was read.
    """

    header: Header
    arms: tuple[ArmLog, ArmLog]
    episodes: list[Episode]
    events: list[RunEvent]
    complete: bool

    def __repr__(self) -> str:
        cut = "" if self.complete else ", cut off"
        about = f"{self.header.env_id}, {self.header.source} cell, {len(self.episodes)} episodes"
        return f"{type(self).__name__}({about}, {len(self.events)} events{cut})"
