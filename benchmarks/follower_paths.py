"""Paths of both arms for `followers.py`: a swing of the flanges, and a bar that is grasped and carried."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from scipy.interpolate import make_interp_spline
from scipy.spatial.transform import Rotation, Slerp

from dual_ur10.envs.tasks.geometry import flanges_of
from dual_ur10.envs.tasks.sync_carry.path import CarryPath
from dual_ur10.envs.tasks.sync_carry.settings import CarrySettings
from ur_core.kinematics.forward import flange_pose
from ur_core.kinematics.frames import ArmMount, to_base
from ur_core.kinematics.inverse import nearest
from ur_core.kinematics.poses import Poses, compose
from ur_core.kinematics.rotations import quat_to_matrix
from ur_core.kinematics.ur10 import NOMINAL_DH

AMPLITUDE_M, FREQUENCY_HZ, DURATION_S, RAMP_S = 0.1, 0.5, 12.0, 2.0  # of the swing
LOWER_S = 4.0
CARRY_S = 30.0
HIGHER_M = 0.0195  # than the task grips: outside of a task, the gate keeps fingers 20 mm off the table
_STEP_S = 0.004

Mounts = Sequence[ArmMount]


class ArmsPath:
    """Joint positions, speeds and accelerations of both arms at any time; the path rests before and after.

    Args:
        joints_rad: (n, 2, 6) joint positions every `_STEP_S`.
        ramp_s: Time at both ends that says nothing about skew, because the arms hardly move.
    """

    def __init__(self, joints_rad: Any, ramp_s: float) -> None:
        times = _STEP_S * np.arange(len(joints_rad))
        self.duration_s, self.ramp_s = float(times[-1]), ramp_s
        self._curve = make_interp_spline(times, joints_rad, k=5)

    def __call__(self, time_s: Any, derivative: int = 0) -> Any:
        """Return values (n, 2, 6) at times."""
        time_s = np.asarray(time_s)
        inside = np.clip(time_s, 0.0, self.duration_s)
        rests = (time_s != inside)[:, None, None]
        return np.where(rests & (derivative > 0), 0.0, self._curve(inside, derivative))

    def targets(self, servoj: Any) -> Any:
        """Return the targets of each control period, which lead by the lag of the law."""
        ticks = round((self.duration_s + 0.2) / servoj.tick_s)
        times = (np.arange(-1, ticks) + 0.5) * servoj.tick_s
        return self(times) + servoj.lookahead_s * self(times, 1) + self(times, 2) / servoj.gain


def swing(q_rad: Any, arms: Sequence[int] = (0, 1)) -> ArmsPath:
    """Return the swing of some arms' flanges along y of their bases; the others rest.

    Args:
        q_rad: (2, 6) joint positions at its begin and end.
        arms: Indices of the arms.
    """
    times = np.arange(round(DURATION_S / _STEP_S) + 1) * _STEP_S
    ramp = _smooth(np.minimum(times, DURATION_S - times) / RAMP_S)
    away = AMPLITUDE_M * ramp * np.sin(2 * np.pi * FREQUENCY_HZ * times)
    joints = np.tile(np.asarray(q_rad), (len(times), 1, 1))
    for arm in arms:
        position, rotation = flange_pose(q_rad[arm], NOMINAL_DH)
        wanted = position + away[:, None] * np.array([0.0, 1.0, 0.0])
        joints[:, arm] = nearest(wanted, np.broadcast_to(rotation, (len(times), 3, 3)), joints[:, arm], NOMINAL_DH)
    return ArmsPath(joints, RAMP_S)


def lowered(q_rad: Any, bar: Poses, mounts: Mounts) -> ArmsPath:
    """Return straight lines of both flanges to the grips of a bar.

    Args:
        q_rad: (2, 6) joint positions at the beginning.
        bar: Pose of the bar in the cell frame.
        mounts: Bases of the arms.
    """
    here_m, here = flanges_in_cell(np.asarray(q_rad)[None], mounts)
    grips = flanges_of(compose(bar, CarrySettings().grip))
    there_m, there = grips.position_m + HIGHER_M * np.eye(3)[2], quat_to_matrix(grips.quat)
    times = np.arange(round(LOWER_S / _STEP_S) + 1) * _STEP_S
    s = _smooth(times / LOWER_S)
    position = here_m[0] + s[:, None, None] * (there_m - here_m[0])
    ends = [Rotation.from_matrix([here[0, arm], there[arm]]) for arm in range(2)]
    rotation = np.stack([Slerp([0.0, 1.0], each)(s).as_matrix() for each in ends], axis=1)
    return ArmsPath(_joints_of(position, rotation, q_rad, mounts), LOWER_S / 4)


def carried(q_rad: Any, bar: Poses, mounts: Mounts) -> ArmsPath:
    """Return the path of SyncCarry, with the flanges fixed to the bar as they are.

    Args:
        q_rad: (2, 6) joint positions at the beginning.
        bar: Pose of the bar in the cell frame.
        mounts: Bases of the arms.
    """
    times = np.arange(round(CARRY_S / _STEP_S) + 1) * _STEP_S
    here_m, here = flanges_in_cell(np.asarray(q_rad)[None], mounts)
    frame = quat_to_matrix(bar.quat)
    # The path begins at any pose of the bar: only its change counts.
    found = CarryPath(CARRY_S)(times[None], Poses(bar.position_m[None], np.array([[1.0, 0.0, 0.0, 0.0]])))
    turned = quat_to_matrix(found.quat[0])
    away_m = (here_m[0] - bar.position_m) @ frame
    moved = turned @ frame
    position = found.position_m[0][:, None] + np.einsum("nij,aj->nai", moved, away_m)
    rotation = np.einsum("nij,ajk->naik", turned, here[0])
    return ArmsPath(_joints_of(position, rotation, q_rad, mounts), 1.0)


def flanges_in_cell(q_rad: Any, mounts: Mounts) -> tuple[Any, Any]:
    """Return positions and rotation matrices of both flanges in the cell frame, (n, 2, 3) and (n, 2, 3, 3)."""
    base_m, to = to_base((mounts[0], mounts[1]))
    poses = [flange_pose(q_rad[:, arm], mounts[arm].dh) for arm in range(2)]
    position = np.stack([base_m[arm] + pose[0] @ to[arm] for arm, pose in enumerate(poses)], axis=1)
    return position, np.stack([to[arm].T @ pose[1] for arm, pose in enumerate(poses)], axis=1)


def _joints_of(position: Any, rotation: Any, q_rad: Any, mounts: Mounts) -> Any:
    """Return the joints, (n, 2, 6), of flange poses in the cell frame."""
    base_m, to = to_base((mounts[0], mounts[1]))
    joints = np.empty((len(position), 2, 6))
    for arm, mount in enumerate(mounts):
        near = np.asarray(q_rad)[arm]
        wanted, turned = (position[:, arm] - base_m[arm]) @ to[arm].T, to[arm] @ rotation[:, arm]
        for k in range(len(position)):
            near = joints[k, arm] = nearest(wanted[k], turned[k], near, mount.dh)
    return joints


def _smooth(s: Any) -> Any:
    s = np.clip(s, 0.0, 1.0)
    return s**3 * (10 + s * (6 * s - 15))
