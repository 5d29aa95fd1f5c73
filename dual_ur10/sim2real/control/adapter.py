"""From an action to the servoj targets of one policy period.

    interpolate (C²)  ->  compensate the lag  ->  limit

The first two are linear in the values that an arm's motion is made of, and so are the limits. `adapter_matrices` gives
the matrices; the kernel applies them to each cell, and limits what breaks a limit.
"""

from __future__ import annotations

import numbers
from collections.abc import Mapping, Sequence
from typing import Final, Literal, NamedTuple, get_args

import numpy as np

from dual_ur10.assets.settings import DEFAULT_TOOLS
from dual_ur10.errors import SettingsError, UnknownNameError
from dual_ur10.sim2real.control import path
from dual_ur10.sim2real.control.adapter_matrices import matrices_of
from dual_ur10.sim2real.control.cartesian_step import goal_of_step
from dual_ur10.sim2real.control.limits import HISTORY, MotionLimits
from ur_core.kernel import RowLoop, Struct
from ur_core.kinematics import flange_pose
from ur_core.kinematics.forward import links
from ur_core.kinematics.rotations import (
    quat_from_matrix,
    quat_from_rotvec,
    quat_multiply,
    quat_to_matrix,
    quat_to_rotvec,
)
from ur_core.kinematics.ur10 import DHParameters
from ur_core.servoj import ServojProfile
from ur_core.types import Array, Rows

ActionMode = Literal["joint_delta", "joint_position", "tcp_delta", "tcp_translation"]

ActionScale = float | Mapping[str, float]

ACTION_GROUPS: Final[dict[str, dict[str, slice]]] = {
    "joint_delta": {"joints": slice(0, 6)},
    "joint_position": {},
    "tcp_delta": {"translation": slice(0, 3), "rotation": slice(3, 6)},
    "tcp_translation": {"translation": slice(0, 3)},
}
"""Numbers of an arm's action that are steps, by action mode and group. Positions and widths of grippers are none."""

JOINT_MARGIN_RAD = 0.01
"""Margin inside the joint range of the gate at which the adapter brakes."""

STROKES_M = (DEFAULT_TOOLS[0].stroke_m, DEFAULT_TOOLS[1].stroke_m)
"""Largest width of each gripper where no other tools are named."""

TCP_STEP_M_S = 0.25
"""Speed of the tool centre point at action 1 of `tcp_delta`: the reduced speed of ISO 10218-1."""

TCP_ROTATION_RAD_S = 0.5
"""Angular speed at action 1 of `tcp_delta`: the first speed that is safe to try on a real arm."""

_ROUNDING = 1e-6  # bounds are float32 where a policy sees them

_GOAL_MARGIN_RAD = 1e-3  # goals stay this far inside the range that the limiter enforces

# Rows of the adapter's state, (n, rows, 12): the last three targets, the last commanded positions, and the path's
# current position, speed and acceleration.
_GOAL = HISTORY + path.POINTS - 1
_NOW, _SPEED, _STATE = _GOAL + 1, _GOAL + 2, _GOAL + 5


class Command(NamedTuple):
    """Commands of one policy period.

    Attributes:
        targets_rad: (n, ticks, 2, 6) servoj targets.
        gripper_m: (n, ticks, 2) width of each gripper; None: there are no grippers.
        payload_kg: (n, 2) mass in each gripper at the end of the period, as set in a simulated controller, which ramps
            to it linearly; None: unchanged.
        scaling: Largest time scaling of both arms from here on, for their distances; a simulated cell has none.
        coupled: Both arms hold one object between them, from here on; only two controllers need to know.
    """

    targets_rad: Array
    gripper_m: Array | None = None
    payload_kg: Array | None = None
    scaling: float = 1.0
    coupled: bool = False


