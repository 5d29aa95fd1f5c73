"""Estimate of the right base's pose in the left base's frame, with its covariance.

Nonlinear least squares on whitened residuals. A robust loss (soft L1) finds the start; then each observation that the
others contradict is rejected, and plain least squares over the rest gives estimate and covariance. The scale of the
noise follows from the residuals, so that intervals are Student's and Fisher's, right for few observations, too.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Final, NamedTuple

import numpy as np

from dual_ur10.errors import CalibrationError
from dual_ur10.sim2real.calibration.directions import LEVER_M, SCALES, Direction, weakest
from dual_ur10.sim2real.calibration.equations import Equations
from dual_ur10.sim2real.calibration.intervals import PoseInterval, scipy_module
from dual_ur10.sim2real.calibration.observations import Noise, Observation
from dual_ur10.sim2real.calibration.transforms import base_in_cell, rotation_of, rotvec_of
from ur_core.kinematics.frames import BASE_TO_BASE_LINK, ArmMount, yaw_and_tilt
from ur_core.kinematics.rotations import quat_from_matrix
from ur_core.kinematics.ur10 import DHParameters
from ur_core.types import Array, Mask

UNDETERMINED_M: Final = 0.02
"""Standard deviation at 1 m, at the stated noise, from which a direction counts as undetermined."""

FAR_M: Final = 0.3
"""Distance between an estimate and the approximate base beyond which one of both is wrong."""

FAR_RAD: Final = math.radians(20)
"""Angle beyond which one of both is wrong."""

EXCHANGED: Final = (
    "With left and right exchanged, the same observations fit the base of the cell file: left and right are exchanged "
    "in the data, or the addresses of both controllers in the cell file. Correct that, and record again"
)

_CONTRADICTED: Final = 1e-3
"""Probability, over all observations of a calibration together, of rejecting one although all are right."""

_BOARD_SIZE: Final = 0.01
"""Error of a board's size from which it is refused: 5 mm at a distance of 0.5 m."""


_LEAST_SCALE: Final = 0.1  # of the stated noise: residuals of zero would state an exact result
_DONE: Final = 1e-12
_MOST_STEPS: Final = 200
_SINGULAR: Final = 1e-11  # of the largest singular value


class Residual(NamedTuple):
    """Residual of one observation at the estimate.

    Attributes:
        distance_m: Distance between both ends of its equation.
        angle_rad: Angle between them; 0 for touches.
        probability: Probability of contradicting the other observations at least this much, if all are right.
        rejected: True if it was left out.
    """

    distance_m: float
    angle_rad: float
    probability: float
    rejected: bool


@dataclass(frozen=True)
class BaseEstimate(PoseInterval):
    """Pose of the right arm's `base` in the left arm's `base`.

    Attributes:
        pose: (4, 4) homogeneous transform.
        covariance: (6, 6) of its shift (m) and its rotation (rad), both along the axes of the left base.
        degrees_of_freedom: Of the noise's scale.
        noise_scale: Noise by the residuals, relative to the stated one.
        residuals: One for each observation, in their order.
        constants: Estimated constant poses (4, 4) by name: grasps, cameras, boards.
        information: (6, 6) at the stated noise, for suggestions.
        normal: Information on all unknown poses, (6 + 6 constants,) square, for suggestions.
        weakest: Direction that the observations determine least.
        exchanged: True if the estimate is far from the approximate base, and that of the same observations with left
            and right exchanged is near it.
    """

    pose: Array
    covariance: Array
    degrees_of_freedom: int
    noise_scale: float
    residuals: tuple[Residual, ...]
    constants: dict[str, Array]
    information: Array
    normal: Array
    weakest: Direction
    exchanged: bool = False

    @property
    def position_m(self) -> Array:
        """(3,) position of the right `base` in the left one."""
        return self.pose[:3, 3]

    def distance_from(self, pose: Array) -> tuple[float, float]:
        """Return how far the estimate is from a pose (4, 4) of the right base in the left one, m and rad."""
        rotation = rotvec_of(self.pose[:3, :3] @ pose[:3, :3].T)
        return math.dist(self.position_m, pose[:3, 3]), float(np.linalg.norm(rotation))

    def is_far_from(self, pose: Array) -> bool:
        """Return True if the estimate is farther from a pose (4, 4) than `FAR_M` or `FAR_RAD`."""
        distance_m, angle_rad = self.distance_from(pose)
        return distance_m > FAR_M or angle_rad > FAR_RAD

    @property
    def yaw_rad(self) -> float:
        """Rotation about the vertical that comes closest to the estimate."""
        rotation = self.pose[:3, :3]
        return math.atan2(rotation[1, 0] - rotation[0, 1], rotation[0, 0] + rotation[1, 1])

    @property
    def tilt_rad(self) -> Array:
        """(2,) rotation of the right base about the left one's x and y axes that remains beside `yaw_rad`."""
        level = rotation_of((0.0, 0.0, self.yaw_rad))
        return rotvec_of(self.pose[:3, :3] @ level.T)[:2]

    @property
    def mount_uncertainty(self) -> tuple[float, float]:
        """Uncertainty of the right mount relative to the left one, m and rad."""
        return self.position_bound_m, self.rotation_bound_rad

    @property
    def uncertainty_at_lever_m(self) -> float:
        """Largest error of the right mount's points at `LEVER_M` from its base."""
        position_m, rotation_rad = self.mount_uncertainty
        return position_m + LEVER_M * rotation_rad

    def mount(self, left: ArmMount, dh: DHParameters) -> ArmMount:
        """Return the right arm's mount in the cell in which the left one stands as given.

        Raises:
            SettingsError: It is beyond what a mount allows.
        """
        found = base_in_cell(left) @ self.pose
        yaw, tilt = yaw_and_tilt(quat_from_matrix(found[:3, :3] @ BASE_TO_BASE_LINK))
        return ArmMount(tuple(map(float, found[:3, 3])), yaw, dh, dh.robot, tilt_rad=tilt)  # type: ignore[arg-type]  # three


