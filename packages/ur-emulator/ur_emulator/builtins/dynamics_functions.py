"""URScript's functions of the arm's dynamics: torque control, what a torque controller needs, and OptiMove."""

from __future__ import annotations

import contextlib
from typing import Any, Final

import numpy as np

from ur_core.errors import MissingExtraError, MotionError
from ur_core.kinematics.dynamics import inverse_dynamics, mass_matrix
from ur_core.kinematics.robots import robot_model
from ur_core.types import Array
from ur_emulator.builtins.motion_functions import SOLUTION_STEPS, Blocking, MotionOwner, joints_of, pose_of
from ur_emulator.controller.controller import Controller
from ur_emulator.motion.arguments import checked_frame, number, six
from ur_emulator.motion.capability import Capability, Load, joint_capability, line_capability
from ur_emulator.motion.tool_kinematics import Tcp
from ur_emulator.script import Builtins

# Names and defaults of the parameters are those of UR's script manual; they are what programs write.

VISCOUS_SCALE: Final = (0.9, 0.9, 0.8, 0.9, 0.9, 0.9)
COULOMB_SCALE: Final = (0.8, 0.8, 0.7, 0.8, 0.8, 0.8)
"""Default fractions of friction that `direct_torque` compensates: UR's script manual, 5.25.1."""

_NONE: Final = (0.0,) * 6
_DIFFERENCE_S: Final = 1e-5  # for the derivative of the Jacobian

_SECOND: Final = (5, 25, 1)
"""First version whose `direct_torque` has scales of the friction."""


def torque_builtins(controller: Controller, owner: MotionOwner) -> Builtins:
    """Return `direct_torque`, with the parameters that the controller's version has."""
    motion = controller.motion
    warned: list[Any] = [None]

    def stream(torque: Any, viscous: Any, coulomb: Any) -> Blocking:
        yield from owner.follow(lambda: motion.direct_torque(torque, viscous, coulomb))

    def first(torque: Any, friction_comp: Any = True) -> Blocking:
        compensates = bool(number(friction_comp, "friction_comp of direct_torque"))
        yield from stream(torque, *((VISCOUS_SCALE, COULOMB_SCALE) if compensates else (_NONE, _NONE)))

    def second(
        torque: Any, viscous_scale: Any = None, coulomb_scale: Any = None, friction_comp: Any = None
    ) -> Blocking:
        if friction_comp is not None and viscous_scale is None and coulomb_scale is None:
            machine = controller.program.machine
            if warned[0] is not machine:
                warned[0] = machine
                controller.send_text("direct_torque: friction_comp is deprecated: use viscous_scale and coulomb_scale")
            yield from first(torque, friction_comp)
        else:
            viscous = VISCOUS_SCALE if viscous_scale is None else viscous_scale
            yield from stream(torque, viscous, COULOMB_SCALE if coulomb_scale is None else coulomb_scale)

    return {"direct_torque": second if controller.profile.at_least(_SECOND) else first}


