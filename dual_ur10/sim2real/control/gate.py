"""The safety gate: the last function before a target leaves for the arms, in simulation and on a robot.

It trusts no caller: it keeps its own record of released targets, and checks every window of targets against all limits,
against the brake that would follow, and against the distances at the end of that brake and along the path there. There
is no switch to turn it off. A period that fails is replaced by the brake from the last released target, which was found
legal when that target was accepted.
"""

from __future__ import annotations

import copy
import math
from dataclasses import dataclass
from typing import Final, NamedTuple, Protocol

import numpy as np

from dual_ur10.errors import ActionError, SettingsError
from dual_ur10.sim2real.control.limits import HISTORY, POINTS, Envelope, MotionLimits
from ur_core.kernel import RowLoop, Struct
from ur_core.kinematics.ur10 import ARMS, JOINTS
from ur_core.types import Array, Mask, Rows

SWEEP_TOLERANCE_M: Final = 0.005
"""Distance by which a pair may be closer than allowed between two checked configurations."""

# A path that needs more checks runs along an obstacle for long at full speed. It is refused, as time is short.
_CHECKS, _CHECKS_PER_TICK = 40, 10

_REST_RAD_S: Final = 1e-3  # speed that no limit notices if it ends at once

_LIMIT, _CARTESIAN = 1, 2  # the kernel's reasons of a refusal; the third is a distance

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
            f"(tick {self.tick}); the arms brake to rest"
        )


