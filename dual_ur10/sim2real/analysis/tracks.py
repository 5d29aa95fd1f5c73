"""Motion of one arm in one episode of a recorded run, on the run's clock and on the task's.

The task's clock counts the numbers of the targets, except where both arms stopped (`tick_map`). Where a cell runs
slower than the task, by its `speed_factor` or the slider, a second of the task takes longer: two runs at different
speeds are the same motion on the task's clock.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from dual_ur10.errors import RecordingError
from dual_ur10.sim2real.analysis.series import rising
from dual_ur10.sim2real.analysis.tick_map import TickMap, sent_around, tick_map
from dual_ur10.sim2real.recording.run import ArmLog, Run
from ur_core.kinematics import BASE_TO_BASE_LINK, flange_pose
from ur_core.kinematics.frames import ArmMount
from ur_core.kinematics.rotations import quat_to_matrix
from ur_core.kinematics.ur10 import ARMS
from ur_core.types import Array

_MOST_APART: Final = 100.0  # ticks from state to state, on average
_MOST_PAUSED_S: Final = 600.0
_STRAIGHT_TICKS: Final = 2.0  # by which targets may be off their straight line
_WINDOW_S: Final = 1.0  # the quickest packet within it gives the offset of the clocks
_LEAST: Final = 25  # samples, of which hardly ever all are late
_LOST_TICKS: Final = 2.0  # within a window: no quartz drifts by that


@dataclass(frozen=True)
class Track:
    """One arm in one episode. Times are on the run's clock, from the beginning of the episode.

    Attributes:
        sent_s: (k,) time at which each target was sent.
        late_s: (k,) delay of each target behind its due time.
        period: (k,) control periods.
        number: (k,) numbers of the targets as sent; fractional where time was slowed down.
        index: (k,) ticks of the task's clock, 0 for the episode's first.
        stopped: (k,) mask of targets that belong to no action, because both arms stop after a missed deadline.
        target_rad: (k, 6) targets.
        time_s: (j,) times of the states, strictly rising.
        task_s: (j,) the same on the task's clock.
        q_rad: (j, 6) measured joints.
        reference_rad: (j, 6) joints that the controller aimed at; None: not recorded.
    """

    sent_s: Array
    late_s: Array
    period: Array
    number: Array
    index: Array
    stopped: NDArray[np.bool_]
    target_rad: Array
    time_s: Array
    task_s: Array
    q_rad: Array
    reference_rad: Array | None


def flange_of(mount: ArmMount, q_rad: Array) -> tuple[Array, Array]:
    """Return positions, (k, 3), and rotations, (k, 3, 3), of a flange in the cell frame."""
    position, rotation = flange_pose(q_rad, mount.dh)
    from_base = quat_to_matrix(mount.quat) @ BASE_TO_BASE_LINK
    return np.array(mount.position_m) + position @ from_base.T, from_base @ rotation


def track(run: Run, number: int, arm: int) -> Track:
    """Return the motion of an arm in an episode.

    Args:
        run: The recording.
        number: Number of the episode in the order of the recording.
        arm: 0 or 1.

    Raises:
        RecordingError: There is no such episode, or not enough was recorded of the arm in it.
    """
    if not 0 <= number < len(run.episodes):
        raise RecordingError(f"the recording has {len(run.episodes)} episodes: there is no number {number}")
    episode, header, log = run.episodes[number], run.header, run.arms[arm]
    numbers = tick_map(run, number)
    sent = _sent(run, number, arm, numbers)
    if len(sent["index"]) < 2:
        raise RecordingError(
            f"{ARMS[arm]}: {len(sent['index'])} targets were recorded in episode {number}: 2 or more are needed. "
            "Compare another episode, or another recording"
        )
    begin_s = episode.begin_s
    sent_s = sent["sent_s"] - begin_s
    index, stopped = numbers(sent["index"])
    # Due times are free of the jitter of sending.
    due_s = _line(sent["period"], sent_s - sent["late_s"], _STRAIGHT_TICKS * header.tick_s)
    end_s = due_s[-1] + header.tick_s
    time_s = state_times(log) - begin_s
    # The last state of the episode before may coincide with the beginning of this one.
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
        stopped=stopped,
        target_rad=sent["target_rad"],
        time_s=time_s,
        task_s=_task_times(time_s, due_s, index * header.tick_s),
        q_rad=log.state["q_rad"][kept][ordered],
        reference_rad=None if reference is None else reference[kept][ordered],
    )


def tracks(run: Run, number: int) -> tuple[Track, Track]:
    """Return the motion of both arms in an episode; see `track`."""
    return track(run, number, 0), track(run, number, 1)


def _sent(run: Run, number: int, arm: int, numbers: TickMap) -> dict[str, Array]:
    kept = sent_around(run, number, arm)
    rows = {name: values[kept] for name, values in run.arms[arm].sent.items()}
    inside = (rows["index"] > numbers.first - 0.5) & (rows["index"] < numbers.end - 0.5)
    return {name: values[inside] for name, values in rows.items()}


def _line(period: Array, times_s: Array, most_s: float) -> Array:
    """Return the straight line of times over control periods; the times themselves where they are too few or off it."""
    if len(period) < 3 or np.ptp(period) < 2:
        return times_s
    middle = period - period.mean()
    slope = float((middle * times_s).sum() / (middle * middle).sum())
    result: Array = times_s.mean() + slope * middle
    # A controller's clock may have stalled.
    return result if float(np.abs(result - times_s).max()) <= most_s else times_s


def _task_times(time_s: Array, due_s: Array, task_s: Array) -> Array:
    """Return times on the task's clock, which runs as the run's before the first target and after the last."""
    ordered = rising(due_s)
    due_s, task_s = due_s[ordered], task_s[ordered]
    result: Array = np.interp(time_s, due_s, task_s)
    result += np.minimum(time_s - due_s[0], 0.0) + np.maximum(time_s - due_s[-1], 0.0)
    return result


def state_times(log: ArmLog) -> Array:
    """Return the (j,) times of the states on the run's clock, from the controller's clock, which no network delays.

    The offset between the clocks may change, as it does where an emulated controller stalls with its machine.
    """
    offset_s = _offset(log)
    return log.state["arrival_s"] if offset_s is None else log.state["timestamp_s"] + offset_s


def clock_error_s(log: ArmLog, tick_s: float) -> float:
    """Return the range of the offset between controller's and run's clock where it exceeds a quartz's drift; else 0."""
    offset_s = _offset(log)
    if offset_s is None:
        return 0.0
    stamps_s = log.state["timestamp_s"]
    later = np.minimum(np.searchsorted(stamps_s, stamps_s + _WINDOW_S), len(stamps_s) - 1)
    apart = bool((np.abs(offset_s[later] - offset_s) > _LOST_TICKS * tick_s).any())
    return float(np.ptp(offset_s)) if apart else 0.0


