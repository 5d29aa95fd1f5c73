"""Two arms moved by processes of their own, through the unmodified `ur_rtde`, against emulated controllers."""

import os
import signal
import time

import numpy as np
import pytest

from dual_ur10.errors import LinkError, SettingsError
from dual_ur10.sim2real.arm_memory import ArmMemory, Phase
from dual_ur10.sim2real.arm_process import ArmConnection, ArmProcess
from dual_ur10.sim2real.controller.emulated_cell import EmulatedCell
from dual_ur10.sim2real.ramp import STOP_RAD_S2, STOP_RAD_S3
from dual_ur10.sim2real.servoj import ServojProfile

ARMS = ("left", "right")
SERVOJ = ServojProfile("cb3", 0.03, 2000.0)
TICK_S = SERVOJ.tick_s


@pytest.fixture(scope="module")
def cell():
    with EmulatedCell(plant="nominal") as cell:
        yield cell


class Pair:
    """Both arms of a cell, and what they are sent."""

    def __init__(self, cell):
        self.cell = cell
        for arm in ARMS:
            cell.wait_until(arm, "robot_mode", 7)
            cell.wait_until(arm, "safety_mode", 1)
        self.first = [cell.ask("setpoints", arm=arm)["count"] for arm in ARMS]
        self.home = [np.array(cell.ask("state", arm=arm, names=["actual_q"])["actual_q"]) for arm in ARMS]
        self.memories = [ArmMemory(), ArmMemory()]
        self.put = [[], []]
        self.arms = [
            ArmProcess(ArmConnection(name, host, SERVOJ), self.memories[arm], (self.memories[1 - arm],))
            for arm, (name, host) in enumerate(zip(ARMS, (cell.left, cell.right), strict=True))
        ]
        for arm in self.arms:
            arm.wait_until_ready(30.0)

    def target(self, arm, tick):
        swing = 0.1 * (1 - np.cos(np.pi * tick * TICK_S))
        return self.home[arm] + swing * np.array([1, 0, 0, 0, 1, 0]) + tick * 1e-9

    def feed(self, ahead=60):
        for arm, memory in enumerate(self.memories):
            fresh = [self.target(arm, tick) for tick in range(memory.written, memory.sent + ahead)]
            if fresh:
                memory.put(np.array(fresh))
                self.put[arm] += fresh

    def begin(self):
        self.feed()
        at = time.monotonic() + 0.1
        for memory in self.memories:
            memory.begin(at)

    def move(self, ticks):
        end = time.monotonic() + 60.0
        goal = [memory.sent + ticks for memory in self.memories]
        while any(memory.sent < most for memory, most in zip(self.memories, goal, strict=True)):
            assert time.monotonic() < end
            assert all(memory.phase <= Phase.STREAMING for memory in self.memories), [m.text for m in self.memories]
            self.feed()
            time.sleep(0.01)

    def ended(self):
        for arm in self.arms:
            assert arm.wait(20.0)
        return [memory.phase for memory in self.memories], [memory.text for memory in self.memories]

    def executed(self, arm):
        return [each[1] for each in self.cell.setpoints(ARMS[arm], self.first[arm])]

    def stand(self):
        for arm in ARMS:
            self.cell.wait_until(arm, "runtime_state", 1)
            assert np.abs(self.cell.ask("state", arm=arm, names=["target_qd"])["target_qd"]).max() < 1e-3

    def close(self):
        for arm in self.arms:
            arm.kill()
        for memory in self.memories:
            memory.close()
        for arm in ARMS:
            self.cell.ask("heal", arm=arm)
            for mode in (3, 5, 21):
                self.cell.ask("release", arm=arm, mode=mode)
            self.cell.wait_until(arm, "runtime_state", 1)


@pytest.fixture
def pair(cell):
    made = Pair(cell)
    yield made
    made.close()


def assert_rests(executed, put):
    """What follows the last target that was put brings the arm to rest, on a way that a stop needs and no longer."""
    known = {tuple(target): k for k, target in enumerate(put)}
    last = max(k for k in (known.get(tuple(each), -1) for each in executed))
    speed = np.abs(put[last] - put[last - 1]).max() / TICK_S
    way = np.abs(np.array(executed[-1]) - put[last]).max()
    assert way <= speed**2 / (2 * STOP_RAD_S2) + speed * (STOP_RAD_S2 / STOP_RAD_S3 + 5 * TICK_S) + 1e-6
    assert way >= 0.4 * speed**2 / (2 * STOP_RAD_S2) - 1e-6  # it did not stop dead


