"""Faults of this machine and its processes: rows 11, 54, 56 and 57 of the fault table in docs/reference/faults.md."""

import contextlib
import math
import os
import random
import re
import signal
import time

import numpy as np
import pytest

from dual_ur10.errors import CellFaulted
from dual_ur10.sim2real.recording.reader import read_run
from tests import soak
from tests.live.faults.lab import assert_gone, descendants
from tests.live.faults.wire import demand

pytestmark = pytest.mark.streams

TICK_S = 0.008
LATCHED = "the program that sends targets has ended"


SILENT_TICKS = 17  # 0.1 s until a silent peer counts as lost, and packets in transit


@pytest.mark.parametrize("who", ["left", "right", "supervisor"] if soak.SOAK else ["left"])
def test_54_a_process_that_is_held_up_for_long_stops_both(lab, who):
    lab.begin()
    pid = lab.pids[("left", "right", "supervisor").index(who)]
    lab.note()
    lab.suspend(pid)
    time.sleep(0.4)
    lab.wake(pid)
    error = lab.step_until_faulted()
    # The watchdog of the controller acts within a control period of the supervisor. Either may name the stall first.
    observed = re.search(rf"{who}\b.*?(no longer responds|program state \d)", str(error))
    assert observed is not None, f"the stop of {who} gives another cause: {error}"
    lab.assert_stopped(error, who, seen_ticks=SILENT_TICKS)


@pytest.mark.parametrize("who", ["left", "right", "supervisor"] if soak.SOAK else ["right"])
def test_11_a_process_that_is_killed_stops_both(lab, who):
    lab.begin()
    lab.note()
    os.kill(lab.pids[("left", "right", "supervisor").index(who)], signal.SIGKILL)
    lab.assert_stopped(lab.step_until_faulted(), who, seen_ticks=SILENT_TICKS)


@pytest.mark.parametrize("who", ["all", "program", "arms", "supervisor"] if soak.SOAK else ["all"])
def test_56_a_machine_sends_nothing_when_it_wakes(lab, who):
    process = lab.program("rollout", "SineTracking", "-n", "1", "--no-record")
    lab.wait_until_moving(process)
    started = descendants(process.pid)
    chosen = {"all": [process.pid, *started], "program": [process.pid], "arms": started[:2], "supervisor": started[2:3]}
    lab.note()
    lab.suspend(*chosen[who])
    lab.assert_at_rest()  # the watchdogs in the controllers see to that
    time.sleep(2.0)
    count = lab.traffic()
    lab.wake(*chosen[who])
    assert process.wait(30.0) == 2
    assert_gone(started)
    # A pending call ends: one packet for an arm, which meets no program.
    more = [now - before for now, before in zip(lab.traffic(), count, strict=True)]
    packages = [more.pop(at) for at in (4, 2)]
    demand(not any(more) and max(packages) <= 1, f"what woke up sent something: {count} before, {lab.traffic()} now")
    # The policy alone: its targets end at rest, and 0.5 s later it is a fault.
    lab.assert_nothing_more(80 if who == "program" else SILENT_TICKS)
    lab.assert_latched()


KILLS = 100 if soak.SOAK else 2
INTERRUPTED_TICKS = 60
SIGNALS = 200 if soak.SOAK else 4


@pytest.mark.parametrize("number", range(KILLS))
def test_57_a_killed_runner_leaves_arms_at_rest_and_a_record(lab, number, tmp_path):
    """Even numbers: the program alone; odd ones: all of its processes."""
    process = lab.program("rollout", "SineTracking", "-n", "1", "--record", str(tmp_path))
    lab.wait_until_moving(process)
    time.sleep(random.Random(number).uniform(0.0, 1.0))
    alone, started = number % 2 == 0, descendants(process.pid)
    tick = lab.note()
    process.kill()
    for pid in () if alone else started:
        with contextlib.suppress(ProcessLookupError):
            os.kill(pid, signal.SIGKILL)
    lab.assert_at_rest()
    assert_gone(started)
    ended = [wire.received()["ended_tick"] - tick for wire in lab.wires]
    assert max(ended) <= math.ceil(0.15 / TICK_S) + 1, f"programs ended {ended} control periods after the kill"
    lab.assert_nothing_more()
    for wire in lab.wires if alone else ():
        wire.assert_rested(tick, TICK_S)
    lab.assert_within_hard_limits()
    if not alone:  # no process was left to latch it: the next program finds it
        with pytest.raises(CellFaulted, match="ended without stopping"):
            lab.make()
    lab.assert_latched(LATCHED if alone else "ended without stopping")
    assert_no_gap(read_run(next(tmp_path.iterdir()), allow_partial=True))


def assert_no_gap(run):
    """Check that all reported states are recorded up to the end."""
    for arm in run.arms:
        times = arm.state["timestamp_s"]
        assert len(times) > 20
        assert np.unique(np.diff(times).round(4)).tolist() == [TICK_S]
        assert all(np.isfinite(arm.state[name]).all() for name in ("q_rad", "qd_rad_s", "target_q_rad"))
        assert np.isfinite(arm.sent["target_rad"]).all()


@pytest.mark.parametrize("number", range(SIGNALS))
def test_57_an_interrupted_runner_leaves_both_arms_at_rest(lab, number, tmp_path):
    """Even numbers: Ctrl-C; odd ones: SIGTERM. Every other two: twice."""
    rng = random.Random(number)
    process = lab.program("rollout", "SineTracking", "-n", "1", "--record", str(tmp_path))
    moves = rng.random() < 0.6
    if moves:
        lab.wait_until_moving(process)
    time.sleep(rng.uniform(0.0, 1.0 if moves else 3.0))
    which, twice = (signal.SIGINT, signal.SIGTERM)[number % 2], number % 4 >= 2
    started = descendants(process.pid)
    lab.note()
    process.send_signal(which)
    if twice:
        time.sleep(rng.uniform(0.0, 0.4))
        process.send_signal(which)
    assert process.wait(30.0) != 0
    assert_gone({*started, *descendants(process.pid)})
    lab.assert_at_rest()
    if moves:
        # Ctrl-C is seen when a step has ended, and closing brakes both; what the policy still has may be gone on with.
        lab.assert_nothing_more(INTERRUPTED_TICKS)
    lab.audit()
    for folder in tmp_path.iterdir():
        if (folder / "run.mcap").exists():
            assert (folder / "run.mcap").read_bytes()[:1] in (b"", b"\x89")
            if moves:
                read_run(folder, allow_partial=True)
    # A person clears a fault, and everything continues.
    lab.latch.clear()
    lab.make()


def test_57_a_process_that_hangs_at_the_end_is_killed(lab):
    lab.begin()
    lab.turn("watchdog", {"on": True}, arm="left", on=False)  # nothing but the dashboard ends its program
    runner = lab.runner
    lab.suspend(lab.pids[0])
    begun = time.monotonic()
    lab.close_env()
    assert time.monotonic() - begun < 10.0
    assert not runner.stopped
    lab.assert_at_rest()
    lab.assert_latched("left: its process did not stop")
