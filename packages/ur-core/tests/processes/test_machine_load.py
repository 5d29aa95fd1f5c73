"""Stalls of this machine, and the one text about them."""

import math
import re

import pytest

from ur_core.processes.machine_load import RECENT_S, SHORT_S, StallWatch, too_busy

BUSY = r"^this machine is too busy to move arms in real time \(.*\): end other programs on it"


def stalled(emulated, *, ago_s=0.0, for_s=2 * SHORT_S):
    """Return the explanation of a stop some time after a process stalled."""
    watch, now_s = StallWatch(emulated), 100.0
    for _ in range(50):
        watch.beat(now_s)
        now_s += 0.008
    now_s += for_s
    watch.beat(now_s)
    return watch.explained("program state 1 (STOPPED): by somebody", now_s + ago_s)


def test_a_stall_explains_what_follows_on_an_emulated_cell():
    found = stalled(True)
    assert re.match(BUSY, found)
    assert "program state 1 (STOPPED); it stalled for 108 ms" in found


@pytest.mark.parametrize(
    ("emulated", "changed"), [(False, {}), (True, {"ago_s": 1.01 * RECENT_S}), (True, {"for_s": 0})]
)
def test_nothing_else_is_explained_by_it(emulated, changed):
    assert stalled(emulated, **changed) == "program state 1 (STOPPED): by somebody"


def test_the_longest_of_several_stalls_is_reported():
    watch = StallWatch(True)
    for silent_s, now_s in ((0.09, 1.0), (0.2, 1.1), (0.06, 1.2), (0.001, 1.3)):
        watch.note(silent_s, now_s)
    assert "stalled for 200 ms" in watch.explained("x", 1.3)
    watch.note(0.07, 1.3 + 2 * RECENT_S)
    assert "stalled for 70 ms" in watch.explained("x", 1.3 + 2 * RECENT_S)


@pytest.mark.parametrize(("behind_s", "explained"), [(0.0, False), (0.04, False), (0.06, True)])
def test_a_controller_that_is_behind_shows_a_stall(behind_s, explained):
    """It catches up in many small steps, none of which is long."""
    watch, drifting = StallWatch(True), 1.0002
    for tick in range(20_000):
        watch.packet(0, drifting * 0.008 * tick, 50.0 + 0.008 * tick)
    now_s = 50.0 + 0.008 * 20_000
    for tick in range(10):
        watch.packet(0, drifting * 0.008 * (20_000 + tick), now_s + 0.004 * tick + behind_s)
    assert (watch.explained("x", now_s + 0.1) != "x") == explained


@pytest.mark.parametrize(
    ("emulated", "other_s", "stalled_ago_s", "busy"),
    [
        (False, 0.106, 0.0, False),
        (True, 0.106, math.inf, True),  # one process emulates both
        (True, 0.9 * SHORT_S, math.inf, False),
        (True, 0.9 * SHORT_S, 0.9 * RECENT_S, True),
        (True, 0.9 * SHORT_S, 1.1 * RECENT_S, False),
    ],
)
def test_one_silent_controller_is_named_where_this_machine_was_on_time(emulated, other_s, stalled_ago_s, busy):
    watch = StallWatch(emulated)
    if stalled_ago_s < math.inf:
        watch.beat(100.0 - stalled_ago_s - 2 * SHORT_S)
        watch.beat(100.0 - stalled_ago_s)
    watch.note(0.106, 100.0)  # of the silent one
    found = "the controller's clock has stalled for 106 ms"
    expected = too_busy(found) if busy else f"{found}; look at its network"
    assert watch.controller_silent(0.106, other_s, 100.0) == expected


@pytest.mark.parametrize("emulated", [False, True])
def test_a_process_that_has_ended_is_not_a_busy_machine(emulated):
    assert StallWatch(emulated).process_silent("it", runs=False, more=": x") == "it has ended"
    silent = StallWatch(emulated).process_silent("it", runs=True, more=": x")
    assert "it no longer responds: x" in silent
    assert bool(re.match(BUSY, silent)) == emulated
