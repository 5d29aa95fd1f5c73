"""Limits of motion, and the brake that every accepted motion must leave possible.

The brake is a linear law: without a new target, the speed of each joint goes on as

    v[k+1] = 2 r v[k] - r² v[k-1],    r = exp(-w T)

which is a critically damped decay. Because it is linear and the same for every tick, "this motion can be stopped within
all limits" is a fixed set of linear inequalities on the last three targets, and a state that satisfies them still does
one brake tick later. Braking is therefore always possible, for the adapter's limiter and for the safety gate alike.
"""

from __future__ import annotations

import math
from collections.abc import Collection
from dataclasses import dataclass, replace
from functools import lru_cache
from typing import Any, SupportsFloat

import numpy as np
from numpy.typing import NDArray

from dual_ur10.errors import SettingsError, distinguishable
from ur_core.kernel import Struct
from ur_core.kinematics import ur10
from ur_core.kinematics.forward import lengths_m
from ur_core.kinematics.robots import ROBOTS, robot_model
from ur_core.kinematics.ur10 import nominal_dh
from ur_core.types import Array, Vector3, constant

Six = tuple[float, float, float, float, float, float]

POINTS = ("elbow", "flange", "TCP")
"""Points of an arm whose speed is limited."""

HISTORY = 3
"""Past targets before the first new one of a window: a third difference reaches back that far."""

REST_SPEED_RAD_S = 1e-4
"""Below this speed the brake holds its position, unless tight limits ask for less."""

_BRAKE_GAP, _BRAKE_PEAK, _BRAKE_LAST = 0.2, 2.0, 3.0
"""Instants along the brake, in units of 1 / w, at which the Cartesian speed is checked: gap, peak and last. The speed
can rise at first, where the joints were still accelerating, and is over its peak before 2 / w."""

_BRAKE_TIMES = 14.0
"""Duration of the whole brake in the same units: any remaining speed then counts as rest."""

_PEAK_BETWEEN_INSTANTS = 1.006
"""Factor by which a peak between two instants can be higher: its curvature is at most w², half a gap is 0.1 / w."""


@lru_cache(maxsize=len(ROBOTS))
def reach_from_joint_m(robot: str) -> Array:
    """Return the largest distance, (6,), of a model's flange from each joint's axis; the elbow is always nearer."""
    _, a2, a3, d4, d5, d6 = robot_model(robot).lengths_m
    arm = abs(a2) + abs(a3) + d5 + d6
    return constant([math.hypot(arm, d4 + d6), arm, arm - abs(a2), d5 + d6, d6, 0.0])


MOST_TCP_M = 2.0
"""Largest coordinate of a tool centre point in its flange's frame: chosen, longer than any tool that an arm carries."""


def checked_tcp(values: Any) -> tuple[Vector3, Vector3]:
    """Return the tool centre points of both arms as plain numbers.

    Raises:
        SettingsError: They are not three numbers for each arm, or too large.
    """
    try:
        array = np.array(values, dtype=np.float64)
    except (TypeError, ValueError):
        array = np.empty(0)
    if array.shape != (2, 3) or not (np.abs(array) <= MOST_TCP_M).all():
        raise SettingsError(
            f"tcp_m is {values!r}: it must be three numbers for each of the two arms, at most {MOST_TCP_M:g} m in size"
        )
    left, right = array.tolist()
    return (*left,), (*right,)


def _six(values: Any) -> Six:
    try:
        array = np.broadcast_to(np.asarray(values, dtype=np.float64), (6,))
    except (OverflowError, TypeError, ValueError):
        raise SettingsError(f"a limit must be one number or six, found {values!r:.200}") from None
    return (*array.tolist(),)


def _one(name: str, value: Any) -> float:
    if isinstance(value, str) or not isinstance(value, SupportsFloat):
        raise SettingsError(f"limit {name} must be a number, found {value!r:.200}")
    try:
        return float(value)
    except (OverflowError, TypeError, ValueError):
        raise SettingsError(f"limit {name} must be a number, found {value!r:.200}") from None


def hard_speed_rad_s(robots: Collection[str]) -> Array:
    """Return the hard limits of the joint speeds, (6,), that targets of all these models have to keep."""
    speed: Array = np.min([robot_model(robot).hard_speed_rad_s for robot in robots], axis=0)
    return speed