def dynamics_builtins(controller: Controller) -> Builtins:
    """Return the queries by name. Joint positions, speeds and TCP that are left out are the present ones."""
    motion, robot = controller.motion, controller.dh.robot
    if controller.profile.at_least((5, 21)):
        # The first call imports pinocchio, for which no control period has the time. A program that asks for it where
        # it is missing ends with an error that says so.
        with contextlib.suppress(MissingExtraError):
            mass_matrix(motion.q, robot=robot)

    def given(values: Any, present: Array, what: str) -> Array:
        controller.spend(SOLUTION_STEPS // 5)
        return present if values is None else np.array(six(values, what))

    def tool_of(tcp: Any) -> Tcp:
        if tcp is None:
            return motion.tool
        checked_frame(tcp, "a TCP")
        return Tcp(tcp)

    def get_mass_matrix(q: Any = None, include_rotors_inertia: Any = False) -> list[list[float]]:
        joints = given(q, controller.reading.q_rad, "q of get_mass_matrix")
        matrix = mass_matrix(joints, *_load(controller), robot=robot)
        if number(include_rotors_inertia, "include_rotors_inertia of get_mass_matrix"):
            matrix = matrix + np.diag(robot_model(robot).armature_kg_m2)
        return _rows(matrix)

    def get_coriolis_and_centrifugal_torques(q: Any = None, qd: Any = None) -> list[float]:
        joints = given(q, controller.reading.q_rad, "q of get_coriolis_and_centrifugal_torques")
        speeds = given(qd, controller.reading.qd_rad_s, "qd of get_coriolis_and_centrifugal_torques")
        torques = inverse_dynamics(joints, speeds, np.zeros(6), *_load(controller), gravity=False, robot=robot)
        return [float(each) for each in torques]

    def get_jacobian(pos: Any = None, tcp: Any = None) -> list[list[float]]:
        return _rows(motion.arm.jacobian(given(pos, controller.reading.q_rad, "pos of get_jacobian"), tool_of(tcp)))

    def get_jacobian_time_derivative(pos: Any = None, vel: Any = None, tcp: Any = None) -> list[list[float]]:
        joints = given(pos, controller.reading.q_rad, "pos of get_jacobian_time_derivative")
        speeds = given(vel, controller.reading.qd_rad_s, "vel of get_jacobian_time_derivative")
        tool, step = tool_of(tcp), _DIFFERENCE_S * speeds
        after, before = motion.arm.jacobian(joints + step, tool), motion.arm.jacobian(joints - step, tool)
        return _rows((after - before) / (2 * _DIFFERENCE_S))

    def get_target_joint_accelerations() -> list[float]:
        return list(controller.values["target_qdd"])

    def get_actual_joint_accelerations() -> list[float]:
        change = controller.reading.qd_rad_s - controller.previous.qd_rad_s
        return [float(each) for each in change / controller.profile.tick_s]

    return {
        each.__name__: each
        for each in (
            get_mass_matrix,
            get_coriolis_and_centrifugal_torques,
            get_jacobian,
            get_jacobian_time_derivative,
            get_target_joint_accelerations,
            get_actual_joint_accelerations,
        )
    }


def optimove_builtins(controller: Controller, owner: MotionOwner) -> Builtins:
    """Return `optimovej` and `optimovel`: `movej` and `movel` at fractions of what the arm can do on the path.

    Their profiles of speed are trapezoids, as of the other moves, where UR's limit the jerk.
    """
    motion = controller.motion

    def optimovej(goal: Any, a: Any = 0.3, v: Any = 0.3, r: Any = 0) -> Blocking:
        target = six(joints_of(controller, goal), "the goal of optimovej")
        fractions = _fractions("optimovej", a, v)
        controller.spend(SOLUTION_STEPS)
        able = joint_capability(controller.dh.robot, motion.q, np.array(target), _load(controller))
        yield from owner.follow(lambda: motion.move_joints(target, *_scaled(able, fractions), 0.0, r))

    def optimovel(goal: Any, a: Any = 0.3, v: Any = 0.3, r: Any = 0) -> Blocking:
        target = pose_of(controller, goal)
        frame, fractions = checked_frame(target, "the goal of optimovel"), _fractions("optimovel", a, v)
        controller.spend(10 * SOLUTION_STEPS)
        able = line_capability(motion.arm, motion.tool, motion.q, frame, _load(controller))
        # Out of reach, the move is refused, whatever its speed is.
        yield from owner.follow(
            lambda: motion.move_linear(target, *_scaled(able or Capability(1, 1), fractions), 0.0, r)
        )

    return {"optimovej": optimovej, "optimovel": optimovel}


def _fractions(name: str, a: Any, v: Any) -> Capability:
    values = {"v": number(v, f"v of {name}"), "a": number(a, f"a of {name}")}
    for argument, value in values.items():
        if not 0.0 < value <= 1.0:
            raise MotionError(
                f"{argument} of {name} is {value:g}: it is a fraction of what the arm can do, above 0 and at most 1"
            )
    return Capability(values["v"], values["a"])


def _scaled(able: Capability, fractions: Capability) -> tuple[float, float]:
    """Return acceleration and speed of a move."""
    return fractions.acceleration * able.acceleration, fractions.speed * able.speed


def _load(controller: Controller) -> Load:
    x, y, z = controller.payload.cog_m
    return Load(controller.payload.mass_kg, (x, y, z))


def _rows(matrix: Array) -> list[list[float]]:
    rows: list[list[float]] = matrix.tolist()
    return rows
