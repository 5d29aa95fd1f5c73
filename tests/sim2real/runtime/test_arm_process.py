"""Two arms moved by their processes through the unmodified `ur_rtde`, against emulated controllers."""

import os
import signal
import time

import numpy as np
import pytest

from dual_ur10.errors import LinkError, SettingsError
from dual_ur10.sim2real.control.servoj import ServojProfile
from dual_ur10.sim2real.emulator.emulated_cell import EmulatedCell
from dual_ur10.sim2real.runtime.arm_memory import ArmMemory, Phase
from dual_ur10.sim2real.runtime.arm_process import ArmConnection, ArmProcess, _round_trip_s
from dual_ur10.sim2real.runtime.cell_memory import CellMemory
from dual_ur10.sim2real.runtime.stop_ramp import STOP_RAD_S2, STOP_RAD_S3

pytestmark = pytest.mark.streams

ARMS = ("left", "right")
SERVOJ = ServojProfile("cb3", 0.03, 2000.0)
TICK_S = SERVOJ.tick_s


@pytest.fixture(scope="module")
def cell():
    with EmulatedCell(plant="nominal") as cell:
        yield cell


STEP_RAD = 1e-9  # per target, in joints that do not swing: it encodes the target's number


class Pair:
    """Both arms of a cell and their processes."""

    def __init__(self, cell):
        self.cell = cell
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
                ArmConnection(name, host, SERVOJ),
                self.memories[arm],
                self.shared,
                (self.memories[1 - arm],),
                supervised=False,
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
        self.shared.begin(time.monotonic() + 0.1)

    def move(self, ticks):
        end = time.monotonic() + 60.0
        goal = [memory.sent_count + ticks for memory in self.memories]
        while any(memory.sent_count < most for memory, most in zip(self.memories, goal, strict=True)):
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
        for memory in (*self.memories, self.shared):
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


class TwoCells:
    """Left arm of one emulated cell and right arm of another, whose control periods are offset."""

    def __init__(self, left, right):
        self.left, self.right = left.left, right.right
        self._cells = dict(zip(ARMS, (left, right), strict=True))

    def ask(self, do, *, arm, **values):
        return self._cells[arm].ask(do, arm=arm, **values)

    def wait_until(self, arm, *what):
        self._cells[arm].wait_until(arm, *what)

    def setpoints(self, arm, since):
        return self._cells[arm].setpoints(arm, since)


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


def test_controllers_execute_the_written_targets(pair):
    pair.begin()
    pair.move(300)
    pair.memories[0].stop()
    phases, texts = pair.ended()
    assert phases == [Phase.STOPPED] * 2
    assert "requested" in texts[0]
    assert texts[1].startswith("right: the other arm stops: left:")
    whole = [bool((memory.sent()[0].index[:30] % 1.0 == 0.0).all()) for memory in pair.memories]
    assert all(whole), "this machine is too busy to tell when control periods begin: the arms are out of step"
    for arm in range(2):
        put = {tuple(target): k for k, target in enumerate(pair.put[arm])}
        executed = [tuple(each) for each in pair.executed(arm)]
        known = [put[each] for each in executed if each in put]
        # Bit for bit, in order; what slows the arm down comes behind.
        assert known == sorted(known)
        # A busy machine delivers two in one control period, of which one is executed.
        assert len(set(known)) + pair.memories[arm].skipped >= 0.7 * (max(known) + 1)
        assert all(each in put for each in executed[: len(known) - 1])
        assert_rests_on_path(pair, arm)
    pair.stand()


@pytest.mark.parametrize("apart_s", [0.003, 0.0045])
def test_offset_controllers_are_sent_targets_of_one_time(apart_s):
    with EmulatedCell(plant="nominal", phase_s=0.0) as one, EmulatedCell(plant="nominal", phase_s=apart_s) as other:
        pair = Pair(TwoCells(one, other))
        try:
            pair.begin()
            pair.move(250)
            left, right = (memory.sent()[0] for memory in pair.memories)
        finally:
            pair.close()
    # Which target belongs to a time is the same for both.
    skew = np.interp(right.sent_s, left.sent_s, left.index)[20:-20] - right.index[20:-20]
    assert abs(np.median(skew)) < 0.3


def test_the_round_trip_is_measured(cell):
    quick = _round_trip_s(ArmConnection("left", cell.left, SERVOJ))
    cell.ask("link", arm="left", port="rtde", delay_s=0.003)
    try:
        slow = _round_trip_s(ArmConnection("left", cell.left, SERVOJ))
    finally:
        cell.ask("heal", arm="left")
    assert 0.0 < quick < slow
    assert slow > 0.006  # there and back


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
    assert_rests_on_path(pair, 0)
    pair.cell.ask("release", arm="right", mode=mode)
    pair.stand()
    # Nothing continues by itself.
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
    assert "stalled" in texts[0]
    assert phases[1] == Phase.STOPPED
    pair.stand()  # the watchdog in the controller has ended its program