# Defaults of MotionLimits.
_SPEED_RAD_S = _six(ur10.HARD_SPEED_RAD_S)
_LOWER_RAD = _six(-ur10.JOINT_RANGE_RAD)
_UPPER_RAD = _six(ur10.JOINT_RANGE_RAD)


@dataclass(frozen=True)
class MotionLimits:
    """Limits of the targets of one arm, on the wire. Both arms share them.

    Attributes:
        speed_rad_s: Six joint speeds, or one for all.
        acceleration_rad_s2: Joint acceleration, the second difference of the targets.
        jerk_rad_s3: Joint jerk, the third difference of the targets.
        tcp_speed_m_s: Cartesian speed of flange, elbow and tool centre point of a nominal arm; a calibrated one differs
            by its deviation in length.
        lower_rad: Smallest joint positions; the arm must also be able to stop inside the range.
        upper_rad: Largest joint positions.
        tcp_m: Tool centre point of the left and the right arm in its flange's frame; zeros: at the flange.
        robots: Models of the left and the right arm.

    Raises:
        UnknownNameError: There is no such model.
        SettingsError: A limit is no number, not positive and finite, or wider than the hard limits of one of both
            models in `ur_core.kinematics.robot_model`.
    """

    speed_rad_s: Six = _SPEED_RAD_S
    acceleration_rad_s2: float = ur10.HARD_ACCELERATION_RAD_S2
    jerk_rad_s3: float = ur10.HARD_JERK_RAD_S3
    tcp_speed_m_s: float = ur10.HARD_TCP_SPEED_M_S
    lower_rad: Six = _LOWER_RAD
    upper_rad: Six = _UPPER_RAD
    tcp_m: tuple[Vector3, Vector3] = ((0.0, 0.0, 0.0), (0.0, 0.0, 0.0))
    robots: tuple[str, str] = ("ur10", "ur10")

    def __post_init__(self) -> None:
        if not isinstance(self.robots, tuple | list) or len(self.robots) != len(ur10.ARMS):
            raise SettingsError(f"robots of the limits are {self.robots!r:.200}: name the models of both arms")
        object.__setattr__(self, "robots", tuple(self.robots))
        for name in ("speed_rad_s", "lower_rad", "upper_rad"):
            object.__setattr__(self, name, _six(getattr(self, name)))
        for name in ("acceleration_rad_s2", "jerk_rad_s3", "tcp_speed_m_s"):
            object.__setattr__(self, name, _one(name, getattr(self, name)))
        for name, hard in (
            ("speed_rad_s", hard_speed_rad_s(self.robots)),
            ("acceleration_rad_s2", ur10.HARD_ACCELERATION_RAD_S2),
            ("jerk_rad_s3", ur10.HARD_JERK_RAD_S3),
            ("tcp_speed_m_s", ur10.HARD_TCP_SPEED_M_S),
        ):
            value = np.asarray(getattr(self, name))
            if not (np.isfinite(value).all() and (value > 0).all() and (value <= hard).all()):
                whose = f" for {' and '.join(dict.fromkeys(self.robots))}; `robots` names other models"
                raise SettingsError(
                    f"limit {name} is {getattr(self, name)}: it must be above 0 and at most {hard}"
                    f"{whose if name == 'speed_rad_s' else ''}"
                )
        object.__setattr__(self, "tcp_m", checked_tcp(self.tcp_m))
        lower, upper = np.asarray(self.lower_rad), np.asarray(self.upper_rad)
        if not ((lower >= -ur10.JOINT_RANGE_RAD) & (upper <= ur10.JOINT_RANGE_RAD) & (lower < upper)).all():
            raise SettingsError(
                f"joint range {self.lower_rad} to {self.upper_rad} rad must lie inside ±{ur10.JOINT_RANGE_RAD.tolist()}"
            )

    def of(self, robots: tuple[str, str]) -> MotionLimits:
        """Return these limits for two models, within their hard limits."""
        speed = np.minimum(self.speed_rad_s, hard_speed_rad_s(robots))
        return replace(self, speed_rad_s=_six(speed), robots=robots)

    def check_range(self, q_rad: Array) -> None:
        """Check that joint angles, (2, 6), are within the joint range.

        Raises:
            SettingsError: One is outside.
        """
        lower, upper = np.asarray(self.lower_rad), np.asarray(self.upper_rad)
        for arm, joint in np.argwhere((q_rad < lower) | (q_rad > upper)):
            value = float(q_rad[arm, joint])
            low = value < lower[joint]
            found, bound = distinguishable(value, float((lower if low else upper)[joint]))
            remedy = "are these degrees?" if abs(value) > 2 * math.pi else "choose another angle"
            raise SettingsError(
                f"{ur10.ARMS[arm]}/{ur10.JOINTS[joint]} is at {found} rad, allowed are at {'least' if low else 'most'} "
                f"{bound} rad: {remedy}"
            )

    def narrowed(self, margin_rad: float) -> MotionLimits:
        """Return these limits with a joint range smaller by `margin_rad` on both sides."""
        return replace(
            self,
            lower_rad=_six(np.asarray(self.lower_rad) + margin_rad),
            upper_rad=_six(np.asarray(self.upper_rad) - margin_rad),
        )

    def brake_rate(self) -> float:
        """Return the brake's decay rate w (1/s), at which no joint at full speed exceeds its other limits."""
        speed = max(self.speed_rad_s)
        # A critically damped decay from v0 peaks at w v0 / e in acceleration and w² v0 in jerk; the 10 % are room for
        # stopping while still accelerating.
        return 0.9 * min(math.e * self.acceleration_rad_s2 / speed, math.sqrt(self.jerk_rad_s3 / speed))


