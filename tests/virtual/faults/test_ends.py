"""Faults before the first target, during an approach, and while a program ends."""

import dataclasses

import gymnasium as gym
import numpy as np
import pytest

from dual_ur10.errors import CellFaulted, ClosedError, LinkError, SettingsError, StartError
from dual_ur10.sim2real.recording.reader import read_run
from dual_ur10.sim2real.runtime.arm_memory import Phase
from dual_ur10.sim2real.runtime.arm_sender import ArmSender
from tests.virtual.faults.lab import ARMS


@pytest.mark.parametrize(("arm", "wait_s"), [(0, 0.15), (1, 1.0)])
def test_11_a_process_that_dies_before_the_start_stops_both(lab, arm, wait_s):
    lab.make()
    lab.note()
    lab.cell.end(ARMS[arm])
    lab.clock.sleep(wait_s)  # the operator reads the question meanwhile
    with pytest.raises((CellFaulted, StartError), match=f"process of the {ARMS[arm]} arm has ended"):
        lab.env.reset(seed=0)
    lab.assert_nothing_executed()
    lab.close_env()
    lab.assert_at_rest()
    if wait_s > 0.5:
        lab.assert_latched(f"the process of the {ARMS[arm]} arm has ended")


def test_11_a_process_that_dies_at_the_start_stops_both_soon(lab):
    """At the last instant: `begin` has checked both already."""
    lab.make()
    lab.note()
    begin = lab.runner.cell.begin

    def late(at_s):
        lab.cell.end("right")
        begin(at_s)

    lab.runner.cell.begin = late
    with pytest.raises(CellFaulted, match=r"does not begin|has ended"):
        lab.env.reset(seed=0)
    start = lab.executed("left")
    assert len(start) < 0.5 / lab.tick_s
    assert np.abs(start - start[:1]).max(initial=0.0) < 0.01
    assert not len(lab.executed("right"))
    lab.close_env()
    lab.assert_latched("right")


def test_11_close_latches_a_stop_without_a_supervisor(lab):
    """The policy was computing meanwhile, and then its program ended in order."""
    lab.begin()
    lab.note()
    lab.cell.end("supervisor")
    end = lab.clock.now_s() + 5.0
    while any(memory.phase < Phase.STOPPED for memory in lab.runner.arms) and lab.clock.now_s() < end:
        lab.clock.sleep(0.01)
    assert lab.latch.read() is None  # not latched yet
    lab.close_env()
    lab.assert_latched("the supervisor has ended")


def test_59_the_next_start_learns_of_a_stop_that_was_not_latched(lab):
    """The disk is full, and the supervisor, which latches the stop as well, is gone."""
    lab.begin()
    lab.note()

    def full(text):
        raise OSError(28, "No space left on device")

    lab.runner.latch.set = full
    lab.cell.end("supervisor")
    error = lab.step_until_faulted()
    assert "the supervisor has ended" in str(error)
    lab.close_env()
    assert lab.latch.read() is None
    lab.assert_at_rest()
    with pytest.raises(CellFaulted, match="ended without stopping them in order"):
        lab.make()


def test_59_the_next_start_learns_of_an_end_that_failed(lab):
    """Nobody knows whether the arms rest."""
    lab.begin()

    def fails():
        raise RuntimeError("out of memory")

    lab.runner._stop_failure = fails
    with pytest.raises(RuntimeError, match="out of memory"):
        lab.close_env()
    assert lab.latch.read() is None
    with pytest.raises(CellFaulted, match="ended without stopping them in order"):
        lab.make()


def test_29_a_controller_stop_during_a_ramp_is_latched(lab):
    lab.begin()
    runner = lab.runner
    ends = runner.cell.end

    def both():
        ends()
        for memory in runner.arms:
            memory.stop()
        lab.do("stop", arm="left", mode=3)

    runner.cell.end = both
    lab.close_env()
    fault = lab.latch.read()
    assert "left" in fault.text


