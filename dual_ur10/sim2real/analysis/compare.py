"""Comparison of two recorded runs: differences, lag, and equality of the targets that were sent."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final, NamedTuple

import numpy as np

from dual_ur10.errors import RecordingError
from dual_ur10.sim2real.analysis.parity import Parity, parity
from dual_ur10.sim2real.analysis.reconstruction import replayed_keywords
from dual_ur10.sim2real.analysis.series import (
    NO_MAGNITUDES,
    Magnitudes,
    Value,
    interpolate,
    lag,
    lengths,
    none,
    rising,
    spread,
)
from dual_ur10.sim2real.analysis.tick_map import late_actions
from dual_ur10.sim2real.analysis.timing import TimingReport, timing
from dual_ur10.sim2real.analysis.tracks import Track, clock_error_s, flange_of, tracks
from dual_ur10.sim2real.recording.header import mounts_of
from dual_ur10.sim2real.recording.run import Header, Run
from ur_core.kinematics.frames import ArmMount
from ur_core.kinematics.ur10 import ARMS
from ur_core.types import Array

Mounts = tuple[ArmMount, ArmMount]

LEAST_S: Final = 0.2
"""Shortest common task time of two runs that are compared."""


@dataclass(frozen=True)
class Differences:
    """Run A minus run B, of one arm.

    Attributes:
        joints_rad: Differences of each joint.
        flange_m: Distance between the flanges.
        flange_axes_m: The same along x, y and z of the cell.
        flange_mean_m: (3,) mean vector from B's flange to A's.
        angle_rad: Angle between the flanges.
    """

    joints_rad: tuple[Magnitudes, ...]
    flange_m: Magnitudes
    flange_axes_m: tuple[Magnitudes, ...]
    flange_mean_m: Array
    angle_rad: Magnitudes


@dataclass(frozen=True)
class ArmComparison:
    """One arm in both runs.

    Attributes:
        lag: Lag of run B behind run A on the task's clock.
        found: Differences as they are.
        free: Differences with B moved by the lag; None where the lag is not known.
        sent: Equality of the targets that were sent.
    """

    lag: Value
    found: Differences
    free: Differences | None
    sent: Parity


class Pair(NamedTuple):
    """Both runs of one episode at the same times.

    Attributes:
        number: Number of the episode.
        time_s: (k,) times on the task's clock.
        q_rad: (2, k, 2, 6) measured joints: run, time, arm.
        free_rad: (k, 2, 6) joints of run B with its lag taken off, if it is known. NaN where run B has no such time.
        flange_m: (2, k, 2, 3) flanges by each run's own kinematics.
        free_m: (k, 2, 3) flanges of run B with its lag taken off.
    """

    number: int
    time_s: Array
    q_rad: Array
    free_rad: Array
    flange_m: Array
    free_m: Array


@dataclass(frozen=True)
class Comparison:
    """Comparison of two runs.

    Attributes:
        headers: Headers of both runs.
        complete: True for a run that was recorded to its end.
        arms: Comparison of the left and the right arm.
        vector_m: Difference of the vectors from the right flange to the left one.
        vector_free_m: The same, each arm of run B moved by its lag.
        timing: Figures of each run by itself.
        pairs: Both runs at the same times, episode by episode.
        step_s: Time between two rows of a pair.
        notes: Caveats for the reader of the figures.
    """

    headers: tuple[Header, Header]
    complete: tuple[bool, bool]
    arms: tuple[ArmComparison, ArmComparison]
    vector_m: Magnitudes
    vector_free_m: Magnitudes
    timing: tuple[TimingReport, TimingReport]
    pairs: tuple[Pair, ...]
    step_s: float
    notes: tuple[str, ...]


def compare(run_a: Run, run_b: Run) -> Comparison:
    """Compare two runs of one task: episode with episode, in their order, on the task's clock.

    Flange poses follow from the measured joints by each run's own kinematics: no figure was measured from outside the
    arms.

    Raises:
        RecordingError: They are of different tasks, of another robot, or have too little in common.
    """
    runs = (run_a, run_b)
    _check(runs)
    step_s = max(each.header.tick_s for each in runs)
    mounts = (mounts_of(run_a.header), mounts_of(run_b.header))
    count = min(len(each.episodes) for each in runs)
    kept, left_out = _shared(runs, count, step_s)
    both, grids = [each[1] for each in kept], [each[2] for each in kept]
    lags = [_lag(both, grids, arm, step_s) for arm in range(2)]
    pairs = tuple(_pair(number, *each, grid, lags, mounts) for number, each, grid in kept)
    arms = [
        ArmComparison(
            lag=lags[arm],
            found=_differences(pairs, arm, mounts, free=False),
            free=None if lags[arm].reason else _differences(pairs, arm, mounts, free=True),
            sent=_parity(runs, [(a[arm], b[arm]) for a, b in both]),
        )
        for arm in range(2)
    ]
    known = not any(each.reason for each in lags)
    return Comparison(
        headers=(run_a.header, run_b.header),
        complete=(run_a.complete, run_b.complete),
        arms=(arms[0], arms[1]),
        vector_m=_vector(pairs, free=False),
        vector_free_m=_vector(pairs, free=True) if known else NO_MAGNITUDES,
        timing=(timing(run_a), timing(run_b)),
        pairs=pairs,
        step_s=step_s,
        notes=(*_notes(runs, mounts, count, [number for number, *_ in kept]), *left_out),
    )


_Tracks = tuple[tuple[Track, Track], tuple[Track, Track]]


def _shared(runs: tuple[Run, Run], count: int, step_s: float) -> tuple[list[tuple[int, _Tracks, Array]], list[str]]:
    """Return the episodes that can be compared, with their common times, and the reasons why others cannot.

    Raises:
        RecordingError: None can.
    """
    kept: list[tuple[int, _Tracks, Array]] = []
    left_out: list[str] = []
    first: RecordingError | None = None
    for number in range(count):
        try:
            _check_begin(runs, number)
            each = tracks(runs[0], number), tracks(runs[1], number)
            kept.append((number, each, _common(number, each, step_s)))
        except RecordingError as error:
            first = first or error
            left_out.append(f"episode {number} was left out: {error}")
    if first is not None and not kept:
        raise first
    return kept, left_out


def _check_begin(runs: tuple[Run, Run], number: int) -> None:
    for name, run in zip("AB", runs, strict=True):
        first = run.episodes[number].first_step
        if first:
            raise RecordingError(
                f"in run {name} it begins with its step {first}, as in a black box: only whole episodes are compared. "
                "Compare the run that it is of"
            )


def _parity(runs: tuple[Run, Run], episodes: list[tuple[Track, Track]]) -> Parity:
    a, b = (each.header for each in runs)
    if a.tick_s != b.tick_s:
        return Parity(0, 0, None, 0.0)  # target n is for another time
    return parity(episodes, b.latency_ticks - a.latency_ticks)


def _check(runs: tuple[Run, Run]) -> None:
    a, b = (each.header for each in runs)
    if a.env_id != b.env_id:
        raise RecordingError(
            f"run A is of {a.env_id}, run B of {b.env_id}: only runs of one task can be compared. Name two of the same"
        )
    for name, run in zip("AB", runs, strict=True):
        if not run.episodes:
            raise RecordingError(f"run {name} has no episode: there is nothing to compare. Name another recording")


def _common(number: int, both: tuple[tuple[Track, Track], tuple[Track, Track]], step_s: float) -> Array:
    """Return the times on the task's clock at which all four arms are known, `step_s` apart."""
    tracks = [each for run in both for each in run]
    begin, end = max(each.task_s[0] for each in tracks), min(each.task_s[-1] for each in tracks)
    if end - begin < LEAST_S:
        raise RecordingError(
            f"in episode {number}, the runs share {max(end - begin, 0.0):.3f} s of the task's time: {LEAST_S:g} s are "
            "needed. One of them was cut short; compare longer runs"
        )
    result: Array = begin + step_s * np.arange(int((end - begin) / step_s + 1e-6) + 1)
    return result


