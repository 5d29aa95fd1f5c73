"""Next observations that tell most about the right base, from candidates that both arms reach.

A candidate is the better, the smaller the mean square of the base's error becomes: the trace of the covariance, with
rotations at `LEVER_M`. Whether the way there is free is for the operator to see.
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np

from dual_ur10.errors import CalibrationError
from dual_ur10.sim2real.calibration.directions import SCALES
from dual_ur10.sim2real.calibration.equations import Equations
from dual_ur10.sim2real.calibration.estimate import BaseEstimate
from dual_ur10.sim2real.calibration.observations import BarPose, Noise, Observation, Touch
from dual_ur10.sim2real.calibration.transforms import flange, inverse_of, rotation_of, rotvec_of, transform
from ur_core.kinematics.frames import BASE_TO_BASE_LINK
from ur_core.kinematics.inverse import try_nearest
from ur_core.kinematics.robots import robot_model
from ur_core.kinematics.ur10 import REACH_M, DHParameters
from ur_core.types import Array, Vector3

PRIOR_M: Final = 0.1
"""Standard deviation of the base before any observation, m and rad times `LEVER_M`."""

# Of arms of the UR10's reach; those of others in proportion.
_GRID_M: Final = 0.1
_NEAR_M: Final = 0.35  # least horizontal distance from a base
_HIGH_M: Final = 1.0  # largest height above both bases
_FRONT_M: Final = 0.2  # least distance of points in front of both bases
_LOW_M: Final = 0.1  # least height above both bases
_FAR: Final = 0.929  # flange from shoulder, of upper arm and forearm: bases may stand otherwise than thought
_BAR_RAD: Final = (0.45, 0.9)  # about one axis
_BAR_CORNER_RAD: Final = 0.6  # about each of three axes at once
_BAR_M: Final = 0.15
_BAR_JOINT_RAD: Final = 1.5  # from a central pose: beyond, an arm might have to change its configuration and let go
_ELBOW_UP: Final = np.array([0.0, -1.2, 1.6, -2.0, -1.57, 0.0])


@dataclass(frozen=True)
class Suggestion:
    """Proposed observation.

    Attributes:
        observation: Joint angles at which it is expected.
        text: Where to bring the arms, for the operator.
        expected_m: Standard deviation of the base after it, at the stated noise: root of the trace.
    """

    observation: Observation
    text: str
    expected_m: float


def touch_candidates(dh: tuple[DHParameters, DHParameters], base: Array, tcp_m: tuple[Vector3, Vector3]) -> list[Touch]:
    """Return touches on a grid in front of both bases that both arms reach with tools from opposite sides.

    The grid is that of the arm with the smaller reach.

    Args:
        dh: Kinematics of the left and the right arm.
        base: (4, 4) pose of the right base in the left one.
        tcp_m: Tool centre points in the flange frames.
    """
    models = [robot_model(each.robot) for each in dh]
    reach_m = min(model.reach_m for model in models)
    scale = reach_m / REACH_M
    grid_m = _GRID_M * scale
    steps = np.arange(-reach_m, reach_m + grid_m / 2, grid_m)
    heights = np.arange(_LOW_M, _HIGH_M * scale, grid_m)
    flat = np.stack(np.meshgrid(steps, steps, heights, indexing="ij"), axis=-1).reshape(-1, 3)
    back = inverse_of(base)
    others = flat @ back[:3, :3].T + back[:3, 3]
    ahead = [(each @ BASE_TO_BASE_LINK)[:, 0] > _FRONT_M for each in (flat, others)]
    near = [np.linalg.norm(each[:, :2], axis=1) > _NEAR_M * scale for each in (flat, others)]
    points = flat[ahead[0] & ahead[1] & near[0] & near[1] & (others[:, 2] > _LOW_M / 2)]
    across = base[:3, 3] * [1.0, 1.0, 0.0]
    across = across / max(float(np.linalg.norm(across)), 1e-9)
    found: dict[int, Touch] = {}
    for down in (0.0, 1.0, 2.0):
        todo = np.array([k for k in range(len(points)) if k not in found], dtype=int)
        joints, good = [], np.ones(len(todo), dtype=np.bool_)
        for arm, (frame, sign) in enumerate(((np.eye(4), 1.0), (back, -1.0))):
            tool = frame[:3, :3] @ _pointing(sign * across - [0.0, 0.0, down])
            at = points[todo] @ frame[:3, :3].T + frame[:3, 3] - tool @ np.asarray(tcp_m[arm])
            reference = np.tile(_ELBOW_UP, (len(todo), 1))
            reference[:, 0] = np.arctan2(-at[:, 1], -at[:, 0])
            q, reached = try_nearest(at, np.tile(tool, (len(todo), 1, 1)), reference, dh[arm])
            joints.append(q)
            far_m = -_FAR * sum(models[arm].a_m)
            good &= reached & (np.linalg.norm(at - [0.0, 0.0, models[arm].d_m[0]], axis=1) < far_m)
        for k in np.flatnonzero(good):
            left, right = (tuple(each[k].tolist()) for each in joints)
            found[int(todo[k])] = Touch(left, right, *tcp_m)
    return [found[k] for k in sorted(found)]


def _pointing(axis: Array) -> Array:
    """Return a rotation whose z axis points along a direction."""
    z = axis / np.linalg.norm(axis)
    x = np.cross(z, [0.0, 0.0, 1.0]) if abs(z[2]) < 0.9 else np.cross(z, [0.0, 1.0, 0.0])
    x /= np.linalg.norm(x)
    return np.stack([x, np.cross(z, x), z], axis=1)


def bar_candidates(
    dh: tuple[DHParameters, DHParameters], estimate: BaseEstimate, observed: Sequence[BarPose]
) -> list[BarPose]:
    """Return poses of the last grasp, rotated and shifted from the mean of the observed ones, that both arms reach."""
    grasp = observed[-1].grasp
    own = [each for each in observed if each.grasp == grasp]
    between = estimate.constants[f"grasp {grasp}"]
    poses = flange([each.left_q_rad for each in own], dh[0])
    central = int(np.linalg.norm(poses[:, :3, 3] - poses[:, :3, 3].mean(0), axis=-1).argmin())
    middle, near = poses[central], (own[central].left_q_rad, own[central].right_q_rad)
    axes = np.concatenate([np.eye(3), -np.eye(3)])
    corners = _BAR_CORNER_RAD * np.array(list(itertools.product((1.0, -1.0), repeat=3)))
    rotations = [np.zeros(3), *(angle * axis for angle in _BAR_RAD for axis in axes), *corners]
    shifts = [np.zeros(3), *(_BAR_M * axes)]
    turned = [rotation_of(each) @ middle[:3, :3] for each in rotations]
    left = np.stack([transform(poses[:, :3, 3].mean(0) + away, each) for each in turned for away in shifts])
    right = inverse_of(estimate.pose) @ left @ between
    joints, good = [], np.ones(len(left), dtype=np.bool_)
    for goals, reference, own_dh in zip((left, right), near, dh, strict=True):
        q, reached = try_nearest(goals[:, :3, 3], goals[:, :3, :3], np.tile(reference, (len(goals), 1)), own_dh)
        joints.append(q)
        good &= reached & (np.abs(q - reference).max(axis=1) < _BAR_JOINT_RAD)
    return [BarPose(tuple(joints[0][k].tolist()), tuple(joints[1][k].tolist()), grasp) for k in np.flatnonzero(good)]


def best(
    candidates: Sequence[Observation],
    dh: tuple[DHParameters, DHParameters],
    base: Array,
    noise: Noise | None = None,
    *,
    estimate: BaseEstimate | None = None,
    observed: Sequence[Observation] = (),
) -> Suggestion:
    """Return the best candidate.

    Args:
        candidates: Observations of one kind at which the arms are thought. Poses of a bar need an estimate.
        dh: Kinematics of the left and the right arm.
        base: (4, 4) approximate pose of the right base in the left one.
        noise: Standard deviations; None: the defaults.
        estimate: Estimate to be improved; None: there is none yet.
        observed: Observations so far, if there is no estimate; only touches count.

    Raises:
        CalibrationError: There is no candidate.
    """
    if not candidates:
        raise CalibrationError(
            "both arms reach none of the candidates in front of both bases: check the poses of the bases, or choose "
            "the next observation by hand"
        )
    noise = noise or Noise()
    if estimate is None:
        touches = [each for each in observed if isinstance(each, Touch)]
        information = _prior(6) + sum(each.T @ each for each in (_rows(touches, dh, base, noise) if touches else []))
        rows = _rows(candidates, dh, base, noise)
    elif isinstance(candidates[0], BarPose):
        information, base = estimate.normal, estimate.pose
        rows = _bar_rows(candidates, dh, noise, estimate)
    else:
        information, base = estimate.normal, estimate.pose
        width = len(information) - 6
        rows = [np.pad(each, ((0, 0), (0, width))) for each in _rows(candidates, dh, base, noise)]
    expected = np.array([_expected(information + each.T @ each) for each in rows])
    chosen = candidates[int(expected.argmin())]
    return Suggestion(chosen, _text(chosen, dh, base), float(expected.min()))


def plan(
    count: int,
    candidates: Sequence[Touch],
    dh: tuple[DHParameters, DHParameters],
    base: Array,
    noise: Noise | None = None,
) -> list[Suggestion]:
    """Return a series of touches, each the best after those before it.

    Raises:
        CalibrationError: There are fewer candidates.
    """
    if len(candidates) < count:
        raise CalibrationError(
            f"both arms reach only {len(candidates)} points in front of both bases: {count} are needed. Check the "
            "poses of the bases, or choose the points by hand"
        )
    left, series = list(candidates), list[Suggestion]()
    for _ in range(count):
        observed = [each.observation for each in series]
        series.append(best(left, dh, base, noise, observed=observed))
        left.remove(series[-1].observation)  # type: ignore[arg-type]  # a touch
    return series


def _rows(
    candidates: Sequence[Observation], dh: tuple[DHParameters, DHParameters], base: Array, noise: Noise
) -> list[Array]:
    """Return the derivatives of the residuals of touches by the base's pose, (3, 6) for each."""
    equations = Equations(candidates, dh, noise, base)
    jacobian = equations.jacobian(equations.start)
    return [jacobian[each, :6] for each in equations.rows]


