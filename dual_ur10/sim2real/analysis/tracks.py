"""What one arm did in one episode of a recorded run, on two clocks: that of the run, and that of the task.

The task's clock is that of the targets' numbers, but where both arms had to rest (`numbering`). Where a cell runs
slower than the task, by its `speed_factor` or the slider, a second of the task takes longer; two runs at different
speeds are the same motion on the task's clock.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from dual_ur10.errors import RecordingError, SettingsError
from dual_ur10.kinematics import BASE_TO_BASE_LINK, flange_pose
from dual_ur10.kinematics.frames import ArmMount
from dual_ur10.kinematics.rotations import quat_from_rotvec, quat_to_matrix
from dual_ur10.kinematics.ur10 import ARMS, DHParameters
from dual_ur10.sim2real.analysis.clock_offset import times_of
from dual_ur10.sim2real.analysis.series import rising
from dual_ur10.sim2real.analysis.tick_map import Numbering, around, numbering
from dual_ur10.sim2real.recording.run import Header, Run
from dual_ur10.types import Array

_MOST_APART: Final = 100.0  # ticks from state to state, on average
_MOST_PAUSED_S: Final = 600.0
_STRAIGHT_TICKS: Final = 2.0  # by which targets may be off a straight line and it is one


@dataclass(frozen=True)
class Track:
    """One arm in one episode. Times are on the run's clock, since the episode began.

    Attributes:
        sent_s: (k,) when each target was sent.
        late_s: (k,) by how much too late.
        period: (k,) control periods.
        number: (k,) numbers of the targets, as they were sent; between two where time was slowed down.
        index: (k,) ticks of the task's clock that they belong to, 0 for the episode's first.
        resting: (k,) whether they belong to no action, for both arms come to rest because one came too late.
        target_rad: (k, 6).
        time_s: (j,) when each state was, strictly rising.
        task_s: (j,) the same on the task's clock.
        q_rad: (j, 6) measured joints.
        reference_rad: (j, 6) where the controller wanted the joints to be; None: it was not recorded.
    """

    sent_s: Array
    late_s: Array
    period: Array
    number: Array
    index: Array
    resting: NDArray[np.bool_]
    target_rad: Array
    time_s: Array
    task_s: Array
    q_rad: Array
    reference_rad: Array | None


def mounts_of(header: Header) -> tuple[ArmMount, ArmMount]:
    """Where the arms of a run stood, and their kinematics.

    Raises:
        RecordingError: They are not those of two UR10s.
    """
    try:
        left, right = (_mount(each) for each in header.mounts)
    except (SettingsError, KeyError, TypeError, ValueError) as error:
        raise RecordingError(
            f"the recording's mounts are not those of two UR10s: {error}. It is of another robot, or damaged"
        ) from error
    return left, right


def _mount(values: dict[str, Any]) -> ArmMount:
    dh = values["dh"]
    parameters = DHParameters(**{name: tuple(dh[name]) for name in ("a_m", "d_m", "alpha_rad", "theta_rad")})
    x, y, z = values["position_m"]
    return ArmMount((x, y, z), values["yaw_rad"], parameters)


def flange_of(mount: ArmMount, q_rad: Array) -> tuple[Array, Array]:
    """Positions, (k, 3), and rotations, (k, 3, 3), of a flange in the cell frame."""
    position, rotation = flange_pose(q_rad, mount.dh)
    turn = quat_to_matrix(quat_from_rotvec(np.array([0.0, 0.0, mount.yaw_rad]))) @ BASE_TO_BASE_LINK
    return np.array(mount.position_m) + position @ turn.T, turn @ rotation


def track(run: Run, number: int, arm: int) -> Track:
    """What an arm did in an episode.

    Args:
        run: The recording.
        number: Of the episode, in the order of the recording.
        arm: 0 or 1.

    Raises:
        RecordingError: There is no such episode, or not enough was recorded of the arm in it.
    """
    if not 0 <= number < len(run.episodes):
        raise RecordingError(f"the recording has {len(run.episodes)} episodes: there is no number {number}")
    episode, header, log = run.episodes[number], run.header, run.arms[arm]
    numbers = numbering(run, number)
    sent = _sent(run, number, arm, numbers)
    if len(sent["index"]) < 2:
        raise RecordingError(
            f"{ARMS[arm]}: {len(sent['index'])} targets were recorded in episode {number}: 2 or more are needed. "
            "Compare another episode, or another recording"
        )
    begin_s = episode.begin_s
    sent_s = sent["sent_s"] - begin_s
    index, resting = numbers(sent["index"])
    # When each target was due: free of the jitter with which it was sent.
    due_s = _line(sent["period"], sent_s - sent["late_s"], _STRAIGHT_TICKS * header.tick_s)
    end_s = due_s[-1] + header.tick_s
    time_s = times_of(log) - begin_s
    # Where an episode begins, another may just have ended: its last state is none of this one.
    kept = (time_s > header.tick_s / 4) & (time_s <= end_s + header.tick_s / 2)
    kept &= np.isfinite(log.state["q_rad"]).all(axis=1)
    time_s = time_s[kept]
    ordered = rising(time_s)
    if ordered.sum() < 2:
        raise RecordingError(
            f"{ARMS[arm]}: {int(ordered.sum())} states were recorded in episode {number}: 2 or more are needed. "
            "Compare another episode, or another recording"
        )
    time_s = time_s[ordered]
    if time_s[-1] - time_s[0] > _MOST_PAUSED_S + _MOST_APART * header.tick_s * len(time_s):
        raise RecordingError(
            f"{ARMS[arm]}: {len(time_s)} states were recorded in {time_s[-1] - time_s[0]:.0f} s of episode {number}, "
            f"not one in {header.tick_s:g} s. The recording is damaged; compare another episode, or another recording"
        )
    reference = log.state.get("target_q_rad")
    return Track(
        sent_s=sent_s,
        late_s=sent["late_s"],
        period=sent["period"],
        number=sent["index"],
        index=index,
        resting=resting,
        target_rad=sent["target_rad"],
        time_s=time_s,
        task_s=_task_times(time_s, due_s, index * header.tick_s),
        q_rad=log.state["q_rad"][kept][ordered],
        reference_rad=None if reference is None else reference[kept][ordered],
    )


def tracks(run: Run, number: int) -> tuple[Track, Track]:
    """What both arms did in an episode; see `track`."""
    return track(run, number, 0), track(run, number, 1)


def _sent(run: Run, number: int, arm: int, numbers: Numbering) -> dict[str, Array]:
    """Targets sent to an arm in an episode."""
    kept = around(run, number, arm)
    rows = {name: values[kept] for name, values in run.arms[arm].sent.items()}
    inside = (rows["index"] > numbers.first - 0.5) & (rows["index"] < numbers.behind - 0.5)
    return {name: values[inside] for name, values in rows.items()}


def _line(period: Array, times_s: Array, most_s: float) -> Array:
    """Times as a straight line over control periods; as they are where periods do not say enough, or it is none."""
    if len(period) < 3 or np.ptp(period) < 2:
        return times_s
    middle = period - period.mean()
    slope = float((middle * times_s).sum() / (middle * middle).sum())
    result: Array = times_s.mean() + slope * middle
    # A controller's clock may have stood still.
    return result if float(np.abs(result - times_s).max()) <= most_s else times_s


def _task_times(time_s: Array, due_s: Array, task_s: Array) -> Array:
    """Times on the task's clock; before the first target and behind the last, it runs as the run's does."""
    ordered = rising(due_s)
    due_s, task_s = due_s[ordered], task_s[ordered]
    result: Array = np.interp(time_s, due_s, task_s)
    result += np.minimum(time_s - due_s[0], 0.0) + np.maximum(time_s - due_s[-1], 0.0)
    return result
