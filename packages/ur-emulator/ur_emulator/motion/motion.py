"""URScript's motion commands of one arm."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from typing import Any, Final

import numpy as np

from ur_core.errors import MotionError
from ur_core.kinematics.ur10 import JOINT_RANGE_RAD
from ur_core.servoj import GAIN_RANGE, LOOKAHEAD_RANGE_S
from ur_core.types import Array
from ur_emulator.motion.arguments import checked_frame, not_negative, number, positive, six
from ur_emulator.motion.cartesian import (
    ACCELERATION_LIMIT,
    RAMP_RAD_S2,
    SPEED_LIMIT,
    PoseBlend,
    PoseBrake,
    PoseMove,
    SpeedPose,
)
from ur_emulator.motion.joint_torque import TorqueStream, checked_torques
from ur_emulator.motion.paths import Line, Path, through
from ur_emulator.motion.reference import JOINT_LIMIT, SINGULARITY, SUDDEN_CHANGE, ZEROS, Handle, damped
from ur_emulator.motion.servo import Servo
from ur_emulator.motion.tool_kinematics import Frame, pose_of
from ur_emulator.motion.tool_motion import ToolMotion
from ur_emulator.motion.trajectories import (
    ACCELERATION_LIMIT_RAD_S2,
    JointBrake,
    JointMove,
    SpeedJoints,
    Superposed,
    Trajectory,
)

_LIMITS_RAD: Final = (JOINT_RANGE_RAD + 1e-9).tolist()
_MAX_TICKS: Final = 2**31


class MotionGenerator(ToolMotion):
    """Reference motion of one arm, with the motion commands of URScript.

    A command takes effect in the next `plan` and replaces the previous one, from the present position and speed. Every
    command returns a [Handle][ur_emulator.motion.Handle].

    Poses are those of the TCP in UR's `base`: x, y, z in m and a rotation vector in rad. Arguments have the meaning of
    UR's script manual: `a` and `v` are acceleration and speed, in rad/s² and rad/s of the joint that moves farthest, or
    for poses in m/s² and m/s, and as the same numbers in rad/s² and rad/s. Joint accelerations are at most 40 rad/s².
    `t`, s, if above 0, is the duration of a move and overrides `a` and `v`; of a stream it is the time until the
    command returns. `r` is the blend radius, m.

    Raises:
        MotionError: An argument of a command is invalid.
    """

    # Moves.

    def move_joints(self, q: Iterable[Any], a: float, v: float, t: float = 0.0, r: float = 0.0) -> Handle:
        """`movej`: move to joint positions (6,) on a line in joint space. Joint speed limits reduce `v`.

        A target beyond the joint limits is an invalid argument: it ends the program, and the arm is not stopped
        protectively. So do the tests of UR's client library expect it.
        """
        target = np.array(six(q, "the target of movej"))
        a, v, t, r = _move_arguments("movej", a, v, t, r)
        if (beyond := _beyond_limits(target)) is not None:
            raise MotionError(f"the target of movej is beyond the joint limits: {beyond}")
        if self.fault is not None:
            return self._refuse()
        ending = self._ending(a)
        if self.fault is not None:
            return self._refuse()
        start = self.q if ending is None else ending.end  # type: ignore[attr-defined]
        move = JointMove(start, target, a, v, t, r, joint_speed_rad_s=self.joint_speed_rad_s)
        return self._begin(move if ending is None else Superposed(move, ending, start), target, ending)

    def move_linear(self, pose: Iterable[Any], a: float, v: float, t: float = 0.0, r: float = 0.0) -> Handle:
        """`movel`: move to a pose (6,) on a line in space, with an even rotation of the tool.

        The move slows down where a joint would exceed its speed limit or the acceleration limit of programs.
        """
        target = checked_frame(pose, "the target of movel")
        return self._move_tcp(None, target, *_move_arguments("movel", a, v, t, r))

    def move_process(self, pose: Iterable[Any], a: float, v: float, r: float = 0.0) -> Handle:
        """`movep`: like `movel`. UR blends with circles at constant speed; here blends are those of `movel`."""
        target = checked_frame(pose, "the target of movep")
        return self._move_tcp(None, target, *_move_arguments("movep", a, v, 0.0, r))

    def servo_circular(self, pose: Iterable[Any], a: float, v: float, r: float = 0.0) -> Handle:
        """`servoc`: like `movep`."""
        target = checked_frame(pose, "the target of servoc")
        return self._move_tcp(None, target, *_move_arguments("servoc", a, v, 0.0, r))

    def move_circular(self, via: Iterable[Any], to: Iterable[Any], a: float, v: float, r: float = 0.0) -> Handle:
        """`movec`: move to a pose (6,) on a circle, with an even rotation of the tool.

        Args:
            via: (6,) pose on the circle, of which only the position is used.
            to: (6,) target.
            a: Acceleration.
            v: Speed.
            r: Blend radius.

        Raises:
            MotionError: An argument is invalid, or no circle passes through the three points.
        """
        via_frame, target = checked_frame(via, "the via point of movec"), checked_frame(to, "the target of movec")
        return self._move_tcp(via_frame.position, target, *_move_arguments("movec", a, v, 0.0, r))

    def _move_tcp(self, via: Array | None, target: Frame, a: float, v: float, t: float, r: float) -> Handle:
        if self.fault is not None:
            return self._refuse()
        ending = self._ending(a)
        if self.fault is not None:
            return self._refuse()
        near: Array = self.q if ending is None else ending.end  # type: ignore[attr-defined]
        blended = isinstance(ending, PoseMove) and ending.tool is self.tool
        start = ending.path.end if blended and isinstance(ending, PoseMove) else self.arm.tcp(near, self.tool)
        path: Path = Line(start, target) if via is None else through(start, via, target)
        end = self._joints_at(target, near)
        if end is None:
            return self._refuse()
        move = PoseMove(self.arm, self.tool, near, path, end, a, v, t, r)
        trajectory: Trajectory = move
        if isinstance(ending, PoseMove) and blended:
            trajectory = PoseBlend(move, ending)
        elif ending is not None:
            trajectory = Superposed(move, ending, near)
        return self._begin(trajectory, end, ending)

    def _joints_at(self, target: Frame, near: Array) -> Array | None:
        """Return the joint positions at a pose; None, with a fault, if it is out of reach."""
        q, ok = self.arm.joints(Frame(target.position[None], target.rotation[None]), near, self.tool)
        if ok:
            found: Array = q[0]
            return found
        self._fail(
            SINGULARITY,
            f"the pose {[round(each, 4) for each in pose_of(target)]} is out of reach from this configuration",
        )
        return None

    def _ending(self, acceleration: float) -> Trajectory | None:
        """Return the motion on which the next move is superposed, so that speeds have no jump; None from rest."""
        self._end_freedrive_for_command()
        trajectory = self._trajectory
        if isinstance(trajectory, JointMove | PoseMove) and trajectory.blend_m > 0.0 and self._handle.done:
            if isinstance(trajectory, PoseMove):
                # The configuration at the end of its path need not be the one nearest to its start.
                end = trajectory.path.end
                q, ok = self.arm.joints(Frame(end.position[None], end.rotation[None]), trajectory.near, trajectory.tool)
                trajectory.end = q[0] if ok else trajectory.end
            return trajectory
        if float(np.abs(self._rate).max()) < 1e-9:
            return None
        # Each joint decelerates at least as fast as the next move accelerates it, so the sum keeps the speed limits.
        slowing = max(min(acceleration, ACCELERATION_LIMIT_RAD_S2), self.assumptions.program_stop_rad_s2)
        brake = JointBrake(self.q, self._rate, np.abs(self._rate) / slowing)
        return brake if self._may_go_to(brake.end) else None

    def _begin(self, trajectory: Trajectory, waypoint: Array | None = None, ending: Trajectory | None = None) -> Handle:
        self._handle.abort()
        self._handle, self._trajectory, self._waypoint = Handle(), trajectory, waypoint
        self._starved = 0
        if ending is None or isinstance(ending, JointBrake):
            # The trajectory starts at the present position. A blend keeps the compliance offset.
            self._offset = ZEROS
        return self._handle

    def _may_go_to(self, target: Sequence[float] | Array) -> bool:
        """Return True if a target is inside the joint limits; raise a fault if it is not."""
        if self.fault is not None:
            return False
        if (beyond := _beyond_limits(target)) is not None:
            self._fail(JOINT_LIMIT, f"position close to joint limits: {beyond}")
        return self.fault is None

    # Streams.

    def servo_joints(self, q: Iterable[Any], t: float, lookahead_s: float, gain: float) -> Handle:
        """`servoj`: follow joint positions by the servoj law, which uses the latest target.

        Args:
            q: (6,) target.
            t: Time for which it controls the arm, s; rounded up to whole control periods, at least one.
            lookahead_s: Clipped to 0.03 to 0.2 s.
            gain: Clipped to 100 to 2000.
        """
        target = six(q, "the target of servoj")
        ticks = self._ticks(t, "t of servoj")
        lookahead = min(
            max(number(lookahead_s, "lookahead_time of servoj"), LOOKAHEAD_RANGE_S[0]), LOOKAHEAD_RANGE_S[1]
        )
        gain = min(max(number(gain, "gain of servoj"), GAIN_RANGE[0]), GAIN_RANGE[1])
        if not self._may_go_to(target):
            return self._refuse()
        self._end_freedrive_for_command()
        servo = self._trajectory if isinstance(self._trajectory, Servo) else Servo(self.q, self._rate)
        factor, time_s = self.assumptions.servoj_jump_factor, lookahead + max(t, self.tick_s)
        reach = [factor * speed * time_s for speed in self.joint_speed_rad_s.tolist()]
        away = [abs(one - other) for one, other in zip(target, servo.q.tolist(), strict=True)]
        if any(far > near for far, near in zip(away, reach, strict=True)):
            joint = int(np.divide(away, reach).argmax())
            self._fail(
                SUDDEN_CHANGE,
                f"sudden change in target position: joint {joint} by {away[joint]:.4f} rad, allowed are "
                f"{reach[joint]:.4f}",
            )
            return self._refuse()
        goal = np.array(target)
        servo.aim(goal, lookahead * self.lookahead_scale, gain, max(1, ticks))
        return self._begin(servo, ending=servo if servo is self._trajectory else None)

    def speed_joints(self, qd: Iterable[Any], a: float, t: float = 0.0) -> Handle:
        """`speedj`: accelerate to joint speeds (6,) and hold them. At `t` 0 it returns when they are reached.

        One factor scales all speeds if a joint would exceed its limit. Without acceleration (`a` 0) the arm keeps its
        speed for `t`: UR's client library commands that on the straight parts of a spline. If the program commands
        nothing after the return, the arm decelerates as at the end of a program.
        """
        speed = np.array(six(qd, "the speed of speedj"))
        ticks = self._ticks(t, "t of speedj")
        keeps = bool(ticks) and not_negative(a, "a of speedj") == 0.0
        a = ACCELERATION_LIMIT_RAD_S2 if keeps else min(positive(a, "a of speedj"), ACCELERATION_LIMIT_RAD_S2)
        if self.fault is not None:
            return self._refuse()
        self._end_freedrive_for_command()
        speed = self._rate if keeps else speed / max(1.0, float((np.abs(speed) / self.joint_speed_rad_s).max()))
        return self._begin(SpeedJoints(self.q, self._rate, speed, a, ticks))

    def speed_linear(self, xd: Iterable[Any], a: float, t: float = 0.0, a_rot: float | None = None) -> Handle:
        """`speedl`: accelerate to a speed (6,) of the TCP in base and hold it. At `t` 0 it returns when it is reached.

        It slows down where a joint would exceed its limits; near a singularity it ends with a fault. If the program
        commands nothing after the return, the arm decelerates as at the end of a program. `a_rot` is the acceleration
        of rotation, rad/s²; the number `a` if None.
        """
        twist = np.array(six(xd, "the speed of speedl"))
        a, a_rot = _accelerations("speedl", a, a_rot)
        ticks = self._ticks(t, "t of speedl")
        if self.fault is not None:
            return self._refuse()
        self._end_freedrive_for_command()
        twist = twist / max(1.0, float(np.abs(twist).max()) / SPEED_LIMIT)
        trajectory = self._trajectory
        goes_on = isinstance(trajectory, SpeedPose) and trajectory.tool is self.tool and not self._offset.any()
        if not (goes_on and isinstance(trajectory, SpeedPose)):
            trajectory = SpeedPose(self.arm, self.tool, self.q, self._twist())
        ramp = trajectory.ramp(twist, a, a_rot)
        if ramp.any():
            joints = damped(self.arm.jacobian(self.q, self.tool), ramp)
            slower = max(1.0, float(np.abs(joints).max()) / RAMP_RAD_S2)
            a, a_rot = a / slower, a_rot / slower
        trajectory.aim(twist, a, a_rot, ticks)
        return self._begin(trajectory)

    def direct_torque(
        self, torque: Iterable[Any], viscous_scale: Iterable[Any], coulomb_scale: Iterable[Any]
    ) -> Handle:
        """`direct_torque`: apply joint torques for one control period, whatever the time scaling is.

        Args:
            torque: (6,) N·m on top of those that carry arm and payload, each within the joint's largest torque.
            viscous_scale: (6,) fraction of the viscous friction to compensate, 0 to 1. The simulated joints have none.
            coulomb_scale: (6,) fraction of the Coulomb friction to compensate, 0 to 1.
        """
        torques = checked_torques(self.arm.dh.robot, torque, viscous_scale, coulomb_scale)
        if self._compliance is not None and not self.free:
            raise MotionError("direct_torque was called in force mode: call end_force_mode before")
        if self.fault is not None:
            return self._refuse()
        self._end_freedrive_for_command()
        stream = TorqueStream(self.q, self.qd, torques)
        return self._begin(stream)

    # Stops.

    def stop_joints(self, a: float) -> Handle:
        """`stopj`: stop all joints together."""
        a = min(positive(a, "a of stopj"), ACCELERATION_LIMIT_RAD_S2)
        if self.fault is not None:
            return self._refuse()
        time = float(np.abs(self._rate).max()) / a
        return self._begin(JointBrake.together(self.q, self._rate, time))

    def stop_linear(self, a: float, a_rot: float | None = None) -> Handle:
        """`stopl`: stop the TCP on its present line. `a_rot` is the deceleration of rotation, by default `a`."""
        a, a_rot = _accelerations("stopl", a, a_rot)
        if self.fault is not None:
            return self._refuse()
        twist = self._twist()
        parts = float(np.linalg.norm(twist[:3])) / a, float(np.linalg.norm(twist[3:])) / a_rot
        time = max(*parts, float(np.abs(self._rate).max()) / RAMP_RAD_S2)
        return self._begin(PoseBrake(self.arm, self.tool, self.q, twist, time))

    def halt(self, scaling: float = 1.0) -> None:
        """Stop at the end of a program, and end force mode and freedrive.

        Args:
            scaling: Time scaling of the last `plan`, by which the arm is slower than its motion. From now on time
                passes at 1.
        """
        self._rate = self._rate * scaling
        self._yield = self._yield * scaling
        if self._trajectory is None and self._compliance is None and not self._yield.any():
            return
        if self.fault is None:
            self._handle.abort()
            self._brake(self.assumptions.program_stop_rad_s2)

    def hold_at(self, q_rad: Array) -> None:
        """Hold the arm at measured joint positions (6,) after it was pushed off its path."""
        self.q = np.array(q_rad, dtype=np.float64)
        self.hold()

    def hold(self) -> None:
        """Hold the arm with its brakes where it is."""
        self._handle.abort()
        self._trajectory = self._compliance = self._still = None
        self._rate = self._offset = self._yield = self.qd = self.qdd = ZEROS

    def _twist(self) -> Array:
        if not self._rate.any():
            return np.zeros(6)
        twist: Array = self.arm.jacobian(self.q, self.tool) @ self._rate
        return twist

    def _ticks(self, t: float, what: str) -> int:
        return min(math.ceil(min(not_negative(t, what) / self.tick_s, _MAX_TICKS) - 1e-6), _MAX_TICKS)


def _beyond_limits(target: Sequence[float] | Array) -> str | None:
    """Return the joint that a target brings beyond its limits, with found and allowed values, or None."""
    for joint, (each, limit) in enumerate(zip(target, _LIMITS_RAD, strict=True)):
        if abs(each) > limit:
            return f"joint {joint} would go to {each:.4f} rad, allowed are ±{JOINT_RANGE_RAD[joint]:.4f}"
    return None


def _move_arguments(name: str, a: float, v: float, t: float, r: float) -> tuple[float, float, float, float]:
    t = not_negative(t, f"t of {name}")
    check = positive if t == 0.0 else number
    return check(a, f"a of {name}"), check(v, f"v of {name}"), t, not_negative(r, f"r of {name}")


def _accelerations(name: str, a: float, a_rot: float | None) -> tuple[float, float]:
    a = min(positive(a, f"a of {name}"), ACCELERATION_LIMIT)
    return a, a if a_rot is None else min(positive(a_rot, f"a_rot of {name}"), ACCELERATION_LIMIT)
