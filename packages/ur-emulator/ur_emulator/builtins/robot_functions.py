"""URScript's functions about the arm: kinematics, measured state, payload and forces."""

from __future__ import annotations

import math
from typing import Any, Final

import numpy as np

from ur_core.errors import MotionError
from ur_core.kinematics.robots import robot_model
from ur_core.kinematics.ur10 import JOINT_RANGE_RAD
from ur_emulator.builtins.functions import Functions
from ur_emulator.builtins.motion_functions import SOLUTION_STEPS, joints_of
from ur_emulator.controller.controller import Controller
from ur_emulator.motion.arguments import checked_frame
from ur_emulator.script import Builtins, Pose
from ur_emulator.script.operations import get
from ur_emulator.script.values import number

# Names and defaults of the parameters are those of UR's script manual, since programs pass them by name.
# ruff: noqa: N803

_CONTACT_N: Final = 15.0  # against a direction; UR publishes no threshold of tool_contact
_INERTIA_KG_M2: Final = 133.0  # UR's script manual
_PERIODS_PER_STEP: Final = 8  # of a contact, that count for one more statement


def _numbers(values: Any, count: int, what: str) -> list[float]:
    numbers = [float(number(each)) for each in values] if isinstance(values, list | tuple | np.ndarray) else []
    if len(numbers) != count or not np.isfinite(numbers).all():
        raise MotionError(f"{what} must be {count} finite numbers, found {values!r}")
    return numbers


def _six(values: Any, what: str) -> list[float]:
    return _numbers(values, 6, what)


def _mass(m: Any, robot: str) -> float:
    most = robot_model(robot).payload_kg
    if not 0.0 <= number(m) <= most:
        raise MotionError(f"a payload of {m!r} kg cannot be set: allowed are 0 to {most:g} kg")
    return float(m)


