"""Two arms moved by their processes, on a virtual cell."""

import collections
import ctypes
import gc
import sys
import threading
import types

import numpy as np
import pytest

from dual_ur10.emulated.cell_emulator import CellEmulator, CellOptions
from dual_ur10.errors import LinkError, SettingsError
from dual_ur10.sim2real.runtime.arm_memory import ArmMemory, Phase
from dual_ur10.sim2real.runtime.arm_process import _KEPT, ArmConnection, ArmProcess, _round_trip_s, _ur_rtde
from dual_ur10.sim2real.runtime.cell_memory import CellMemory
from dual_ur10.testing import VirtualCell
from tests.sim2real.runtime.pair import SERVOJ, TICK_S, Pair, assert_rests_on_path, assert_stops_both, numbers_of
from ur_core.links.json_link import JsonLink
from ur_emulator.injection.cell_requests import CellRequests


@pytest.fixture(scope="module")
def cell():
    with VirtualCell(plant="nominal") as cell:
        yield cell


@pytest.fixture
def pair(cell):
    made = Pair(cell)
    yield made
    made.close()


def test_controllers_execute_the_written_targets(pair):
    assert_stops_both(pair, 300)
    for arm, memory in enumerate(pair.memories):
        assert memory.skipped == 0
        put = {tuple(target): number for number, target in enumerate(pair.put[arm])}
        executed = [tuple(each) for each in pair.executed(arm)]
        known = [put[each] for each in executed if each in put]
        assert len(known) >= 300
        # Bit for bit, in order, none left out; what slows the arm down comes behind.
        assert known == list(range(len(known)))
        assert all(each in put for each in executed[: len(known)])
        assert_rests_on_path(pair, arm)
    pair.stand()


class Other(CellRequests):
    """Emulated controllers beside a virtual cell, with control periods of their own."""

    def __init__(self, cell, phase_s):
        started = []
        self.clock = cell.clock
        options = CellOptions(plant="nominal", left="127.0.0.4", right="127.0.0.5", phase_s=phase_s)
        self._process = cell.system.spawn(_emulate, options, started, name="other cell")
        self.clock.sleep(TICK_S)
        self.right, port = started[0].servers[1].host, started[0].description()["emulator"]["port"]
        self._injection = JsonLink("fault injection", "127.0.0.4", port, system=cell.system)

    def close(self):
        self._injection.close()
        self._process.kill()


def _emulate(options, started, *, system):
    started.append(CellEmulator(options, system=system))
    started[0].run()


class TwoCells:
    """Left arm of one cell and right arm of another, whose control periods are offset."""

    def __init__(self, left, right):
        self.left, self.right = left.left, right.right
        self.clock, self.system = left.clock, left.system
        self._cells = {"left": left, "right": right}

    def ask(self, do, *, arm, **values):
        return self._cells[arm].ask(do, arm=arm, **values)

    def wait_until(self, arm, *what):
        self._cells[arm].wait_until(arm, *what)

    def setpoints(self, arm, since):
        return self._cells[arm].setpoints(arm, since)


@pytest.mark.parametrize("apart_s", [0.003, 0.0045])
def test_offset_controllers_are_sent_targets_of_one_time(cell, apart_s):
    with Other(cell, apart_s) as other:
        pair = Pair(TwoCells(cell, other))
        try:
            pair.begin()
            pair.move(250)
            left, right = (memory.sent()[0] for memory in pair.memories)
        finally:
            pair.close()
    # Which target belongs to a time is the same for both.
    skew = np.interp(right.sent_s, left.sent_s, left.index)[20:-20] - right.index[20:-20]
    assert len(skew) > 200
    assert np.abs(skew).max() < 1e-9