def _offset(log: ArmLog) -> Array | None:
    """Return the (j,) offsets of the run's clock from the controller's; None: the controller reports no usable time."""
    arrival_s = log.state["arrival_s"]
    stamps_s = log.state.get("timestamp_s")
    if stamps_s is None or len(arrival_s) < 2 or not np.isfinite(stamps_s).all() or (np.diff(stamps_s) <= 0).any():
        return None
    away_s = arrival_s - stamps_s
    count = max(_LEAST, round(_WINDOW_S / float(np.median(np.diff(stamps_s)))))
    # A delayed packet exceeds the quickest on both sides; after a jump of the clock, a packet exceeds that of one side.
    result: Array = np.maximum(_least_of_next(away_s, count), _least_of_next(away_s[::-1], count)[::-1])
    return result


def _least_of_next(values: Array, count: int) -> Array:
    """Return the (k,) minima of each value and the `count` - 1 after it; near the end, of the last `_LEAST`."""
    least, width = np.concatenate([values, np.full(count, np.inf)]), 1
    while width < count:  # twice as many with each round
        step = min(width, count - width)
        least, width = np.minimum(least[:-step], least[step:]), width + step
    result: Array = least[: len(values)].copy()
    result[-_LEAST:] = values[-_LEAST:].min()
    return result