class Envelope:
    """Limits as inequalities on a window of targets: three past ones and `ticks` new ones.

    A row of `rows` (m, 3 + ticks) maps the window of one joint to one limited quantity: speed, acceleration, jerk and
    position at each new target, the same along the brake that would follow, and the position where it stops.
    With `q = rows @ window`, the window is legal if |q - middle| <= half for every row and joint.

    Args:
        limits: Limits of each arm.
        tick_s: Time between two targets.
        ticks: Number of new targets in a window, at least 1.
        stops: New targets after which a stop must be possible; None: the last one.
    """

    def __init__(self, limits: MotionLimits, tick_s: float, ticks: int, stops: Collection[int] | None = None) -> None:
        self.limits, self.tick_s, self.ticks = limits, tick_s, ticks
        self.brake_rate = limits.brake_rate()
        self.ratio = math.exp(-self.brake_rate * tick_s)
        # Stopping dead from this speed takes at most half the acceleration and three quarters of the jerk.
        self.rest_speed_rad_s = min(
            REST_SPEED_RAD_S, limits.acceleration_rad_s2 * tick_s / 2, limits.jerk_rad_s3 * tick_s**2 / 4
        )
        width = HISTORY + ticks
        identity = np.eye(width)
        speed = (identity[1:] - identity[:-1]) / tick_s
        acceleration = (speed[1:] - speed[:-1]) / tick_s
        jerk = (acceleration[1:] - acceleration[:-1]) / tick_s
        blocks = {
            "joint speed": [speed[HISTORY - 1 :]],
            "joint acceleration": [acceleration[HISTORY - 2 :]],
            "joint jerk": [jerk[HISTORY - 3 :]],
            "joint position": [identity[HISTORY:]],
        }
        ahead, r = self._brake_derivatives(), self.ratio
        self._stops = sorted({ticks} if stops is None else {*stops, ticks})
        for stop in self._stops:
            last = HISTORY - 1 + stop
            speeds = speed[[last - 1, last - 2]]
            for kind, rows in ahead.items():
                blocks[kind].append(rows @ speeds)
            # End of a first-order decay, and end of the brake itself: under the brake the position follows the first,
            # which follows the second, which stays. With all three inside the range, so is the path.
            first_order = identity[last] + tick_s * r / (1 - r) * speeds[0]
            rest = identity[last] + tick_s * ((2 * r - r * r) * speeds[0] - r * r * speeds[1]) / (1 - r) ** 2
            blocks["joint position"].append(np.stack([first_order, rest]))
        stacked = {kind: np.vstack(parts) for kind, parts in blocks.items()}
        self.rows: Array = np.ascontiguousarray(np.vstack(list(stacked.values())))
        self.kinds = [kind for kind, block in stacked.items() for _ in block]
        self.rest_row = len(self.rows) - 1
        self.middle, self.half = self._bounds()
        self.brake: Array = self._brake(ticks)
        self.coast: Array = self._coast(ticks)
        self.kernel = self._kernel()

    def _kernel(self) -> Struct:
        """Return the coefficients as the kernel's structure."""
        limits, samples = self.limits, self._sampled_brake()
        # Largest fraction of the Cartesian speed limit that each joint uses at its own full speed.
        arms = zip(limits.robots, limits.tcp_m, strict=True)
        reach = np.array([reach_from_joint_m(robot) + math.hypot(*tcp_m) for robot, tcp_m in arms])
        lever = np.zeros((12, 2))
        for arm in range(2):
            lever[6 * arm : 6 * arm + 6, arm] = np.asarray(limits.speed_rad_s) * reach[arm] / limits.tcp_speed_m_s
        used = self.rows != 0.0
        return Struct(
            "Envelope",
            ticks=self.ticks,
            width=HISTORY + self.ticks,
            m=len(self.rows),
            speed_rows=self.kinds.count("joint speed"),
            position_row=len(self.rows) - self.kinds.count("joint position"),
            samples=len(samples) // 2,
            stops=len(self._stops),
            tick_s=self.tick_s,
            tcp_speed_m_s=limits.tcp_speed_m_s,
            rest_speed_rad_s=self.rest_speed_rad_s,
            peak_between=_PEAK_BETWEEN_INSTANTS,
            rows=self.rows,
            begins=used.argmax(axis=1),
            ends=used.shape[1] - used[:, ::-1].argmax(axis=1),
            middle=np.tile(self.middle, 2),
            scale=1.0 / np.tile(self.half, 2),
            lever=lever * _PEAK_BETWEEN_INSTANTS,
            reach_m=reach,
            brake_samples=samples,
            stop=np.array(self._stops),
            brake=self.brake,
            coast=self.coast,
            lengths_m=np.array([lengths_m(nominal_dh(robot)) for robot in limits.robots]),
            tcp_m=np.array(limits.tcp_m),
        )

    def _brake(self, ticks: int) -> Array:
        """Return rows (ticks, 3) that continue three past targets with the brake."""
        r, rows = self.ratio, list(np.eye(HISTORY))
        for _ in range(ticks):
            rows.append(rows[-1] + 2 * r * (rows[-1] - rows[-2]) - r * r * (rows[-2] - rows[-3]))
        return np.array(rows[HISTORY:])

    def whole_brake(self) -> Array:
        """Return rows (k, 3) that continue three past targets with the brake until it is at rest."""
        return self._brake(math.ceil(_BRAKE_TIMES / (self.brake_rate * self.tick_s)))

    def _brake_derivatives(self) -> dict[str, Array]:
        limits = self.limits
        speeds = frozenset(limits.speed_rad_s)
        return _brake_derivatives(speeds, limits.acceleration_rad_s2, limits.jerk_rad_s3, self.brake_rate, self.tick_s)

    def of_brakes(self) -> tuple[Array, NDArray[np.int64]]:
        """Return peaks along the brake as rows (m, 3) on targets, each of speed (0), acceleration (1) or jerk (2)."""
        identity = np.eye(HISTORY)
        speeds = np.diff(identity, axis=0)[::-1] / self.tick_s
        rows = list(self._brake_derivatives().values())
        return np.concatenate(rows) @ speeds, np.repeat(np.arange(len(rows)), [len(each) for each in rows])

    def _coast(self, ticks: int) -> Array:
        """Return rows (ticks, 3) that continue three past targets at their speed, while the acceleration decays."""
        rows = list(np.eye(HISTORY))
        for _ in range(ticks):
            speed, before = rows[-1] - rows[-2], rows[-2] - rows[-3]
            rows.append(rows[-1] + speed + self.ratio * (speed - before))
        return np.array(rows[HISTORY:])

    def _sampled_brake(self) -> Array:
        """Return rows (2 samples, 3): targets before the sampled ticks of the brake, then those at these ticks."""
        at = _brake_ticks(self.brake_rate * self.tick_s)
        positions = np.vstack([np.eye(HISTORY)[-1:], self._brake(int(at[-1]) + 1)])
        return np.concatenate([positions[at], positions[at + 1]])

    def _bounds(self) -> tuple[Array, Array]:
        """Return middle and half width of every row's range, (m, 6) each."""
        limits = self.limits
        lower, upper = np.asarray(limits.lower_rad), np.asarray(limits.upper_rad)
        half = {
            "joint speed": np.asarray(limits.speed_rad_s),
            "joint acceleration": np.full(6, limits.acceleration_rad_s2),
            "joint jerk": np.full(6, limits.jerk_rad_s3),
            "joint position": (upper - lower) / 2,
        }
        middle = np.array([(upper + lower) / 2 if kind == "joint position" else np.zeros(6) for kind in self.kinds])
        return middle, np.array([half[kind] for kind in self.kinds])


