"""Values that a controller reports to its clients, and the measurements that they derive from."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any, Final, NamedTuple

import numpy as np

from ur_core.kinematics.forward import elbow_and_flange_position
from ur_core.kinematics.ur10 import DHParameters
from ur_core.protocol.modes import JointMode
from ur_core.types import Array
from ur_emulator.controller.rtde_variables import zero_values
from ur_emulator.motion import MotionGenerator
from ur_emulator.profile import ControllerProfile

GRAVITY_M_S2: Final = 9.81

# UR publishes no torque constants. These give plausible currents for the simulated torques.
_NM_PER_A: Final = np.array([13.0, 13.0, 10.0, 9.0, 9.0, 9.0])

_MEASURED: Final = (
    "target_q",
    "actual_q",
    "actual_qd",
    "actual_TCP_force",
    "actual_current",
    "target_current",
    "joint_control_output",
    "actual_robot_current",
)


class ArmReading(NamedTuple):
    """Measurements of one arm.

    Attributes:
        q_rad: (6,) joint positions.
        qd_rad_s: (6,) joint speeds.
        torque_nm: (6,) motor torques of the joints.
        wrench: (6,) force and torque on the flange, N and N·m, along the axes of the arm's `base`, without the
            gripper's own weight; zero where nothing measures it.
        gripper_m: Gripper width; None without a gripper.
    """

    q_rad: Array
    qd_rad_s: Array
    torque_nm: Array
    wrench: Array
    gripper_m: float | None


class LiveValues(dict[str, Any]):
    """Values by name, of which some are computed when they are read first after `forget`.

    Args:
        values: Values of all names.
        derived: Functions of the derived values by their names; names that are not among `values` are skipped.
    """

    def __init__(
        self, values: Mapping[str, Any], derived: Mapping[tuple[str, ...], Callable[[], tuple[Any, ...]]]
    ) -> None:
        super().__init__(values)
        self._sources = {name: (names, source) for names, source in derived.items() for name in names if name in values}

    def __missing__(self, name: str) -> Any:
        names, source = self._sources[name]
        for each, value in zip(names, source(), strict=True):
            if each in self._sources:
                self.setdefault(each, value)  # an override stays
        return self[name]

    def forget(self) -> None:
        """Forget the derived values: what they are derived from has changed."""
        for name in self._sources:
            self.pop(name, None)

    def complete(self) -> None:
        """Compute all derived values that were not read yet."""
        for name in self._sources:
            if name not in self:
                self.__missing__(name)


class ReportedValues(LiveValues):
    """Values of one controller, by RTDE name.

    Values of the arm's motion are derived from measurements and reference motion when somebody reads them. The others
    are those of the controller, which writes them.

    Args:
        profile: Version of the controller.
        dh: Nominal kinematics of the arm.
        reading: Measurements, at rest.
        motion: Reference motion.
    """

    def __init__(
        self, profile: ControllerProfile, dh: DHParameters, reading: ArmReading, motion: MotionGenerator
    ) -> None:
        super().__init__(zero_values(profile), self._derived())
        self._robot, self._tick_s = dh.robot, profile.tick_s
        self._shown = _Shown(reading, reading.q_rad, motion, np.zeros(6), np.zeros(6))
        self.update(
            joint_temperatures=(30.0,) * 6,
            actual_main_voltage=48.0,
            actual_robot_voltage=48.0,
            actual_joint_voltage=(48.0,) * 6,
            actual_tool_accelerometer=(0.0, 0.0, GRAVITY_M_S2),
            tool_temperature=30.0,
            tool_mode=int(JointMode.RUNNING),
            actual_execution_time=0.0,
        )

    def renew(self, reading: ArmReading, motion: MotionGenerator, qdd: Array, wrench: Array) -> None:
        """Derive from the next control period.

        Args:
            reading: Measurements.
            motion: Reference motion.
            qdd: (6,) its mean accelerations.
            wrench: (6,) force and torque at the TCP.
        """
        self._shown = _Shown(reading, self._shown.reading.q_rad, motion, qdd, wrench)
        self.forget()

    def _derived(self) -> dict[tuple[str, ...], Callable[[], tuple[Any, ...]]]:
        """Return functions of values that are computed when somebody reads them, by the names of these values."""
        return {
            _MEASURED: self._measured,
            ("target_qd",): lambda: (_numbers(self._shown.target_qd),),
            ("target_qdd",): lambda: (_numbers(self._shown.target_qdd),),
            ("target_moment",): lambda: (_numbers(self._shown.reading.torque_nm),),
            ("actual_TCP_pose", "actual_TCP_speed"): lambda: self._shown.actual_tcp(),
            ("target_TCP_pose", "target_TCP_speed"): lambda: self._shown.target_tcp(),
            ("elbow_position", "elbow_velocity"): self._elbow,
            ("tcp_force_scalar",): lambda: (float(np.linalg.norm(self._shown.wrench[:3])),),
            ("ft_raw_wrench",): lambda: (_numbers(self._shown.reading.wrench),),
            ("actual_current_as_torque",): lambda: (_numbers(self._shown.reading.torque_nm),),
        }

    def _measured(self) -> tuple[Any, ...]:
        shown = self._shown
        current = shown.reading.torque_nm / _NM_PER_A
        of_joints = _numbers(current)
        return (
            _numbers(shown.target_q),
            _numbers(shown.reading.q_rad),
            _numbers(shown.reading.qd_rad_s),
            _numbers(shown.wrench),
            of_joints,
            of_joints,
            of_joints,
            0.5 + 0.1 * float(np.abs(current).sum()),
        )

    def _elbow(self) -> tuple[Any, ...]:
        elbow = elbow_and_flange_position(self._shown.reading.q_rad, self._robot)[0]
        before = elbow_and_flange_position(self._shown.q_before, self._robot)[0]
        return _numbers(elbow), _numbers((elbow - before) / self._tick_s)


class _Shown:
    """State of one control period from which reported values are derived.

    Args:
        reading: Measurements.
        q_before: (6,) joint positions one control period before.
        motion: Reference motion.
        target_qdd: (6,) its mean accelerations.
        wrench: (6,) force and torque at the TCP.
    """

    __slots__ = ("_arm", "_tool", "q_before", "reading", "target_q", "target_qd", "target_qdd", "wrench")

    def __init__(
        self, reading: ArmReading, q_before: Array, motion: MotionGenerator, target_qdd: Array, wrench: Array
    ) -> None:
        self.reading, self.q_before, self.wrench = reading, q_before, wrench
        self.target_q, self.target_qd, self.target_qdd = motion.q, motion.qd, target_qdd
        self._arm, self._tool = motion.arm, motion.tool

    def actual_tcp(self) -> tuple[tuple[float, ...], tuple[float, ...]]:
        """Return pose (6,) and speed (6,) of the TCP of the arm."""
        return self._arm.pose_and_speed(self.reading.q_rad, self.reading.qd_rad_s, self._tool)

    def target_tcp(self) -> tuple[tuple[float, ...], tuple[float, ...]]:
        """Return pose (6,) and speed (6,) of the TCP of the reference motion."""
        return self._arm.pose_and_speed(self.target_q, self.target_qd, self._tool)


def _numbers(array: Array) -> tuple[float, ...]:
    return tuple(array.tolist())