def test_what_is_put_is_what_the_controllers_execute(pair):
    pair.begin()
    pair.move(300)
    pair.memories[0].stop()
    phases, texts = pair.ended()
    assert phases == [Phase.STOPPED] * 2
    assert "asked" in texts[0]
    assert texts[1].startswith("right: the other arm stops: left:")
    for arm in range(2):
        numbers = {tuple(target): k for k, target in enumerate(pair.put[arm])}
        executed = [tuple(each) for each in pair.executed(arm)]
        known = [numbers[each] for each in executed if each in numbers]
        # Bit for bit, in order; what the ramp adds comes behind.
        assert known == sorted(known)
        assert len(set(known)) + pair.memories[arm].skipped >= 0.9 * (max(known) + 1)
        assert all(each in numbers for each in executed[: len(known)])
        assert_rests(pair.executed(arm), pair.put[arm])
    pair.stand()


@pytest.mark.parametrize("mode", [3, 5, 21])
def test_a_stop_of_one_arm_stops_the_other(pair, mode):
    pair.begin()
    pair.move(120)
    pair.cell.ask("stop", arm="right", mode=mode)
    phases, texts = pair.ended()
    assert phases[0] == Phase.STOPPED
    assert phases[1] in (Phase.STOPPED, Phase.FAULTED)
    assert texts[1].startswith("right: safety mode")
    assert str(mode) in texts[1]
    assert "the other arm stops" in texts[0]
    assert_rests(pair.executed(0), pair.put[0])
    pair.cell.ask("release", arm="right", mode=mode)
    pair.stand()
    # Nothing goes on by itself.
    count = [len(pair.executed(arm)) for arm in range(2)]
    time.sleep(0.3)
    assert count == [len(pair.executed(arm)) for arm in range(2)]


def test_a_program_stopped_at_the_pendant_stops_both(pair):
    pair.begin()
    pair.move(60)
    pair.cell.ask("press", arm="left", button="stop")
    _, texts = pair.ended()
    assert texts[0].startswith("left: program state")
    assert "the other arm stops" in texts[1]
    pair.stand()


def test_a_controller_that_falls_silent_stops_both(pair):
    pair.begin()
    pair.move(60)
    pair.cell.ask("link", arm="left", port="rtde", mute=True)
    phases, texts = pair.ended()
    assert phases[0] == Phase.FAULTED
    assert "stood still" in texts[0]
    assert phases[1] == Phase.STOPPED
    pair.stand()  # the watchdog in the controller has ended its program


def test_a_killed_process_leaves_no_arm_moving(pair):
    pair.begin()
    pair.move(60)
    os.kill(pair.arms[0].process.pid, signal.SIGKILL)
    pair.cell.wait_until("left", "runtime_state", 1)
    pair.memories[1].stop()
    assert pair.arms[1].wait(20.0)
    pair.stand()


def test_an_end_of_targets_is_a_stop(pair):
    pair.begin()
    phases, texts = pair.ended()
    assert phases == [Phase.STOPPED] * 2
    assert any("no more targets" in text for text in texts)
    for arm in range(2):
        assert_rests(pair.executed(arm), pair.put[arm])
    pair.stand()


@pytest.mark.parametrize(
    ("tick", "value", "words"),
    [
        (80, np.nan, "finite"),
        (80, np.inf, "finite"),
        (80, 0.03, "from the one before"),
        (80, 9.0, "joint range"),
        (0, 0.03, "where the arm is"),
    ],
)
def test_what_no_gate_lets_out_is_not_sent(pair, tick, value, words):
    true = pair.target

    def spoiled(arm, number):
        target = true(arm, number)
        if arm == 1 and number == tick:
            target[3] += value
        return target

    pair.target = spoiled
    pair.begin()
    end = time.monotonic() + 20.0
    while time.monotonic() < end and all(memory.phase <= Phase.STREAMING for memory in pair.memories):
        pair.feed()
        time.sleep(0.01)
    _, texts = pair.ended()
    assert words in texts[1]
    assert "the other arm stops" in texts[0]
    executed = np.array(pair.executed(1)).reshape(-1, 6)
    assert np.isfinite(executed).all()
    assert not len(executed) or np.abs(executed[:, 3] - pair.home[1][3]).max() < 1e-3
    pair.stand()


def test_an_arm_that_cannot_be_reached_is_named(cell):
    memory = ArmMemory()
    try:
        arm = ArmProcess(ArmConnection("left", "127.250.250.250", SERVOJ), memory)
        with pytest.raises(LinkError, match=r"left.*127\.250\.250\.250"):
            arm.wait_until_ready(30.0)
        assert arm.wait(5.0)
    finally:
        memory.close()


def test_a_stopped_arm_is_not_begun(cell):
    cell.ask("stop", arm="left", mode=3)
    memory = ArmMemory()
    try:
        arm = ArmProcess(ArmConnection("left", cell.left, SERVOJ), memory)
        with pytest.raises(LinkError, match="left"):
            arm.wait_until_ready(30.0)
    finally:
        memory.close()
        cell.ask("release", arm="left", mode=3)


def test_bad_priorities_are_refused():
    for priority in (-1, 91):
        with pytest.raises(SettingsError, match="rt_priority"):
            ArmConnection("left", "127.0.0.2", SERVOJ, priority)
