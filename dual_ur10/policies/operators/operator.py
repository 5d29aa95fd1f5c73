"""Policy of a person who leads both arms with an input device."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Sequence
from collections.abc import Mapping as Fields
from dataclasses import replace
from typing import Any, Final

import numpy as np

from dual_ur10.assets.settings import DEFAULT_TOOLS, SceneSettings
from dual_ur10.envs.tasks.observation_layout import ARM_FIELDS, ConciseView, ObservationLayout
from dual_ur10.envs.tasks.task import Timing
from dual_ur10.errors import (
    ActionError,
    DeviceSilentError,
    LeaderConfigurationError,
    SettingsError,
    StopPressedError,
    UnknownNameError,
)
from dual_ur10.policies.operators.device import FULL_TWIST, LOST_S, SILENT_S, Device, Reading, checked
from dual_ur10.policies.operators.mapping import MIRRORED, Mapping
from dual_ur10.sim2real.control.adapter import JOINT_MARGIN_RAD, ActionMode, ActionScale, scale_of_steps
from dual_ur10.sim2real.control.cartesian_step import fraction_of_step, goal_of_step
from dual_ur10.sim2real.control.limits import MotionLimits
from ur_core.kinematics import flange_pose_quat, try_nearest
from ur_core.kinematics.frames import ArmMount, Frames
from ur_core.kinematics.poses import Poses, compose, relative_to
from ur_core.kinematics.rotations import (
    quat_conjugate,
    quat_from_rotvec,
    quat_multiply,
    quat_to_matrix,
    quat_to_rotvec,
    rotate,
)
from ur_core.kinematics.ur10 import ARMS
from ur_core.tools.tool import Tool, levers_m
from ur_core.types import Array, Mask

JOINED_WITHIN_RAD: Final = 0.6
"""Largest distance of a leader's joint from that of its arm at which they are joined."""

_MODES: Final = ("tcp_delta", "joint_delta", "joint_position")
_JOIN_RAD_S: Final = 0.2  # speed of an arm to its leader, until it is there: at most 3 s
_JOINED_RAD: Final = 0.01  # distance at which it is
_SMOOTH_S: Final = 0.03  # time constant with which an arm follows wanted poses and joints
_ROOM: Final = 0.95  # of the limits, for a step of a held object
_SHORTER: Final = 0.8  # factor on such a step that one arm cannot take
_TRIES: Final = 8
_HELD_M_S2: Final = 0.5  # acceleration of a held object, and the same of its rotation
_HELD_RAD_S2: Final = 1.0
_TURN: Final = 2.0 * math.pi
_PICKED_UP: Final = 0.15  # distance of a trigger from its gripper's opening at which they are joined

_LAYOUT: Final = ObservationLayout(*ARM_FIELDS)
_COMMANDED: Final = _LAYOUT.indices(["commanded_q_rad"])


