"""Faults of a moving robot: rows 29 to 43 of the table of faults in `docs/reference/faults.md`."""

import contextlib
import logging

import numpy as np
import pytest

from dual_ur10.errors import EmulatorError, StartError
from dual_ur10.sim2real.runtime.arm_sender import root_cause
from dual_ur10.sim2real.runtime.safety_monitor import REDUCED_SCALING
from tests import soak
from tests.virtual.faults.lab import ARMS, VirtualLab

CODES = (3, 4, 5, 6, 7, 8, 9, 10, 11, 12, 13, 14, 15, 16, 17, 18, 19, 20, 21, 22, 99, 255)
ALL = [(arm, mode) for mode in CODES for arm in ARMS]


def other(arm):
    return ARMS[1 - ARMS.index(arm)]


@pytest.mark.parametrize(("arm", "mode"), ALL if soak.SOAK else ALL[::9])
def test_29_30_31_a_stop_of_one_arm_stops_both_and_stays(lab, arm, mode):
    lab.begin()
    lab.do("stop", arm=arm, mode=mode)
    error = lab.step_until_faulted()
    lab.cell.ask("release", arm=arm, mode=mode)
    lab.clock.sleep(0.1)
    lab.assert_stopped(error, f"{arm}: ", f"safety mode {mode} (", ramped=[other(arm)])


def test_29_the_reason_is_that_of_the_arm_that_stopped_first():
    why = "right: safety mode 3 (PROTECTIVE_STOP)"
    others = ["left: a stop was requested", f"left: the other arm stops: {why}"]
    for each in others:
        assert root_cause([each, why]) == root_cause([why, each]) == why
    assert root_cause(others) in others


def test_29_a_protective_stop_is_not_unlocked(lab):
    lab.begin()
    lab.do("stop", arm="right", mode=3)
    error = lab.step_until_faulted()
    lab.clock.sleep(6.0)  # from 5 s on it could be
    assert lab.ask("right", "safety_mode") == [3]
    lab.assert_stopped(error, "right: safety mode 3 (PROTECTIVE_STOP)", arms=["left"])
    assert lab.ask("right", "safety_mode") == [3]


@pytest.mark.parametrize("bits", [1 << 3 | 1, 1 << 11, 0])
def test_31_bits_of_a_stop_alone_stop_both(lab, bits):
    lab.begin()
    lab.override("left", safety_status_bits=bits)
    lab.assert_stopped(lab.step_until_faulted(), f"left: safety status bits 0x{bits:x}")


def test_32_a_program_that_is_stopped_at_the_pendant_stops_both(lab):
    lab.begin()
    lab.do("press", arm="left", button="stop")
    lab.assert_stopped(lab.step_until_faulted(), "left: program state", ramped=["right"])


def test_33_a_program_paused_and_resumed_does_not_continue(lab):
    lab.begin()
    lab.do("press", arm="right", button="pause")
    error = lab.step_until_faulted()
    with contextlib.suppress(EmulatorError):  # it has ended already
        lab.cell.ask("press", arm="right", button="resume")
    lab.assert_stopped(error, "right: program state")


def slowed(lab, count, request, slow, normal):
    """Slow an arm down for some steps. Return each arm's rates (n,) of targets, and how many are slow."""
    lab.begin()
    memories = lab.runner.arms
    first = [memory.sent_count for memory in memories]
    lab.cell.ask(request, **slow)
    for _ in range(count):
        lab.step()
        apart = [np.abs(np.subtract(memory.status.q_rad, memory.status.target_q_rad)).max() for memory in memories]
        assert max(apart) < 0.01  # no error builds up
    counts = [memory.sent_count - begin - 1 for memory, begin in zip(memories, first, strict=True)]
    lab.cell.ask(request, **normal)
    lab.step(25)
    assert lab.latch.read() is None
    sent = [memory.sent(begin)[0] for memory, begin in zip(memories, first, strict=True)]
    rates = [np.diff(each.index) / np.diff(each.period) for each in sent]
    assert [float(rate[-1]) for rate in rates] == pytest.approx([1.0, 1.0], abs=1e-2)
    # At any time both are as far as each other: an object that both hold is not torn.
    left, right = (dict(zip(each.period, each.index, strict=True)) for each in sent)
    common = sorted(left.keys() & right.keys())
    assert len(common) > 100
    assert all(left[period] == right[period] for period in common)
    lab.assert_within_limits()
    return rates, counts


