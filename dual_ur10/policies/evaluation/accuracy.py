"""Accuracy of a recorded episode.

Flange poses are computed from the joint positions with `ur_core.kinematics`, not taken from the simulator: a site
that is one physics step old would add 0.6 mm at the sine's speed. Speeds are central differences of positions one
policy period apart: they contain no frequency above half the policy's rate.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from dual_ur10.envs.tasks.sine_tracking.settings import TOOL_DOWN_QUAT
from dual_ur10.errors import SettingsError
from dual_ur10.policies.evaluation.cross_correlation import cross_correlation, peak_delay
from dual_ur10.policies.evaluation.rollout import Record
from ur_core.kinematics import flange_pose
from ur_core.kinematics.frames import to_base
from ur_core.kinematics.rotations import quat_to_matrix
from ur_core.types import Array

_MOST_PERIODS = 5  # largest delay considered
_STILL_M = 1e-6  # a reference that moves less counts as static


@dataclass(frozen=True)
class Accuracy:
    """Accuracy of one episode; of figures per arm, the worse one.

    A constant distance between the flanges proves little: two equal arms in equal configurations keep it in any case,
    and errors across the line between them hardly change it. The vector from flange to flange shows those. Errors that
    both arms share, such as lag, show in the flange error alone.

    Attributes:
        flange_max_mm: Largest distance of a flange to its reference.
        flange_rms_mm: Its root mean square.
        orientation_max_deg: Largest angle of a flange to its reference orientation.
        distance_max_mm: Largest error of the distance between the flanges.
        vector_max_mm: Largest error of the vector between the flanges, in the cell frame.
        ripple_max_m_s: Largest difference of a flange's speed to that of its reference.
    """

    flange_max_mm: float
    flange_rms_mm: float
    orientation_max_deg: float
    distance_max_mm: float
    vector_max_mm: float
    ripple_max_m_s: float


@dataclass(frozen=True)
class Errors:
    """Errors over time, (k,) or one column per arm, (k, 2). See `Accuracy`.

    Attributes:
        flange_m: (k, 2).
        orientation_rad: (k, 2).
        distance_m: (k,) with its sign: positive is too far apart.
        vector_m: (k, 3) left minus right.
        speed_m_s: (k, 2) with its sign: positive is too fast.
    """

    flange_m: Array
    orientation_rad: Array
    distance_m: Array
    vector_m: Array
    speed_m_s: Array


def flange_positions(record: Record) -> Array:
    """Return flange positions in the cell frame, (k, 2, 3), from the joint positions."""
    base_m, from_cell = to_base(record.mounts)
    local = [flange_pose(record.q_rad[:, arm], mount.dh)[0] for arm, mount in enumerate(record.mounts)]
    return np.stack([base_m[arm] + position @ from_cell[arm] for arm, position in enumerate(local)], axis=1)


def errors(record: Record, reference_quat: Array = TOOL_DOWN_QUAT) -> Errors:
    """Return errors over time.

    Args:
        record: An episode of a task with a reference.
        reference_quat: (4,) reference orientation of both flanges, in each arm's own `base` frame.

    Raises:
        SettingsError: The episode has no reference, or fewer than three steps.
    """
    reference = _reference(record)
    position = flange_positions(record)
    wanted = quat_to_matrix(reference_quat)
    rotations = [flange_pose(record.q_rad[:, arm], mount.dh)[1] for arm, mount in enumerate(record.mounts)]
    # |R1 - R2| is 2 sqrt(2) sin(angle / 2), exact for small angles where the arc cosine of a trace is not.
    apart = np.linalg.norm(np.stack(rotations, axis=1) - wanted, axis=(2, 3))
    vector, wanted_vector = position[:, 0] - position[:, 1], reference[:, 0] - reference[:, 1]
    return Errors(
        flange_m=np.linalg.norm(position - reference, axis=2),
        orientation_rad=2 * np.arcsin(np.minimum(apart / np.sqrt(8), 1.0)),
        distance_m=np.linalg.norm(vector, axis=1) - np.linalg.norm(wanted_vector, axis=1),
        vector_m=vector - wanted_vector,
        speed_m_s=_speed(position, record.period_s) - _speed(reference, record.period_s),
    )


def accuracy(record: Record, reference_quat: Array = TOOL_DOWN_QUAT, *, after_s: float = 0.0) -> Accuracy:
    """Return the accuracy of an episode.

    Args:
        record: See `errors`.
        reference_quat: See `errors`.
        after_s: Time before which nothing counts.

    Raises:
        SettingsError: See `errors`; or it ended before `after_s`.
    """
    late = record.time_s >= after_s - 1e-9
    if not late.any():
        raise SettingsError(f"the episode is {record.time_s[-1]:g} s long: there is nothing after {after_s:g} s")
    found = errors(record, reference_quat)
    flange = found.flange_m[late]
    return Accuracy(
        flange_max_mm=1e3 * float(flange.max()),
        flange_rms_mm=1e3 * float(np.sqrt((flange**2).mean(axis=0)).max()),
        orientation_max_deg=float(np.degrees(found.orientation_rad[late].max())),
        distance_max_mm=1e3 * float(np.abs(found.distance_m[late]).max()),
        vector_max_mm=1e3 * float(np.linalg.norm(found.vector_m[late], axis=1).max()),
        ripple_max_m_s=float(np.abs(found.speed_m_s[late]).max()),
    )


def along_axis(record: Record) -> tuple[Array, Array]:
    """Return displacements of flanges and references along the reference path, (k, 2) each; 0 for a static arm."""
    reference = _reference(record)
    moved = reference - reference.mean(axis=0)
    position = flange_positions(record) - reference.mean(axis=0)
    result = np.zeros((2, record.steps, 2))
    for arm in range(2):
        far = moved[np.linalg.norm(moved[:, arm], axis=1).argmax(), arm]
        length = float(np.linalg.norm(far))
        if length > _STILL_M:
            # Seen from one side for both arms, so that they can be compared.
            direction = far / length * np.sign(far[np.abs(far).argmax()])
            result[:, :, arm] = position[:, arm] @ direction, moved[:, arm] @ direction
    return result[0], result[1]


def lag_s(record: Record) -> Array:
    """Return the lag, (2,), of each flange behind its reference; NaN for a static arm."""
    position, reference = along_axis(record)
    return np.array([delay_s(position[:, arm], reference[:, arm], record.period_s) for arm in range(2)])


def skew_s(record: Record) -> float:
    """Return the lag of the left arm behind the right one; NaN if one of them is static."""
    position, reference = along_axis(record)
    if not np.abs(reference).max(axis=0).all():
        return float("nan")
    return delay_s(position[:, 0], position[:, 1], record.period_s)


def correlation(late: Array, early: Array) -> tuple[NDArray[np.intp], Array]:
    """Return the delays from -5 to 5 periods and the cross-correlation of two signals, (k,) each, at these delays."""
    return np.arange(-_MOST_PERIODS, _MOST_PERIODS + 1), cross_correlation(late, early, _MOST_PERIODS)


def delay_s(late: Array, early: Array, period_s: float) -> float:
    """Return the delay of `late` behind `early`, by cross-correlation; NaN if a signal is constant or too short."""
    if len(late) <= 2 * _MOST_PERIODS + 2:
        return float("nan")
    _, values = correlation(late, early)
    return float("nan") if np.isnan(values).any() else peak_delay(values) * period_s


def _reference(record: Record) -> Array:
    if record.reference_m is None or record.steps < 3:
        raise SettingsError("accuracy needs an episode of three steps or more, of a task with a reference")
    return record.reference_m


def _speed(position: Array, period_s: float) -> Array:
    """Return (k, 2) speeds by central differences; the first and last are those of their neighbours."""
    speed: Array = np.linalg.norm(position[2:] - position[:-2], axis=2) / (2 * period_s)
    return np.concatenate([speed[:1], speed, speed[-1:]])
