"""Timing of one recorded run: lag behind its targets, skew, late ticks, ripple and repeatability."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Final

import numpy as np

from dual_ur10.errors import RecordingError
from dual_ur10.sim2real.analysis.series import (
    NO_MAGNITUDES,
    Magnitudes,
    Value,
    interpolate,
    lag,
    lengths,
    none,
    rising,
    smoothed,
    spread,
)
from dual_ur10.sim2real.analysis.tracks import Track, flange_of, tracks
from dual_ur10.sim2real.recording.header import mounts_of
from dual_ur10.sim2real.recording.run import Run
from ur_core.types import Array

LATE_S: Final = (0.002, 0.008)
"""Delays above which late targets are counted."""

RIPPLE_WINDOW_S: Final = 0.2
"""Window over which a flange's velocity is smoothed: changes faster than some 10 Hz are ripple."""

MOVING_M_S: Final = 0.005
"""Speed above which a flange's ripple is evaluated."""

SAME_START_RAD: Final = 0.02
"""Largest joint difference of episodes that begin at the same pose."""


@dataclass(frozen=True)
class Late:
    """Late and missed targets.

    Attributes:
        targets: Number of targets that were sent.
        late: Number of targets later than each of `LATE_S`.
        missed: Control periods in between without a target.
        most_s: Largest delay.
    """

    targets: int
    late: tuple[int, ...]
    missed: int
    most_s: float

    @property
    def ratios(self) -> tuple[float, ...]:
        """Ratios of late targets to all targets."""
        return tuple(each / self.targets if self.targets else math.nan for each in self.late)


@dataclass(frozen=True)
class Ripple:
    """Difference of a flange's velocity from a smooth one, while the flange moves.

    The velocity is the central difference of flange positions, one control period to either side, by the kinematics
    and the measured joints. The smooth one is that of the cubic fitted to a moving window of `RIPPLE_WINDOW_S`.

    Attributes:
        size_m_s: Length of the difference.
        reason: Reason why there is none; "" if there is.
    """

    size_m_s: Magnitudes
    reason: str = ""


@dataclass(frozen=True)
class Repeatability:
    """Repeatability of the pose at which episodes begin.

    Attributes:
        episodes: Number of episodes that began at the same pose.
        most_m: Largest distance of a flange to their mean.
        iso_m: Mean distance plus three standard deviations, the pose repeatability of ISO 9283; NaN below three.
        reason: Reason why there is none; "" if there is.
    """

    episodes: int
    most_m: float
    iso_m: float
    reason: str = ""


@dataclass(frozen=True)
class ArmTiming:
    """Figures of one arm in one run.

    Attributes:
        behind: Lag of the measured joints behind the targets that were sent.
        late: Late targets.
        ripple: Ripple of the flange's velocity.
        repeatability: Repeatability of the start pose.
    """

    behind: Value
    late: Late
    ripple: Ripple
    repeatability: Repeatability


@dataclass(frozen=True)
class TimingReport:
    """Figures of one run.

    Attributes:
        arms: Figures of the left and the right arm.
        skew_s: Time between the sendings of the same target to both arms.
        skew_reason: Reason why there is none; "" if there is.
        skews_s: (k,) skew of each target, left minus right.
    """

    arms: tuple[ArmTiming, ArmTiming]
    skew_s: Magnitudes
    skew_reason: str
    skews_s: Array


def timing(run: Run) -> TimingReport:
    """Return the figures of a run, over all its episodes.

    Raises:
        RecordingError: No episode holds enough of both arms.
    """
    episodes = _episodes(run)
    arms = [
        ArmTiming(
            behind=_first_of([behind(each[arm], run.header.tick_s) for each in episodes]),
            late=_late([each[arm] for each in episodes]),
            ripple=_ripple(run, [each[arm] for each in episodes], arm),
            repeatability=_repeatability(run, arm),
        )
        for arm in range(2)
    ]
    skews = [_skews(left, right) for left, right in episodes]
    skews_s = np.concatenate(skews) if skews else np.zeros(0)
    reason = "" if skews_s.size else "no target was sent to both arms"
    return TimingReport((arms[0], arms[1]), spread(skews_s), reason, skews_s)


def _episodes(run: Run) -> list[tuple[Track, Track]]:
    """Return the episodes of which enough was recorded. An episode may have ended at once."""
    found, first = [], None
    for number in range(len(run.episodes)):
        try:
            found.append(tracks(run, number))
        except RecordingError as error:
            first = first or error
    if first is not None and not found:
        raise first
    return found