def scale_of_steps(mode: str, scale: object) -> Array:
    """Return the factor of each of the six numbers of an arm's action, (6,).

    Args:
        mode: Action mode.
        scale: One number for all steps, or one for each of some groups of `ACTION_GROUPS`; the others have 1.

    Raises:
        SettingsError: A number is not above 0 and at most 1, or actions of this mode are no steps.
        UnknownNameError: The mode has no such group.
    """
    groups = ACTION_GROUPS[mode]
    given = scale if isinstance(scale, Mapping) else dict.fromkeys(groups, scale)
    if not groups and not (isinstance(scale, numbers.Real) and scale == 1.0):
        raise SettingsError(
            f"action_scale is {scale!r:.200}, but actions of {mode!r} are positions, not steps: leave it out, or "
            f"choose another action_mode, {' or '.join(repr(name) for name, found in ACTION_GROUPS.items() if found)}"
        )
    result: Array = np.ones(6)
    for name, value in given.items():
        if name not in groups:
            raise UnknownNameError(f"group of action_scale in {mode!r}", str(name), list(groups))
        if isinstance(value, bool) or not isinstance(value, numbers.Real) or not 0.0 < float(value) <= 1.0:
            raise SettingsError(
                f"action_scale of {name} is {value!r:.200}: it must be a number above 0 and at most 1, at which an "
                "action of 1 is a step at the speed limit"
            )
        result[groups[name]] = float(value)
    return result


