"""URScript's functions that move the arm."""

from __future__ import annotations

from collections.abc import Callable, Generator, Sequence
from typing import Any, Final

from ur_core.errors import MotionError
from ur_emulator.builtins.functions import Functions
from ur_emulator.controller.controller import Controller
from ur_emulator.motion import Handle
from ur_emulator.script import Builtins, Pose
from ur_emulator.script.values import number

Blocking = Generator[None, None, None]

SOLUTION_STEPS: Final = 50
"""Statements that one solution of the inverse kinematics counts for."""

# Names and defaults of the parameters are those of UR's script manual; they are what programs write.
# ruff: noqa: A002


class MotionOwner:
    """Ownership of the arm's motion by one thread of a program at a time, as on a real controller."""

    def __init__(self, controller: Controller) -> None:
        self._controller = controller
        self._owner: Any = None

    def check(self) -> None:
        """Check that the caller is the main program.

        Raises:
            MotionError: It is a secondary program.
        """
        machine = self._controller.program.machine
        if machine is None or machine.thread is None:  # a secondary program runs now
            raise MotionError("a secondary program must not move the arm: do that in a program, with def")

    def _take(self) -> tuple[Any, Any]:
        """Own the motion from the running thread, and return it with its program.

        Raises:
            MotionError: Another thread owns it.
        """
        self.check()
        machine, owner = self._controller.program.machine, self._owner
        thread = (machine, machine.thread if machine is not None else None)
        if owner is not None and owner[0] is machine and owner[1] is not thread[1]:
            raise MotionError("another thread is already controlling the robot")
        self._owner = thread
        return thread

    def follow(self, start: Callable[[], Handle]) -> Blocking:
        """Start a motion and block until its command returns. A killed thread stops its motion."""
        thread = self._take()
        try:
            handle = start()
            try:
                while not handle.done:
                    yield
            except GeneratorExit:
                self._controller.motion.halt()
                raise
            if handle.aborted:
                raise MotionError("a stop ended the motion: start the program again")
        finally:
            if self._owner == thread:
                self._owner = None


def joints_of(controller: Controller, q: Sequence[float], near: Sequence[float] | None = None) -> list[float]:
    """Return the joint positions of a target: joint positions, or a pose.

    Raises:
        MotionError: The pose cannot be reached, or there are not six numbers.
    """
    if len(q) != 6:
        raise MotionError(f"a target has six numbers, found {len(q)}")
    if not isinstance(q, Pose):
        return [float(number(each)) for each in q]
    controller.spend(SOLUTION_STEPS)
    found = controller.motion.inverse(q, controller.motion.q if near is None else near)
    if found is None:
        raise MotionError(f"no joint positions reach the pose {[round(float(each), 4) for each in q]}")
    return [float(each) for each in found]


def pose_of(controller: Controller, target: Sequence[float]) -> list[float]:
    """Return the pose of the TCP for a target: a pose, or joint positions."""
    if len(target) != 6:
        raise MotionError(f"a target has six numbers, found {len(target)}")
    if isinstance(target, Pose):
        return [float(number(each)) for each in target]
    return [float(each) for each in controller.motion.tcp_pose(joints_of(controller, target))]


