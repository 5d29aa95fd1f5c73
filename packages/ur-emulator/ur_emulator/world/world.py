"""Simulated world behind emulated controllers: its interface, and parts that all worlds share."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, Final, Protocol

import numpy as np

from ur_core.kinematics.frames import ArmMount
from ur_core.tools.tool import Tool
from ur_core.types import Array, constant
from ur_emulator.controller.reported_values import ArmReading
from ur_emulator.motion import JointTorques

NO_WRENCH: Final = constant(np.zeros(6))


class SimulatedWorld(Protocol):
    """Simulated arms, advanced by one control period at a time.

    Attributes:
        names: Names of the controllers.
        mounts: Nominal mount of each arm.
        tick_s: Control period.
        substeps: Physics steps per control period.
        start_q_rad: (arms, 6) initial joint positions.
        lookahead_scale: (arms,) ratio of each controller's true lookahead to the commanded one.
        gripper_kg: Mass of each arm's gripper; 0 without one.
        tools: Gripper of each arm; None: the flange is bare.
        sampled: Sampled parameters of the plant, by name.
    """

    names: tuple[str, ...]
    mounts: tuple[ArmMount, ...]
    tick_s: float
    substeps: int
    start_q_rad: Array
    lookahead_scale: Array
    gripper_kg: Sequence[float]
    tools: Sequence[Tool | None]
    sampled: Mapping[str, Array]

    @property
    def failed(self) -> bool:
        """True after the simulation has diverged. The arms stay at their last valid state."""
        ...

    @property
    def has_object(self) -> bool:
        """True if there is an object to handle."""
        ...

    def read(self, arm: int) -> ArmReading:
        """Measure one arm. A hand that pushes it adds to the wrench on its flange."""
        ...

    def advance(
        self,
        plans: Sequence[Array],
        widths_m: Sequence[float | None],
        payloads_kg: Sequence[float],
        torques: Sequence[JointTorques | None],
    ) -> None:
        """Advance by one control period.

        Args:
            plans: Per arm (substeps, 3, 6): position before, speed after and acceleration in every physics step.
            widths_m: Commanded gripper width of each arm; None: as at the start.
            payloads_kg: Payload mass as set on each controller.
            torques: Torques of each arm, in place of its plan; None in position control. The controllers know the
                friction of their joints.
        """

    def pose(self, body: str) -> tuple[Array, Array]:
        """Return position (3,) and orientation (4,), (w, x, y, z), of a body, or of a prop, in the cell frame.

        Raises:
            UnknownNameError: There is no such body.
        """
        ...

    def joints(self, prop: str) -> dict[str, float]:
        """Return the positions of a prop's joints, rad or m, by their names; {} for other bodies."""
        ...

    def positions(self) -> tuple[Array, Array]:
        """Return the positions of MuJoCo's model, (nq,), and the poses of bodies that are placed, (n, 7)."""
        ...

    def place(self, pose: Array, prop: str = "") -> None:
        """Place an object at a pose, (7,) position and (w, x, y, z), at rest.

        Args:
            pose: The pose.
            prop: Name of the object; "": the only one.

        Raises:
            SettingsError: There is none, or there are several and none is named.
            UnknownNameError: There is no such object.
        """

    def set_joints(self, values: Mapping[str, float]) -> None:
        """Put joints of objects at positions, rad or m, by their names, at rest.

        Raises:
            UnknownNameError: There is no such joint.
        """

    def push(self, arm: int, wrench: Array, duration_s: float) -> None:
        """Push the flange of an arm by hand, in place of an earlier push.

        The arms follow their reference motions, whatever pushes them: only a compliant one, as in freedrive, yields.

        Args:
            arm: Index of the arm.
            wrench: (6,) force and torque on the flange, N and N·m, along the axes of the arm's `base`.
            duration_s: Duration, rounded to control periods.
        """

    def draw(self) -> tuple[Any, Any]:
        """Return MuJoCo's model and data of the present state: the same objects at every call."""
        ...


class Delay:
    """Motion that arrives late by whole physics steps.

    Torques act at once. A motion that follows them begins where they brought the arm, so it is not delayed either until
    the arm stops.

    Args:
        steps: Delay in physics steps.
        q_rad: (6,) joint positions until then.
    """

    def __init__(self, steps: int, q_rad: Array) -> None:
        self._waiting = np.zeros((steps, 3, 6))
        self._waiting[:, 0] = q_rad
        self._delays = True

    def __call__(self, plan: Array, *, free: bool = False) -> Array:
        """Return the motion of a control period: that of `plan`, or earlier ones that arrive in it."""
        steps = len(self._waiting)
        if free or not (self._delays or not plan[:, 1].any()):
            self._delays = False
            return plan
        if not self._delays:
            self._delays = True
            self._waiting[:] = 0.0
            self._waiting[:, 0] = plan[0, 0]
        if not steps:
            return plan
        queue = np.concatenate([self._waiting, plan])
        self._waiting = queue[len(plan) :]
        return queue[: len(plan)]


class Hand:
    """Push by a hand.

    Args:
        wrench: (6,) wrench on the flange.
        ticks: Control periods that it lasts.
    """

    def __init__(self, wrench: Array = NO_WRENCH, ticks: int = 0) -> None:
        self._ticks = ticks
        self.wrench: Array = wrench if ticks > 0 else NO_WRENCH

    def pass_tick(self) -> None:
        """Let a control period pass."""
        self._ticks -= 1
        if self._ticks <= 0:
            self.wrench = NO_WRENCH