class Distances(Protocol):
    """Distances between bodies; see `dual_ur10.sim2real.control.clearance.Clearance`."""

    @property
    def kernel(self) -> Struct:
        """Return the kernel's structure `Distances`: how to measure, and the pairs' levers."""

    def worst(self, q_rad: Array) -> tuple[str, float, float]:
        """Return the pair with the smallest margin at a configuration, (12,), its distance and the legal minimum."""


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
        threads: Threads to compute on.
    """

    def __init__(
        self,
        limits: MotionLimits,
        tick_s: float,
        ticks: int,
        clearance: Distances,
        *,
        n: int = 1,
        threads: int = 1,
    ) -> None:
        self.limits, self.ticks, self.n, self._tick_s = limits, ticks, n, tick_s
        self.envelope = Envelope(limits, tick_s, ticks)
        self._clearance = clearance
        pairs = int(clearance.kernel.values["pairs"])
        self._past: Array = np.zeros((n, HISTORY, 12))
        self._sent = np.zeros(n, dtype=np.int64)
        self._verdicts: dict[int, Verdict] = {}
        self._targets: Array = np.zeros((n, ticks, 2, 6))
        self._spare: Array = np.zeros((n, pairs))
        # Known of the last target: the spare distance at a configuration, and the travel from there.
        self._known, self._away = np.zeros((n, pairs)), np.zeros((n, 12))
        # Targets that passed when somebody asked before, and what will be known of them.
        self._asked: Array = np.zeros((n, ticks, 2, 6))
        self._passed = np.zeros(n, dtype=np.int64)
        self._reason, self._index = np.zeros((2, n), dtype=np.int64)
        self._found, self._q = np.zeros(n), np.zeros((n, 12))
        brake = self.envelope.whole_brake()
        self.kernel = Struct(
            "Gate",
            n=n,
            ticks=ticks,
            pairs=pairs,
            brake_rows=len(brake),
            sweep_tolerance_m=SWEEP_TOLERANCE_M,
            most_checks=_CHECKS + _CHECKS_PER_TICK * ticks,
            envelope=self.envelope.kernel,
            distances=clearance.kernel,
            brake=brake,
            past=self._past,
            spare_m=self._spare,
            known_m=self._known,
            away_rad=self._away,
            next_known_m=np.zeros((n, pairs)),
            next_away_rad=np.zeros((n, 12)),
            asked=self._asked,
            passed=self._passed,
            reason=self._reason,
            index=self._index,
            found=self._found,
            q_rad=self._q,
            targets=self._targets,
        )
        self._step = RowLoop("gate_step", self.kernel, n, threads)

    @property
    def distances(self) -> Distances:
        """Distances that it checks."""
        return self._clearance

    @property
    def last_targets_rad(self) -> Array:
        """Targets released last, (n, 2, 6)."""
        return self._past[:, -1].reshape(self.n, 2, 6).copy()

    @property
    def rests(self) -> Mask:
        """(n,) True if the last targets are at rest, nearly: a brake decays."""
        steps: Array = np.abs(np.diff(self._past, axis=1)).max(axis=(1, 2))
        return steps <= _REST_RAD_S * self._tick_s

    @property
    def spare_m(self) -> Array:
        """Distances above the smallest legal ones, (n, pairs), at the end of the brake after the last window."""
        return self._spare

    def reset(self, q_rad: Array, rows: Rows | None = None) -> None:
        """Start from rest at `q_rad`, (n, 2, 6), in all cells or in `rows` of them (then (len(rows), 2, 6)).

        Raises:
            SettingsError: A configuration is not finite: nothing changes.
        """
        start: Array = np.asarray(q_rad, dtype=np.float64).reshape(-1, 1, 12)
        if not np.isfinite(start).all():
            raise SettingsError(
                f"the gate must start from finite configurations, found {start.tolist()}: measure again"
            )
        index = np.arange(self.n) if rows is None else rows
        self._past[index] = start
        self._sent[index] = self._reason[index] = self._passed[index] = 0
        self._known[index] = self._away[index] = 0.0  # the caller has checked the start
        for row in index.tolist():
            self._verdicts.pop(row, None)

    def rehearsal(self, past_rad: Array | None = None) -> SafetyGate:
        """Return another gate with the same limits, for checks of a path ahead: nothing that it releases may be sent.

        Args:
            past_rad: (n, HISTORY, 2, 6) targets from which it continues; None: those of this gate.
        """
        result = copy.deepcopy(self)
        if past_rad is not None:
            result.reset(past_rad[:, -1])
            result._past[:] = np.asarray(past_rad).reshape(self.n, HISTORY, 12)
        return result

    def __call__(self, targets_rad: Array) -> GateResult:
        """Release targets, or replace them by the brake.

        Args:
            targets_rad: (n, ticks, 2, 6).

        Raises:
            ActionError: Wrong shape or type, or NaN or infinity: nothing leaves and nothing changes.
        """
        shape = self._targets.shape
        if not isinstance(targets_rad, np.ndarray) or targets_rad.shape != shape:
            found = getattr(targets_rad, "shape", type(targets_rad).__name__)
            raise ActionError(f"targets must be an array of shape {shape}, found {found}: send all of them")
        if targets_rad.dtype != np.float64:
            raise ActionError(f"targets must be float64, found {targets_rad.dtype}: convert them first")
        if np.count_nonzero(np.isfinite(targets_rad)) < targets_rad.size:
            raise ActionError(_not_finite(targets_rad))
        self._targets[:] = targets_rad
        self._step()
        if np.count_nonzero(self._reason):
            for row in np.flatnonzero(self._reason).tolist():
                if row not in self._verdicts:
                    self._verdicts[row] = self._explain(row)
        self._sent += self.ticks
        self._clearance.kernel.check()
        # Copies: the released targets are the checked ones, and no caller holds the gate's own record.
        return GateResult(self._targets.copy(), dict(self._verdicts))

    def _explain(self, row: int) -> Verdict:
        """Return the reason that the kernel left for the refusal of a row."""
        tick, envelope, limits = int(self._sent[row]), self.envelope, self.limits
        reason, index, found = int(self._reason[row]), int(self._index[row]), float(self._found[row])
        if reason == _LIMIT:
            worst, column = divmod(index, 12)
            half, middle = envelope.half[worst, column % 6], envelope.middle[worst, column % 6]
            allowed = middle + half if found > middle else middle - half
            kind = envelope.kinds[worst]
            if kind != "joint position":
                found, allowed = abs(found), half
            return Verdict(kind, f"{ARMS[column // 6]}/{JOINTS[column % 6]}", found, float(allowed), tick)
        if reason == _CARTESIAN:
            arm, point = divmod(index, len(POINTS))
            limit = limits.tcp_speed_m_s
            return Verdict("Cartesian speed", f"{ARMS[arm]}/{POINTS[point]}", found * limit, limit, tick)
        try:
            pair, distance, smallest = self._clearance.worst(self._q[row])
        except Exception as error:  # the brake must leave, whatever its reason
            unknown = f"unknown pair ({type(error).__name__}: {error})"
            return Verdict("distance", unknown, math.nan, math.nan, tick)
        return Verdict("distance", pair, distance, smallest, tick)


def _not_finite(targets_rad: Array) -> str:
    row, tick, arm, joint = np.argwhere(~np.isfinite(targets_rad))[0]
    return (
        f"target of {ARMS[arm]}/{JOINTS[joint]} is {targets_rad[row, tick, arm, joint]} (cell {row}, tick {tick} of "
        "the period): targets must be finite. Nothing was sent"
    )
