"""Estimation of the lookahead and latency of each arm from targets and measured joints."""

from __future__ import annotations

import cmath
import math
from dataclasses import dataclass, replace
from typing import Final

import numpy as np
from numpy.typing import NDArray

from dual_ur10.errors import RecordingError
from dual_ur10.sim2real.analysis.series import STILL_RAD, rising
from dual_ur10.sim2real.analysis.tracks import Track, tracks
from dual_ur10.sim2real.recording.run import Run
from ur_core.kinematics.ur10 import ARMS
from ur_core.servoj import GAIN_RANGE, LOOKAHEAD_RANGE_S
from ur_core.types import Array

LOOKAHEAD_S: Final = (0.005, 0.5)
LATENCY_S: Final = (-0.05, 0.3)
"""Ranges of the estimates."""

_LEAST_S: Final = 1.0
_ROUNDS: Final = 30
_STEP_S: Final = 1e-5  # of differences
_EXPONENT: Final = 300.0  # of the largest exponential that is summed at once


@dataclass(frozen=True)
class Estimate:
    """Estimate of the parameters of the `servoj` law from a motion.

    Attributes:
        lookahead_s: Lookahead of the law.
        latency_s: Time from the sending of a target until it acts.
        lookahead_sigma_s, latency_sigma_s: Standard deviations of these.
        rms_rad: Root mean square of the residuals.
        reason: Reason why there is no estimate, with NaN for all numbers; "" if there is.
    """

    lookahead_s: float
    latency_s: float
    lookahead_sigma_s: float
    latency_sigma_s: float
    rms_rad: float
    reason: str = ""


@dataclass(frozen=True)
class ArmFit:
    """Estimates of one arm.

    Attributes:
        law: Estimate from the joints that the controller aimed at: the controller alone.
        arm: Estimate from the measured joints: controller and arm together, as a policy meets them. Where the lookahead
            of the controller alone is known, it is kept, and the latency includes the lag of the arm: the data hardly
            separate the two.
        lookahead_set_s, gain: Arguments with which `servoj` was called. The gain is not estimated.
    """

    law: Estimate
    arm: Estimate
    lookahead_set_s: float
    gain: float


def fit(run: Run, episode: int | None = None) -> tuple[ArmFit, ArmFit]:
    """Estimate lookahead and latency of both arms.

    Args:
        run: The recording, with moving arms.
        episode: Number of the episode; None: the longest.

    Raises:
        RecordingError: There is no such episode, nothing was recorded of an arm in it, or no controller accepts the
            recorded settings of servoj.
    """
    if episode is None:
        episode = max(range(len(run.episodes)), key=lambda each: len(run.episodes[each].reward), default=0)
    found = []
    for arm, each in enumerate(tracks(run, episode)):
        try:
            lookahead_s, gain = (float(run.header.servoj[arm][name]) for name in ("lookahead_s", "gain"))
        except (IndexError, KeyError, TypeError, ValueError) as error:
            raise RecordingError(f"{ARMS[arm]}: the recording does not say how servoj was called: {error}") from error
        if not (LOOKAHEAD_RANGE_S[0] <= lookahead_s <= LOOKAHEAD_RANGE_S[1] and GAIN_RANGE[0] <= gain <= GAIN_RANGE[1]):
            raise RecordingError(
                f"{ARMS[arm]}: servoj was called with lookahead_s={lookahead_s!r} and gain={gain!r}, by the recording: "
                f"a controller takes {LOOKAHEAD_RANGE_S[0]} to {LOOKAHEAD_RANGE_S[1]} s and {GAIN_RANGE[0]:g} to "
                f"{GAIN_RANGE[1]:g}. It is damaged; record another run"
            )
        reference = each.reference_rad
        law = (
            _no("the recording does not hold the joints that the controller aimed at")
            if reference is None
            else estimate(each, reference, lookahead_s, gain)
        )
        found.append(ArmFit(law, _with(law, each, lookahead_s, gain), lookahead_s, gain))
    return found[0], found[1]


