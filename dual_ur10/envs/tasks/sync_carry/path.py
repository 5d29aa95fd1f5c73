"""Path of the carried bar: its pose at any time."""

from __future__ import annotations

import math
from typing import Final

import numpy as np

from dual_ur10.errors import SettingsError
from dual_ur10.kernel import RowLoop, Struct
from dual_ur10.kinematics.poses import Poses
from dual_ur10.types import Array

_X, _Y, _Z, _ROLL, _PITCH, _YAW = range(6)

_LIFT_M: Final = 0.25
_DEGREE: Final = math.pi / 180

# Begin, end (s), coordinate, change (m, rad). Overlapping moves add up, so that the bar does not stop between them.
# Roll tilts the bar's ends against each other, pitch rotates it about its own length. The longer path rotates more
# slowly and ends with all moves at once.
MOVES: Final = {
    30.0: (
        (0.0, 3.0, _Z, _LIFT_M),
        (2.0, 4.0, _Y, 0.12),
        (4.0, 6.0, _Y, -0.24),
        (6.0, 8.0, _Y, 0.12),
        (7.5, 9.5, _X, 0.08),
        (9.5, 11.5, _X, -0.16),
        (11.5, 13.5, _X, 0.08),
        (12.0, 15.0, _YAW, 20 * _DEGREE),
        (15.0, 18.5, _YAW, -40 * _DEGREE),
        (18.5, 21.5, _YAW, 20 * _DEGREE),
        (20.5, 22.5, _ROLL, 10 * _DEGREE),
        (22.5, 25.0, _ROLL, -20 * _DEGREE),
        (25.0, 27.0, _ROLL, 10 * _DEGREE),
        (21.5, 23.5, _PITCH, 15 * _DEGREE),
        (23.5, 26.0, _PITCH, -30 * _DEGREE),
        (26.0, 28.0, _PITCH, 15 * _DEGREE),
        (26.5, 30.0, _Z, -_LIFT_M),
    ),
    60.0: (
        (0.0, 4.0, _Z, _LIFT_M),
        (3.0, 5.0, _Y, 0.12),
        (5.0, 7.0, _Y, -0.24),
        (7.0, 9.0, _Y, 0.12),
        (8.5, 10.5, _X, 0.08),
        (10.5, 12.5, _X, -0.16),
        (12.5, 14.5, _X, 0.08),
        (13.0, 18.0, _YAW, 20 * _DEGREE),
        (18.0, 27.0, _YAW, -40 * _DEGREE),
        (27.0, 32.0, _YAW, 20 * _DEGREE),
        (31.0, 34.0, _ROLL, 10 * _DEGREE),
        (34.0, 38.0, _ROLL, -20 * _DEGREE),
        (38.0, 41.0, _ROLL, 10 * _DEGREE),
        (33.0, 36.0, _PITCH, 15 * _DEGREE),
        (36.0, 40.0, _PITCH, -30 * _DEGREE),
        (40.0, 43.0, _PITCH, 15 * _DEGREE),
        (42.0, 45.0, _Y, 0.08),
        (45.0, 49.0, _Y, -0.16),
        (49.0, 52.0, _Y, 0.08),
        (42.0, 46.0, _YAW, -8 * _DEGREE),
        (46.0, 52.0, _YAW, 16 * _DEGREE),
        (52.0, 56.0, _YAW, -8 * _DEGREE),
        (43.0, 46.0, _X, 0.06),
        (46.0, 50.0, _X, -0.12),
        (50.0, 53.0, _X, 0.06),
        (44.0, 47.0, _ROLL, -6 * _DEGREE),
        (47.0, 51.0, _ROLL, 12 * _DEGREE),
        (51.0, 54.0, _ROLL, -6 * _DEGREE),
        (45.0, 48.0, _PITCH, -10 * _DEGREE),
        (48.0, 52.0, _PITCH, 20 * _DEGREE),
        (52.0, 55.0, _PITCH, -10 * _DEGREE),
        (46.0, 49.0, _Z, 0.08),
        (50.0, 53.0, _Z, -0.08),
        (56.0, 60.0, _Z, -_LIFT_M),
    ),
}
"""Moves of the paths by their length in s."""


class CarryPath:
    """Lift, sideways, forward, yaw, roll, pitch, and down: twice continuously differentiable, by minimum jerk moves.

    Args:
        duration_s: A key of `MOVES`.
    """

    def __init__(self, duration_s: float) -> None:
        moves = MOVES[duration_s]
        self.duration_s = duration_s
        rows = np.zeros((len(moves), 8))
        for row, (begin, end, number, change) in zip(rows, moves, strict=True):
            row[0], row[1], row[2 + number] = begin, end - begin, change
        self._moves = rows
        self._known: dict[tuple[int, ...], tuple[Array, Array, Array, Array, RowLoop]] = {}

    def __call__(self, time_s: Array, start: Poses) -> Poses:
        """Return the poses at times on the path, (n, k); before 0 that of the start, after the end the last one.

        Args:
            time_s: (n, k).
            start: Poses of the bar before it is lifted, (n, 3) and (n, 4); rotated about the vertical only.

        Raises:
            SettingsError: Other shapes.
        """
        shapes = time_s.shape, start.position_m.shape, start.quat.shape
        if len(shapes[0]) != 2 or shapes[1:] != ((len(time_s), 3), (len(time_s), 4)):
            raise SettingsError(f"times and poses of a path must be (n, k), (n, 3) and (n, 4), found {shapes}")
        times, position, quat, poses, follow = self._known.get(shapes[0]) or self._begin(*shapes[0])
        times[:], position[:], quat[:] = time_s, *start
        follow()
        result = poses.copy()
        return Poses(result[..., :3], result[..., 3:])

    def _begin(self, n: int, k: int) -> tuple[Array, Array, Array, Array, RowLoop]:
        """Return buffers of a shape, kept for the next call, and the function that computes the poses in the last."""
        times, position, quat, poses = np.zeros((n, k)), np.zeros((n, 3)), np.zeros((n, 4)), np.zeros((n, k, 7))
        struct = Struct(
            "CarryPath",
            n=n,
            count=k,
            size=len(self._moves),
            moves=self._moves,
            time_s=times,
            position_m=position,
            quat=quat,
            poses=poses,
        )
        self._known[n, k] = times, position, quat, poses, RowLoop("carry_path", struct, n, 1)
        return self._known[n, k]
