"""Faults of this machine and its processes: rows 54 to 57 and 59 of the fault table in docs/reference/faults.md."""

import re

import numpy as np
import pytest

from dual_ur10.errors import RecordingError
from tests.virtual.faults.lab import ARMS

DASHBOARD_TICKS = 30  # 0.1 s until it counts as lost, then the request
SILENT_TICKS = 17  # 0.1 s until a silent peer counts as lost, and packets in transit
BUSY = "this machine is too busy to move arms in real time"


@pytest.mark.parametrize("periods", [1, 4])
def test_54_a_short_stall_skips_late_targets(lab, periods):
    lab.begin()
    for k in range(12):
        lab.cell.stall(ARMS[k % 2], (periods + 0.1 * (k - 6)) * lab.tick_s)
        lab.step()
    assert lab.latch.read() is None
    for memory in lab.runner.arms:
        sent = memory.sent()[0]
        assert (np.diff(sent.period) >= 1).all()  # none was sent right after another one to catch up
        assert (np.diff(sent.index) == np.diff(sent.period)).all()
        assert np.diff(sent.period).max() > 1
    lab.assert_within_limits()


@pytest.mark.parametrize(("who", "word"), [("left", "program state 0"), ("supervisor", "no longer")])
def test_54_a_process_that_is_held_up_for_long_stops_both(lab, who, word):
    """The watchdog of an arm's controller acts in the period in which the supervisor misses the arm's process."""
    lab.begin()
    lab.note()
    lab.cell.stall(who, 0.4)
    error = lab.step_until_faulted()
    assert BUSY in str(error)
    lab.assert_stopped(error, who, word, seen_ticks=SILENT_TICKS)


@pytest.mark.parametrize("kind", ["emulated", "real"])
def test_54_a_stall_of_emulated_controllers_is_one_of_this_machine(lab, kind):
    """They run on it. Real ones that are silent do not."""
    object.__setattr__(lab.file, "kind", kind)
    lab.begin(confirm=lambda question: True, amplitude_m=0.05)
    lab.note()
    lab.cell.stall("emulated cell", 0.2)
    error = lab.step_until_faulted()
    assert "the controller's clock has stalled for 1" in str(error)
    assert (BUSY in str(error), "look at its network" in str(error)) == (kind == "emulated", kind == "real")
    lab.assert_at_rest()
    assert lab.latch.read().text in str(error)


@pytest.mark.parametrize("who", ["right"])
def test_54_the_supervisor_ends_a_program_without_its_watchdog(lab, who):
    lab.begin()
    lab.cell.ask("watchdog", arm=who, on=False)
    tick = lab.note()
    lab.cell.stall(who, 60.0)
    lab.cell.wait_until(who, "runtime_state", 1)
    wire = lab.wires[ARMS.index(who)]
    assert wire.received()["ended_tick"] - tick <= DASHBOARD_TICKS
    assert not lab.starved()
    lab.assert_stopped(lab.step_until_faulted(), who, "no longer responds", seen_ticks=SILENT_TICKS)


@pytest.mark.parametrize("who", ["right", "supervisor"])
def test_11_a_process_that_is_killed_stops_both(lab, who):
    lab.begin()
    lab.note()
    lab.cell.end(who)
    error = lab.step_until_faulted()
    assert BUSY not in str(error)
    assert re.search(rf"{who}.* has ended", str(error))
    lab.assert_stopped(error, who, seen_ticks=SILENT_TICKS)


@pytest.mark.parametrize("for_s", [0.3, 3.0])
def test_11_a_process_that_is_killed_is_the_cause_while_the_supervisor_stands_still(lab, for_s):
    lab.begin()
    lab.cell.stall("supervisor", for_s)
    lab.clock.sleep(0.02)  # so that the supervisor is the first that is missed
    lab.note()
    lab.cell.end("right")
    error = lab.step_until_faulted()
    assert re.search("right: its process has ended|the process of the right arm has ended", str(error))
    assert BUSY not in str(error)
    lab.assert_stopped(error, "right", seen_ticks=SILENT_TICKS)


def test_56_a_machine_sends_nothing_when_it_wakes(lab, monkeypatch):
    lab.begin()
    lab.note()
    for who in (*ARMS, "supervisor"):
        lab.cell.stall(who, 2.0)
    lab.clock.sleep(1.9)
    lab.assert_at_rest()  # the watchdogs in the controllers see to that
    assert lab.starved() == 2
    quiet, inputs = lab.traffic(), []
    for server in lab.cell.emulator.servers:
        monkeypatch.setattr(server.controller.received, "package", lambda *written: inputs.append(written))
    lab.clock.sleep(0.2)
    error = lab.step_until_faulted(1)
    assert lab.traffic() == quiet
    assert not inputs  # not even one that moves nothing
    monkeypatch.undo()
    lab.assert_stopped(error)


@pytest.mark.parametrize("moving", [False, True])
def test_57_closing_is_a_controlled_stop_and_no_fault(lab, moving):
    lab.begin(steps=5)
    if not moving:
        lab.env.unwrapped.core.cell.finish()
    lab.close_env()
    lab.assert_at_rest()
    assert lab.latch.read() is None
    lab.make()


@pytest.mark.parametrize("where", ["/proc/nowhere", "/dev/full"])
def test_59_an_unwritable_record_is_refused_before_any_motion(lab, where):
    with pytest.raises(RecordingError, match="cannot make a folder for the run"):
        lab.make(record=where)
    lab.assert_nothing_has_moved()
    lab.make()