class _Fit(NamedTuple):
    poses: Array
    residuals: Array
    jacobian: Array


def estimate(
    observations: Sequence[Observation],
    dh: tuple[DHParameters, DHParameters],
    near: Array,
    noise: Noise | None = None,
) -> BaseEstimate:
    """Estimate the right base from any mix of observations.

    Args:
        observations: Touches, poses of a bar and views of a board.
        dh: Kinematics of the left and the right arm, as their controllers have them.
        near: (4, 4) approximate pose of the right base in the left one; some dm and tens of degrees are near enough.
        noise: Standard deviations; None: the defaults.

    Raises:
        CalibrationError: There are too few observations, or all of them leave a direction undetermined, which the
            message names together with what to add; or most contradict each other, or the board has another size. If
            they fit with left and right exchanged, the message says so.
    """
    stated = noise or Noise()
    try:
        found = _estimated(observations, dh, near, stated)
    except CalibrationError as error:
        if _fits_exchanged(observations, dh, near, stated):
            raise CalibrationError(f"{error}. {EXCHANGED}") from error
        raise
    exchanged = found.is_far_from(near) and _fits_exchanged(observations, dh, near, stated)
    return replace(found, exchanged=exchanged)


def _fits_exchanged(
    observations: Sequence[Observation], dh: tuple[DHParameters, DHParameters], near: Array, noise: Noise
) -> bool:
    """Return True if the observations with left and right exchanged put the right base near the approximate one."""
    for tips in (True, False):  # exchanged addresses exchange the joint angles, and not the tips of the cell file
        try:
            found = _estimated([each.exchanged(tips=tips) for each in observations], dh, near, noise)
        except CalibrationError:
            continue
        if not found.is_far_from(near):
            return True
    return False


def _estimated(
    observations: Sequence[Observation], dh: tuple[DHParameters, DHParameters], near: Array, noise: Noise
) -> BaseEstimate:
    equations = Equations(observations, dh, noise, near)
    every = np.ones(len(observations), dtype=np.bool_)
    robust = _solved(equations, equations.start, every, "soft_l1")
    _check_determined(equations, robust, every, observations)
    kept = _kept(equations, robust)
    fit = _solved(equations, robust.poses, kept)
    rows = _chosen(equations, kept)
    information, normal = _information(fit.jacobian[rows])
    direction = weakest(information, fit.poses[0])
    _check_determined(equations, fit, kept, observations)
    freedom = len(rows) - fit.jacobian.shape[1]
    scale = max(float(np.sqrt(fit.residuals[rows] @ fit.residuals[rows] / freedom)), _LEAST_SCALE)
    _check_board_size(equations, fit, kept)
    probabilities = _probabilities(equations, fit, kept)
    return BaseEstimate(
        pose=fit.poses[0],
        covariance=np.asarray(scale**2 * np.linalg.inv(information), dtype=np.float64),
        degrees_of_freedom=freedom,
        noise_scale=scale,
        residuals=tuple(
            Residual(float(distance), float(angle), float(probability), not bool(keep))
            for (distance, angle), probability, keep in zip(
                equations.plain(fit.poses), probabilities, kept, strict=True
            )
        ),
        constants=dict(zip(equations.unknown[1:], fit.poses[1:], strict=True)),
        information=information,
        normal=normal,
        weakest=direction,
    )


