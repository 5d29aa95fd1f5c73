"""Settings of `SyncCarry`, and the largest speed of its path for two arms."""

from __future__ import annotations

import dataclasses
import itertools
from functools import lru_cache
from typing import Literal, get_args

import numpy as np

from dual_ur10.assets.props import BAR_WIDTH_M, GRIP_DISTANCE_M, GRIP_QUAT
from dual_ur10.assets.settings import SceneSettings, home_q_rad
from dual_ur10.envs.tasks.geometry import flanges_of, lying
from dual_ur10.envs.tasks.sync_carry.path import MOVES, CarryPath
from dual_ur10.envs.tasks.task import check_numbers
from dual_ur10.errors import SettingsError, UnknownNameError, WorkspaceError
from dual_ur10.sim2real.control.limits import MotionLimits
from ur_core.kinematics import try_nearest
from ur_core.kinematics.forward import elbow_flange_and_tcp
from ur_core.kinematics.frames import Frames
from ur_core.kinematics.poses import Poses, compose, relative_to
from ur_core.kinematics.rotations import quat_to_matrix
from ur_core.kinematics.ur10 import ARMS
from ur_core.tools.tool import Tool, levers_m
from ur_core.types import Array

Grasp = Literal["friction", "rigid"]
Payload = Literal["known", "unknown"]

_ROOM = 0.85  # of a speed limit, for the path; corrections need the rest
_STEP_S = 0.1

FRICTION_HEIGHT_M = 0.003
"""Height of the fingers' middle above the bar's middle, so that the fingertips stay off the table."""


@dataclasses.dataclass(frozen=True)
class CarrySettings:
    """Keywords of `SyncCarry`, described there.

    Raises:
        SettingsError: A value is not legal.
    """

    duration_s: float = 30.0
    grasp: Grasp = "friction"
    payload: Payload = "known"
    grip_force_n: float = 100.0
    path_speed: bool = False
    object_range_m: float = 0.02
    object_turn_rad: float = 0.05
    success_error_m: float = 0.01
    success_turn_rad: float = 0.05
    success_slip_m: float = 0.005

    def __post_init__(self) -> None:
        for name, choices in (("grasp", get_args(Grasp)), ("payload", get_args(Payload))):
            if getattr(self, name) not in choices:
                raise UnknownNameError(name, str(getattr(self, name)), choices)
        if not isinstance(self.path_speed, bool):
            raise SettingsError(f"path_speed is {self.path_speed!r}: it must be True or False")
        if self.duration_s not in MOVES:
            raise SettingsError(f"duration_s is {self.duration_s!r}: the path has {' or '.join(map(str, MOVES))} s")
        check_numbers(
            self,
            ("object_range_m", 0.0, 0.3),
            ("object_turn_rad", 0.0, 1.0),
            ("success_error_m", 1e-6, 1.0),
            ("success_turn_rad", 1e-6, 3.2),
            ("success_slip_m", 1e-6, 1.0),
        )

    @property
    def rigid(self) -> bool:
        """True if the bar is welded to the grippers from the start."""
        return self.grasp == "rigid"

    @property
    def grip(self) -> Poses:
        """Poses of both tools in the frame of the bar that they grip, (2, 3) and (2, 4)."""
        height = 0.0 if self.rigid else FRICTION_HEIGHT_M
        position = [[0.0, sign * GRIP_DISTANCE_M / 2, height] for sign in (1, -1)]
        return Poses(np.array(position), np.array([GRIP_QUAT, GRIP_QUAT]))


@lru_cache(maxsize=64)
def path_rate(settings: CarrySettings, scene: SceneSettings, limits: MotionLimits) -> float:
    """Return the largest rate of the path's clock, at most 1, for every initial pose of the bar.

    Raises:
        WorkspaceError: The path leaves an arm's workspace, with the bar where `object_range_m` may put it.
    """
    path, frames = CarryPath(settings.duration_s), Frames(scene.mounts)
    reach, turn = settings.object_range_m, settings.object_turn_rad
    starts = [(x, y, yaw) for x, y in itertools.product((-reach, reach), repeat=2) for yaw in (-turn, turn)]
    times = np.arange(0.0, path.duration_s + _STEP_S, _STEP_S)
    start = bar_pose(np.array(starts))
    bars = path(np.broadcast_to(times, (len(starts), len(times))), start)
    tools = compose(Poses(bars.position_m[:, :, None], bars.quat[:, :, None]), settings.grip)
    flanges = flanges_of(tools, levers_m(scene.equipment.tools))
    position, quat = frames.position_to_base(flanges.position_m), frames.quat_to_base(flanges.quat)
    rotation = quat_to_matrix(quat)
    q = np.empty((len(starts), len(times), 2, 6))
    for arm, mount in enumerate(scene.mounts):
        near = np.broadcast_to(home_q_rad(scene.mounts)[arm], (len(starts), 6))
        for k in range(len(times)):
            near, reached = try_nearest(position[:, k, arm], rotation[:, k, arm], near, mount.dh)
            if not reached.all():
                x, y, yaw = starts[int(np.flatnonzero(~reached)[0])]
                raise WorkspaceError(
                    f"the {ARMS[arm]} arm cannot reach the bar {times[k]:.1f} s after it is lifted, if the bar begins "
                    f"at ({x:g}, {y:g}) m, turned by {yaw:g} rad: choose a smaller object_range_m or object_turn_rad, "
                    "or move the base"
                )
            q[:, k, arm] = near
    speeds = np.abs(np.diff(q, axis=1)).max(axis=(0, 1, 2)) / _STEP_S
    points = elbow_flange_and_tcp(q, limits.tcp_m, scene.robots)
    tip = np.sqrt((np.diff(points, axis=1) ** 2).sum(axis=-1)).max() / _STEP_S
    needed = max(float((speeds / limits.speed_rad_s).max()), float(tip) / limits.tcp_speed_m_s)
    return min(1.0, _ROOM / needed)


def bar_pose(where: Array) -> Poses:
    """Return poses of bars that lie on the table, (n, 3) and (n, 4), for x, y (m) and yaw (rad), (n, 3)."""
    return lying(where, BAR_WIDTH_M)


def ideal_relative(grip: Poses, tools: tuple[Tool, Tool]) -> Poses:
    """Return the nominal pose of the right flange in the left flange's frame while both grip the bar, (3,) and (4,)."""
    left, right = (Poses(grip.position_m[arm], grip.quat[arm]) for arm in (0, 1))
    lever_m = levers_m(tools)  # the flanges are parallel, so each lever counts along the same axis
    return Poses(relative_to(left, right).position_m + (lever_m[0] - lever_m[1]), np.array([1.0, 0.0, 0.0, 0.0]))
