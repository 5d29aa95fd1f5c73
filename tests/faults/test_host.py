"""What goes wrong with this machine and its processes: rows 54 to 57 and 59 of the table in `docs/safety.md`."""

import os
import random
import signal
import time

import numpy as np
import pytest

from dual_ur10.errors import RecordingError
from dual_ur10.recording.reader import read_run
from tests import soak
from tests.faults.lab import assert_gone, descendants

TICK_S = 0.008
LATCHED = "the program that gives targets has ended"


def in_step(lab):
    """No target was sent right behind another one, to catch up."""
    for memory in lab.runner.arms:
        sent = memory.sent()[0]
        assert (np.diff(sent.period) >= 1).all()
        # Now and then this machine is busy between a look at the clock and the sending.
        assert (np.diff(sent.sent_s) < 0.4 * TICK_S).sum() <= 1
        assert (np.diff(sent.index) <= np.diff(sent.period) * (1.0 + 1e-2)).all()


@pytest.mark.parametrize("periods", [1, 5] if soak.SOAK else [5])
def test_54_a_process_that_is_held_up_for_short_leaves_out_what_is_late(lab, periods):
    lab.begin()
    for k in range(12):
        lab.suspend(lab.pids[k % 2])
        time.sleep((periods + 0.1 * (k - 6)) * TICK_S)
        lab.wake(lab.pids[k % 2])
        lab.env.step(lab.policy())
    assert lab.latch.read() is None
    in_step(lab)
    lab.assert_within_limits()


@pytest.mark.parametrize("who", ["left", "right", "supervisor"] if soak.SOAK else ["left", "supervisor"])
def test_54_a_process_that_is_held_up_for_long_stops_both(lab, who):
    lab.begin()
    pid = lab.pids[("left", "right", "supervisor").index(who)]
    lab.suspend(pid)
    time.sleep(0.4)
    lab.wake(pid)
    lab.assert_stopped(lab.step_until_faulted())


@pytest.mark.parametrize("who", ["left", "right", "supervisor"] if soak.SOAK else ["right"])
def test_11_a_process_that_is_killed_stops_both(lab, who):
    lab.begin()
    os.kill(lab.pids[("left", "right", "supervisor").index(who)], signal.SIGKILL)
    lab.assert_stopped(lab.step_until_faulted(), who)


@pytest.mark.parametrize("who", ["all", "program", "arms", "supervisor"] if soak.SOAK else ["all"])
def test_56_a_machine_that_was_asleep_sends_nothing_when_it_wakes(lab, who):
    process = lab.program("rollout", "SineTracking", "-n", "1", "--no-record")
    lab.wait_until_moving(process)
    started = descendants(process.pid)
    chosen = {"all": [process.pid, *started], "program": [process.pid], "arms": started[:2], "supervisor": started[2:3]}
    lab.suspend(*chosen[who])
    lab.assert_at_rest()  # the watchdogs in the controllers see to that
    time.sleep(2.0)
    count = [lab.cell.ask("setpoints", arm=arm)["count"] for arm in ("left", "right")]
    programs = lab.programs()
    lab.wake(*chosen[who])
    assert process.wait(30.0) == 2
    assert_gone(started)
    assert [lab.cell.ask("setpoints", arm=arm)["count"] for arm in ("left", "right")] == count
    assert lab.programs() == programs
    lab.assert_latched()


KILLS = 100 if soak.SOAK else 3
SIGNALS = 200 if soak.SOAK else 4


@pytest.mark.parametrize("number", range(KILLS))
def test_57_a_runner_that_is_killed_leaves_both_arms_at_rest(lab, number):
    process = lab.program("rollout", "SineTracking", "-n", "1", "--no-record")
    lab.wait_until_moving(process)
    time.sleep(random.Random(number).uniform(0.0, 1.0))
    started = descendants(process.pid)
    process.kill()
    lab.assert_at_rest()
    assert_gone(started)
    lab.assert_within_hard_limits()
    lab.assert_latched(LATCHED)


@pytest.mark.parametrize("number", range(SIGNALS))
def test_57_a_runner_that_is_interrupted_at_any_time_leaves_both_arms_at_rest(lab, number, tmp_path):
    """Even numbers: Ctrl-C; odd ones: SIGTERM. Every other two: twice."""
    rng = random.Random(number)
    process = lab.program("rollout", "SineTracking", "-n", "1", "--record", str(tmp_path))
    moves = rng.random() < 0.6
    if moves:
        lab.wait_until_moving(process)
    time.sleep(rng.uniform(0.0, 1.0 if moves else 3.0))
    which, twice = (signal.SIGINT, signal.SIGTERM)[number % 2], number % 4 >= 2
    started = descendants(process.pid)
    process.send_signal(which)
    if twice:
        time.sleep(rng.uniform(0.0, 0.4))
        process.send_signal(which)
    assert process.wait(30.0) != 0
    assert_gone({*started, *descendants(process.pid)})
    lab.assert_at_rest()
    lab.assert_within_hard_limits()
    for folder in tmp_path.iterdir():
        if (folder / "run.mcap").exists():
            assert (folder / "run.mcap").read_bytes()[:1] in (b"", b"\x89")
            if moves:
                read_run(folder, allow_partial=True)
    # A person clears it where it was a fault, and then all goes on.
    lab.latch.clear()
    lab.make()


@pytest.mark.skipif(not soak.SOAK, reason="in a soak")
@pytest.mark.parametrize("moving", [False, True])
def test_57_ctrl_c_in_a_program_is_a_controlled_stop_and_no_fault(lab, moving):
    lab.begin(steps=5)
    if not moving:
        lab.env.unwrapped.core.cell.finish()
    lab.close_env()
    lab.assert_at_rest()
    assert lab.latch.read() is None
    lab.make()


@pytest.mark.parametrize("where", ["/proc/nowhere", "/dev/full"] if soak.SOAK else ["/dev/full"])
def test_59_a_record_that_cannot_be_written_is_refused_before_anything_moves(lab, where):
    with pytest.raises(RecordingError, match="cannot make a folder for the run"):
        lab.make(record=where)
    lab.assert_nothing_has_moved()
    lab.make()