def _chosen(equations: Equations, kept: Mask) -> Array:
    """Return the numbers of the residuals of some observations."""
    parts = [np.arange(rows.start, rows.stop) for rows, keep in zip(equations.rows, kept, strict=True) if keep]
    return np.concatenate(parts) if parts else np.empty(0, dtype=int)


def _solved(equations: Equations, start: Array, kept: Mask, loss: str = "linear") -> _Fit:
    """Solve for the poses; residuals and Jacobian are those of all observations."""
    least_squares = scipy_module("optimize").least_squares

    rows, scale = _chosen(equations, kept), np.tile(1 / SCALES, len(start))

    def residuals(change: Array) -> Array:
        return equations.residuals(equations.moved(start, change / scale))

    found = least_squares(
        lambda change: residuals(change)[rows],
        np.zeros(start.size // 16 * 6),
        jac="3-point",
        loss=loss,
        xtol=_DONE,
        ftol=_DONE,
        gtol=_DONE,
        max_nfev=_MOST_STEPS,
    )
    poses = equations.moved(start, found.x / scale)
    return _Fit(poses, equations.residuals(poses), equations.jacobian(poses))


def _information(jacobian: Array) -> tuple[Array, Array]:
    """Return the information on the base, with all constants unknown, and that on everything."""
    own, others = jacobian[:, :6], jacobian[:, 6:]
    if others.shape[1]:
        u, values, _ = np.linalg.svd(others, full_matrices=False)
        u = u[:, values > _SINGULAR * values[0]] if len(values) else u
        own = own - u @ (u.T @ own)
    return own.T @ own, jacobian.T @ jacobian


def _check_determined(equations: Equations, fit: _Fit, kept: Mask, observations: Sequence[Observation]) -> None:
    rows = _chosen(equations, kept)
    direction = weakest(_information(fit.jacobian[rows])[0], fit.poses[0])
    unknown = fit.jacobian.shape[1]
    if direction.sigma_m > UNDETERMINED_M:
        verb = "leaves" if kept.sum() == 1 else "leave"
        raise CalibrationError(
            f"{_count(observations, kept)} {verb} {direction.text} of the right base undetermined (± "
            f"{min(2e3 * direction.sigma_m, 1e4):.3g} mm at {LEVER_M:g} m; coordinates in the left base's frame). "
            f"{_remedy(observations, direction)}"
        )
    if len(rows) <= unknown:
        raise CalibrationError(
            f"{_count(observations, kept)} give {len(rows)} equations for {unknown} unknowns: none is left to tell "
            "how accurate the result is. Add an observation"
        )


def _check_board_size(equations: Equations, fit: _Fit, kept: Mask) -> None:
    """Refuse views whose distances all are too large or too small by one factor: the board is of another size."""
    stats = scipy_module("stats")
    least_squares = scipy_module("optimize").least_squares

    rows = _chosen(equations, kept)
    freedom = len(rows) - fit.jacobian.shape[1] - 1
    if not equations.has_views or freedom < 1:
        return
    units = np.append(np.tile(SCALES, len(fit.poses)), 1.0)

    def residuals(change: Array) -> Array:
        values: Array = equations.resized(float(np.exp(change[-1]))).residuals(
            equations.moved(fit.poses, change[:-1] * units[:-1])
        )
        chosen: Array = values[rows]
        return chosen

    found = least_squares(residuals, np.zeros(len(units)), xtol=_DONE, ftol=_DONE, gtol=_DONE, max_nfev=_MOST_STEPS)
    before, after = float(fit.residuals[rows] @ fit.residuals[rows]), 2.0 * float(found.cost)
    factor = float(np.exp(found.x[-1]))
    after = max(after, freedom * _LEAST_SCALE**2)
    if abs(factor - 1.0) > _BOARD_SIZE and stats.f.sf((before - after) / (after / freedom), 1, freedom) < _CONTRADICTED:
        raise CalibrationError(
            f"the board is {factor:.3f} times as large as described, by the motion of the arms: measure the edge of a "
            "square over many squares, and correct square_m and marker_m of `board`"
        )


def _count(observations: Sequence[Observation], kept: Mask) -> str:
    names = {"Touch": "touch", "BarPose": "pose of a bar", "BoardView": "view of a board"}
    plural = {"Touch": "touches", "BarPose": "poses of a bar", "BoardView": "views of a board"}
    kinds = [type(each).__name__ for each, keep in zip(observations, kept, strict=True) if keep]
    parts = [f"{kinds.count(each)} {(names if kinds.count(each) == 1 else plural)[each]}" for each in names]
    return " and ".join(part for part in parts if not part.startswith("0 "))


def _remedy(observations: Sequence[Observation], direction: Direction) -> str:
    kind = type(observations[-1]).__name__
    if kind == "Touch":
        return (
            "Touch points that do not lie on one line, three or more, at least 0.3 m from it: to the left and right of "
            "the bases, near and far, high and low. `--suggest` names one"
        )
    if kind == "BarPose":
        return "Rotate the bar about two other axes by 20° or more between poses. `--suggest` names a pose"
    return (
        "Rotate the arm that carries camera or board about two different axes by 20° or more between views, and let "
        "views relate both arms"
    )


def _kept(equations: Equations, robust: _Fit) -> Mask:
    """Return a mask of the observations that do not contradict the others.

    The start are those close to the robust solution. Then the worst of them is taken out, or one of the others put
    back, until all of them agree.
    """
    stats = scipy_module("stats")

    sizes = np.array([rows.stop - rows.start for rows in equations.rows])
    squares = np.array([robust.residuals[rows] @ robust.residuals[rows] for rows in equations.rows])
    medians = stats.chi2.median(sizes)
    scale = max(float(np.median(squares / medians)), _LEAST_SCALE**2)
    far = stats.chi2.sf(squares / scale, sizes) < _CONTRADICTED / len(sizes)
    kept: Mask = ~far
    seen = set()
    while kept.any() and kept.tobytes() not in seen:
        seen.add(kept.tobytes())
        fit = _solved(equations, robust.poses, kept)
        probabilities = _probabilities(equations, fit, kept)
        contradicted = probabilities < _CONTRADICTED / len(sizes)
        if (contradicted & kept).any():
            kept = kept.copy()
            kept[np.where(kept, probabilities, np.inf).argmin()] = False
        elif (~contradicted & ~kept).any():
            kept = kept.copy()
            kept[np.where(kept, -np.inf, probabilities).argmax()] = True
    if kept.sum() <= len(kept) / 2:
        raise CalibrationError(
            f"only {kept.sum()} of {len(kept)} observations agree with each other: most tips did not touch, a tool "
            "offset or the kinematics of an arm is wrong, or the bar slipped. Check them, and record again"
        )
    return kept


def _probabilities(equations: Equations, fit: _Fit, kept: Mask) -> Array:
    """Return for each observation the probability that the others contradict it at least this much, (n,).

    An F test of its residuals against those of the other kept observations, whose estimate predicts them.
    """
    stats = scipy_module("stats")

    rows = _chosen(equations, kept)
    inside, jacobian = fit.residuals[rows], fit.jacobian[rows]
    _, values, vt = np.linalg.svd(jacobian, full_matrices=False)
    good = values > _SINGULAR * values[0]
    root = vt[good].T / values[good]  # the covariance is this times its transpose
    square, freedom = float(inside @ inside), len(rows) - int(good.sum())
    result = np.ones(len(kept))
    for k, own in enumerate(equations.rows):
        residual, spread = fit.residuals[own], fit.jacobian[own] @ root
        size = len(residual)
        leverage = spread @ spread.T
        if kept[k]:
            left = freedom - size
            among = np.eye(size) - leverage
            if left < 1 or np.linalg.eigvalsh(among)[0] < 1e-6:
                continue  # nothing else determines it
            change = float(residual @ np.linalg.solve(among, residual))
            rest = max(square - change, freedom * (1e-3 * _LEAST_SCALE) ** 2)
        else:
            left = freedom
            if left < 1:
                continue
            change = float(residual @ np.linalg.solve(np.eye(size) + leverage, residual))
            rest = max(square, freedom * (1e-3 * _LEAST_SCALE) ** 2)
        result[k] = stats.f.sf(change / size / (rest / left), size, left)
    return result
