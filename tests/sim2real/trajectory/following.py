"""A cell that moves as the law of `servoj` does, with faults, and trajectories for it."""

import numpy as np

from dual_ur10.assets.settings import HOME_Q_RAD, SceneSettings
from dual_ur10.errors import CellFaulted
from dual_ur10.sim2real.cell.cell import CellState, CellStep
from dual_ur10.sim2real.control.clearance import Clearance
from dual_ur10.sim2real.control.command_queue import CommandQueue
from dual_ur10.sim2real.control.gate import SafetyGate
from dual_ur10.sim2real.control.limits import MotionLimits
from dual_ur10.sim2real.trajectory.executor import TrajectoryExecutor
from dual_ur10.sim2real.trajectory.joint_trajectory import JointTrajectory
from dual_ur10.sim2real.trajectory.path_check import TargetLaw
from ur_core.kinematics.ur10 import NOMINAL_DH
from ur_core.servoj import ServojLaw, ServojProfile

PROFILE = ServojProfile()
LIMITS = MotionLimits()
TICKS = 2
CLEARANCE = Clearance(SceneSettings())
DIRECTIONS = np.array([[1.0, 0.5, -0.5, 1.0, 0.3, 1.0], [0.8, -0.5, 0.5, -1.0, 0.3, 1.0]])


class LawCell:
    """Both arms follow the law exactly; what else happens is set by attributes.

    `offset_rad` is added to measured positions. `fault` is raised by the next command. `pauses` counts commands that
    come too late, after which the arms stand at their last target.
    """

    n = 1

    def __init__(self, latency_ticks):
        self.queue = CommandQueue(1, latency_ticks)
        law = ServojLaw(PROFILE.lookahead_s, PROFILE.gain)
        self.transition = law.transition(PROFILE.tick_s)
        self.sent, self.measured, self.finished = [], [], 0
        self.offset_rad, self.fault, self.pauses = np.zeros((2, 6)), None, 0
        self.diverged = False

    def reset(self, start, rows=None, *, seeds=None, perturbation=None):
        q = np.asarray(start.q_rad).reshape(1, 2, 6)
        self.queue.reset(q, np.arange(1))
        self.q, self.qd = q[0].copy(), np.zeros((2, 6))
        self.sent = [q[0].copy() for _ in range(3)]
        return CellStep(self.state())

    def state(self):
        q, nothing = (self.q + self.offset_rad)[None], np.zeros((1, 2, 3))
        failed = np.array([self.diverged])
        return CellState(np.zeros(1), q, self.qd[None].copy(), nothing, np.zeros((1, 2, 4)), nothing, failed)

    def advance(self, command):
        if self.fault:
            raise CellFaulted(self.fault)
        if self.pauses:
            self.pauses -= 1
            rest = self.sent[-1].copy()
            self.reset(type("Start", (), {"q_rad": rest}))
            return CellStep(self.state(), stopped_q_rad=rest[None], late=True)
        self.sent.extend(command.targets_rad[0])
        for target in self.queue(command).targets_rad[0]:
            moved = self.transition @ np.stack([(self.q - target).ravel(), self.qd.ravel()])
            self.q, self.qd = moved[0].reshape(2, 6) + target, moved[1].reshape(2, 6)
            self.measured.append(self.q + self.offset_rad)
        return CellStep(self.state())

    def finish(self):
        self.finished += 1

    def close(self):
        self.closed = True


def made(latency_ticks=0, **changes):
    """Return an executor on such a cell, at home."""
    gate = SafetyGate(LIMITS, PROFILE.tick_s, TICKS, CLEARANCE)
    law = TargetLaw.of(PROFILE, TICKS, 1.0, None)
    executor = TrajectoryExecutor(
        LawCell(latency_ticks), gate, law, CLEARANCE, latency_ticks=latency_ticks, dh=[NOMINAL_DH] * 2, **changes
    )
    executor.start(HOME_Q_RAD)
    return executor


def wave(duration_s=2.0, points=9, amplitude=0.3, order=2, start=HOME_Q_RAD, first_s=0.0, arms=("left", "right")):
    """Return a motion from rest to rest along `DIRECTIONS`, with positions, speeds (1) and accelerations (2)."""
    time = np.linspace(0.0, duration_s, points)
    w = np.pi / duration_s
    values = [
        amplitude * (1.0 - np.cos(w * time)) / 2,
        amplitude * w * np.sin(w * time) / 2,
        amplitude * w * w * np.cos(w * time) / 2,
    ]
    values[1][-1] = 0.0
    rows = [("left", "right").index(each) for each in arms]
    moved = [each[:, None, None] * DIRECTIONS[rows] for each in values]
    moved[0] = moved[0] + np.asarray(start)[rows]
    return JointTrajectory(arms, first_s + time, *moved[: 1 + order])


def part(trajectory, first, last):
    """Return some points of a trajectory."""
    names = ("time_s", "q_rad", "qd_rad_s", "qdd_rad_s2")
    values = [getattr(trajectory, name) for name in names]
    return JointTrajectory(trajectory.arms, *(None if each is None else each[first:last] for each in values))


def check_sent(executor):
    """Check that no released target exceeds a limit of motion."""
    sent = np.array(executor.cell.sent)
    tick_s = PROFILE.tick_s
    for order, most in ((1, np.array(LIMITS.speed_rad_s)), (2, LIMITS.acceleration_rad_s2), (3, LIMITS.jerk_rad_s3)):
        assert (np.abs(np.diff(sent, order, axis=0)) / tick_s**order <= np.asarray(most) * (1 + 1e-6)).all()
