"""Equations of the observations: their residuals as functions of the right base's pose and of constant mounts.

Unknown are the pose X of the right base, and for each grasp, camera and board a constant pose. An observation states
that two chains of poses end at one point or in one pose: such a chain is the flange of an arm (X times it for the
right one), a constant, and a measurement.
"""

from __future__ import annotations

from collections.abc import Sequence
from copy import copy
from dataclasses import dataclass, replace
from typing import Final

import numpy as np

from dual_ur10.errors import CalibrationError
from dual_ur10.sim2real.calibration.observations import BarPose, BoardView, Carrier, Noise, Observation, Touch
from dual_ur10.sim2real.calibration.transforms import flange, inverse_of, rotation_of, rotvec_of, skew, transform
from ur_core.kinematics.ur10 import DHParameters
from ur_core.types import Array

_IDENTITY, _BASE = 0, 1  # rows of the stack of transforms; the constants follow

_STEP: Final = 1e-6  # m and rad; the residuals are nearly linear
_SIX: Final = np.eye(6)


@dataclass
class _Chains:
    """Chains of n observations: X or not, flange, constant, measurement."""

    base: Array
    arm: Array
    constant: Array
    measured: Array

    def poses(self, stack: Array) -> Array:
        poses: Array = stack[self.base] @ self.arm @ stack[self.constant] @ self.measured
        return poses