def test_the_round_trip_is_measured(cell):
    quick = _round_trip_s(ArmConnection("left", cell.left, SERVOJ, "ur10"), cell.system)
    cell.ask("link", arm="left", port="rtde", delay_s=0.003)
    try:
        slow = _round_trip_s(ArmConnection("left", cell.left, SERVOJ, "ur10"), cell.system)
    finally:
        cell.ask("heal", arm="left")
    assert quick == 0.0
    assert slow == pytest.approx(0.006)  # there and back


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
    pair.clock.sleep(0.3)
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
    pair.cell.end("left")
    pair.cell.wait_until("left", "runtime_state", 1)
    assert pair.arms[1].process.wait(20.0)
    assert pair.memories[1].phase == Phase.STOPPED
    assert "the process of the left arm has ended" in pair.memories[1].text
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
    end = pair.clock.now_s() + 20.0
    while pair.clock.now_s() < end and min(memory.sent_count for memory in pair.memories) < 90:
        pair.clock.sleep(0.01)
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
    numbers = [numbers_of(pair, arm) for arm in range(2)]
    shared = min(map(len, numbers))
    np.testing.assert_array_equal(numbers[0][:shared] > 0.0, numbers[1][:shared] > 0.0)
    np.testing.assert_allclose(numbers[0][:shared], numbers[1][:shared], atol=1e-3)
    rate = np.diff(numbers[0])
    np.testing.assert_allclose(rate[-50:], 0.25, atol=1e-3)
    assert rate.max() < 1.001
    pair.memories[1].stop()
    pair.ended()


def test_a_suspended_process_sends_nothing_when_it_wakes(pair):
    pair.begin()
    pair.move(60)
    pair.cell.stall("left", 0.5)
    pair.cell.wait_until("left", "runtime_state", 1)
    count = pair.cell.ask("setpoints", arm="left")["count"]
    assert pair.arms[0].process.wait(20.0)
    assert pair.memories[0].phase == Phase.FAULTED
    assert pair.cell.ask("setpoints", arm="left")["count"] == count
    assert pair.arms[1].process.wait(20.0)
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
    end = pair.clock.now_s() + 20.0
    while pair.clock.now_s() < end and all(memory.phase <= Phase.STREAMING for memory in pair.memories):
        pair.feed()
        pair.clock.sleep(0.01)
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
        arm = ArmProcess(ArmConnection("left", "127.250.250.250", SERVOJ, "ur10"), memory, shared, system=cell.system)
        with pytest.raises(LinkError, match=r"left.*127\.250\.250\.250"):
            arm.wait_until_ready(30.0)
        assert arm.process.wait(5.0)
    finally:
        memory.close()
        shared.close()


def test_a_process_that_is_killed_while_it_connects_is_no_slow_network(cell):
    memory, shared = ArmMemory(), CellMemory()
    try:
        arm = ArmProcess(ArmConnection("left", cell.left, SERVOJ, "ur10"), memory, shared, system=cell.system)
        arm.process.kill()
        with pytest.raises(LinkError, match=r"left: its process has ended with code -9 before it was ready"):
            arm.wait_until_ready(30.0)
    finally:
        memory.close()
        shared.close()


def test_a_stopped_arm_is_not_begun(cell):
    cell.ask("stop", arm="left", mode=3)
    memory, shared = ArmMemory(), CellMemory()
    try:
        arm = ArmProcess(ArmConnection("left", cell.left, SERVOJ, "ur10"), memory, shared, system=cell.system)
        with pytest.raises(LinkError, match="left"):
            arm.wait_until_ready(30.0)
    finally:
        memory.close()
        shared.close()
        cell.ask("release", arm="left", mode=3)


def test_bad_priorities_are_refused():
    for priority in (-1, 91):
        with pytest.raises(SettingsError, match="rt_priority"):
            ArmConnection("left", "127.0.0.2", SERVOJ, "ur10", priority)


def test_records_of_a_motion_do_not_burden_the_garbage_collector(pair):
    pair.begin()
    kinds = []
    for _ in range(2):
        pair.move(80)
        gc.collect()
        kinds.append(collections.Counter(type(each) for each in gc.get_objects()))
    assert max((kinds[1] - kinds[0]).values(), default=0) < 80  # each of them is visited in every full collection


@pytest.mark.skipif(sys.platform != "linux", reason="timer slack is Linux's")
def test_threads_of_ur_rtde_wake_together_with_others(monkeypatch):
    def slack_ns():
        return ctypes.CDLL(None).prctl(30, 0, 0, 0, 0)  # PR_GET_TIMERSLACK

    class Control:
        def __init__(self, host):
            thread = threading.Thread(target=lambda: found.append(slack_ns()))
            thread.start()
            thread.join()

    found, before_ns = [], slack_ns()
    monkeypatch.setitem(sys.modules, "rtde_control", types.SimpleNamespace(RTDEControlInterface=Control))
    assert isinstance(_ur_rtde("127.0.0.2"), Control)
    _KEPT.pop()
    assert found == [1_000_000]
    assert slack_ns() == before_ns  # targets are sent in time
