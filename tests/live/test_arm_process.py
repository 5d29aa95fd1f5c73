"""Two arms moved by their processes through the unmodified `ur_rtde`, against emulated controllers."""

import os
import signal
import time

import pytest

from dual_ur10.emulated.emulated_cell import EmulatedCell
from dual_ur10.sim2real.runtime.arm_memory import Phase
from tests.sim2real.runtime.pair import Pair, assert_rests_on_path, assert_stops_both

pytestmark = pytest.mark.streams


@pytest.fixture(scope="module")
def cell():
    with EmulatedCell(plant="nominal") as cell:
        yield cell


@pytest.fixture
def pair(cell):
    made = Pair(cell)
    yield made
    made.close()


def test_controllers_execute_the_written_targets(pair):
    assert_stops_both(pair, 300)
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


def test_a_killed_process_stops_the_other_arm(pair):
    pair.begin()
    pair.move(60)
    os.kill(pair.arms[0].process.pid, signal.SIGKILL)
    pair.cell.wait_until("left", "runtime_state", 1)
    assert pair.arms[1].process.wait(20.0)
    assert pair.memories[1].phase == Phase.STOPPED
    assert "the process of the left arm has ended" in pair.memories[1].text
    assert_rests_on_path(pair, 1)
    pair.stand()


def test_a_suspended_process_sends_nothing_when_it_wakes(pair):
    pair.begin()
    pair.move(60)
    os.kill(pair.arms[0].process.pid, signal.SIGSTOP)
    pair.cell.wait_until("left", "runtime_state", 1)
    count = pair.cell.ask("setpoints", arm="left")["count"]
    time.sleep(0.15)  # longer than a program of ours waits, by this clock, too
    os.kill(pair.arms[0].process.pid, signal.SIGCONT)
    assert pair.arms[0].process.wait(20.0)
    assert pair.memories[0].phase == Phase.FAULTED
    assert pair.cell.ask("setpoints", arm="left")["count"] == count
    assert pair.arms[1].process.wait(20.0)
    pair.stand()


def test_ur_rtde_does_not_print_what_a_stop_is_reported_by(pair, capfd, caplog):
    pair.begin()
    pair.move(60)
    with caplog.at_level("INFO"):
        for arm in pair.arms:
            pair.cell.ask("press", arm=arm.connection.name, button="stop")
        for arm in pair.arms:
            assert arm.process.wait(20.0)
    assert capfd.readouterr() == ("", "")
    told = [each.getMessage() for each in caplog.records if "ur_rtde" in each.getMessage()]
    assert "left, ur_rtde: its control script no longer runs" in told
    assert len(told) == len(set(told))
    pair.stand()