class Equations:
    """Whitened residuals of observations: of standard deviation 1 if the stated noise is right.

    Args:
        observations: Those of all kinds.
        dh: Kinematics of the left and the right arm.
        noise: Standard deviations.
        base: (4, 4) approximate pose of the right base in the left one.

    Attributes:
        unknown: Names of the unknown poses; the first one is the base.
        start: (unknown, 4, 4) approximate poses.
        rows: Slice of the residuals that belong to each observation.

    Raises:
        CalibrationError: There are none.
    """

    def __init__(
        self, observations: Sequence[Observation], dh: tuple[DHParameters, DHParameters], noise: Noise, base: Array
    ) -> None:
        if not observations:
            raise CalibrationError("there are no observations: record touches, poses of a bar, or views of a board")
        self._dh, self._noise = dh, noise
        self.unknown = ["base"]
        starts = [base]
        touches = [each for each in observations if isinstance(each, Touch)]
        bars = [each for each in observations if isinstance(each, BarPose)]
        views = [each for each in observations if isinstance(each, BoardView)]
        self._tips = [self._tip(touches, arm) for arm in (0, 1)]
        self._bars, self._views = self._of_bars(bars, starts), self._of_views(views, starts)
        self.start: Array = np.stack(starts)
        self._whiten_bars = self._bar_weights()
        self._scale_views = np.repeat([1 / noise.board_m, 1 / noise.board_rad], 3)
        self.rows = _rows_of(observations, len(touches), len(bars))

    def _tip(self, touches: list[Touch], arm: int) -> Array:
        """Return the touched points (n, 4, 1) in the frame of the arm's own base."""
        joints = [(each.left_q_rad, each.right_q_rad)[arm] for each in touches]
        tcp = [[*(each.left_tcp_m, each.right_tcp_m)[arm], 1.0] for each in touches]
        points: Array = flange(np.reshape(joints, (-1, 6)), self._dh[arm]) @ np.reshape(tcp, (-1, 4, 1))
        return points

    def _arm(self, observation: BarPose | BoardView, carrier: Carrier) -> Array:
        if carrier == "fixed":
            return np.eye(4)
        joints = observation.left_q_rad if carrier == "left" else observation.right_q_rad
        return flange(np.asarray(joints, dtype=np.float64), self._dh[carrier == "right"])

    def _of_bars(self, bars: list[BarPose], starts: list[Array]) -> tuple[_Chains, _Chains]:
        left = np.reshape([self._arm(each, "left") for each in bars], (-1, 4, 4))
        right = np.reshape([self._arm(each, "right") for each in bars], (-1, 4, 4))
        rows = np.empty(len(bars), dtype=int)
        for k, each in enumerate(bars):
            name = f"grasp {each.grasp}"
            if name not in self.unknown:
                self.unknown.append(name)
                starts.append(inverse_of(left[k]) @ starts[0] @ right[k])
            rows[k] = self.unknown.index(name) + _BASE
        none, unit = np.zeros(len(bars), dtype=int), np.tile(np.eye(4), (len(bars), 1, 1))
        return _Chains(none, left, rows, unit), _Chains(none + _BASE, right, none, unit)

    def _of_views(self, views: list[BoardView], starts: list[Array]) -> tuple[_Chains, _Chains]:
        cameras = np.reshape([self._arm(each, each.camera_on) for each in views], (-1, 4, 4))
        boards = np.reshape([self._arm(each, each.board_on) for each in views], (-1, 4, 4))
        measured = transform(
            np.reshape([each.position_m for each in views], (-1, 3)),
            rotation_of(np.reshape([each.rotation_rad for each in views], (-1, 3))),
        )
        on_base = [[each.camera_on == "right" for each in views], [each.board_on == "right" for each in views]]
        bases = np.array(on_base, dtype=int).reshape(2, -1) * _BASE
        near = np.stack([np.eye(4), starts[0]])
        between = inverse_of(near[bases[1]] @ boards) @ near[bases[0]] @ cameras
        for pair in dict.fromkeys((each.camera_on, each.board_on) for each in views):
            chosen = [k for k, each in enumerate(views) if (each.camera_on, each.board_on) == pair]
            names = (f"camera on {pair[0]}", f"board on {pair[1]}")
            known = [starts[self.unknown.index(name)] if name in self.unknown else None for name in names]
            for name, pose in zip(names, _mounts_of(between[chosen], measured[chosen], *known), strict=True):
                if name not in self.unknown:
                    self.unknown.append(name)
                    starts.append(pose)
        rows = [
            np.array([self.unknown.index(f"{part} on {carrier}") + _BASE for carrier in carriers], dtype=int)
            for part, carriers in (
                ("camera", [each.camera_on for each in views]),
                ("board", [each.board_on for each in views]),
            )
        ]
        unit = np.tile(np.eye(4), (len(views), 1, 1))
        return _Chains(bases[0], cameras, rows[0], measured), _Chains(bases[1], boards, rows[1], unit)

    def _bar_weights(self) -> Array:
        """Return the whitening matrices (n, 6, 6) of poses of bars.

        The bar may sit slightly otherwise in each hand. A rotation in the left hand moves the right one, too.
        """
        left, right = (each.poses(self._stack(self.start)) for each in self._bars)
        lever = skew(right[:, :3, 3] - self._bars[0].arm[:, :3, 3]) if len(left) else np.zeros((0, 3, 3))
        position, rotation = self._noise.bar_m**2, self._noise.bar_rad**2
        covariance = np.zeros((len(left), 6, 6))
        covariance[:, :3, :3] = 2 * position * np.eye(3) - rotation * lever @ lever
        covariance[:, 3:, 3:] = 2 * rotation * np.eye(3)
        covariance[:, :3, 3:] = -rotation * lever
        covariance[:, 3:, :3] = rotation * lever
        factor = np.linalg.cholesky(covariance)
        weights: Array = np.linalg.solve(factor, np.broadcast_to(_SIX, factor.shape))
        return weights

    @property
    def has_views(self) -> bool:
        """True if there are views of a board."""
        return len(self._views[0].measured) > 0

    def resized(self, factor: float) -> Equations:
        """Return these equations with a board that is larger by a factor."""
        result = copy(self)
        measured = self._views[0].measured.copy()
        measured[:, :3, 3] *= factor
        result._views = (replace(self._views[0], measured=measured), self._views[1])
        return result

    @staticmethod
    def _stack(poses: Array) -> Array:
        stack: Array = np.concatenate([np.eye(4)[None], poses])
        return stack

    def moved(self, poses: Array, change: Array) -> Array:
        """Return the unknown poses after a change: 3 m and 3 rad for each, along and about the left base's axes."""
        change = change.reshape(-1, 6)
        result = poses.copy()
        result[:, :3, :3] = rotation_of(change[:, 3:]) @ poses[:, :3, :3]
        result[:, :3, 3] += change[:, :3]
        return result

    def residuals(self, poses: Array) -> Array:
        """Return all whitened residuals: of touches, then of bars, then of boards."""
        stack = self._stack(poses)
        tips = (self._tips[0] - stack[_BASE] @ self._tips[1])[:, :3, 0] / self._noise.touch_m
        bars = (self._whiten_bars @ _differences(*self._bars, stack)[..., None])[..., 0]
        views = _differences(*self._views, stack) * self._scale_views
        whole: Array = np.concatenate([tips.ravel(), bars.ravel(), views.ravel()])
        return whole

    def jacobian(self, poses: Array) -> Array:
        """Return the derivatives of all residuals by the changes of all poses, by central differences."""
        columns = []
        for k in range(6 * len(poses)):
            change = np.zeros(6 * len(poses))
            change[k] = _STEP
            ahead, behind = (self.residuals(self.moved(poses, sign * change)) for sign in (1, -1))
            columns.append((ahead - behind) / (2 * _STEP))
        jacobian: Array = np.stack(columns, axis=1)
        return jacobian

    def plain(self, poses: Array) -> Array:
        """Return the distance in m and the angle in rad of each observation's residual, (n, 2), in its order."""
        stack = self._stack(poses)
        tips = (self._tips[0] - stack[_BASE] @ self._tips[1])[:, :3, 0]
        six = np.concatenate(
            [np.pad(tips, ((0, 0), (0, 3))), _differences(*self._bars, stack), _differences(*self._views, stack)]
        )
        sizes: Array = np.linalg.norm(six.reshape(-1, 2, 3), axis=-1)
        order = np.argsort([each.start for each in self.rows], kind="stable")
        result: Array = np.empty_like(sizes)
        result[order] = sizes
        return result