@pytest.mark.parametrize(("arm", "fraction"), [("left", 0.5), ("right", 0.1)] if soak.SOAK else [("right", 0.1)])
def test_34_a_speed_slider_slows_both_arms_alike(lab, arm, fraction):
    rates, counts = slowed(lab, 6, "slider", {"arm": arm, "fraction": fraction}, {"arm": arm, "fraction": 1.0})
    paced = [rate[:count].min() for rate, count in zip(rates, counts, strict=True)]
    assert max(paced) <= fraction
    assert min(paced) >= fraction / 2


def test_35_reduced_mode_stops_both_and_nothing_begins_in_it(lab):
    lab.begin()
    lab.do("reduce", arm="left", on=True)
    lab.assert_stopped(lab.step_until_faulted(), "left: safety mode 2 (REDUCED)")
    lab.latch.clear()
    with pytest.raises(StartError, match=r"left, safety mode: 2 \(REDUCED\), expected: 1 \(NORMAL\); "):
        lab.make()
    lab.assert_nothing_has_moved()


def test_42_a_tracking_error_stops_both(lab):
    lab.begin()
    here = list(lab.ask("left", "target_q")[0])
    here[4] += 0.2
    lab.override("left", actual_q=here)
    lab.assert_stopped(lab.step_until_faulted(), "left: wrist_2_joint is ", "allowed are 0.100", seen_ticks=6)


def test_42_a_hot_joint_is_reported(lab, caplog):
    lab.begin()
    lab.override("right", joint_temperatures=[30.0, 30.0, 81.0, 30.0, 30.0, 30.0])
    with caplog.at_level(logging.WARNING):
        lab.step(15)
    assert lab.latch.read() is None
    assert any("right: elbow_joint has 81 °C" in each.message for each in caplog.records)


def test_43_a_controller_clock_that_goes_back_stops_both(lab):
    lab.begin()
    lab.override("right", timestamp=1.0)
    lab.assert_stopped(lab.step_until_faulted(), "right: ", "time")


def test_38_a_loss_of_power_or_sensors_stops_both(lab):
    lab.begin()
    lab.override("left", robot_mode=5)
    lab.assert_stopped(lab.step_until_faulted(), "left: ")


@pytest.mark.parametrize("values", [{"robot_status_bits": 2}, {"actual_q": [float("nan")] * 6}])
def test_38_values_that_cannot_be_stop_both(lab, values):
    lab.begin()
    lab.override("left", **values)
    lab.assert_stopped(lab.step_until_faulted(), "left: ")


def test_30_nothing_moves_after_an_emergency_stop(lab):
    lab.begin()
    lab.do("stop", arm="left", mode=7)
    error = lab.step_until_faulted()
    lab.cell.ask("release", arm="left", mode=7)
    lab.cell.wait_until("left", "safety_mode", 1)
    for button, mode in (("power_on", 5), ("release_brakes", 7)):
        lab.cell.ask("press", arm="left", button=button)
        lab.cell.wait_until("left", "robot_mode", mode)
    lab.assert_stopped(error, "left: ", "7 (ROBOT_EMERGENCY_STOP)")
    # After a clear everything is checked again, and the approach is slow.
    lab.latch.clear()
    lab.begin(steps=5)
    for arm in ARMS:
        assert lab.ask(arm, "runtime_state") == [2]


# Another program on a controller, whose state stays PLAYING.

REPLACED_TICKS = 30
MOST_S = 0.3


def movej(lab, arm, *by_rad, a=1.2, v=0.3):
    here = lab.ask(arm, "actual_q")[0]
    return f"movej({np.add(here, [*by_rad, *[0.0] * 6][:6]).tolist()}, a={a}, v={v})"


def assert_replaced(lab, arm, line, *words, port=30003):
    """Replace an arm's program, and check that both rest soon and the cause is named."""
    at_s = lab.replace(arm, line, port)
    error = lab.step_until_faulted()
    lab.assert_at_rest()
    assert max(map(lab.moved_until_s, ARMS)) - at_s < MOST_S
    lab.assert_stopped(error, f"{arm}: ", *words, seen_ticks=REPLACED_TICKS, ramped=[other(arm)])


