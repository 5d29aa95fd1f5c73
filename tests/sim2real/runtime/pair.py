"""Two arms that their processes move, on an emulated or a virtual cell."""

import numpy as np

from dual_ur10.errors import LinkError
from dual_ur10.sim2real.runtime.arm_memory import ArmMemory, Phase
from dual_ur10.sim2real.runtime.arm_process import ArmConnection, ArmProcess
from dual_ur10.sim2real.runtime.arm_sender import STOP_RAD_S2, STOP_RAD_S3
from dual_ur10.sim2real.runtime.cell_memory import CellMemory
from ur_core.processes.system import LOCAL
from ur_core.servoj import ServojProfile

ARMS = ("left", "right")
SERVOJ = ServojProfile("cb3", 0.03, 2000.0)
TICK_S = SERVOJ.tick_s
STEP_RAD = 1e-9  # per target, in joints that do not swing: it encodes the target's number


class Pair:
    """Both arms of a cell and their processes."""

    def __init__(self, cell):
        self.cell, self.clock, system = cell, cell.clock, getattr(cell, "system", LOCAL)
        for arm in ARMS:
            cell.wait_until(arm, "robot_mode", 7)
            cell.wait_until(arm, "safety_mode", 1)
        self.first = [cell.ask("setpoints", arm=arm)["count"] for arm in ARMS]
        self.home = [np.array(cell.ask("state", arm=arm, names=["actual_q"])["actual_q"]) for arm in ARMS]
        self.memories = [ArmMemory(), ArmMemory()]
        self.shared = CellMemory()
        self.put = [[], []]
        self.arms = [
            ArmProcess(
                ArmConnection(name, host, SERVOJ, "ur10"),
                self.memories[arm],
                self.shared,
                (self.memories[1 - arm],),
                supervised=False,
                system=system,
            )
            for arm, (name, host) in enumerate(zip(ARMS, (cell.left, cell.right), strict=True))
        ]
        try:
            for arm in self.arms:
                arm.wait_until_ready(30.0)
        except LinkError:
            self.close()
            raise

    def target(self, arm, tick):
        swing = 0.1 * (1 - np.cos(np.pi * tick * TICK_S))
        return self.home[arm] + swing * np.array([1, 0, 0, 0, 1, 0]) + tick * STEP_RAD

    def feed(self, ahead=60):
        for arm, memory in enumerate(self.memories):
            passed = memory.sent_count + memory.skipped  # a busy machine skips periods
            fresh = [self.target(arm, tick) for tick in range(memory.end, passed + ahead)]
            if fresh:
                memory.put(memory.end, np.array(fresh))
                self.put[arm] += fresh

    def begin(self):
        self.feed()
        self.shared.begin(self.clock.now_s() + 0.1)

    def move(self, ticks):
        end = self.clock.now_s() + 60.0
        goal = [memory.sent_count + ticks for memory in self.memories]
        while any(memory.sent_count < most for memory, most in zip(self.memories, goal, strict=True)):
            assert self.clock.now_s() < end
            assert all(memory.phase <= Phase.STREAMING for memory in self.memories), [m.text for m in self.memories]
            self.feed()
            self.clock.sleep(0.01)

    def ended(self):
        for arm in self.arms:
            assert arm.process.wait(20.0)
        return [memory.phase for memory in self.memories], [memory.text for memory in self.memories]

    def executed(self, arm):
        return [each[1] for each in self.cell.setpoints(ARMS[arm], self.first[arm])]

    def stand(self):
        for arm in ARMS:
            self.cell.wait_until(arm, "runtime_state", 1)
            assert np.abs(self.cell.ask("state", arm=arm, names=["target_qd"])["target_qd"]).max() < 1e-3

    def close(self):
        for arm in self.arms:
            arm.process.kill()
        for memory in (*self.memories, self.shared):
            memory.close()
        for arm in ARMS:
            self.cell.ask("heal", arm=arm)
            for mode in (3, 5, 21):
                self.cell.ask("release", arm=arm, mode=mode)
            self.cell.wait_until(arm, "runtime_state", 1)


def assert_stops_both(pair, ticks):
    """Move both arms for some control periods, stop the left one, and check that the right one stops because of it."""
    pair.begin()
    pair.move(ticks)
    pair.memories[0].stop()
    phases, texts = pair.ended()
    assert phases == [Phase.STOPPED] * 2
    assert "requested" in texts[0]
    assert texts[1].startswith("right: the other arm stops: left:")


def numbers_of(pair, arm):
    """Return the target numbers, possibly fractional, of all executed targets."""
    return (np.array(pair.executed(arm))[:, 1] - pair.home[arm][1]) / STEP_RAD


def assert_rests_on_path(pair, arm):
    """Check that the last executed targets follow the path ever more slowly."""
    numbers = numbers_of(pair, arm)
    sent, _ = pair.memories[arm].sent()
    slower = np.diff(sent.index) < 0.99 * np.diff(sent.period)
    last = sent.index[int(np.flatnonzero(slower)[0])]  # before it is slowed down
    begin = int(np.flatnonzero(numbers < last + 1e-3)[-1])
    executed = np.array(pair.executed(arm))
    # All targets lie on the path, up to the error of the cubic between two.
    for q, number in zip(executed[begin:], numbers[begin:], strict=True):
        np.testing.assert_allclose(q, pair.target(arm, number), atol=2e-5)
    advance = np.diff(numbers[begin:])
    assert (advance > -1e-3).all()
    speeds = [np.abs(np.diff(pair.put[each], axis=0)).max() / TICK_S for each in range(2)]
    longest_s = max(speeds) / STOP_RAD_S2 + STOP_RAD_S2 / STOP_RAD_S3 + 6 * TICK_S
    assert advance.sum() <= longest_s / TICK_S
