"""Path of the carried bar: its pose at any time."""

from __future__ import annotations

import math
from typing import Final

import numpy as np

from dual_ur10.errors import SettingsError
from ur_core.kinematics.poses import Poses
from ur_core.kinematics.rotations import quat_multiply
from ur_core.types import Array

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
        begin, end, number, change = np.array(MOVES[duration_s]).T
        self.duration_s = duration_s
        self._begin_s, self._length_s = begin, end - begin
        self._changes = change[:, None] * (number[:, None] == np.arange(6))  # (moves, coordinates)

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
        x = np.minimum(np.maximum((time_s[..., None] - self._begin_s) / self._length_s, 0.0), 1.0)
        change = (x * x * x * (10.0 + x * (6.0 * x - 15.0))) @ self._changes
        half = 0.5 * change[..., 3:]
        half[..., 2] += np.arctan2(start.quat[:, 3:], start.quat[:, :1])
        parts = np.empty((*half.shape, 2))
        parts[..., 0], parts[..., 1] = np.cos(half), np.sin(half)
        roll, pitch, yaw = parts[..., 0, :], parts[..., 1, :], parts[..., 2, :]
        products = (yaw[..., :, None] * roll[..., None, :])[..., None] * pitch[..., None, None, :]
        quat = products.reshape(*time_s.shape, 8) @ _QUAT
        return Poses(start.position_m[:, None] + change[..., :3], quat)


def _products() -> Array:
    """Return the (8, 4) table from products of cosine and sine of half yaw, roll and pitch to their quaternion."""
    table, unit = np.zeros((2, 2, 2, 4)), np.eye(4)
    for yaw, roll, pitch in np.ndindex(2, 2, 2):
        turned = quat_multiply(quat_multiply(unit[3 * yaw], unit[roll]), unit[2 * pitch])
        table[yaw, roll, pitch] = turned
    return table.reshape(8, 4)


_QUAT: Final = _products()