@pytest.mark.parametrize(
    ("arm", "port", "by_rad", "v"), [("left", 30003, [0.5] * 6, 0.3), ("right", 30001, [-0.5], 0.05)]
)
def test_63_another_program_that_moves_an_arm_stops_both(lab, arm, port, by_rad, v):
    lab.begin()
    line = movej(lab, arm, *by_rad, v=v)
    assert_replaced(lab, arm, line, "another program replaced the control script", port=port)


def test_63_another_program_that_moves_an_arm_at_rest_stops_both(lab):
    """It moves 6 mrad before it is seen."""
    lab.begin(steps=1)
    lab.policy = lambda: np.zeros(12, dtype=np.float32)
    for _ in range(25):
        lab.env.step(lab.policy())
    before = lab.ask("left", "actual_q")[0][0]
    at_s = lab.replace("left", movej(lab, "left", 0.5))
    assert "another program replaced the control script" in str(lab.step_until_faulted())
    lab.assert_at_rest()
    assert max(map(lab.moved_until_s, ARMS)) - at_s < MOST_S
    assert 0.0 < lab.ask("left", "actual_q")[0][0] - before < 0.02
    lab.assert_latched("left: ", "another program replaced the control script")


def test_63_another_program_that_holds_an_arm_stops_both(lab):
    """Later: it rests. That the network is not the cause does not show."""
    lab.begin()
    lab.replace("right", "def other():\n  sleep(5)\nend")
    error = lab.step_until_faulted()
    words = "right: ", "the controller does not follow", "for another program that holds the arm"
    lab.assert_stopped(error, *words, seen_ticks=REPLACED_TICKS, ramped=["left"])


# Arms that are slowed down where the cell file allows it.


@pytest.mark.parametrize("arm", ARMS if soak.SOAK else ["left"])
def test_35_reduced_mode_slows_both_alike_where_it_is_allowed(lab, arm):
    lab.configure(allow_reduced_mode=True)
    rates, counts = slowed(lab, 12, "reduce", {"arm": arm, "on": True}, {"arm": arm, "on": False})
    for rate, count in zip(rates, counts, strict=True):
        assert float(np.median(rate[count - 19 : count])) == pytest.approx(REDUCED_SCALING, abs=1e-3)


def test_35_other_stops_stop_both_where_reduced_mode_is_allowed(lab):
    lab.configure(allow_reduced_mode=True)
    lab.begin()
    lab.cell.ask("reduce", arm="left", on=True)
    lab.step(5)
    lab.do("stop", arm="left", mode=3)
    lab.assert_stopped(lab.step_until_faulted(), "left: ")
    lab.latch.clear()
    with pytest.raises(StartError, match="safety mode"):  # a start needs normal mode in any case
        lab.make()


# Control periods from a stop to the last target of the other arm's motion, and to the last one of its ramp.


def stop_cycles(arm, mode, stalled_s=0.0):
    """Return both numbers, for a supervisor and a policy that stall at the same time."""
    lab = VirtualLab()
    try:
        lab.begin(steps=20)
        lab.cell.stall("supervisor", stalled_s)
        lab.do("stop", arm=arm, mode=mode)
        lab.clock.sleep(stalled_s)
        lab.step_until_faulted()
        which = ARMS.index(other(arm))
        memory = lab.runner.arms[which]
        planned = {tuple(memory.target(index)) for index in range(memory.end)}
        ticks, targets = lab.wires[which].packages()
        moved = [tick for tick, target in zip(ticks, targets.tolist(), strict=True) if tuple(target) in planned]
        return max(moved) - lab.fault_tick + 1, ticks[-1] - lab.fault_tick + 1
    finally:
        lab.close()


@pytest.mark.parametrize(
    ("arm", "codes"), [("left", CODES[::12]), ("right", CODES[::21])] if soak.SOAK else [("right", CODES[::12])]
)
def test_29_the_other_arm_stops_in_the_same_periods_each_time(arm, codes):
    found = {stop_cycles(arm, mode) for mode in codes}
    assert found == {(0, 11)}


@pytest.mark.parametrize("arm", ARMS if soak.SOAK else ["left"])
def test_29_the_other_arm_stops_as_soon_by_itself(arm):
    assert stop_cycles(arm, 3, stalled_s=0.08) == (0, 11)