def _rows_of(observations: Sequence[Observation], touches: int, bars: int) -> list[slice]:
    """Return the residuals of each observation."""
    first = {Touch: 0, BarPose: 3 * touches, BoardView: 3 * touches + 6 * bars}
    rows = []
    for each in observations:
        kind = type(each)
        size = 3 if kind is Touch else 6
        rows.append(slice(first[kind], first[kind] + size))
        first[kind] += size
    return rows


def _differences(left: _Chains, right: _Chains, stack: Array) -> Array:
    """Return position and rotation, (n, 6), from the ends of the second chains to those of the first."""
    ends, others = left.poses(stack), right.poses(stack)
    result = np.empty((len(ends), 6))
    result[:, :3] = ends[:, :3, 3] - others[:, :3, 3]
    result[:, 3:] = rotvec_of(ends[:, :3, :3] @ others[:, :3, :3].swapaxes(-1, -2))
    return result


def _mounts_of(between: Array, measured: Array, camera: Array | None, board: Array | None) -> tuple[Array, Array]:
    """Return the mounts of camera and board: `between` camera `measured` = board.

    Args:
        between: (n, 4, 4) what carries the camera, in the frame of what carries the board.
        measured: (n, 4, 4) the board in the camera's frame.
        camera: Its mount, if it is known already.
        board: Likewise.
    """
    if camera is None:
        camera = (
            _hand_eye(between, measured) if board is None else inverse_of(between[0]) @ board @ inverse_of(measured[0])
        )
    if board is None:
        board = between[0] @ camera @ measured[0]
    return camera, board


def _hand_eye(between: Array, measured: Array) -> Array:
    """Solve hand-eye calibration in closed form: rotation first, as Park and Martin do (IEEE T-RA 10(5), 1994).

    The relative poses a and b of two observations fulfil a M = M b. The rotation takes the rotation vectors of all b to
    those of all a; the translation then is linear.
    """
    first, second = np.triu_indices(len(between), 1)
    a = inverse_of(between[second]) @ between[first]
    b = measured[second] @ inverse_of(measured[first])
    outer = rotvec_of(a[:, :3, :3]).T @ rotvec_of(b[:, :3, :3])
    u, _, vt = np.linalg.svd(outer)
    rotation = u @ np.diag([1.0, 1.0, np.linalg.det(u @ vt)]) @ vt
    left = (a[:, :3, :3] - np.eye(3)).reshape(-1, 3)
    right = (b[:, :3, 3] @ rotation.T - a[:, :3, 3]).ravel()
    return transform(np.linalg.lstsq(left, right, rcond=None)[0], rotation)