class _MotionFunctions(Functions):
    """Functions that move the arm, or let it be moved."""

    def __init__(self, controller: Controller, owner: MotionOwner) -> None:
        super().__init__(controller)
        self._owner = owner

    def movej(self, q: Any, a: float = 1.4, v: float = 1.05, t: float = 0, r: float = 0) -> Blocking:
        joints = joints_of(self._controller, q)
        yield from self._owner.follow(lambda: self._motion.move_joints(joints, a, v, t, r))

    def movel(self, pose: Any, a: float = 1.2, v: float = 0.25, t: float = 0, r: float = 0) -> Blocking:
        target = pose_of(self._controller, pose)
        yield from self._owner.follow(lambda: self._motion.move_linear(target, a, v, t, r))

    def movep(self, pose: Any, a: float = 1.2, v: float = 0.25, r: float = 0) -> Blocking:
        target = pose_of(self._controller, pose)
        yield from self._owner.follow(lambda: self._motion.move_process(target, a, v, r))

    def movec(
        self, pose_via: Any, pose_to: Any, a: float = 1.2, v: float = 0.25, r: float = 0, mode: int = 0
    ) -> Blocking:
        if number(mode) != 0:
            raise MotionError(f"mode {mode} of movec is not emulated: use 0, by which the orientation is interpolated")
        via, to = pose_of(self._controller, pose_via), pose_of(self._controller, pose_to)
        yield from self._owner.follow(lambda: self._motion.move_circular(via, to, a, v, r))

    def servoj(
        self, q: Any, a: float = 0, v: float = 0, t: float | None = None, lookahead_time: float = 0.1, gain: float = 300
    ) -> Blocking:
        joints, t = joints_of(self._controller, q), self._controller.profile.tick_s if t is None else t

        def start() -> Handle:
            handle = self._motion.servo_joints(joints, t, lookahead_time, gain)
            if self._motion.fault is None:
                self._controller.note_setpoint(joints, t, lookahead_time, gain)
            return handle

        yield from self._owner.follow(start)

    def servoc(self, pose: Any, a: float = 1.2, v: float = 0.25, r: float = 0) -> Blocking:
        target = pose_of(self._controller, pose)
        yield from self._owner.follow(lambda: self._motion.servo_circular(target, a, v, r))

    def speedj(self, qd: Any, a: float = 1.4, t: float = 0) -> Blocking:
        yield from self._owner.follow(lambda: self._motion.speed_joints(qd, a, t))

    def speedl(self, xd: Any, a: float = 1.2, t: float = 0, aRot: float = 0) -> Blocking:  # noqa: N803  # UR's name
        yield from self._owner.follow(lambda: self._motion.speed_linear(xd, a, t, aRot or a))

    def stopj(self, a: float) -> Blocking:
        yield from self._owner.follow(lambda: self._motion.stop_joints(a))

    def stopl(self, a: float, aRot: float = 0) -> Blocking:  # noqa: N803  # UR's name
        yield from self._owner.follow(lambda: self._motion.stop_linear(a, aRot or a))

    def force_mode(self, task_frame: Any, selection_vector: Any, wrench: Any, type: int, limits: Any) -> None:
        self._owner.check()
        self._motion.force_mode(task_frame, selection_vector, wrench, type, limits)

    def end_force_mode(self) -> None:
        self._motion.end_force_mode()

    def force_mode_set_damping(self, damping: float) -> None:
        self._motion.force_mode_settings(damping=damping)

    def force_mode_set_gain_scaling(self, scaling: float) -> None:
        if not self._controller.profile.at_least((5, 0)):
            # A CB3 must know the name: the program of UR's client library has a call that it never reaches there.
            raise MotionError("force_mode_set_gain_scaling needs a robot of the e-Series")
        self._motion.force_mode_settings(gain_scaling=scaling)

    def teach_mode(self) -> None:
        self._owner.check()
        self._motion.freedrive([1] * 6, [0.0] * 6)

    def end_teach_mode(self) -> None:
        self._motion.end_freedrive()

    def freedrive_mode(self, freeAxes: Any = (1, 1, 1, 1, 1, 1), feature: Any = (0.0,) * 6) -> None:  # noqa: N803
        self._owner.check()
        self._motion.freedrive(freeAxes, feature)

    def end_freedrive_mode(self) -> None:
        self._motion.end_freedrive()

    def get_freedrive_status(self) -> int:
        return 0  # normal operation; 1 and 2 would be the nearness of a singularity


def motion_builtins(controller: Controller, owner: MotionOwner) -> Builtins:
    """Return the functions by name."""
    return _MotionFunctions(controller, owner).by_name()
