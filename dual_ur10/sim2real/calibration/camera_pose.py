"""Estimate of a camera's intrinsics, and of its pose on an arm or in the cell, from images of a board of markers.

Either camera or board is on a flange, the other one stands, or is on the other flange. One least-squares fit of all
corners in all images gives both poses, the intrinsics and their covariance; the scale of the noise follows from the
residuals.
The camera's frame has x to the right, y down, z forward.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import combinations
from typing import Final

import numpy as np
from numpy.typing import ArrayLike

from dual_ur10.errors import CalibrationError
from dual_ur10.sim2real.calibration.board import Intrinsics, calibration_of, opencv
from dual_ur10.sim2real.calibration.intervals import PoseInterval, scipy_module
from dual_ur10.sim2real.calibration.transforms import (
    base_in_cell,
    flange,
    inverse_of,
    rotation_of,
    rotvec_of,
    transform,
)
from ur_core.kinematics.frames import ArmMount
from ur_core.kinematics.ur10 import DHParameters
from ur_core.mjcf.camera import Camera
from ur_core.types import Array

BODY: Final = "wrist_3_link"
"""Body of an arm that carries what is on its flange, with a gripper and without."""

_LEAST_VIEWS: Final = 5
_LEAST_ROTATION_RAD: Final = 0.1
_PARALLEL: Final = 0.05  # of the second singular value of all rotation axes to the first
_MOST_PIXELS: Final = 2.0  # RMS
_LEAST_PIXELS: Final = 0.02  # residuals of zero would state an exact result
_UNDETERMINED_M: Final = 0.05
_DONE: Final = 1e-12
_MOST_STEPS: Final = 100
_DISTORTION: Final = 4


@dataclass(frozen=True)
class CornerView:
    """Corners of the board in one image.

    Attributes:
        camera_frame, board_frame: (4, 4) poses in the cell of what camera and board are mounted on; identity: the cell.
        on_board_m: (n, 3) corners on the board.
        in_image_px: (n, 2) corners in the image.
    """

    camera_frame: Array
    board_frame: Array
    on_board_m: Array
    in_image_px: Array


@dataclass(frozen=True)
class CameraEstimate(PoseInterval):
    """Camera and board as mounted.

    Attributes:
        pose: (4, 4) pose of the camera in the frame of what it is mounted on.
        covariance: (6, 6) of its shift (m) and its rotation (rad), both along the axes of that frame.
        degrees_of_freedom: Of the noise's scale.
        intrinsics: Intrinsics, with four coefficients of distortion.
        size: Height and width of the images.
        rms_px: RMS of the residuals of a coordinate.
        board: (4, 4) pose of the board in the frame of what that is mounted on.
    """

    pose: Array
    covariance: Array
    degrees_of_freedom: int
    intrinsics: Intrinsics
    size: tuple[int, int]
    rms_px: float
    board: Array

    @property
    def fovy_rad(self) -> float:
        """Vertical field of view."""
        return 2.0 * math.atan(self.size[0] / 2.0 / self.intrinsics.matrix_px[1])

    def camera(self, name: str, body: str) -> Camera:
        """Return the camera of a scene that stands there.

        Args:
            name: Its name.
            body: Body that carries it; "": the cell.
        """
        position, rotation = self.pose[:3, 3], self.pose[:3, :3]
        target, up = position + rotation[:, 2], -rotation[:, 1]
        rounded = (tuple(round(float(each), 7) for each in values) for values in (position, target, up))
        at, to, upwards = rounded
        return Camera(name, at, to, math.degrees(self.fovy_rad), body, upwards)  # type: ignore[arg-type]  # three each


def body_in_cell(mount: ArmMount, q_rad: ArrayLike, dh: DHParameters) -> Array:
    """Return the pose (4, 4) in the cell of the body of an arm that carries a camera or board; see `BODY`.

    Args:
        mount: Mounting of the arm.
        q_rad: Joint angles (6,).
        dh: Kinematics of the arm.
    """
    found: Array = base_in_cell(mount) @ flange(q_rad, dh) @ transform([0.0, 0.0, -dh.d_m[5]], np.eye(3))
    return found


def estimate_camera(views: Sequence[CornerView], size: tuple[int, int]) -> CameraEstimate:
    """Estimate a camera from images of a board.

    Args:
        views: Corners of the board in each image.
        size: Height and width of the images.

    Raises:
        CalibrationError: There are too few images, the arm rotates about one axis only, or corners and arms do not fit
            one camera.
        MissingExtraError: OpenCV or scipy is not installed.
    """
    if len(views) < _LEAST_VIEWS:
        raise CalibrationError(f"{len(views)} images of the board: {_LEAST_VIEWS} are needed, 15 are good. Take more")
    intrinsics, boards = _calibrated(views, size)
    between = np.array([inverse_of(each.camera_frame) @ each.board_frame for each in views])
    camera, board = _closed_form(between, boards)
    unit = np.array([1e-3] * 3 + [1e-3] * 3 + [1e-3] * 6 + [1.0] * 4 + [1e-2] * _DISTORTION)
    observed = np.concatenate([each.in_image_px for each in views]).reshape(-1)

    def residuals(change: Array) -> Array:
        step = unit * change
        there = _projected(_moved(camera, step), _moved(board, step[6:]), intrinsics + step[12:], between, views)
        found: Array = there.reshape(-1) - observed
        return found

    least_squares = scipy_module("optimize").least_squares
    limits = {"xtol": _DONE, "ftol": _DONE, "gtol": _DONE, "max_nfev": _MOST_STEPS}
    robust = least_squares(residuals, np.zeros(len(unit)), loss="soft_l1", **limits)
    fit = least_squares(residuals, robust.x, jac="3-point", **limits)
    freedom = len(observed) - len(unit)
    rms = float(np.sqrt(fit.fun @ fit.fun / freedom))
    if not rms < _MOST_PIXELS:
        raise CalibrationError(
            f"images and joint angles do not fit one camera ({rms:.2g} pixels RMS, allowed {_MOST_PIXELS:g}): check "
            "`board`, that neither camera nor board has slipped, and the kinematics of the arm"
        )
    scale = max(rms, _LEAST_PIXELS)
    information = fit.jac.T @ fit.jac
    covariance = scale**2 * np.linalg.pinv(information, hermitian=True)[:6, :6] * np.outer(unit[:6], unit[:6])
    if math.sqrt(float(np.trace(covariance[:3, :3]))) > _UNDETERMINED_M:
        raise CalibrationError(
            "the images leave the camera undetermined: rotate the arm about two axes, by 0.3 rad and more, and tilt "
            "the board in the images"
        )
    step = unit * fit.x
    fx, fy, cx, cy, *distortion = (intrinsics + step[12:]).tolist()
    return CameraEstimate(
        pose=_moved(camera, step),
        covariance=covariance,
        degrees_of_freedom=freedom,
        intrinsics=Intrinsics((fx, fy, cx, cy), tuple(distortion)),
        size=size,
        rms_px=rms,
        board=_moved(board, step[6:]),
    )


def _calibrated(views: Sequence[CornerView], size: tuple[int, int]) -> tuple[Array, Array]:
    """Return intrinsics, (4 + 4,), and the poses of the board in the camera's frame, (k, 4, 4), of the images alone."""
    _, matrix, distortion, rotations, positions = calibration_of(
        [each.on_board_m for each in views], [each.in_image_px for each in views], size
    )
    numbers = [matrix[0, 0], matrix[1, 1], matrix[0, 2], matrix[1, 2], *np.ravel(distortion)[:_DISTORTION]]
    boards = [
        transform(np.ravel(position), rotation_of(np.ravel(rotation)))
        for position, rotation in zip(positions, rotations, strict=True)
    ]
    return np.array(numbers, dtype=np.float64), np.array(boards)


