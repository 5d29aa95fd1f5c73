"""Checks shared by the safety tests: adversarial actions, and limits computed from their definition."""

from __future__ import annotations

import numpy as np

from dual_ur10.sim2real.control.limits import HISTORY, Envelope, MotionLimits
from ur_core.kernel import Struct, call
from ur_core.kinematics.ur10 import DH_A_M, DH_D_M

HARD = MotionLimits()
TIGHT = MotionLimits(speed_rad_s=0.5, acceleration_rad_s2=4.0, jerk_rad_s3=200.0, tcp_speed_m_s=0.25)
NARROW = MotionLimits(
    speed_rad_s=(0.9, 0.6, 1.1, 2.0, 2.5, 0.3),
    acceleration_rad_s2=7.0,
    jerk_rad_s3=600.0,
    tcp_speed_m_s=0.7,
    lower_rad=(-1.0, -2.2, 0.9, -3.0, -2.5, 0.4),
    upper_rad=(0.7, -0.9, 2.6, -1.1, -0.6, 2.2),
)
TOOL = MotionLimits(
    speed_rad_s=1.2, tcp_speed_m_s=0.25, tcp_m=((0.02, -0.03, 0.19), (0.0, 0.25, 0.1))
)  # tools that are faster than their flanges

ACTION_KINDS = ("huge", "alternating", "denormal", "zero", "random", "constant", "steps", "float32", "sine")


class Measured:
    """Stub of `Clearance` with distances of its own.

    Attributes:
        checks: Number of configurations at which distances were measured.
    """

    def __init__(self, levers_m: np.ndarray) -> None:
        levers_m = np.array(levers_m, dtype=np.float64)
        self.checks = 0
        self.kernel = Struct(
            "Distances",
            pairs=len(levers_m),
            levers=levers_m,
            measure=self._measure,
            slopes="measured_slopes",
            context=None,
        )

    def _measure(self, q_rad: np.ndarray, spare_m: np.ndarray) -> None:
        self.checks += 1
        spare_m[:] = self.spare_m(q_rad)

    def spare_m(self, q_rad: np.ndarray) -> np.ndarray:
        """Return (pairs,) spare distances at a configuration, (12,)."""
        return np.ones(1)

    def worst(self, q_rad: np.ndarray) -> tuple[str, float, float]:
        """Return the name of the pair with the least to spare, its distance and the smallest legal one."""
        spare_m = self.spare_m(q_rad)
        return f"pair {spare_m.argmin()}", 0.02 + float(spare_m.min()), 0.02


class AlwaysClear(Measured):
    """Stub of `Clearance` without bodies."""

    def __init__(self) -> None:
        super().__init__(np.zeros((1, 12)))


def limit_use(envelope: Envelope, windows: np.ndarray) -> np.ndarray:
    """Return the used fraction of each limit, (n, m, 12), in windows (n, 3 + ticks, 12): above 1 is a violation."""
    return np.abs(envelope.rows @ windows - np.tile(envelope.middle, 2)) / np.tile(envelope.half, 2)