def _joints(track: Track, when_s: Array) -> Array:
    """Return the measured joints, (k, 6), at times of the task's clock."""
    ordered = rising(track.task_s)  # where the task's clock stopped, the first state of that time
    return interpolate(track.task_s[ordered], track.q_rad[ordered], when_s)


def _lag(
    both: list[tuple[tuple[Track, Track], tuple[Track, Track]]], grids: list[Array], arm: int, step_s: float
) -> Value:
    """Return the lag of run B's arm behind run A's: the median over the episodes in which it is known."""
    values = [
        lag(_joints(b[arm], grid), _joints(a[arm], grid), step_s) for (a, b), grid in zip(both, grids, strict=True)
    ]
    found = [each.value for each in values if not each.reason]
    return Value(float(np.median(found))) if found else none(values[0].reason)


def _pair(
    number: int,
    a: tuple[Track, Track],
    b: tuple[Track, Track],
    grid: Array,
    lags: list[Value],
    mounts: tuple[Mounts, Mounts],
) -> Pair:
    q = np.stack([np.stack([_joints(each, grid) for each in run], axis=1) for run in (a, b)])
    late = [0.0 if each.reason else each.value for each in lags]
    free = np.stack([_joints(each, grid + late[arm]) for arm, each in enumerate(b)], axis=1)
    for arm, each in enumerate(b):
        moved_s = grid + late[arm]
        free[(moved_s < each.task_s[0] - 1e-9) | (moved_s > each.task_s[-1] + 1e-9), arm] = np.nan
    flanges = [
        np.stack([flange_of(mounts[run][arm], joints[:, arm])[0] for arm in range(2)], axis=1)
        for run, joints in ((0, q[0]), (1, q[1]), (1, free))
    ]
    return Pair(number, grid, q, free, np.stack(flanges[:2]), flanges[2])


