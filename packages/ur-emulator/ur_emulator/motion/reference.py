"""State of one arm's reference motion, and its advance by one tick."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np

from ur_core.errors import MotionError, UnreachableError
from ur_core.kinematics.robots import robot_model
from ur_core.kinematics.ur10 import JOINT_RANGE_RAD, DHParameters
from ur_core.types import Array, constant
from ur_emulator.motion.cartesian import PoseBlend
from ur_emulator.motion.compliance import SPEED_CAP, TIME_CONSTANT_S, Compliance
from ur_emulator.motion.servo import Servo
from ur_emulator.motion.tool_kinematics import ArmKinematics, Tcp
from ur_emulator.motion.trajectories import JointBrake, JointTorques, Superposed, Trajectory
from ur_emulator.profile import Assumptions

# Codes and meanings: the error codes of UR's service manual.
JOINT_LIMIT: Final = "C150A0"  # position close to joint limits
SINGULARITY: Final = "C154A0"  # position in singularity
SUDDEN_CHANGE: Final = "C204A1"  # path sanity check: sudden change in target position
SUDDEN_STOP: Final = "C204A3"  # path sanity check: sudden stop
INVALID_SETPOINT: Final = "C204A5"  # path sanity check: the program resulted in an invalid setpoint

_NO_TIME: Final = 1e-6  # scaling below which the arm stops
_MOVING_RAD_S: Final = 1e-6
_STILL_RAD_S: Final = 0.01  # slower arms without a command are not stopped
_EXCESS: Final = 1.1  # ratio to a joint's limit above which a setpoint is invalid
_WITHIN: Final = 0.999  # ratio to it at which a pace aims
_SLOWEST: Final = 0.02  # ratio to its speed below which a TCP motion is stopped near a singularity
_TRIES: Final = 6
_DAMPING: Final = 0.05  # of the damped least squares from a compliant TCP to the joints
_YIELD_RAD_S2: Final = 8.0  # acceleration of the joints of a compliant TCP
_YIELD_RATIO: Final = 0.4
_LIMITS_RAD: Final = (JOINT_RANGE_RAD + 1e-9).tolist()
ZEROS: Final = constant(np.zeros(6))


@dataclass(frozen=True)
class MotionFault:
    """Reason for a protective stop of a UR controller.

    Attributes:
        code: UR's error code.
        text: Found and allowed values.
    """

    code: str
    text: str


class Handle:
    """Progress of a motion command, for the program that waits for it.

    Attributes:
        done: Whether the command returns now: the motion has ended, its blend has begun, or its time is over.
        aborted: Whether the motion was cut short by a fault, a stop or another motion. Then it is done, too.
    """

    __slots__ = ("aborted", "done")

    def __init__(self) -> None:
        self.done = self.aborted = False

    def abort(self) -> None:
        """End the motion before it is done."""
        if not self.done:
            self.done = self.aborted = True


class Reference:
    """Reference motion of one arm.

    Args:
        tick_s: Control period.
        substeps: Physics steps per control period.
        q_rad: (6,) initial joint positions.
        dh: Nominal Denavit-Hartenberg parameters of the controller.
        lookahead_scale: Ratio of the true lookahead of `servoj` to the commanded one.
        assumptions: Behaviour that no document settles.

    Attributes:
        joint_speed_rad_s: (6,) largest joint speeds of the arm's model.
        q, qd, qdd: (6,) at the end of the last tick; qd and qdd are differences over its last physics step.
        fault: Reason for a protective stop now, or None. The arm then leaves its path and stops all joints together as
            fast as possible. Commands are refused until it is set to None again.
    """

    def __init__(
        self,
        tick_s: float,
        substeps: int,
        q_rad: Sequence[float] | Array,
        *,
        dh: DHParameters,
        lookahead_scale: float = 1.0,
        assumptions: Assumptions | None = None,
    ) -> None:
        self.tick_s, self.substeps = tick_s, substeps
        self.lookahead_scale = lookahead_scale
        self.assumptions = Assumptions() if assumptions is None else assumptions
        self.arm, self.tool = ArmKinematics(dh), Tcp()
        self.joint_speed_rad_s = robot_model(dh.robot).joint_speed_rad_s
        q = np.array(q_rad, dtype=np.float64)
        if q.shape != (6,) or not np.isfinite(q).all():
            raise MotionError(f"initial joint angles must be six finite numbers, found {q_rad!r}")
        self.q: Array = q
        self.qd: Array = ZEROS
        self.qdd: Array = ZEROS
        self._waypoint: Array | None = None  # target of the move that runs
        self.fault: MotionFault | None = None
        self._dt = tick_s / substeps
        self._counts = np.arange(1.0, substeps + 1)
        self._trajectory: Trajectory | None = None
        self._handle = Handle()
        self._refused = Handle()
        self._rate: Array = ZEROS  # speed in trajectory time
        self._scaling = 0.0
        self._starved = 0
        self._still: Array | None = None  # plan of an arm at rest
        # Displacement of the compliant TCP, on top of the trajectory.
        self._compliance: Compliance | None = None
        self._offset: Array = ZEROS
        self._yield: Array = ZEROS

    @property
    def waypoint(self) -> Array:
        """(6,) target of the move that runs, or else the present position."""
        return self.q if self._trajectory is None or self._waypoint is None else self._waypoint

    @property
    def torques(self) -> JointTorques | None:
        """Torques of the control period that was planned last; None in position control."""
        return None if self._trajectory is None else self._trajectory.torques

    def observe(self, q_rad: Array, qd_rad_s: Array) -> None:
        """Continue from the measured positions and speeds (6,) under torque control, in which no path is known."""
        if self.torques is not None:
            self.q, self.qd, self._rate = q_rad.copy(), qd_rad_s.copy(), qd_rad_s.copy()

    @property
    def _yields(self) -> bool:
        """True while a compliant TCP moves off its path."""
        return self._yield is not ZEROS and bool(self._yield.any())

    @property
    def moving(self) -> bool:
        """True if the reference moves, or would move if its time passed."""
        trajectory = self._trajectory
        if trajectory is not None and not trajectory.streamed:
            return True
        if not self._yields:
            return trajectory is not None and max(map(abs, self._rate.tolist())) > _MOVING_RAD_S
        return float(np.abs(self._rate + self._yield).max()) > _MOVING_RAD_S

    def plan(
        self,
        scaling: float = 1.0,
        *,
        wrench: Sequence[float] | Array | None = None,
        q_actual: Sequence[float] | Array | None = None,
    ) -> Array:
        """Advance by one control tick.

        Without a new `direct_torque`, an arm under torque control returns to position control and brakes.

        Args:
            scaling: Ratio of trajectory time to the tick, 0 to 1.
            wrench: (6,) wrench of the environment on the TCP, in base's axes, N and N m; None: no wrench.
            q_actual: (6,) measured joint angles; unused.

        Returns:
            (substeps, 3, 6): position before each physics step, speed after it, acceleration in it. Speeds are
            differences of positions over the step, accelerations differences of speeds. A semi-implicit integrator
            that is given the accelerations follows exactly. Read-only.

        Raises:
            MotionError: `scaling` is out of range.
        """
        if not 0.0 <= scaling <= 1.0:
            raise MotionError(f"the time scaling is {scaling!r}: allowed are 0 to 1")
        if self.torques is not None:
            if self._handle.done:  # not commanded again
                self._brake(self.assumptions.program_stop_rad_s2)
            else:
                scaling = 1.0  # torques act whatever the time scaling is
        self._await_commands(scaling)
        self._scaling = scaling
        self._refused.abort()
        if scaling < _NO_TIME or (self._trajectory is None and self._compliance is None and not self._yields):
            return self._stand()
        self._still = None
        step = scaling * self._dt
        path = np.empty((self.substeps + 1, 6))
        path[0] = self.q
        path[1:] = self._advance(step)
        if self._compliance is not None or self._yields:
            path[1:] += self._give_way(step, wrench)
        else:
            path[1:] += self._offset
        plan = np.empty((self.substeps, 3, 6))
        plan[:, 0] = path[:-1]
        speed = (path[1:] - path[:-1]) / self._dt
        plan[:, 1] = speed
        plan[0, 2] = (speed[0] - self.qd) / self._dt
        plan[1:, 2] = (speed[1:] - speed[:-1]) / self._dt
        self.q, self.qd, self.qdd = path[-1], speed[-1], plan[-1, 2]
        return plan

    def _stand(self) -> Array:
        trajectory, handle = self._trajectory, self._handle
        if trajectory is not None:
            trajectory.ticks_left -= 1
        handle.done = handle.done or trajectory is None or (trajectory.streamed and trajectory.returns)
        if self._still is None:
            plan = np.zeros((self.substeps, 3, 6))
            plan[:, 0] = self.q
            if self.qd.any():
                plan[0, 2] = -self.qd / self._dt
                self.qd, self.qdd = ZEROS, plan[-1, 2]
                return plan
            self.qdd = ZEROS
            self._still = plan
            plan.setflags(write=False)
        return self._still

    def _await_commands(self, scaling: float) -> None:
        """React to a program that stopped commanding a moving arm.

        None is expected while the motion slows down, as for a pause, or stands.
        """
        trajectory = self._trajectory
        if trajectory is None or not trajectory.streamed or not self._handle.done:
            self._starved = 0
            return
        if scaling < _NO_TIME or scaling < self._scaling:
            return
        self._starved += 1
        if self._starved <= self.assumptions.starved_ticks:
            return
        if not isinstance(trajectory, Servo):
            time = float(np.abs(self._rate).max()) / self.assumptions.program_stop_rad_s2
            self._trajectory = JointBrake.together(self.q - self._offset, self._rate, time)
        elif float(np.abs(self._rate).max()) > _STILL_RAD_S:
            self._fail(
                SUDDEN_STOP,
                f"sudden stop: no servoj for {self._starved} control periods while the arm moves, allowed are "
                f"{self.assumptions.starved_ticks}. Call it in every period, and stop with stopj",
            )

    # The trajectory.

    def _advance(self, step: float) -> Array:
        """Advance the trajectory and return its positions (substeps, 6)."""
        trajectory = self._trajectory
        if trajectory is None:
            self._rate = ZEROS
            return np.broadcast_to(self.q - self._offset, (self.substeps, 6))
        before = self.q - self._offset
        try:
            q, time, speed = self._paced(trajectory, before, step)
            self._check(trajectory, q, speed)
        except UnreachableError as error:
            self._fail(SINGULARITY, f"position in singularity or out of reach: {error}")
        except _InvalidError as error:
            self._fail(error.code, str(error))
        else:
            return self._commit(trajectory, q, time, speed)
        return self._advance(step)  # of the brake

    def _paced(self, trajectory: Trajectory, before: Array, step: float) -> tuple[Array, float, Array]:
        """Return positions after each physics step, the trajectory's time for them, and the last speed.

        The pace of a governed trajectory changes evenly within the tick. It is the greatest, up to 1, that keeps the
        joints' speeds and accelerations, and at which their path does not bend faster than they may accelerate.
        """
        if not trajectory.governed:
            q = trajectory.positions(step, self._counts)
            speeds = np.empty(q.shape)
            np.subtract(q[0], before, out=speeds[0])
            np.subtract(q[1:], q[:-1], out=speeds[1:])
            speeds /= step
            used = float((np.abs(speeds) / self.joint_speed_rad_s).max())
            if used > _EXCESS and not isinstance(trajectory, JointBrake):
                raise _InvalidError(
                    INVALID_SETPOINT,
                    f"invalid setpoint: a joint would move at {used:.3g} times its greatest speed, "
                    f"allowed is {_EXCESS}",
                )
            return q, step * self.substeps, speeds[-1]
        # Mean pace in each physics step is `kept + gain * pace`. From rest it need not be continuous.
        gain = (self._counts - 0.5) / self.substeps
        if trajectory.t == 0.0 and not self._rate.any():
            gain = np.ones(self.substeps)
        kept, wanted = trajectory.pace * (1.0 - gain), 1.0
        most = np.array([[self.joint_speed_rad_s], [np.full(6, trajectory.most_rad_s2 * step)]])
        for _ in range(_TRIES):
            pace = wanted
            paces = kept + gain * pace
            times = np.cumsum(paces)
            q = trajectory.positions(step, times)
            speeds = np.diff(q, axis=0, prepend=before[None]) / step
            used = float((np.abs([speeds, np.diff(speeds, axis=0, prepend=self._rate[None])]) / most).max())
            fits = used <= 1.0 + 1e-6
            if fits and trajectory.pace == pace == 1.0:
                break
            # Speeds are proportional to the pace where the path is straight: a linear inequality for each limit.
            slope = speeds / paces[:, None]
            fixed, free = slope * kept[:, None], slope * gain[:, None]
            fixed = np.array([fixed, np.diff(fixed, axis=0, prepend=self._rate[None])])
            free = np.array([free, np.diff(free, axis=0, prepend=0.0)])
            path = slope if trajectory.slope is None else np.vstack([trajectory.slope, slope])
            bends = np.abs(np.diff(path, axis=0)) / paces[1 - len(path) :, None]
            with np.errstate(divide="ignore", invalid="ignore"):
                ends = (np.array([-_WITHIN * most, _WITHIN * most]) - fixed) / free
                even = float(np.sqrt(most[1, 0, 0] / bends.max(initial=0.0)))
            low, high = min(float(np.nanmax(ends.min(0))), 1.0), max(float(np.nanmin(ends.max(0))), 0.0)
            wanted = max(low, min(high, even, 1.0)) if low <= high else 0.5 * (low + high)
            if (fits and pace <= 1.01 * wanted) or wanted < _SLOWEST:
                break
        if used > _EXCESS or wanted < _SLOWEST:
            raise UnreachableError("its joints would exceed their limits of speed or acceleration")
        trajectory.pace, trajectory.slope = pace, speeds[-1] / paces[-1]
        return q, step * float(times[-1]), speeds[-1]

    def _check(self, trajectory: Trajectory, q: Array, rate: Array) -> None:
        """Stop at the joint limits. Targets of other trajectories were checked when they were commanded."""
        if not trajectory.streamed:
            return
        stop = q[-1] if isinstance(trajectory, Servo) else q[-1] + 0.5 * self._stopping_s(rate) * rate
        beyond = zip(stop.tolist(), _LIMITS_RAD, rate.tolist(), strict=True)
        if any(abs(each) > limit and each * speed > 0.0 for each, limit, speed in beyond):
            joint = int((np.abs(stop) - JOINT_RANGE_RAD).argmax())
            raise _InvalidError(
                JOINT_LIMIT,
                f"position close to joint limits: joint {joint} at {q[-1, joint]:.4f} rad, allowed are "
                f"±{JOINT_RANGE_RAD[joint]:.4f}",
            )

    def _commit(self, trajectory: Trajectory, q: Array, time: float, speed: Array) -> Array:
        """Accept the positions after `time` of the trajectory; `speed` is the last one in trajectory time."""
        trajectory.commit(time)
        trajectory.ticks_left -= 1
        rate = trajectory.rate()
        self._rate = speed if rate is None else rate * trajectory.pace
        if isinstance(trajectory, Superposed | PoseBlend) and trajectory.ending.finished:
            trajectory.main.pace = trajectory.pace
            trajectory = self._trajectory = trajectory.main
        handle = self._handle
        if not handle.done:
            handle.done = trajectory.returns or self._in_blend_zone(trajectory, q[-1])
        if trajectory.finished:
            self._trajectory, self._rate = None, ZEROS
        return q

    def _in_blend_zone(self, trajectory: Trajectory, q: Array) -> bool:
        blend: float = getattr(trajectory, "blend_m", 0.0)
        if blend <= 0.0:
            return False
        profile, end = trajectory.profile, trajectory.end  # type: ignore[attr-defined]
        if not profile.decelerates(trajectory.t):
            return False
        away = self.arm.tcp(q, self.tool).position - self.arm.tcp(end, self.tool).position
        return float(away @ away) <= blend * blend

    def _refuse(self) -> Handle:
        """Return the handle of a refused command. It is done after this tick, so that no program spins."""
        if self._refused.done:
            self._refused = Handle()
        return self._refused

    def _stopping_s(self, rate: Array) -> float:
        """Return the duration of the fastest stop from given joint speeds."""
        return self.assumptions.stopping_s * float((np.abs(rate) / self.joint_speed_rad_s).max())

    def _brake(self, acceleration: float) -> None:
        """Stop the joints together."""
        rate = self._rate + self._yield
        self._follow(JointBrake.together(self.q, rate, float(np.abs(rate).max()) / acceleration))

    def _follow(self, trajectory: Trajectory) -> None:
        """Continue with a trajectory that starts at the present position and speed."""
        self._trajectory, self._compliance, self._waypoint = trajectory, None, None
        self._offset = self._yield = ZEROS
        self._starved = 0

    def _fail(self, code: str, text: str) -> None:
        """Stop as a controller does after a fault."""
        self.fault = MotionFault(code, text)
        self._handle.abort()
        rate = self._rate + self._yield
        self._follow(JointBrake.together(self.q, rate, self._stopping_s(rate)))

    # Compliance.

    def _give_way(self, step: float, wrench: Sequence[float] | Array | None) -> Array:
        """Return the displacement (substeps, 6) of the compliant TCP on top of the trajectory."""
        time = step * self.substeps
        target = ZEROS
        if self._compliance is not None:
            jacobian = self.arm.jacobian(self.q, self.tool)
            speed = jacobian[:3] @ (self._rate + self._yield)
            twist = self._compliance.twist(wrench, self.arm.tcp(self.q, self.tool), speed)
            twist = np.clip(twist, -SPEED_CAP, SPEED_CAP)
            target = damped(jacobian, twist)
            target = target / max(1.0, float((np.abs(target) / (_YIELD_RATIO * self.joint_speed_rad_s)).max()))
            # Stop before a joint limit, with room to spare.
            after = self.q + target * self.assumptions.stopping_s
            target = np.where((np.abs(after) > JOINT_RANGE_RAD) & (target * self.q > 0.0), 0.0, target)
        change = (target - self._yield) * min(1.0, time / TIME_CONSTANT_S)
        most = _YIELD_RAD_S2 * time
        change = change * min(1.0, most / max(float(np.abs(change).max()), most))
        t = (step * self._counts)[:, None]
        offset: Array = self._offset + t * self._yield + (0.5 / time) * t * t * change
        self._yield = self._yield + change
        if self._compliance is None and float(np.abs(self._yield).max()) < 1e-9:
            self._yield = ZEROS
        self._offset = offset[-1]
        return offset


def damped(jacobian: Array, twist: Array) -> Array:
    """Return the joint speeds (6,) for a speed (6,) of the TCP by damped least squares."""
    speeds: Array = jacobian.T @ np.linalg.solve(jacobian @ jacobian.T + _DAMPING**2 * np.eye(6), twist)
    return speeds


class _InvalidError(Exception):
    """Setpoint that no controller executes."""

    def __init__(self, code: str, text: str) -> None:
        super().__init__(text)
        self.code = code
