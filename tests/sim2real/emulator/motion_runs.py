"""Runs of a reference motion, and what holds of all of them."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from dual_ur10.kinematics import flange_pose
from dual_ur10.sim2real.emulator.motion import Handle, Motion

Array = NDArray[np.float64]

TICK_S = 0.008
SUBSTEPS = 4
DT = TICK_S / SUBSTEPS
Q0 = np.array([0.3, -1.2, 1.5, -1.0, -1.4, 0.2])


def motion(q: Array = Q0, tick_s: float = TICK_S, substeps: int = SUBSTEPS, **options: object) -> Motion:
    return Motion(tick_s, substeps, q, **options)  # type: ignore[arg-type]


def until_done(arm: Motion, handle: Handle, scaling: Callable[[int], float] = lambda _: 1.0) -> tuple[Array, int]:
    """Positions (n, 6) of all physics steps until a handle is done, from where the arm is, and the ticks it took."""
    path = [arm.q[None]]
    for tick in range(20_000):
        plan = arm.plan(scaling(tick))
        path.append(np.vstack([plan[1:, 0], arm.q[None]]))
        if handle.done:
            return np.concatenate(path), tick + 1
    raise AssertionError("the motion does not end")


def run(arm: Motion, ticks: int, scaling: float = 1.0) -> Array:
    """Positions (n, 6) of all physics steps of some ticks, from where the arm is."""
    path = [arm.q[None]]
    for _ in range(ticks):
        plan = arm.plan(scaling)
        path.append(np.vstack([plan[1:, 0], arm.q[None]]))
    return np.concatenate(path)


def at_rest(arm: Motion, ticks: int = 3000) -> Array:
    """Positions (n, 6) until the arm rests."""
    path = [arm.q[None]]
    for _ in range(ticks):
        plan = arm.plan()
        path.append(np.vstack([plan[1:, 0], arm.q[None]]))
        if not arm.moving:
            return np.concatenate(path)
    raise AssertionError("the arm does not come to rest")


def positions(q: Array) -> Array:
    """(n, 3) of the flange."""
    return flange_pose(q)[0]


def pose(arm: Motion, *offset: float) -> list[float]:
    """The TCP's pose, displaced."""
    return [a + b for a, b in zip(arm.tcp_pose(arm.q), [*offset, *[0.0] * (6 - len(offset))], strict=True)]