def test_a_killed_process_stops_the_other_arm(pair):
    pair.begin()
    pair.move(60)
    os.kill(pair.arms[0].pid, signal.SIGKILL)
    pair.cell.wait_until("left", "runtime_state", 1)
    assert pair.arms[1].wait(20.0)
    assert pair.memories[1].phase == Phase.STOPPED
    assert "the process of the left arm no longer responds" in pair.memories[1].text
    assert_rests_on_path(pair, 1)
    pair.stand()


def test_a_fault_of_the_cell_stops_both(pair):
    pair.begin()
    pair.move(60)
    pair.shared.enter_fault("a reason")
    phases, texts = pair.ended()
    assert phases == [Phase.STOPPED] * 2
    assert any("a reason" in text for text in texts)
    for arm in range(2):
        assert_rests_on_path(pair, arm)


def test_after_the_last_target_the_arms_rest(pair):
    pair.begin()
    end = time.monotonic() + 20.0
    while time.monotonic() < end and min(memory.sent_count for memory in pair.memories) < 90:
        time.sleep(0.01)
    for arm, memory in enumerate(pair.memories):
        assert memory.phase == Phase.STREAMING
        sent, _ = memory.sent()
        np.testing.assert_array_equal(sent.target_rad[-1], pair.put[arm][-1])
    pair.memories[0].stop()
    assert pair.ended()[0] == [Phase.STOPPED] * 2
    pair.stand()


def test_a_slower_scaling_holds_for_both(pair):
    pair.begin()
    pair.move(30)
    period = float(pair.memories[0].sent_count + 5)
    pair.shared.set_time_scaling(pair.shared.time_scaling.towards(0.25, period, TICK_S))
    pair.move(200)
    rates = [np.diff(numbers_of(pair, arm)) for arm in range(2)]
    for rate in rates:
        assert np.median(rate[-50:]) == pytest.approx(0.25, abs=1e-3)
        assert np.abs(np.diff(rate[rate > 0.0])).max() < 4.5  # none but those that a busy machine left out
    shared = min(len(numbers_of(pair, arm)) for arm in range(2))
    apart = numbers_of(pair, 0)[:shared] - numbers_of(pair, 1)[:shared]
    assert np.abs(apart).max() <= 10.0  # periods that a busy machine left out of one
    pair.memories[1].stop()
    pair.ended()


def test_a_suspended_process_sends_nothing_when_it_wakes(pair):
    pair.begin()
    pair.move(60)
    os.kill(pair.arms[0].pid, signal.SIGSTOP)
    pair.cell.wait_until("left", "runtime_state", 1)
    count = pair.cell.ask("setpoints", arm="left")["count"]
    time.sleep(0.15)  # longer than a program of ours waits, by this clock, too
    os.kill(pair.arms[0].pid, signal.SIGCONT)
    assert pair.arms[0].wait(20.0)
    assert pair.memories[0].phase == Phase.FAULTED
    assert pair.cell.ask("setpoints", arm="left")["count"] == count
    assert pair.arms[1].wait(20.0)
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
def test_targets_that_no_gate_releases_are_not_sent(pair, tick, value, words):
    true = pair.target

    def spoiled(arm, number):
        target = true(arm, number)
        if arm == 1 and number == tick:
            target[3] += value  # once: those that follow would be fine
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
    memory, shared = ArmMemory(), CellMemory()
    try:
        arm = ArmProcess(ArmConnection("left", "127.250.250.250", SERVOJ), memory, shared)
        with pytest.raises(LinkError, match=r"left.*127\.250\.250\.250"):
            arm.wait_until_ready(30.0)
        assert arm.wait(5.0)
    finally:
        memory.close()
        shared.close()


def test_a_stopped_arm_is_not_begun(cell):
    cell.ask("stop", arm="left", mode=3)
    memory, shared = ArmMemory(), CellMemory()
    try:
        arm = ArmProcess(ArmConnection("left", cell.left, SERVOJ), memory, shared)
        with pytest.raises(LinkError, match="left"):
            arm.wait_until_ready(30.0)
    finally:
        memory.close()
        shared.close()
        cell.ask("release", arm="left", mode=3)


def test_bad_priorities_are_refused():
    for priority in (-1, 91):
        with pytest.raises(SettingsError, match="rt_priority"):
            ArmConnection("left", "127.0.0.2", SERVOJ, priority)
