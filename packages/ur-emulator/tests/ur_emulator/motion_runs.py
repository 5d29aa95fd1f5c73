"""Runs of a reference motion."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from ur_core.kinematics import flange_pose
from ur_core.kinematics.ur10 import NOMINAL_DH
from ur_emulator.motion import Handle, MotionGenerator

Array = NDArray[np.float64]

TICK_S = 0.008
SUBSTEPS = 4
DT = TICK_S / SUBSTEPS
Q0 = np.array([0.3, -1.2, 1.5, -1.0, -1.4, 0.2])


def motion(q: Array = Q0, tick_s: float = TICK_S, substeps: int = SUBSTEPS, **options: object) -> MotionGenerator:
    return MotionGenerator(tick_s, substeps, q, **{"dh": NOMINAL_DH} | options)  # type: ignore[arg-type]


def until_done(
    arm: MotionGenerator, handle: Handle, scaling: Callable[[int], float] = lambda _: 1.0
) -> tuple[Array, int]:
    """Run until a handle is done. Return positions (n, 6) of all physics steps, and the number of ticks."""
    path = [arm.q[None]]
    for tick in range(20_000):
        plan = arm.plan(scaling(tick))
        path.append(np.vstack([plan[1:, 0], arm.q[None]]))
        if handle.done:
            return np.concatenate(path), tick + 1
    raise AssertionError("the motion does not end")


def run(arm: MotionGenerator, ticks: int, scaling: float = 1.0) -> Array:
    """Run some ticks and return positions (n, 6) of all physics steps."""
    path = [arm.q[None]]
    for _ in range(ticks):
        plan = arm.plan(scaling)
        path.append(np.vstack([plan[1:, 0], arm.q[None]]))
    return np.concatenate(path)


def at_rest(arm: MotionGenerator, ticks: int = 3000) -> Array:
    """Run until the arm stops and return positions (n, 6)."""
    path = [arm.q[None]]
    for _ in range(ticks):
        plan = arm.plan()
        path.append(np.vstack([plan[1:, 0], arm.q[None]]))
        if not arm.moving:
            return np.concatenate(path)
    raise AssertionError("the arm does not come to rest")


def until_fault(
    arm: MotionGenerator, code: str, command: Callable[[int], object] = lambda _: None, ticks: int = 2000
) -> Array:
    """Command and run until this fault. Return the speeds (n, 6) of all physics steps."""
    speeds = []
    for k in range(ticks):
        command(k)
        speeds.append(arm.plan()[:, 1])
        if arm.fault is not None:
            assert arm.fault.code == code
            return np.concatenate(speeds)
    raise AssertionError("there is no fault")


def positions(q: Array) -> Array:
    """Return flange positions (n, 3)."""
    return flange_pose(q, NOMINAL_DH)[0]


def pose(arm: MotionGenerator, *offset: float) -> list[float]:
    """Return the TCP's pose, displaced."""
    return [a + b for a, b in zip(arm.tcp_pose(arm.q), [*offset, *[0.0] * (6 - len(offset))], strict=True)]