def _differences(pairs: tuple[Pair, ...], arm: int, mounts: tuple[Mounts, Mounts], *, free: bool) -> Differences:
    joints, flanges, angles = [], [], []
    for each in pairs:
        q_b = (each.free_rad if free else each.q_rad[1])[:, arm]
        known = np.isfinite(q_b).all(axis=1)
        q_a, q_b = each.q_rad[0, known, arm], q_b[known]
        joints.append(q_a - q_b)
        flanges.append(each.flange_m[0, known, arm] - (each.free_m if free else each.flange_m[1])[known, arm])
        apart = flange_of(mounts[0][arm], q_a)[1] - flange_of(mounts[1][arm], q_b)[1]
        # |R1 - R2| is 2 sqrt(2) sin(angle / 2), exact for small angles where the arc cosine of a trace is not.
        angles.append(2 * np.arcsin(np.minimum(np.linalg.norm(apart, axis=(1, 2)) / math.sqrt(8), 1.0)))
    joint, flange = np.concatenate(joints), np.concatenate(flanges)
    return Differences(
        joints_rad=tuple(spread(joint[:, k]) for k in range(6)),
        flange_m=spread(lengths(flange)),
        flange_axes_m=tuple(spread(flange[:, k]) for k in range(3)),
        flange_mean_m=flange.mean(axis=0) if len(flange) else np.full(3, np.nan),
        angle_rad=spread(np.concatenate(angles)),
    )


def _vector(pairs: tuple[Pair, ...], *, free: bool) -> Magnitudes:
    """Return the difference of the vector from flange to flange, which hides errors that both arms share."""
    found = []
    for each in pairs:
        away = each.flange_m[0] - (each.free_m if free else each.flange_m[1])
        apart = lengths(away[:, 0] - away[:, 1])
        found.append(apart[np.isfinite(apart)])
    return spread(np.concatenate(found))


def _notes(runs: tuple[Run, Run], mounts: tuple[Mounts, Mounts], count: int, compared: Sequence[int]) -> list[str]:
    (a, b), notes = (each.header for each in runs), []
    for name, run in zip("AB", runs, strict=True):
        if not run.complete:
            notes.append(f"run {name} was cut off: all that is whole was compared")
        notes += _stop_notes(name, run, compared)
        notes += _clock_notes(name, run)
    if len(runs[0].episodes) != len(runs[1].episodes):
        numbers = " and ".join(str(len(each.episodes)) for each in runs)
        notes.append(f"the runs have {numbers} episodes: the first {count} of each were compared")
    for what, left, right in (
        ("controllers", a.family, b.family),
        ("speed factors", f"{a.speed_factor:g}", f"{b.speed_factor:g}"),
        ("ticks per action", a.period_ticks, b.period_ticks),
        ("latencies in ticks", a.latency_ticks, b.latency_ticks),
        ("settings of servoj", _profiles(a), _profiles(b)),
        ("seeds", _seeds(runs[0], count), _seeds(runs[1], count)),
    ):
        # A replay begins where the replayed run began, and samples nothing.
        replayed = what == "seeds" and any("replays" in each.extra for each in (a, b))
        if left != right and not replayed:
            notes.append(f"{what} differ: {left} in run A, {right} in run B")
    if a.tick_s != b.tick_s:
        notes.append("control periods differ: the targets that were sent are not compared")
    ours, theirs = (replayed_keywords(each) for each in (a, b))
    for name in sorted({*ours, *theirs}):
        left, right = (repr(each[name]) if name in each else "not given" for each in (ours, theirs))
        if left != right:
            notes.append(f"{name} of the environment differs: {left:.200} in run A, {right:.200} in run B")
    if mounts[0] != mounts[1]:
        notes.append("bases or calibrations differ: each run's flanges are by its own")
    return notes


def _stop_notes(name: str, run: Run, compared: Sequence[int]) -> list[str]:
    count = late_actions(run, compared)
    if not count:
        return []
    what = "1 action missed its" if count == 1 else f"{count} actions missed their"
    return [
        f"run {name}: {what} deadline, and both arms stopped each time. On the task's clock, a stop lasts one action, "
        "however long it took: during it, the arms stand and the other run's arms move"
    ]


def _clock_notes(name: str, run: Run) -> list[str]:
    found = []
    for arm, each in zip(ARMS, run.arms, strict=True):
        by_s = clock_error_s(each, run.header.tick_s)
        if by_s:
            found.append(
                f"run {name}: the clock of the {arm} controller did not run steadily, as that of an emulated one on a "
                f"machine that stalls: it was off by up to {by_s:.3f} s. The times of its states follow from their "
                "arrival alone"
            )
    return found


def _seeds(run: Run, count: int) -> str:
    return ", ".join("none" if each.seed is None else str(each.seed) for each in run.episodes[:count])


def _profiles(header: Header) -> str:
    return ", ".join(f"lookahead {each['lookahead_s']:g} s with gain {each['gain']:g}" for each in header.servoj)