def _closed_form(between: Array, boards: Array) -> tuple[Array, Array]:
    """Return camera and board, (4, 4) each, with camera @ boards[k] = between[k] @ board in the mean (Park, Martin).

    Raises:
        CalibrationError: The arm rotates about one axis only.
    """
    pairs = list(combinations(range(len(boards)), 2))
    moved = np.array([between[j] @ inverse_of(between[i]) for i, j in pairs])
    seen = np.array([boards[j] @ inverse_of(boards[i]) for i, j in pairs])
    axes, axes_seen = rotvec_of(moved[:, :3, :3]), rotvec_of(seen[:, :3, :3])
    rotated = np.linalg.norm(axes, axis=1) > _LEAST_ROTATION_RAD
    spread = np.linalg.svd(axes[rotated], compute_uv=False) if rotated.any() else np.zeros(3)
    if spread[1] <= _PARALLEL * spread[0] or not spread[0]:
        raise CalibrationError(
            "the arm rotates about one axis only between the images: rotate it about a second one, too, by 0.3 rad and "
            "more"
        )
    u, _, vt = np.linalg.svd(axes[rotated].T @ axes_seen[rotated])
    rotation = u @ np.diag([1.0, 1.0, np.linalg.det(u @ vt)]) @ vt
    left = (moved[:, :3, :3] - np.eye(3)).reshape(-1, 3)
    right = (seen[:, :3, 3] @ rotation.T - moved[:, :3, 3]).reshape(-1)
    camera = transform(np.linalg.lstsq(left, right, rcond=None)[0], rotation)
    candidates = inverse_of(between) @ camera @ boards
    u, _, vt = np.linalg.svd(candidates[:, :3, :3].mean(axis=0))
    return camera, transform(candidates[:, :3, 3].mean(axis=0), u @ np.diag([1.0, 1.0, np.linalg.det(u @ vt)]) @ vt)


def _moved(pose: Array, step: Array) -> Array:
    """Return a pose (4, 4) after a shift (m) and a rotation (rad), both along the axes of its own frame's parent."""
    return transform(pose[:3, 3] + step[:3], rotation_of(step[3:6]) @ pose[:3, :3])


def _projected(camera: Array, board: Array, intrinsics: Array, between: Array, views: Sequence[CornerView]) -> Array:
    """Return all corners in the images, (n, 2) px, one view after the other."""
    boards = inverse_of(camera) @ between @ board
    points = [each.on_board_m @ there[:3, :3].T + there[:3, 3] for each, there in zip(views, boards, strict=True)]
    return project(np.concatenate(points), intrinsics[:4], intrinsics[4:])


def project(points_m: Array, matrix_px: Array, distortion: Array) -> Array:
    """Return points (n, 3) of the camera's frame in its image, (n, 2) px.

    Args:
        points_m: The points.
        matrix_px: (4,) fx, fy, cx, cy.
        distortion: (4,) k1, k2, p1, p2.
    """
    fx, fy, cx, cy = matrix_px.tolist()
    matrix, zero = Intrinsics((fx, fy, cx, cy)).matrix, np.zeros(3)
    found: Array = opencv().projectPoints(points_m, zero, zero, matrix, distortion)[0].reshape(-1, 2)
    return found