def remark(found: Estimate, tick_s: float) -> str:
    """Return a caveat of an estimate; "" if there is none."""
    if found.reason or found.latency_s >= 0.0:
        return ""
    if found.latency_s < -tick_s - 3 * found.latency_sigma_s:
        return (
            f"the latency is below 0 by more than a control period of {1e3 * tick_s:g} ms, which no controller's is: "
            "clocks or settings of servoj differ from the recorded ones. Fit another run"
        )
    return (
        "the latency is below 0 by a part of a control period, which counts as 0: the instant of a state within its "
        "control period is not known, and the least delay of its packets is taken as 0"
    )


def _with(law: Estimate, track: Track, lookahead_s: float, gain: float) -> Estimate:
    """Return the estimate of an arm whose controller is known, if it is."""
    if law.reason:
        return estimate(track, track.q_rad, lookahead_s, gain)
    found = estimate(track, track.q_rad, law.lookahead_s, gain, known=True)
    return found if found.reason else replace(found, lookahead_sigma_s=law.lookahead_sigma_s)


def estimate(track: Track, joints_rad: Array, lookahead_s: float, gain: float, *, known: bool = False) -> Estimate:
    """Estimate lookahead and latency by least squares: the law, moved by targets, against joints.

    Each joint may be off by a constant, as in a sagging arm. Standard deviations account for the autocorrelation of the
    residuals.

    Args:
        track: Targets and their times.
        joints_rad: (j, 6) joints at `track.time_s`.
        lookahead_s: Initial lookahead.
        gain: Gain of the law, 1/s².
        known: Keep the lookahead, and estimate only the latency.
    """
    finite = np.isfinite(joints_rad).all(axis=1)
    time_s, joints = track.time_s[finite], joints_rad[finite]
    if len(time_s) < 3 or time_s[-1] - time_s[0] < _LEAST_S:
        return _no(f"too short: {_LEAST_S:g} s of motion are needed")
    if float(np.ptp(track.target_rad, axis=0).max()) < STILL_RAD:
        return _no("the targets of the arm do not move")
    if float(np.ptp(joints, axis=0).max()) < STILL_RAD:
        return _no("the arm did not move")

    ordered = rising(track.sent_s)
    sent_s, targets = track.sent_s[ordered], track.target_rad[ordered]

    def residuals(values: Array) -> Array:
        response = respond(sent_s + values[1], targets, targets[0], float(values[0]), gain, time_s)
        away: Array = joints - response
        return np.ravel(away - away.mean(axis=0))

    values, left = np.array([lookahead_s, 0.0]), np.zeros(0)
    low, high = np.array([LOOKAHEAD_S[0], LATENCY_S[0]]), np.array([LOOKAHEAD_S[1], LATENCY_S[1]])
    slopes, damping, settled = np.zeros((0, 2)), 1e-9, False
    left, directions = residuals(values), _STEP_S * np.eye(2)[1 if known else 0 :]
    for _ in range(_ROUNDS):
        slopes = np.stack(
            [(residuals(values + each) - residuals(values - each)) / (2 * _STEP_S) for each in directions], axis=1
        )
        square = slopes.T @ slopes
        damped = square + damping * np.diag(np.diag(square)) + 1e-12 * np.eye(len(directions))
        move = -np.linalg.solve(damped, slopes.T @ left)
        trial = np.clip(values + move @ directions / _STEP_S, low, high)
        after = residuals(trial)
        if after @ after <= left @ left * (1 + 1e-12):
            settled = bool(np.abs(trial - values).max() < 1e-8)
            values, left, damping = trial, after, max(damping / 10, 1e-9)
        else:
            settled = bool(np.abs(trial - values).max() < 1e-8)
            damping = max(damping * 100, 1e-3)
        if settled:
            break
    if not settled or (values <= low).any() or (values >= high).any():
        return _no(
            f"no lookahead of {LOOKAHEAD_S[0]:g} to {LOOKAHEAD_S[1]:g} s and latency of {LATENCY_S[0]:g} to "
            f"{LATENCY_S[1]:g} s makes the law move as the arm did"
        )
    rms = math.sqrt(float(left @ left) / len(left))
    moved = float(np.sqrt(((joints - joints.mean(axis=0)) ** 2).mean(axis=0)).max())
    if rms > 0.1 * moved:
        return _no(f"the law explains too little of the motion: it is {rms:.2g} rad off where joints move {moved:.2g}")
    square = slopes.T @ slopes
    sigma = np.sqrt(np.diag(np.linalg.inv(square)) * float(left @ left) / max(len(left) - 8, 1) * _redundancy(left))
    return Estimate(float(values[0]), float(values[1]), 0.0 if known else float(sigma[0]), float(sigma[-1]), rms)


