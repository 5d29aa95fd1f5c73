"""Simulated observations of cells whose right base is known; see also `recording.touched`."""

from __future__ import annotations

from collections.abc import Callable
from typing import Final

import numpy as np

from dual_ur10.errors import UnreachableError
from dual_ur10.sim2real.calibration.observations import BarPose, BoardView, JointAngles, Noise
from dual_ur10.sim2real.calibration.transforms import flange, inverse_of, rotation_of, rotvec_of, transform
from ur_core.kinematics.inverse import nearest, try_nearest
from ur_core.kinematics.ur10 import DH_A_M, DH_ALPHA_RAD, DH_D_M, DHParameters
from ur_core.types import Array

BAR_M: Final = 1.0
"""Length of the simulated bar between both flanges."""

_LENGTH_ERROR_M: Final = 1e-3
_ANGLE_ERROR_RAD: Final = 1e-3
_TRIES: Final = 50
_DOWN: Final = np.diag([1.0, -1.0, -1.0])
_ELBOW_UP: Final = np.array([0.0, -1.2, 1.6, -2.0, -1.57, 0.0])


def random_dh(rng: np.random.Generator) -> DHParameters:
    """Return the kinematics of a UR10 as built: 1 mm and 1 mrad from the nominal ones, one standard deviation.

    Their flange is some millimetres beside that of the nominal arm, as the flanges of UR's arms are.
    """
    a, d = (each + rng.normal(0.0, _LENGTH_ERROR_M, 6) for each in (DH_A_M, DH_D_M))
    alpha, theta = (each + rng.normal(0.0, _ANGLE_ERROR_RAD, 6) for each in (DH_ALPHA_RAD, np.zeros(6)))
    return DHParameters(
        tuple(a.tolist()), tuple(d.tolist()), tuple(alpha.tolist()), tuple(theta.tolist()), robot="ur10"
    )


def bar_poses(
    count: int,
    dh: tuple[DHParameters, DHParameters],
    base: Array,
    noise: Noise,
    rng: np.random.Generator,
    angle_rad: float = 0.6,
) -> list[BarPose]:
    """Return random poses of a bar of 1 m between both hands, as measured.

    The hands stand on a line along that of the bases and point down. The bar sits in each hand up to the noise.

    Args:
        count: Number of poses.
        dh: True kinematics of both arms.
        base: (4, 4) true pose of the right base in the left one.
        noise: Standard deviations.
        rng: Source of poses and noise.
        angle_rad: Largest rotation of the bar about each axis.

    Raises:
        UnreachableError: The arms reach hardly any pose.
    """
    return [
        BarPose(*hands)
        for hands in _both_hands(
            count, dh, base, angle_rad, rng, lambda hand: hand @ _seat(noise.bar_m, noise.bar_rad, rng)
        )
    ]


def held(
    planned: BarPose, dh: tuple[DHParameters, DHParameters], base: Array, noise: Noise, rng: np.random.Generator
) -> BarPose:
    """Return a pose of the bar of `bar_poses` as measured: the left hand is brought to a pose, and the right follows.

    Args:
        planned: Its left joint angles are taken, and the configuration of the right arm.
        dh: True kinematics of both arms.
        base: (4, 4) true pose of the right base in the left one.
        noise: Standard deviations.
        rng: Source of the noise.

    Raises:
        UnreachableError: An arm does not reach its end of the bar.
    """
    across = base[:3, 3] / np.linalg.norm(base[:3, 3])
    left = flange(planned.left_q_rad, dh[0])
    right = inverse_of(base) @ left @ transform(_DOWN.T @ (BAR_M * across), np.eye(3))
    joints: list[JointAngles] = []
    for hand, near, own in zip((left, right), (planned.left_q_rad, planned.right_q_rad), dh, strict=True):
        seated = hand @ _seat(noise.bar_m, noise.bar_rad, rng)
        joints.append(tuple(nearest(seated[:3, 3], seated[:3, :3], np.asarray(near), own).tolist()))
    return BarPose(joints[0], joints[1], planned.grasp)


def board_views(
    count: int,
    dh: tuple[DHParameters, DHParameters],
    base: Array,
    noise: Noise,
    rng: np.random.Generator,
    angle_rad: float = 0.3,
) -> list[BoardView]:
    """Return random views of a board on the right flange by a camera on the left one, as measured.

    Both hands stand as those of a bar, each with a rotation and a place of its own. Camera and board look across.

    Args:
        count: Number of views.
        dh: True kinematics of both arms.
        base: (4, 4) true pose of the right base in the left one.
        noise: Standard deviations.
        rng: Source of poses and noise.
        angle_rad: Largest rotation of each hand about each axis.

    Raises:
        UnreachableError: The arms reach hardly any pose.
    """
    camera = transform((0.02, 0.05, 0.1), rotation_of((0.1, -0.05, 1.0)))
    board = transform((-0.04, 0.03, 0.05), rotation_of((0.2, 0.1, -0.5)))

    def move(hand: Array) -> Array:
        return hand @ transform(rng.uniform(-0.1, 0.1, 3), rotation_of(rng.uniform(-angle_rad, angle_rad, 3)))

    found = []
    for left, right in _both_hands(count, dh, base, angle_rad, rng, move):
        seen = inverse_of(flange(left, dh[0]) @ camera) @ base @ flange(right, dh[1]) @ board
        position = seen[:3, 3] + rng.normal(0.0, noise.board_m, 3)
        rotation = rotvec_of(seen[:3, :3] @ rotation_of(rng.normal(0.0, noise.board_rad, 3)))
        found.append(BoardView("left", "right", left, right, tuple(position.tolist()), tuple(rotation.tolist())))
    return found


def _both_hands(
    count: int,
    dh: tuple[DHParameters, DHParameters],
    base: Array,
    angle_rad: float,
    rng: np.random.Generator,
    change: Callable[[Array], Array],
) -> list[tuple[JointAngles, JointAngles]]:
    """Return joint angles of both arms whose flanges stand at the ends of a bar, after a change of each flange."""
    across = base[:3, 3] / np.linalg.norm(base[:3, 3])
    middle, ahead = base[:3, 3] / 2, np.cross(across, [0.0, 0.0, 1.0])
    ahead = ahead if ahead[0] < 0.0 else -ahead  # in front of the arms is -x of `base`
    found: list[tuple[JointAngles, JointAngles]] = []
    for _ in range(_TRIES * count):
        if len(found) == count:
            return found
        bar = rotation_of(rng.uniform(-angle_rad, angle_rad, 3))
        centre = middle + (0.7 + rng.uniform(-0.1, 0.1)) * ahead + [0.0, 0.0, 0.45 + rng.uniform(-0.1, 0.1)]
        joints: list[JointAngles] = []
        for arm, sign in enumerate((-1.0, 1.0)):
            hand = change(transform(centre + bar @ (0.5 * sign * BAR_M * across), bar @ _DOWN))
            own = hand if arm == 0 else inverse_of(base) @ hand
            q, reached = try_nearest(own[:3, 3], own[:3, :3], _ELBOW_UP, dh[arm])
            if reached:
                joints.append(tuple(q.tolist()))
        if len(joints) == 2:
            found.append((joints[0], joints[1]))
    raise UnreachableError(f"both arms reach only {len(found)} poses, {count} are needed: move the bases")


def _seat(shift_m: float, rotation_rad: float, rng: np.random.Generator) -> Array:
    return transform(rng.normal(0.0, shift_m, 3), rotation_of(rng.normal(0.0, rotation_rad, 3)))
