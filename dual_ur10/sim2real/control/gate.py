"""The safety gate: the last function before a target leaves for the arms, in simulation and on a robot.

It trusts no caller: it keeps its own record of released targets, and checks every window of targets against all limits,
against the brake that would follow, and against the distances at the end of that brake and along the path there. There
is no switch to turn it off. A period that fails is replaced by the brake from the last released target, which was found
legal when that target was accepted.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from dual_ur10.errors import ActionError
from dual_ur10.kinematics.ur10 import ARMS, JOINTS
from dual_ur10.sim2real.control.limits import HISTORY, POINTS, Envelope, MotionLimits
from dual_ur10.sim2real.control.swept_clearance import Distances, SweptClearance
from dual_ur10.types import Array, Mask, Rows

_TOLERANCE = 1.0 + 1e-9  # rounding of a third difference of positions

_UNITS = {
    "joint position": "rad",
    "joint speed": "rad/s",
    "joint acceleration": "rad/s²",
    "joint jerk": "rad/s³",
    "Cartesian speed": "m/s",
    "distance": "m",
}


@dataclass(frozen=True)
class Verdict:
    """Reason why the gate refused a period.

    Attributes:
        kind: "joint position", "joint speed", "joint acceleration", "joint jerk", "Cartesian speed" or
            "distance".
        subject: The joint, point or pair of bodies, with its arm: "left/elbow_joint", "left/forearm_link and table".
        found: Value that the targets would have reached.
        allowed: Limit.
        tick: Ticks sent by this row since its reset, at the beginning of the refused period.
    """

    kind: str
    subject: str
    found: float
    allowed: float
    tick: int

    def __str__(self) -> str:
        unit = _UNITS[self.kind]
        side = "at least" if self.kind == "distance" else "at most"
        return (
            f"{self.subject}: {self.kind} {self.found:.6g} {unit}, allowed {side} {self.allowed:.6g} {unit} "
            f"(tick {self.tick}); the arms brake to rest and stay there until a reset"
        )


class GateResult(NamedTuple):
    """Released targets, and the reasons for refused ones.

    Attributes:
        targets_rad: (n, ticks, 2, 6) targets; the brake in refused rows.
        verdicts: Verdict of each row refused now or earlier since its reset; empty if there is none.
    """

    targets_rad: Array
    verdicts: dict[int, Verdict]


class SafetyGate:
    """Checks every target before it is released.

    Args:
        limits: Limits of motion.
        tick_s: Time between two targets.
        ticks: Targets per call.
        clearance: Computes distances.
        n: Number of cells.
    """

    def __init__(self, limits: MotionLimits, tick_s: float, ticks: int, clearance: Distances, *, n: int = 1) -> None:
        self.limits, self.ticks, self.n = limits, ticks, n
        self.envelope = Envelope(limits, tick_s, ticks)
        self._clearance = clearance
        self._past: Array = np.zeros((n, HISTORY, 12))
        self._sent = np.zeros(n, dtype=np.int64)
        self._spare: Array = np.zeros((n, 0))
        self._verdicts: dict[int, Verdict] = {}
        self._swept = SweptClearance(clearance, self.envelope.whole_brake(), ticks)
        self._too_close_q: dict[int, Array] = {}  # by row: configuration on its path where a pair is too close

    @property
    def last_targets_rad(self) -> Array:
        """Targets released last, (n, 2, 6)."""
        return self._past[:, -1].reshape(self.n, 2, 6).copy()

    @property
    def spare_m(self) -> Array:
        """Distances above the smallest legal ones, (n, pairs), at the end of the brake after the last window."""
        return self._spare

    def reset(self, q_rad: Array, rows: Rows | None = None) -> None:
        """Start from rest at `q_rad`, (n, 2, 6), in all cells or in `rows` of them (then (len(rows), 2, 6))."""
        index = np.arange(self.n) if rows is None else rows
        self._past[index] = np.asarray(q_rad).reshape(-1, 1, 12)
        self._sent[index] = 0
        self._swept.reset(index)
        for row in index.tolist():
            self._verdicts.pop(row, None)

    @np.errstate(over="ignore", invalid="ignore")  # the checks find huge and infinite targets
    def __call__(self, targets_rad: Array) -> GateResult:
        """Release targets, or replace them by the brake.

        Args:
            targets_rad: (n, ticks, 2, 6).

        Raises:
            ActionError: Wrong shape or type, or NaN or infinity: nothing leaves and nothing changes.
        """
        envelope, ticks, n = self.envelope, self.ticks, self.n
        if not isinstance(targets_rad, np.ndarray) or targets_rad.shape != (n, ticks, 2, 6):
            found = getattr(targets_rad, "shape", type(targets_rad).__name__)
            raise ActionError(f"targets must be an array of shape {(n, ticks, 2, 6)}, found {found}: send all of them")
        if targets_rad.dtype != np.float64:
            raise ActionError(f"targets must be float64, found {targets_rad.dtype}: convert them first")
        window = np.concatenate([self._past, targets_rad.reshape(n, ticks, 12)], axis=1)
        quantities = envelope.rows @ window
        used = envelope.use(quantities)
        # Every check is of the form "within the limit", which NaN and infinity never are.
        kept = envelope.within(used, _TOLERANCE, 1.0)
        if not kept and not np.isfinite(targets_rad).all():
            raise ActionError(_not_finite(targets_rad))
        first_order, rest = quantities[:, envelope.rest_row - 1], quantities[:, envelope.rest_row]
        self._spare = spare = self._clearance.spare_m(rest)
        legal = np.logical_and.reduce(spare >= 0.0, axis=1)
        if not kept:
            legal = legal & self._in_detail(window, used)
        going = legal.copy()
        going[list(self._verdicts)] = False
        self._too_close_q = self._swept(window, first_order, rest, spare, going)
        legal[list(self._too_close_q)] = False
        if self._verdicts or not np.logical_and.reduce(legal):
            self._refuse(np.flatnonzero(~legal), window, quantities, used)
        self._past = window[:, -HISTORY:]
        self._sent += ticks
        # Copies: the released targets are the checked ones, and no caller holds the gate's own record.
        leaving = window[:, HISTORY:].copy().reshape(n, ticks, 2, 6)
        return GateResult(leaving, dict(self._verdicts))

    def _in_detail(self, window: Array, used: Array) -> Mask:
        """Return an (n,) mask of rows within all limits, with the Cartesian speed itself where its bound fails."""
        legal: Mask = used.reshape(self.n, -1).max(axis=1) <= _TOLERANCE
        rows = np.flatnonzero(legal & (self.envelope.cartesian_bound(used) > 1.0))
        if rows.size:
            fastest, _ = self.envelope.cartesian_use(window[rows])
            legal[rows] = fastest.max(axis=1) <= _TOLERANCE
        return legal

    def _refuse(self, rows: Rows, window: Array, quantities: Array, used: Array) -> None:
        """Write the brake into the refused rows of `window`, and keep the reason."""
        for row in rows.tolist():
            if row not in self._verdicts:
                self._verdicts[row] = self._explain(row, window, quantities, used)
        stopping = np.array(sorted(self._verdicts), dtype=np.intp)
        past = self._past[stopping]
        # Relative to the last target, rounding of the brake is far below that of a third difference.
        last = past[:, -1:]
        brake = last + self.envelope.brake @ (past - last)
        speed = np.abs(np.diff(past, axis=1)).max(axis=(1, 2)) / self.envelope.tick_s
        resting = speed < self.envelope.rest_speed_rad_s
        window[stopping, HISTORY:] = np.where(resting[:, None, None], last, brake)

    def _explain(self, row: int, window: Array, quantities: Array, used: Array) -> Verdict:
        tick, envelope = int(self._sent[row]), self.envelope
        worst, column = np.unravel_index(used[row].argmax(), used[row].shape)
        if not used[row, worst, column] <= _TOLERANCE:
            half = envelope.half[worst, column % 6]
            found, middle = quantities[row, worst, column], envelope.middle[worst, column % 6]
            allowed = middle + half if found > middle else middle - half
            kind = envelope.kinds[worst]
            if kind != "joint position":
                found, allowed = abs(found), half
            subject = f"{ARMS[column // 6]}/{JOINTS[column % 6]}"
            return Verdict(kind, subject, float(found), float(allowed), tick)
        (fastest,), (point,) = envelope.cartesian_use(window[[row]])
        arm = int(fastest.argmax())
        if fastest[arm] > _TOLERANCE:
            subject = f"{ARMS[arm]}/{POINTS[point[arm]]}"
            limit = self.limits.tcp_speed_m_s
            return Verdict("Cartesian speed", subject, float(fastest[arm] * limit), limit, tick)
        q_rad = self._too_close_q.get(row, quantities[row, envelope.rest_row])
        pair, distance, allowed = self._clearance.worst(q_rad)
        return Verdict("distance", pair, distance, allowed, tick)


def _not_finite(targets_rad: Array) -> str:
    row, tick, arm, joint = np.argwhere(~np.isfinite(targets_rad))[0]
    return (
        f"target of {ARMS[arm]}/{JOINTS[joint]} is {targets_rad[row, tick, arm, joint]} (cell {row}, tick {tick} of "
        "the period): targets must be finite. Nothing was sent"
    )