class Operator:
    """Policy that turns the readings of an input device into actions.

    It continues from the commanded joint positions that the observation holds, never from measured ones: an arm that
    lags or sags does not drag its command along. Limits, singularities and the other arm are felt as the adapter and
    the safety gate treat them: a tool slides along what is in its way, a step that is shortened is lost, and another
    direction is open at once.

    A hand whose clutch is released leaves its arm and its gripper as they are. So does a device that is silent for more
    than 80 ms; after 1 s of silence it is given up.

    Leader arms are absolute. Whole turns of their joints are chosen by the configuration of the arm; a joint that is
    then more than 0.6 rad away is refused. Until the arm has come to its leader, it moves at 0.2 rad/s or less.

    Args:
        device: Input device. `close` closes it.
        mapping: Settings between the hands and the arms.
        timing: Rate of actions.
        action_mode: "tcp_delta", "joint_delta" or "joint_position".
        action_scale: Factor of steps, as of the environment.
        mounts: Poses of the bases and kinematics of the arms; None: those of the default cell.
        limits: Motion limits of the task, as far as the cell allows them, with the joint speeds that steps can command.
        tools: Tools of both arms.
        grippers: An action has an opening for each gripper.
        view: Concise view that is observed; None: all numbers of the task are.
        clock: Clock by which actions are paced, for a simulation that would run faster than a person can follow; None:
            they are not, since something else keeps the time.
        wait: Sleep of that clock.

    Attributes:
        buttons: Names of the buttons pressed since the action before.
        opening: (2,) commanded openings of the grippers, 0 closed to 1 open.
        leads: (2,) True for an arm that a hand led in the last action.
        commander: (2,) True for an arm that a person commands, led or at rest.
        commanded_q_rad: (2, 6) joint positions that the last observation shows as commanded.
        tools_m: (2, 7) poses of the tool centre points there, in the cell frame.
        step_rad: (6,) largest steps of an arm's joints in a period.
        on_buttons: Called with the buttons of each reading before hands lead; None: nothing is.
        stops: The button "stop" is an error, which ends what runs; False: what runs acts on it.
        asks: A leader too far from its arm is kept in `refusals` instead of an error, and its arm stays.
        refusals: Reasons why arms did not follow their leaders in the last action, by arm.

    Raises:
        SettingsError: The device or a value is not legal.
    """

    def __init__(
        self,
        device: Device,
        mapping: Mapping | None = None,
        *,
        timing: Timing,
        action_mode: ActionMode = "tcp_delta",
        action_scale: ActionScale = 1.0,
        mounts: Sequence[ArmMount] | None = None,
        limits: MotionLimits,
        tools: tuple[Tool, Tool] = DEFAULT_TOOLS,
        grippers: bool = True,
        view: ConciseView | None = None,
        clock: Callable[[], float] | None = None,
        wait: Callable[[float], None] = time.sleep,
    ) -> None:
        if not isinstance(device, Device) or device.hands not in (1, 2):
            raise SettingsError(
                f"{device!r:.80} is no input device: it needs begin(), read(), close(), a name, and hands, 1 or 2"
            )
        if action_mode not in _MODES:
            raise UnknownNameError("action mode of an operator", str(action_mode), _MODES)
        self.device, self.mapping = device, mapping or Mapping()
        self.timing, self.action_mode, self.grippers = timing, action_mode, grippers
        both = SceneSettings().mounts if mounts is None else (mounts[0], mounts[1])
        self._dh = [mount.dh for mount in both]
        self._frames = Frames(both)
        self._links = np.stack([mount.quat for mount in both])
        self._levers_m = levers_m(tools) if grippers else np.zeros((2, 3))
        self.step_rad: Array = np.array(limits.speed_rad_s) * timing.period_s
        self._ahead = 2.0 / (limits.narrowed(JOINT_MARGIN_RAD).brake_rate() * timing.period_s)
        scale = scale_of_steps(action_mode, action_scale) if action_mode == "tcp_delta" else 1.0
        self._most = FULL_TWIST * timing.period_s * scale
        self._view = view
        self._clock, self._wait, self._due = clock, wait, -math.inf
        self.__name__ = f"operator with {device.name}"  # in results and records
        self._arm = 1 if self.mapping.arms == "right" else 0  # that a device for one hand leads
        self.on_buttons: Callable[[frozenset[str]], None] | None = None
        self.asks, self.stops = False, True
        self.commander: Mask = np.ones(2, dtype=bool)
        self.reset()

    def __repr__(self) -> str:
        return f"{type(self).__name__}({self.device.name}, {self.action_mode})"

    def reset(self) -> None:
        """Begin an episode: grippers are open, and what hands and leaders were joined to is forgotten.

        With the first action also what was pressed before it, but not the button "stop".
        """
        self._begins = True
        self.buttons: frozenset[str] = frozenset()
        self.opening: Array = np.ones(2)
        self.leads: Mask = np.zeros(2, dtype=bool)
        self.commanded_q_rad: Array = np.zeros((2, 6))
        self.tools_m: Array = np.zeros((2, 7))
        self.refusals: dict[int, str] = {}
        self._side: Array = np.zeros(2)  # of a trigger from its gripper's opening; 0: they are joined; NaN: not known
        self.release()

    def release(self) -> None:
        """Forget what hands and leaders are joined to: whoever leads begins anew from what is commanded."""
        self._held: Poses | None = None
        self._held_speed: Array = np.zeros(6)
        self._leader: list[Array | None] = [None, None]  # joint positions before, in the arm's turns
        self._joined = np.zeros(2, dtype=bool)

    def take(self, arm: int, opening: float) -> None:
        """Begin to command an arm whose gripper has an opening, 0 to 1. A trigger counts once it is there, too."""
        self.commander[arm], self.opening[arm], self._side[arm] = True, opening, np.nan

    def lead(self, arm: int) -> None:
        """Lead this arm from now on with a device for one hand."""
        if self.mapping.arms == "both":
            self._arm = arm

    def close(self) -> None:
        """Close the device. May be called twice."""
        self.device.close()

    def __call__(self, observation: Any) -> Array:
        """Return the float32 action for the observation of one cell, or for a batch of one.

        Raises:
            ActionError: It is not one observation.
            DeviceError: One of its kinds: the device is gone, silent, or not understood, or "stop" was pressed.
        """
        self._keep_time()
        given = observation["state"] if isinstance(observation, Fields) else observation
        state = np.asarray(given, dtype=np.float64)
        one = state.ndim == 1 or (state.ndim == 2 and len(state) == 1)
        least = _LAYOUT.size if self._view is None else self._view.layout.size
        if not one or state.size % 2 or state.size < 2 * least:
            raise ActionError(
                f"an operator leads one cell: found observations of shape {state.shape}. Run one environment at a time"
            )
        if self._view is None:
            commanded = state.reshape(2, -1)[:, _COMMANDED]
        else:
            commanded = self._view.commanded_q_rad(state.reshape(1, -1))[0]
        tools = self._tools(commanded)
        self.commanded_q_rad, self.tools_m, self.refusals = commanded, np.concatenate(tools, axis=1), {}
        if self._begins:  # arms may have moved to the start since `reset`
            self.device.begin()
            self._begins = False
        reading = self._read()
        if self.on_buttons is not None:
            self.on_buttons(reading.buttons)
        reading = self._routed(reading)
        self.leads = reading.clutch
        self.opening = np.where(self._pulls(reading), reading.gripper, self.opening)
        self._grip(reading)
        goal = self._goal(reading, commanded, tools)
        action = goal if not self.grippers else np.concatenate([goal, 2.0 * self.opening[:, None] - 1.0], axis=1)
        return action.reshape(*state.shape[:-1], -1).astype(np.float32)

    def _keep_time(self) -> None:
        """Wait until the next action is due."""
        if self._clock is None:
            return
        now = self._clock()
        if now < self._due:
            self._wait(self._due - now)
        self._due = max(self._due, now) + self.timing.period_s

    def poll(self) -> frozenset[str]:
        """Return the buttons that are pressed while nothing moves.

        Raises:
            DeviceError: One of its kinds, as for an action.
        """
        return self._read().buttons

    def _read(self) -> Reading:
        reading = checked(self.device.read(), self.device.name)
        self.buttons = reading.buttons
        if self.stops and "stop" in reading.buttons:
            raise StopPressedError(f"the button to stop was pressed on {self.device.name}: start again to go on")
        if reading.age_s > LOST_S:
            raise DeviceSilentError(
                f"{self.device.name} has been silent for {reading.age_s:.1f} s, allowed are {LOST_S:g} s: check its "
                "cable and its power, then start again"
            )
        if reading.age_s > SILENT_S:
            self.release()
            return replace(reading, clutch=np.zeros(2, dtype=bool))
        return reading

    def _pulls(self, reading: Reading) -> Mask:
        """Return a mask, (2,), of the grippers that follow a trigger: the others have none, or it is elsewhere yet."""
        held: Mask = reading.clutch & ~np.isnan(reading.gripper)
        if not reading.triggers:
            return held
        away = reading.gripper - self.opening
        side = np.where(np.abs(away) < _PICKED_UP, 0.0, np.sign(away))
        self._side = np.where(held & np.isnan(self._side), side, self._side)
        self._side = np.where(held & (side != self._side), 0.0, self._side)
        followed: Mask = held & (self._side == 0.0)
        return followed

    def _grip(self, reading: Reading) -> None:
        """Open or close grippers by buttons: closed ones open, others close; two that are led together do the same."""
        pressed = np.array(["grip" in reading.buttons or f"grip_{arm}" in reading.buttons for arm in ARMS])
        moved = pressed & reading.clutch
        if moved.any():
            wanted = self.opening < 0.5
            together = self.mapping.arms in ("mirrored", "held")
            self.opening = np.where(moved, wanted[0] if together else wanted, self.opening)

    def _routed(self, reading: Reading) -> Reading:
        """Return the reading with a row for each arm."""
        arms = self.mapping.arms
        kind, hands = reading.kind, self.device.hands
        if arms in ("mirrored", "held"):
            if kind != "twist":
                raise SettingsError(
                    f"arms={arms!r} is for devices that give speeds, and {self.device.name} gives {kind}: use both, "
                    "left or right"
                )
            first = self._rows(reading, np.array([0, 0]))
            leads = self.commander if arms == "mirrored" else self.commander.all()
            first = replace(first, clutch=first.clutch & leads)
            if arms == "mirrored" and reading.twist is not None:
                return replace(first, twist=reading.twist[0] * np.stack([np.ones(6), MIRRORED]))
            return first
        if hands == 1:
            if arms == "both" and "switch" in reading.buttons:
                self._arm = 1 - self._arm
                self.release()
            reading = self._rows(reading, np.array([0, 0]))
            leads = np.arange(2) == self._arm
        else:
            leads = np.array([arms in ("both", name) for name in ARMS])
        return replace(reading, clutch=reading.clutch & leads & self.commander)

    @staticmethod
    def _rows(reading: Reading, rows: Any) -> Reading:
        """Return the reading with other rows."""
        values: dict[str, Any] = {reading.kind: getattr(reading, reading.kind)[rows]}
        return replace(reading, gripper=reading.gripper[rows], clutch=reading.clutch[rows], **values)

    def _tools(self, q_rad: Array) -> Poses:
        """Return the tool centre points at joint positions, (2, 6), in the cell frame."""
        flanges = [flange_pose_quat(q, dh) for q, dh in zip(q_rad, self._dh, strict=True)]
        position = self._frames.position_to_cell(np.stack([each[0] for each in flanges]))
        quat = self._frames.quat_to_cell(np.stack([each[1] for each in flanges]))
        return Poses(position + rotate(quat, self._levers_m), quat)

    def _goal(self, reading: Reading, commanded: Array, tools: Poses) -> Array:
        """Return the joint part of the action, (2, 6)."""
        clutch = reading.clutch
        if reading.joints_rad is not None:
            return self._to_joints(reading.joints_rad, clutch, commanded, tools)
        if reading.poses is not None:
            step = _difference(tools, Poses(reading.poses[:, :3], reading.poses[:, 3:])) * self._share
            step = self._shortened(step)
        elif self.mapping.arms == "held":
            step = self._held_step(reading, commanded, tools)
        else:
            step = self._in_cell(self.mapping.speeds(_required(reading.twist)), tools) * self.timing.period_s
        return self._action_of_step(np.where(clutch[:, None], step, 0.0), commanded)

    @property
    def _share(self) -> float:
        """Share of the way to an absolute goal that an arm takes in a period."""
        return 1.0 - math.exp(-self.timing.period_s / _SMOOTH_S)

    def _in_cell(self, speeds: Array, tools: Poses) -> Array:
        """Rotate speeds, (2, 6), from the mapping's frame to that of the cell."""
        if self.mapping.frame == "cell":
            return speeds
        quat = self._links if self.mapping.frame == "base" else tools.quat
        return rotate(quat[:, None], speeds.reshape(2, 2, 3)).reshape(2, 6)

    def _shortened(self, step: Array) -> Array:
        """Return Cartesian steps, (2, 6), as far as one period allows, in their direction."""
        lengths = np.linalg.norm(step.reshape(2, 2, 3), axis=2) / self._most[::3]
        result: Array = step / np.maximum(1.0, lengths.max(axis=1, keepdims=True))
        return result

    def _action_of_step(self, step: Array, commanded: Array) -> Array:
        """Return the joint part of the action of Cartesian steps, (2, 6), m and rad along the axes of the cell."""
        if self.action_mode == "tcp_delta":
            share: Array = self._shortened(step) / self._most
            return share
        in_base = (step.reshape(2, 2, 3) @ self._frames.rotation.swapaxes(-1, -2)).reshape(2, 1, 6)
        goal = np.concatenate(
            [
                goal_of_step(q[None], by[:, :3], by[:, 3:], self._ahead, dh, lever_m)
                for q, by, dh, lever_m in zip(commanded, in_base, self._dh, self._levers_m[:, 2], strict=True)
            ]
        )
        return self._action_of_joints(np.where(step.any(axis=1, keepdims=True), goal - commanded, 0.0), commanded)

    def _action_of_joints(self, step_rad: Array, commanded: Array) -> Array:
        """Return the joint part of the action of joint steps, (2, 6), each arm's as far as one period allows."""
        share = step_rad / self.step_rad
        share = share / np.maximum(1.0, np.abs(share).max(axis=1, keepdims=True))
        goal: Array = commanded + share * self.step_rad
        return goal if self.action_mode == "joint_position" else share

    # Leader arms.

    def _to_joints(self, joints: Array, clutch: Mask, commanded: Array, tools: Poses) -> Array:
        """Return the joint part of the action towards the joint positions of leaders."""
        step = np.zeros((2, 6))
        for arm in range(2):
            if not clutch[arm]:
                self._leader[arm], self._joined[arm] = None, False
                continue
            before = self._leader[arm]
            near = commanded[arm] if before is None else before
            wanted = joints[arm] + _TURN * np.round((near - joints[arm]) / _TURN)
            if before is None:
                reason = _unlike(arm, wanted, commanded[arm])
                if reason and not self.asks:
                    raise LeaderConfigurationError(reason)
                if reason:
                    self.refusals[arm], self.leads = reason, self.leads & (np.arange(2) != arm)
                    continue
            self._leader[arm] = wanted
            away = wanted - commanded[arm]
            step[arm] = away * self._share
            if not self._joined[arm]:
                self._joined[arm] = bool(np.abs(away).max() < _JOINED_RAD)
                most = _JOIN_RAD_S * self.timing.period_s
                step[arm] *= min(1.0, most / max(float(np.abs(step[arm]).max()), most))
        if self.action_mode != "tcp_delta":
            return self._action_of_joints(step, commanded)
        share = np.abs(step) / self.step_rad
        goal = self._tools(commanded + step / np.maximum(1.0, share.max(axis=1, keepdims=True)))
        return self._shortened(np.where(clutch[:, None], _difference(tools, goal), 0.0)) / self._most

    # One object that both grippers hold.

    def _held_step(self, reading: Reading, commanded: Array, tools: Poses) -> Array:
        """Return Cartesian steps, (2, 6), that move both tools as parts of one body."""
        if not reading.clutch[0]:
            self._held, self._held_speed = None, np.zeros(6)
            return np.zeros((2, 6))
        if self._held is None:
            middle = Poses(tools.position_m.mean(axis=0)[None], tools.quat[:1])
            self._held = relative_to(middle, tools)
        here = _body(tools, self._held)
        speed = self._in_cell(self.mapping.speeds(_required(reading.twist)), tools)[0]
        self._held_speed = self._held_speed + _bounded(
            speed - self._held_speed, _HELD_M_S2 * self.timing.period_s, _HELD_RAD_S2 * self.timing.period_s
        )
        move, shorter = self._held_speed * self.timing.period_s, 1.0
        for _ in range(_TRIES):
            step = self._parts(here, move * shorter, tools, self._held)
            excess = self._excess(step, commanded)
            if excess <= 1.0:
                break
            shorter *= _SHORTER / excess if math.isfinite(excess) else 0.5
        else:
            step, shorter = np.zeros((2, 6)), 0.0
        self._held_speed = self._held_speed * shorter
        return step

    @staticmethod
    def _parts(body: Poses, move: Array, tools: Poses, held: Poses) -> Array:
        """Return the steps of both tools, (2, 6), with which the held object moves from a pose by a step, (6,)."""
        moved = Poses(body.position_m + move[:3], quat_multiply(quat_from_rotvec(move[3:]), body.quat))
        return _difference(tools, compose(moved, held))

    def _excess(self, step: Array, commanded: Array) -> float:
        """Return the largest ratio of a step of both tools to what one period allows; infinite out of reach."""
        ratio = float((np.linalg.norm(step.reshape(2, 2, 3), axis=2) / self._most[::3]).max())
        in_base = (step.reshape(2, 2, 3) @ self._frames.rotation.swapaxes(-1, -2)).reshape(2, 6)
        for q, by, dh, lever_m in zip(commanded, in_base, self._dh, self._levers_m[:, 2], strict=True):
            position, quat = flange_pose_quat(q, dh)
            wanted = quat_multiply(quat_from_rotvec(by[3:]), quat)
            lever = np.array([0.0, 0.0, lever_m])
            place = position + rotate(quat, lever) + by[:3] - rotate(wanted, lever)
            goal, reached = try_nearest(place, quat_to_matrix(wanted), q, dh)
            if not reached or fraction_of_step(q[None], (goal - q)[None], self._ahead, dh)[0] < 1.0:
                return math.inf
            ratio = max(ratio, float((np.abs(goal - q) / self.step_rad).max()) / _ROOM)
        return ratio


