"""What a record of a run holds, however it came about: simulated, emulated or real.

All times named `..._s` are seconds since the run began: on the host's monotonic clock, or, in simulation, simulated
time with the run's episodes one after the other.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from dual_ur10.types import Array

LATE: Final = -1
"""In place of a target's number: the action came too late, and nothing of it was sent."""


@dataclass(frozen=True)
class Header:
    """All that is needed to run it again and to compare it.

    Attributes:
        env_id: Of the environment, as `dual_ur10.make` takes it.
        kwargs: Its settings; only what JSON can hold.
        seed: Of the first reset; None: no seed was given. A file's header is written before: what reads it takes it
            from the first episode.
        source: "mujoco", "emulated" or "real".
        family: "cb3" or "e-series".
        tick_s: Length of a control period.
        period_ticks: Control periods of a step.
        latency_ticks: Control periods between an action's step and its first target.
        speed_factor: Share of the full speed, at most 1.
        mounts: Per arm `position_m`, `yaw_rad` and `dh` (`a_m`, `d_m`, `alpha_rad`, `theta_rad`).
        servoj: Per arm `lookahead_s` and `gain`.
        versions: Of this package and of those it stands on.
        started_utc: When the run began, ISO 8601.
        policy: Its name; empty: none was told.
        policy_sha256: Of a checkpoint's manifest, which holds that of its weights. None: it is no checkpoint; of a
            scripted policy, `versions` say which it was.
        cell_file: Text of the cell file.
        cell_sha256: Of the cell file.
        extra: Anything else; only what JSON can hold. Of a replay, "replays" says of what: "run" (the name of its
            folder), "sha256" of its file, and "episode".
    """

    env_id: str
    kwargs: dict[str, Any]
    seed: int | None
    source: str
    family: str
    tick_s: float
    period_ticks: int
    latency_ticks: int
    speed_factor: float
    mounts: list[dict[str, Any]]
    servoj: list[dict[str, Any]]
    versions: dict[str, str]
    started_utc: str
    policy: str
    policy_sha256: str | None
    cell_file: str | None
    cell_sha256: str | None
    extra: dict[str, Any]


@dataclass(frozen=True)
class ArmLog:
    """One arm, at the rate of its control periods.

    Attributes:
        state: By field of `ArmStatus`, (k,) or (k, m), in the order in which they arrived.
        sent: Each target that was sent: "period", "index", "sent_s", "late_s" (k,) and "target_rad" (k, 6).
    """

    state: dict[str, Array]
    sent: dict[str, Array]


@dataclass(frozen=True)
class Episode:
    """One episode of m steps, at the rate of the policy; row j is step j.

    Attributes:
        seed: Of the reset that began it.
        number: Within the run, from 0 on.
        begin_s: When tick 0 of the episode is.
        action: (m, A) as the policy gave it.
        targets_rad: (m, ticks, 2, 6) what the gate let out for it.
        gripper_m: (m, ticks, 2) openings asked for; None: no grippers.
        gated: (m,) whether the gate held the step back.
        reward: (m,).
        terminated: (m,).
        truncated: (m,).
        success: None: not known.
        ended_by: Why it ended; empty: not known.
        observation: (m+1, O), row 0 that of the reset; None: not kept.
        time_s: (m,) task time at the end of the step.
        q_rad: (m+1, 2, 6).
        flange_m: (m+1, 2, 3).
        initial_state: Of MuJoCo after the reset; None outside simulation.
        first_target: (m,) number of the first of each step's targets, among those that were sent (`ArmLog.sent`,
            "index"); `LATE` where nothing of it was sent.
        first_step: Number of step 0 here in the episode: above 0 in a black box that begins within one.
    """

    seed: int | None
    number: int
    begin_s: float
    action: NDArray[Any]
    targets_rad: Array
    gripper_m: Array | None
    gated: NDArray[np.bool_]
    reward: Array
    terminated: NDArray[np.bool_]
    truncated: NDArray[np.bool_]
    success: bool | None
    ended_by: str
    observation: Array | None
    time_s: Array
    q_rad: Array
    flange_m: Array
    initial_state: bytes | None
    first_target: NDArray[np.int64]
    first_step: int = 0


@dataclass(frozen=True)
class Event:
    """Something that happened.

    Attributes:
        time_s: When.
        kind: In one word.
        text: What, for a reader.
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
        header: What was run.
        arms: Left and right.
        episodes: In order.
        events: In order.
        complete: False: the file was cut off; everything whole was read.
    """

    header: Header
    arms: tuple[ArmLog, ArmLog]
    episodes: list[Episode]
    events: list[Event]
    complete: bool