def test_57_a_process_that_hangs_at_the_end_is_killed(lab):
    lab.begin()
    lab.do("watchdog", arm="left", on=False)  # nothing but the dashboard ends its program
    runner = lab.runner
    lab.cell.stall("left", 60.0)
    begun = lab.clock.now_s()
    lab.close_env()
    assert lab.clock.now_s() - begun < 10.0
    assert not runner.stopped
    lab.assert_at_rest()
    lab.assert_latched("left: its process did not stop")


def test_33_the_dashboard_ends_a_program_paused_by_a_stop(lab):
    """This package does not rely on a watchdog acting on a program that does not run."""
    lab.begin()
    for arm in ARMS:
        lab.do("watchdog", arm=arm, on=False)
    lab.do("stop", arm="left", mode=3)  # which pauses its program
    error = lab.step_until_faulted()
    assert "left" in str(error)
    lab.cell.wait_until("left", "runtime_state", 1)
    lab.cell.ask("release", arm="left", mode=3)
    lab.assert_at_rest()
    lab.assert_latched("left")


def test_57_an_interrupt_of_an_approach_stops_both_arms_soon(lab, monkeypatch):
    """As in a notebook: the program continues, and nothing is closed."""
    for arm, away in zip(ARMS, (0.5, -0.5), strict=True):
        q = lab.ask(arm, "actual_q")[0]
        lab.play(arm, f"movej({[q[0] + away, *q[1:]]}, a=4.0, v=2.0)")
    for arm in ARMS:
        lab.cell.wait_until(arm, "runtime_state", 1)
    lab.make()
    sleep, until_s = lab.clock.sleep, lab.clock.now_s() + 1.2

    def interrupted(duration_s):
        sleep(duration_s)
        if lab.clock.now_s() >= until_s:
            raise KeyboardInterrupt

    with monkeypatch.context() as patch:
        patch.setattr(lab.clock, "sleep", interrupted)
        with pytest.raises(KeyboardInterrupt):
            lab.env.reset(seed=0)
    lab.note()
    lab.clock.sleep(1.5)  # half a second, and the ramp
    lab.assert_at_rest()
    with pytest.raises(CellFaulted, match="the policy gave no action"):
        lab.env.reset(seed=0)
    lab.close_env()
    lab.assert_latched("the policy gave no action")


def test_measured_states_of_a_stop_are_in_the_black_box(lab, tmp_path):
    lab.begin(record=str(tmp_path))
    lab.do("stop", arm="left", mode=5)
    lab.step_until_faulted()
    lab.close_env()
    (box,) = tmp_path.rglob("blackbox-*.mcap")
    run = read_run(box)
    state = run.arms[1].state
    assert np.abs(state["qd_rad_s"]).max() > 0.1
    assert np.abs(state["qd_rad_s"][-1]).max() < 0.02  # the record shows the stop of the other arm
    assert run.arms[1].sent["sent_s"][-1] < state["arrival_s"][-1] + 2 * lab.tick_s


@pytest.mark.parametrize("change", [{"speed_factor": 0.5}, {"speed_rad_s": 0.7}, {"minimum_clearance_m": 0.01}])
def test_a_configuration_that_differs_from_the_file_is_refused(lab, change):
    """The arms' processes use the file: limits that only one side knows would not hold."""
    lab.mark()
    config = dataclasses.replace(lab.file.config(), **change)
    with pytest.raises(SettingsError, match=f"{next(iter(change))} of the cell is .* its cell file says"):
        gym.make("DualUR10/SineTracking-v0", cell=config)
    lab.assert_nothing_has_moved()


def test_an_arm_without_a_link_is_stopped_by_a_ramp(lab):
    """Its link breaks during the ramp and is closed."""

    class Link:
        polled = 0

        def fileno(self):
            if self.polled:
                raise ClosedError("closed")
            return here.fileno()

        def poll(self):
            self.polled += 1
            raise LinkError("lost")

    here, there = lab.system.channel()
    there.send_now(b"always readable")
    sender = object.__new__(ArmSender)
    sender.link, sender._now_s, sender._wait = Link(), lab.clock.now_s, lab.clock.wait
    for _ in range(3):
        until_s = lab.clock.now_s() + 0.02
        assert not sender._record(until_s)
        assert lab.clock.now_s() == until_s
    assert sender.link.polled == 1