def _unlike(arm: int, wanted: Array, commanded: Array) -> str:
    """Return the reason why a leader's joints, (6,), cannot be joined to those of its arm; "" if they can."""
    off = np.abs(wanted - commanded)
    joint = int(off.argmax())
    if off[joint] <= JOINED_WITHIN_RAD:
        return ""
    return (
        f"joint {joint + 1} of the leader of the {ARMS[arm]} arm is at {wanted[joint]:.2f} rad, that of the arm at "
        f"{commanded[joint]:.2f} rad: allowed are {JOINED_WITHIN_RAD:g} rad between them. Put the leader into the "
        "configuration of its arm; if it is there, check its offsets and signs"
    )


def _required(values: Array | None) -> Array:
    if values is None:
        raise SettingsError("a reading has no speeds")
    return values


def _bounded(change: Array, most_m: float, most_rad: float) -> Array:
    """Return a change of a twist, (6,), no longer than allowed."""
    change = change.copy()
    for part, most in ((slice(0, 3), most_m), (slice(3, 6), most_rad)):
        change[part] *= min(1.0, most / max(float(np.linalg.norm(change[part])), most))
    return change


def _difference(tools: Poses, goal: Poses) -> Array:
    """Return the steps, (2, 6), from poses of tools to others: translation, and rotation vector, both in the cell."""
    turn = quat_to_rotvec(quat_multiply(goal.quat, quat_conjugate(tools.quat)))
    return np.concatenate([goal.position_m - tools.position_m, turn], axis=1)


def _body(tools: Poses, held: Poses) -> Poses:
    """Return the pose of a held object, (1, 3) and (1, 4): the middle of what both tools say.

    Args:
        tools: Poses of the tools.
        held: The same in the frame of the object.
    """
    quat = quat_multiply(tools.quat, quat_conjugate(held.quat))
    position = tools.position_m - rotate(quat, held.position_m)
    half = quat_from_rotvec(quat_to_rotvec(quat_multiply(quat[1], quat_conjugate(quat[0]))) / 2)
    return Poses(position.mean(axis=0)[None], quat_multiply(half, quat[0])[None])