def _bar_rows(
    candidates: Sequence[Observation], dh: tuple[DHParameters, DHParameters], noise: Noise, estimate: BaseEstimate
) -> list[Array]:
    equations = Equations(candidates, dh, noise, estimate.pose)
    names = ["base", *estimate.constants]
    poses = np.stack([estimate.pose, *(estimate.constants[each] for each in equations.unknown[1:])])
    jacobian = equations.jacobian(poses)
    result = np.zeros((len(jacobian), 6 * len(names)))
    for k, name in enumerate(equations.unknown):
        there = 6 * names.index(name)
        result[:, there : there + 6] = jacobian[:, 6 * k : 6 * k + 6]
    return [result[each] for each in equations.rows]


def _prior(size: int) -> Array:
    result: Array = np.diag(np.tile(1 / (PRIOR_M * SCALES), size // 6) ** 2)
    return result


def _expected(normal: Array) -> float:
    """Return the root of the trace of the base's covariance, with rotations at `LEVER_M`, m."""
    covariance = np.linalg.inv(normal + 1e-6 * _prior(len(normal)))[:6, :6]
    return float(np.sqrt((np.diag(covariance) / SCALES**2).sum()))


def _text(observation: Observation, dh: tuple[DHParameters, DHParameters], base: Array) -> str:
    if isinstance(observation, Touch):
        pose = flange(observation.left_q_rad, dh[0])
        point = pose @ [*observation.left_tcp_m, 1.0]
        other = inverse_of(base) @ point
        return (
            f"touch the point {_numbers(point[:3])} m in the left base's frame, which is {_numbers(other[:3])} m in "
            "the right one's"
        )
    if isinstance(observation, BarPose):
        pose = flange(observation.left_q_rad, dh[0])
        return (
            f"bring the bar to where the left flange is at {_numbers(pose[:3, 3])} m with the rotation vector "
            f"{_numbers(rotvec_of(pose[:3, :3]))} rad, in the left base's frame"
        )
    raise CalibrationError("views of a board are not suggested: rotate the arm about another axis than before")


def _numbers(values: Array) -> str:
    return f"({', '.join(f'{each:.2f}' for each in values)})"