class ServojAdapter:
    """Converts one action per cell into the servoj targets of one policy period.

    The adapter continues from its own last command, never from measured joints: the same actions give the same targets
    in simulation and on a robot. It has no clock and does no I/O.

    Args:
        profile: The controllers' family and servoj settings, whose lag is compensated.
        limits: Limits of motion; the joint range is narrowed by `JOINT_MARGIN_RAD`.
        ticks: Controller ticks per action.
        n: Number of cells.
        mode: Meaning of an action's six numbers per arm. "joint_delta": steps of the six joints from the last
            command, as fractions of the speed limit times the period, -1 to 1. "joint_position": six positions, rad.
            "tcp_delta": translation of the tool centre point from its last command, and rotation vector about it,
            along the axes of the cell frame, as fractions of 0.25 m/s and 0.5 rad/s; a step out of reach leaves that
            arm where it is, and steps towards a singularity shrink to zero (`cartesian_step`). "tcp_translation": its
            first three numbers; each tool keeps the orientation that it has where an episode begins.
        action_scale: Factor of steps, above 0 and at most 1; see `scale_of_steps`.
        gripper: An action has a last number per arm, the gripper's width: -1 closed, 1 open.
        compensate_lag: Send targets ahead by the law's inverse, so that the arms do not lag.
        dh: The arms' kinematics, for "tcp_delta".
        tcp_m: (2,) distance of each tool centre point before its flange, for "tcp_delta".
        stroke_m: (2,) largest width of each gripper.
        yaw_rad: Rotation of each base about the vertical, for "tcp_delta".
        tilt_rad: Tilt of each base after that, as in `ArmMount`, for "tcp_delta".
        speed_factor: Rate of task time in real time. At 0.25 a second of the task takes four, in which the controllers'
            law does four times as much.
        lookahead_s: Measured lookahead of the law that the arms follow; None: that of `profile`.
        threads: Threads to compute on.
    """

    def __init__(
        self,
        profile: ServojProfile,
        limits: MotionLimits,
        ticks: int,
        *,
        n: int = 1,
        mode: ActionMode = "joint_delta",
        action_scale: ActionScale = 1.0,
        gripper: bool = False,
        compensate_lag: bool = True,
        dh: Sequence[DHParameters],
        tcp_m: Sequence[float] = (0.0, 0.0),
        stroke_m: Sequence[float] = STROKES_M,
        yaw_rad: Sequence[float] = (0.0, 0.0),
        tilt_rad: Sequence[tuple[float, float]] = ((0.0, 0.0), (0.0, 0.0)),
        speed_factor: float = 1.0,
        lookahead_s: float | None = None,
        threads: int = 1,
    ) -> None:
        if mode not in get_args(ActionMode):
            raise UnknownNameError("action mode", str(mode), get_args(ActionMode))
        self.profile, self.limits, self.ticks, self.n = profile, limits.narrowed(JOINT_MARGIN_RAD), ticks, n
        self.mode, self.gripper, self.compensate_lag, self.dh = mode, gripper, compensate_lag, tuple(dh)
        self._tcp_m = tuple(tcp_m)
        self.action_scale = scale_of_steps(mode, action_scale)
        self.stroke_m: Array = np.array(stroke_m, dtype=np.float64)
        self._cartesian = mode in ("tcp_delta", "tcp_translation")
        self._held: Array = np.tile(np.eye(3), (n, 2, 1, 1))  # orientations of the flanges in their bases
        self.speed_factor = speed_factor
        lookahead_s = profile.lookahead_s if lookahead_s is None else lookahead_s
        self._matrices = matrices_of(profile, self.limits, ticks, compensate_lag, lookahead_s, speed_factor)
        self.envelope, self.period_s = self._matrices.envelope, self._matrices.period_s
        # Towards a joint's limit a goal may cover a fraction of the remaining distance: an approach that the brake can
        # always follow, so that one joint at its limit does not hold the other eleven.
        self._approach = min(0.3, self.envelope.brake_rate * self.period_s / 10)
        speed = np.tile(self.limits.speed_rad_s, 2)
        self._leash = speed * (speed / (2 * self.limits.acceleration_rad_s2) + self.period_s)
        self._steps_to_rest = 2.0 / (self.envelope.brake_rate * self.period_s)  # along a critically damped decay
        # Rotates vectors of the cell frame into each arm's `base`, which is rotated by π from base_link.
        rotations = np.array([[0.0, 0.0, -np.pi - yaw] for yaw in yaw_rad])
        upright = quat_from_rotvec(np.array([[-x, -y, 0.0] for x, y in tilt_rad]))
        self._to_base = quat_to_matrix(quat_multiply(quat_from_rotvec(rotations), upright))
        self._state: Array = np.zeros((n, _STATE, 12))
        self._before: Array = np.zeros((n, _STATE, 12))  # the last plan
        self._rest = np.zeros(n, dtype=np.int64)  # of the last path: twice the periods left, plus 1 if curved
        self._stops = np.zeros(n, dtype=np.int64)  # joints that stop past their commands, a bit each; bit 12: led
        self._commanded: Array = np.zeros((n, 2, 6))
        self._action: Array = np.zeros((n, 2, 6 + gripper))
        self._cartesian_goal: Array = np.zeros((n, 12))
        self._clipped = np.zeros(n, dtype=np.int64)
        self._targets: Array = np.zeros((n, ticks, 2, 6))
        self._widths: Array = np.tile(self.stroke_m, (n, ticks, 1))
        self.kernel, self.threads = self._struct(), threads
        self._step = RowLoop("adapter_step", self.kernel, n, threads)

    def _struct(self) -> Struct:
        """Return the coefficients and the state as the kernel's structure."""
        low, high = np.full((2, self._action.shape[2]), -1.0), np.full((2, self._action.shape[2]), 1.0)
        if not self._cartesian:
            low, high = self.action_bounds
        return Struct(
            "Adapter",
            n=self.n,
            ticks=self.ticks,
            width=HISTORY + self.ticks + 2,
            mode=get_args(ActionMode).index("tcp_delta" if self._cartesian else self.mode),
            size=self._action.shape[2],
            approach=self._approach,
            **self._matrices.values,
            joint_step=self.joint_step_rad,
            lower=self._approach * (np.tile(self.limits.lower_rad, 2) + _GOAL_MARGIN_RAD),
            upper=self._approach * (np.tile(self.limits.upper_rad, 2) - _GOAL_MARGIN_RAD),
            leash=self._leash,
            state=self._state,
            before=self._before,
            rest=self._rest,
            stops=self._stops,
            commanded=self._commanded,
            action=self._action,
            targets=self._targets,
            widths_m=self._widths,
            most_m=self.stroke_m,
            goal=self._cartesian_goal,
            lowest=low - _ROUNDING,
            highest=high + _ROUNDING,
            clipped=self._clipped,
            links=np.stack([links(dh) for dh in self.dh]),
            tool_m=np.array(self._tcp_m, dtype=np.float64),
            turn_m=TCP_STEP_M_S / TCP_ROTATION_RAD_S,
        )

    @property
    def joint_step_rad(self) -> Array:
        """Steps of the joints for an action of 1 with "joint_delta", (12,)."""
        step: Array = np.tile(np.asarray(self.limits.speed_rad_s) * self.action_scale, 2) * self.period_s
        return step

    @property
    def action_size(self) -> int:
        """Size of an action per arm."""
        return (3 if self.mode == "tcp_translation" else 6) + self.gripper

    @property
    def action_bounds(self) -> tuple[Array, Array]:
        """Lowest and highest action, (2, action_size) each."""
        low, high = np.full((2, self.action_size), -1.0), np.full((2, self.action_size), 1.0)
        if self.mode == "joint_position":
            low[:, :6], high[:, :6] = self.limits.lower_rad, self.limits.upper_rad
        return low, high

    @property
    def clipped_actions(self) -> int:
        """Number of actions so far that were clipped to the bounds."""
        return int(self._clipped.sum())

    @property
    def commanded_q_rad(self) -> Array:
        """Joint positions commanded last, (n, 2, 6), from which the next action's steps start.

        Where a limit keeps the arms from following, they stay within a braking distance of the targets.
        """
        return self._commanded.copy()

    @property
    def targets_rad(self) -> Array:
        """Targets of the last period, (n, ticks, 2, 6)."""
        return self._targets.copy()

    def reset(self, q_rad: Array, rows: Rows | None = None, *, begins: bool = True) -> None:
        """Start from rest.

        Args:
            q_rad: (n, 2, 6) joint positions, or (len(rows), 2, 6).
            rows: The cells to start; None: all.
            begins: Keep the orientations that the tools have here with "tcp_translation", not those before.
        """
        index = slice(None) if rows is None else rows
        self._state[index] = np.asarray(q_rad).reshape(-1, 1, 12)
        self._state[index, _SPEED:] = 0.0
        self._rest[index] = 0
        self._stops[index] = 0
        self._commanded[index] = self._state[index, _GOAL].reshape(-1, 2, 6)
        if begins and self.mode == "tcp_translation":
            for arm, dh in enumerate(self.dh):
                self._held[index, arm] = flange_pose(self._commanded[index][:, arm], dh)[1]
        self._widths[index] = self.stroke_m

    def __call__(self, action: Array) -> Command:
        """Return the targets of the next period.

        Args:
            action: (n, 2, action_size). Values outside the bounds are clipped to them. A cell with a value that is not
                finite gets no motion, as after steps of zero, and its grippers keep their widths.
        """
        if self.mode == "tcp_translation":
            self._action[..., :3], self._action[..., 6:] = action[..., :3], action[..., 3:]
        else:
            self._action[:] = action
        if self._cartesian:
            self._cartesian_goal[:] = self._tcp_goal(self._action[..., :6]).reshape(self.n, 12)
        self._step()
        return Command(self.targets_rad, self._widths.copy() if self.gripper else None)

    def goals(self, action: Array) -> Array:
        """Return the joint positions, (n, 2, 6), that actions ask for from the last command, before limits of motion.

        Args:
            action: (n, 2, action_size), not of "tcp_translation", which depends on how an episode began.
        """
        if self._cartesian:
            return self._tcp_goal(action[..., :6])
        joints: Array = np.clip(action, *self.action_bounds)[..., :6]
        return self._commanded + joints * self.joint_step_rad.reshape(2, 6) if self.mode == "joint_delta" else joints

    def _tcp_goal(self, action: Array) -> Array:
        """Return joint goals, (n, 2, 6), of Cartesian steps."""
        now = self.commanded_q_rad
        asked = np.clip(np.nan_to_num(action), -1.0, 1.0) * self.action_scale  # the kernel moves no cell with a NaN
        goal = now.copy()
        for arm, dh in enumerate(self.dh):
            # One small product per cell, so that its last bit does not depend on how many others there are.
            vectors = asked[:, arm].reshape(-1, 2, 3) @ self._to_base[arm].T
            step = vectors[:, 0] * (TCP_STEP_M_S * self.period_s)
            most_rad = TCP_ROTATION_RAD_S * self.period_s
            rotation = vectors[:, 1] * most_rad
            if self.mode == "tcp_translation":
                rotation = self._back(now[:, arm], arm, most_rad)
            goal[:, arm] = goal_of_step(now[:, arm], step, rotation, self._steps_to_rest, dh, self._tcp_m[arm])
        return goal

    def _back(self, q_rad: Array, arm: int, most_rad: float) -> Array:
        """Return rotations, (n, 3), towards the orientation that a tool keeps, at most `most_rad` each."""
        away = self._held[:, arm] @ flange_pose(q_rad, self.dh[arm])[1].swapaxes(-1, -2)
        rotation = quat_to_rotvec(quat_from_matrix(away))
        angle = np.sqrt(np.vecdot(rotation, rotation))[:, None]
        result: Array = rotation * np.minimum(1.0, most_rad / np.maximum(angle, 1e-12))
        return result