def _first_of(values: list[Value]) -> Value:
    """Return the median of the figures, or the first reason if there is none."""
    found = [each.value for each in values if not each.reason]
    if found:
        return Value(float(np.median(found)))
    return values[0] if values else none("there are no episodes")


def behind(track: Track, tick_s: float) -> Value:
    """Return the lag of the measured joints behind the targets that were sent, on the run's clock."""
    ordered = rising(track.sent_s)
    sent_s, targets = track.sent_s[ordered], track.target_rad[ordered]
    grid = _grid(max(sent_s[0], track.time_s[0]), min(sent_s[-1], track.time_s[-1]), tick_s)
    return lag(interpolate(track.time_s, track.q_rad, grid), interpolate(sent_s, targets, grid), tick_s)


def _grid(begin: float, end: float, step_s: float) -> Array:
    count = max(int((end - begin) / step_s + 1e-6) + 1, 0)
    result: Array = begin + step_s * np.arange(count, dtype=np.float64)
    return result


def _late(arms: list[Track]) -> Late:
    late_s = np.concatenate([each.late_s for each in arms]) if arms else np.zeros(0)
    missed = sum(int(np.maximum(np.diff(each.period) - 1, 0).sum()) for each in arms)
    counts = tuple(int((late_s > limit).sum()) for limit in LATE_S)
    return Late(len(late_s), counts, missed, float(late_s.max()) if len(late_s) else math.nan)


def _skews(left: Track, right: Track) -> Array:
    """Return the time from the sending of a target to the right arm to that to the left one."""
    both = [(each.number[ordered], each.sent_s[ordered]) for each in (left, right) for ordered in [rising(each.number)]]
    (index_l, sent_l), (index_r, sent_r) = both
    inside = (index_l >= index_r[0]) & (index_l <= index_r[-1])
    # A target that one arm missed is not interpolated.
    after = np.clip(np.searchsorted(index_r, index_l), 0, len(index_r) - 1)
    before = np.maximum(after - 1, 0)
    inside &= (index_r[after] == index_l) | (index_r[after] - index_r[before] <= 1.0)
    result: Array = sent_l[inside] - np.interp(index_l[inside], index_r, sent_r)
    return result


def ripple_of(positions_m: Array, step_s: float) -> Array:
    """Return the (j,) differences of a velocity from a smooth one while it moves, in m/s; (0,) if too short or slow.

    Args:
        positions_m: (k, 3) positions, `step_s` apart.
        step_s: Time between two positions.
    """
    velocity = (positions_m[2:] - positions_m[:-2]) / (2 * step_s)
    half = max(2, round(RIPPLE_WINDOW_S / 2 / step_s))
    smooth = smoothed(velocity, half)
    if not len(smooth):
        return np.zeros(0)
    difference = lengths(velocity[half : len(velocity) - half] - smooth)
    result: Array = difference[lengths(smooth) > MOVING_M_S]
    return result


def _ripple(run: Run, arms: list[Track], arm: int) -> Ripple:
    mount, step_s = mounts_of(run.header)[arm], run.header.tick_s
    found = []
    for each in arms:
        grid = _grid(each.time_s[0], each.time_s[-1], step_s)
        found.append(ripple_of(flange_of(mount, interpolate(each.time_s, each.q_rad, grid))[0], step_s))
    sizes = np.concatenate(found) if found else np.zeros(0)
    if not sizes.size:
        return Ripple(NO_MAGNITUDES, f"the flange did not move faster than {1e3 * MOVING_M_S:g} mm/s, or not for long")
    return Ripple(spread(sizes))


def _repeatability(run: Run, arm: int) -> Repeatability:
    starts = [each.q_rad[0, arm] for each in run.episodes if not each.first_step]
    count = len(starts)
    same = [each for each in starts if np.abs(each - starts[0]).max() <= SAME_START_RAD]
    if len(same) < 2:
        few = f"of {count} episodes, no other begins at the pose of the first"
        reason = few if count > 1 else "two episodes or more are needed"
        return Repeatability(len(same), math.nan, math.nan, reason)
    positions = flange_of(mounts_of(run.header)[arm], np.array(same))[0]
    away = lengths(positions - positions.mean(axis=0))
    iso = float(away.mean() + 3 * away.std(ddof=1)) if len(away) > 2 else math.nan
    return Repeatability(len(same), float(away.max()), iso)