def _no(reason: str) -> Estimate:
    return Estimate(math.nan, math.nan, math.nan, math.nan, math.nan, reason)


def _redundancy(left: Array) -> float:
    """Return the ratio of the number of residuals to the number of independent ones."""
    rows = left.reshape(-1, 6)
    total = float((rows * rows).sum())
    if total == 0.0:
        return 1.0
    like = min(max(float((rows[1:] * rows[:-1]).sum()) / total, 0.0), 0.999)
    return (1 + like) / (1 - like)


def respond(acts_s: Array, targets: Array, begin: Array, lookahead_s: float, gain: float, when_s: Array) -> Array:
    """Return the exact response of the law to targets at arbitrary times, from rest.

    qdd = gain (target - q - lookahead qd), each target held until the next.

    Args:
        acts_s: (k,) times at which each target begins to act, rising.
        targets: (k, d) targets.
        begin: (d,) joints before the first target.
        lookahead_s: Lookahead of the law.
        gain: Gain of the law, 1/s².
        when_s: (j,) times of the response, rising.

    Returns:
        (j, d) joints.
    """
    steps = np.diff(targets, axis=0, prepend=begin[None])
    half = gain * lookahead_s / 2
    root = cmath.sqrt(half * half - gain)
    if abs(root) < 1e-6 * half:  # a double root is replaced by two that hardly differ
        root = complex(1e-6 * half)
    fast, slow = half + root, half - root
    # A step decays as (fast exp(-slow t) - slow exp(-fast t)) / (fast - slow).
    left = fast * _decayed(acts_s, steps, slow, when_s) - slow * _decayed(acts_s, steps, fast, when_s)
    latest = np.searchsorted(acts_s, when_s, side="right") - 1
    held = np.where(latest[:, None] < 0, begin, targets[np.maximum(latest, 0)])
    result: Array = held - (left / (fast - slow)).real
    return result


def _decayed(begins_s: Array, steps: Array, rate: complex, when_s: Array) -> NDArray[np.complex128]:
    """Return the (j, d) sums of the steps before each time, each decayed by exp(-rate (time - begin))."""
    result = np.zeros((len(when_s), steps.shape[1]), dtype=np.complex128)
    carried: NDArray[np.complex128] = np.zeros(steps.shape[1], dtype=np.complex128)
    block_s = _EXPONENT / max(rate.real, 1e-9)
    first, origin = 0, begins_s[0]
    while first < len(begins_s):
        stop = max(int(np.searchsorted(begins_s, begins_s[first] + block_s)), first + 1)
        carried *= np.exp(-rate * (begins_s[first] - origin))
        origin = begins_s[first]
        grown = steps[first:stop] * np.exp(rate * (begins_s[first:stop] - origin))[:, None]
        sums = carried + np.cumsum(grown, axis=0)
        end = np.inf if stop == len(begins_s) else begins_s[stop]
        inside = slice(int(np.searchsorted(when_s, origin)), int(np.searchsorted(when_s, end)))
        latest = np.searchsorted(begins_s[first:stop], when_s[inside], side="right") - 1
        result[inside] = sums[latest] * np.exp(-rate * (when_s[inside] - origin))[:, None]
        carried, first = sums[-1], stop
    return result