def _brake_ticks(tick: float) -> NDArray[np.intp]:
    """Return the brake's ticks, 0 the first, at which the Cartesian speed is checked; `tick` in units of 1 / w."""
    gap, peak, last = max(int(_BRAKE_GAP / tick), 1), math.ceil(_BRAKE_PEAK / tick), math.ceil(_BRAKE_LAST / tick)
    return np.append(np.arange(0, peak + 1, gap), max(last, peak + 1))


@lru_cache(maxsize=64)
def _brake_derivatives(
    speeds_rad_s: frozenset[float], acceleration_rad_s2: float, jerk_rad_s3: float, brake_rate: float, tick_s: float
) -> dict[str, Array]:
    """Return rows (m, 2) on (last speed, the one before) of the brake's ticks that bound all others.

    A gate and its adapter, whose limits differ in joint ranges alone, have the same.
    """
    r = math.exp(-brake_rate * tick_s)
    speed = [np.array([0.0, 1.0]), np.array([1.0, 0.0])]
    for _ in range(math.ceil(6.0 / (-math.log(r))) + 3):
        speed.append(2 * r * speed[-1] - r * r * speed[-2])
    v = np.array(speed)
    a = np.diff(v, axis=0) / tick_s
    j = np.diff(a, axis=0) / tick_s
    ahead = {"joint speed": v[2:], "joint acceleration": a[1:], "joint jerk": j}
    most = {"joint acceleration": acceleration_rad_s2, "joint jerk": jerk_rad_s3}
    keep: dict[str, set[int]] = {kind: set() for kind in ahead}
    for joint_speed in speeds_rad_s:
        # |row · x| <= limit for all rows holds exactly if it holds for the corners of the hull of ±rows / limit.
        scaled = {kind: rows / most.get(kind, joint_speed) for kind, rows in ahead.items()}
        owner = [(kind, i) for kind, rows in scaled.items() for i in range(len(rows))]
        for corner in _hull_corners(np.vstack(list(scaled.values()))):
            keep[owner[corner][0]].add(owner[corner][1])
    # The bound of the Cartesian speed takes the brake's speeds from these rows: none of its peaks may be missing.
    keep["joint speed"].update(_brake_ticks(brake_rate * tick_s).tolist())
    return {kind: ahead[kind][sorted(keep[kind])].reshape(-1, 2) for kind in ahead}


def _hull_corners(points: Array) -> list[int]:
    """Return the corners of the convex hull of `points` and their mirror images, as indices of points."""
    n = len(points)
    both: list[list[float]] = np.vstack([points, -points]).tolist()  # a brake of minutes has 72,000 points
    order = sorted(range(2 * n), key=both.__getitem__)

    def chain(indices: list[int]) -> list[int]:
        corners: list[int] = []
        for i in indices:
            x, y = both[i]
            while len(corners) >= 2:
                (ox, oy), (ax, ay) = both[corners[-2]], both[corners[-1]]
                if (ax - ox) * (y - oy) - (ay - oy) * (x - ox) > 0:
                    break
                corners.pop()
            corners.append(i)
        return corners

    return sorted({i % n for i in chain(order) + chain(order[::-1])})