class _RobotFunctions(Functions):
    """Functions about the arm."""

    def __init__(self, controller: Controller) -> None:
        super().__init__(controller)
        self._values, self._payload = controller.values, controller.payload

    def get_actual_joint_positions(self) -> list[float]:
        return [float(each) for each in self._controller.reading.q_rad]

    def get_target_joint_positions(self) -> list[float]:
        return [float(each) for each in self._motion.q]

    def get_actual_joint_speeds(self) -> list[float]:
        return [float(each) for each in self._controller.reading.qd_rad_s]

    def get_target_joint_speeds(self) -> list[float]:
        return [float(each) for each in self._motion.qd]

    def get_actual_joint_positions_history(self, steps: int = 0) -> list[float]:
        history = self._controller.history
        if not 0 <= steps < len(history):
            raise MotionError(f"joint positions of {steps} periods ago are not kept: there are {len(history)}")
        return list(history[-1 - int(steps)])

    def get_actual_tcp_pose(self) -> Pose:
        return Pose(self._motion.tcp_pose(self._controller.reading.q_rad))

    def get_target_tcp_pose(self) -> Pose:
        return Pose(self._motion.tcp_pose(self._motion.q))

    def get_target_waypoint(self) -> Pose:
        return Pose(self._motion.tcp_pose(self._motion.waypoint))

    def get_actual_tcp_speed(self) -> list[float]:
        return list(self._motion.tcp_speed(self._controller.reading.q_rad, self._controller.reading.qd_rad_s))

    def get_target_tcp_speed(self) -> list[float]:
        return [float(each) for each in self._motion.tcp_speed(self._motion.q, self._motion.qd)]

    def get_actual_tool_flange_pose(self) -> Pose:
        return Pose(self._motion.flange_pose(self._controller.reading.q_rad))

    def get_forward_kin(self, q: Any = None, tcp: Any = None) -> Pose:
        self._controller.spend(SOLUTION_STEPS // 5)
        joints = self._motion.q if q is None else _six(q, "joint positions")
        return Pose(self._motion.forward(joints, self._motion.tcp if tcp is None else _six(tcp, "a TCP")))

    def _inverse(self, x: Any, qnear: Any, tcp: Any) -> Any:
        self._controller.spend(SOLUTION_STEPS)
        near = self._motion.q if qnear is None else _six(qnear, "joint positions")
        return self._motion.inverse(_six(x, "a pose"), near, None if tcp is None else _six(tcp, "a TCP"))

    def get_inverse_kin(
        self,
        x: Any,
        qnear: Any = None,
        maxPositionError: float = 1e-10,
        maxOrientationError: float = 1e-10,
        tcp: Any = None,
    ) -> list[float]:
        found = self._inverse(x, qnear, tcp)
        if found is None:
            raise MotionError(f"get_inverse_kin found no joint positions for {_six(x, 'a pose')}")
        return [float(each) for each in found]

    def get_inverse_kin_has_solution(
        self,
        pose: Any,
        qnear: Any = None,
        maxPositionError: float = 1e-10,
        maxOrientationError: float = 1e-10,
        tcp: Any = None,
    ) -> bool:
        return self._inverse(pose, qnear, tcp) is not None

    def is_within_safety_limits(self, pose: Any) -> bool:
        try:
            q = joints_of(self._controller, pose)
        except MotionError:
            return False
        return bool((np.abs(q) <= JOINT_RANGE_RAD).all())

    def is_steady(self) -> bool:
        return self._controller.steady

    def get_steptime(self) -> float:
        return self._controller.profile.tick_s

    def get_joint_torques(self) -> list[float]:
        return [float(each) for each in self._controller.reading.torque_nm]

    def get_tcp_force(self) -> list[float]:
        return [float(each) for each in self._controller.wrench]

    def force(self) -> float:
        return float(np.linalg.norm(self._controller.wrench[:3]))

    def get_joint_temp(self, j: int) -> float:
        temperature: float = get(list(self._values["joint_temperatures"]), j)
        return temperature

    def get_controller_temp(self) -> float:
        return 30.0

    def zero_ftsensor(self) -> None:
        self._controller.zero_wrench()

    def set_tcp(self, pose: Any) -> None:
        self._motion.set_tcp(_six(pose, "a TCP"))

    def get_tcp_offset(self) -> Pose:
        return Pose(self._motion.tcp)

    def set_payload(self, m: float, cog: Any = (0.0, 0.0, 0.0)) -> None:
        mass, place = _mass(m, self._controller.dh.robot), tuple(_numbers(cog, 3, "a centre of gravity"))
        checked_frame((*place, 0.0, 0.0, 0.0), "the centre of gravity")
        self._payload.mass_kg, self._payload.cog_m, self._payload.inertia_kg_m2 = mass, place, (0.0,) * 6

    def set_payload_mass(self, m: float) -> None:
        self.set_payload(m, self._payload.cog_m)

    def set_payload_cog(self, CoG: Any) -> None:
        self.set_payload(self._payload.mass_kg, CoG)

    def set_target_payload(self, m: float, cog: Any, inertia: Any = (0.0,) * 6, transition_time: float = 0.0) -> None:
        moments = tuple(_six(inertia, "an inertia"))
        if max(map(abs, moments)) > _INERTIA_KG_M2 or min(moments[:3]) < 0.0:
            raise MotionError(
                f"an inertia of {moments} kg·m² cannot be set: allowed are ±{_INERTIA_KG_M2:g}, about the axes from 0"
            )
        self.set_payload(m, cog)
        self._payload.inertia_kg_m2 = moments

    def get_target_payload(self) -> float:
        return self._payload.mass_kg

    def get_target_payload_cog(self) -> list[float]:
        return list(self._payload.cog_m)

    def get_target_payload_inertia(self) -> list[float]:
        return list(self._payload.inertia_kg_m2)

    def set_gravity(self, d: Any) -> None:
        _numbers(d, 3, "gravity")  # without effect: the arms stand upright in every emulated cell

    def enable_external_ft_sensor(
        self,
        enable: bool,
        sensor_mass: float = 0.0,
        sensor_measuring_offset: Any = (0.0,) * 3,
        sensor_cog: Any = (0.0,) * 3,
    ) -> None:
        self._controller.use_external_sensor(bool(enable))

    def protective_stop(self) -> None:
        self._controller.protective_stop("C209A0", "the program asked for it")

    def tool_contact(self, direction: Any = (0.0,) * 6) -> int:
        x, y, z = towards = _six(direction, "a direction")[:3]
        length, steps = math.hypot(*towards), 0
        for force in reversed(self._controller.forces):
            push = math.hypot(*force) if length < 1e-9 else -(x * force[0] + y * force[1] + z * force[2]) / length
            if not push > _CONTACT_N:
                break
            steps += 1
        self._controller.spend(steps // _PERIODS_PER_STEP)
        return min(steps, len(self._controller.history) - 1)


def robot_builtins(controller: Controller) -> Builtins:
    """Return the functions by name."""
    functions = _RobotFunctions(controller).by_name()
    functions["ft_rtde_input_enable"] = functions["enable_external_ft_sensor"]
    functions["get_joint_positions"] = functions["get_actual_joint_positions"]  # its name in older programs
    return functions