def cartesian_use(envelope: Envelope, windows: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the kernel's used fraction of the Cartesian speed limit in windows and along the brakes after them.

    Args:
        envelope: The limits.
        windows: (n, 3 + ticks, 12) targets.

    Returns:
        (n, 2) fraction of each arm, and (n, 2) index of its fastest point in `POINTS`.
    """
    assert windows.shape[1:] == (HISTORY + envelope.ticks, 12)
    fraction, point = np.empty((2, len(windows), 2))
    call("envelope_cartesian_use", envelope.kernel, np.ascontiguousarray(windows), fraction, point, len(windows))
    return fraction, point.astype(int)


def adversarial_action(kind: str, period: int, rng: np.random.Generator, size: tuple[int, ...]) -> np.ndarray:
    if kind == "huge":
        return rng.choice([-1e9, 1e9], size)
    if kind == "alternating":
        return np.full(size, 1.0 if period % 2 else -1.0)
    if kind == "denormal":
        return rng.choice([-5e-324, 5e-324, 1e-310, -0.0], size)
    if kind == "zero":
        return np.zeros(size)
    if kind == "random":
        return rng.uniform(-1.0, 1.0, size)
    if kind == "constant":
        return np.broadcast_to(np.random.default_rng(size[0]).uniform(-3.0, 3.0, size[1:]), size).copy()
    if kind == "steps":
        return np.broadcast_to(rng.uniform(-6.0, 6.0, size[1:]) if period % 13 < 2 else np.zeros(size[1:]), size).copy()
    if kind == "float32":
        return rng.normal(0.0, 2.0, size).astype(np.float32)
    return np.sin(period * 0.3 + np.arange(np.prod(size)).reshape(size)) * 1.3


def elbow_position(q_rad: np.ndarray) -> np.ndarray:
    reach = DH_A_M[1] * np.cos(q_rad[..., 1])
    height = DH_D_M[0] + DH_A_M[1] * np.sin(q_rad[..., 1])
    return np.stack([np.cos(q_rad[..., 0]) * reach, np.sin(q_rad[..., 0]) * reach, height], axis=-1)


def flange(q_rad: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return position, (..., 3), and rotation, (..., 3, 3), of nominal flanges, without the kernel."""
    c1, c2, c5, c6 = (np.cos(q_rad[..., joint]) for joint in (0, 1, 4, 5))
    s1, s2, s5, s6 = (np.sin(q_rad[..., joint]) for joint in (0, 1, 4, 5))
    elbow, wrist = q_rad[..., 1] + q_rad[..., 2], q_rad[..., 1] + q_rad[..., 2] + q_rad[..., 3]
    c, s = np.cos(wrist), np.sin(wrist)
    # Columns, each by its parts outwards, beside and up: joints 2 to 4 move in a plane that joint 1 rotates.
    x = c * c5 * c6 - s * s6, s5 * c6, s * c5 * c6 + c * s6
    y = -c * c5 * s6 - s * c6, -s5 * s6, -s * c5 * s6 + c * c6
    z = -c * s5, c5, -s * s5
    p = (
        DH_A_M[1] * c2 + DH_A_M[2] * np.cos(elbow) + DH_D_M[4] * s + DH_D_M[5] * z[0],
        DH_D_M[3] + DH_D_M[5] * z[1],
        DH_D_M[0] + DH_A_M[1] * s2 + DH_A_M[2] * np.sin(elbow) - DH_D_M[4] * c + DH_D_M[5] * z[2],
    )
    turned = [
        np.stack([c1 * out + s1 * beside, s1 * out - c1 * beside, up], axis=-1) for out, beside, up in (x, y, z, p)
    ]
    return turned[3], np.stack(turned[:3], axis=-1)


def cartesian_speed(sent: np.ndarray, tick_s: float, tcp_m: object = ((0, 0, 0), (0, 0, 0))) -> np.ndarray:
    """Return the largest Cartesian speed of both arms, (n, t - 1), over targets (n, t, 2, 6)."""
    position, rotation = flange(sent)
    tool = position + np.einsum("ntaij,aj->ntai", rotation, np.asarray(tcp_m))
    points = np.stack([elbow_position(sent), position, tool])
    moved = np.linalg.norm(np.diff(points, axis=2), axis=-1) / tick_s
    return moved.max(axis=(0, 3))


def worst_use(sent: np.ndarray, limits: MotionLimits, tick_s: float) -> dict[str, float]:
    """Return the largest used fraction of each limit over (n, t, 2, 6); of positions, the excess in rad plus 1."""
    speed = np.diff(sent, axis=1) / tick_s
    acceleration = np.diff(speed, axis=1) / tick_s
    jerk = np.diff(acceleration, axis=1) / tick_s
    beyond = np.maximum(sent - limits.upper_rad, np.asarray(limits.lower_rad) - sent).max()
    return {
        "speed": float((np.abs(speed) / limits.speed_rad_s).max()),
        "acceleration": float(np.abs(acceleration).max() / limits.acceleration_rad_s2),
        "jerk": float(np.abs(jerk).max() / limits.jerk_rad_s3),
        "position": 1.0 + float(beyond),
        "tip": float(cartesian_speed(sent, tick_s, limits.tcp_m).max() / limits.tcp_speed_m_s),
    }


def assert_within(sent: np.ndarray, limits: MotionLimits, tick_s: float, tolerance: float = 1e-9) -> None:
    used = worst_use(sent, limits, tick_s)
    assert max(used.values()) <= 1.0 + tolerance, used


def braked(last_three: np.ndarray, limits: MotionLimits, tick_s: float) -> np.ndarray:
    """Return three targets and the brake after them, (n, t, 2, 6), by its definition."""
    ratio = np.exp(-limits.brake_rate() * tick_s)
    sent = list(np.moveaxis(last_three, 1, 0))
    for _ in range(int(12.0 / (limits.brake_rate() * tick_s)) + 10):
        speed, before = sent[-1] - sent[-2], sent[-2] - sent[-3]
        sent.append(sent[-1] + 2 * ratio * speed - ratio**2 * before)
    return np.stack(sent, axis=1)
