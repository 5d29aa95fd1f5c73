"""Scheduler of virtual cells: order by time and number, stalls and ends, waiting, and what would never go on."""

import itertools
import math
import signal
import sys
import threading

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from dual_ur10.errors import VirtualCellError
from tests.soak import scaled
from ur_emulator.virtual import scheduler as module
from ur_emulator.virtual.scheduler import BEGIN_S, Group, Scheduler, VirtualClock, VirtualEvent, VirtualLock

TIMES = st.integers(0, 8).map(lambda number: number / 8)  # exact, and often equal


@pytest.fixture
def scheduler():
    return Scheduler()


@pytest.fixture
def clock(scheduler):
    return VirtualClock(scheduler)


def elapsed(scheduler):
    return scheduler.now_s - BEGIN_S


# Order.


@settings(max_examples=scaled(100))
@given(st.lists(st.lists(TIMES, min_size=1, max_size=5), min_size=1, max_size=5))
def test_actors_run_by_time_and_then_by_number(sleeps):
    scheduler = Scheduler()
    clock, seen = VirtualClock(scheduler), []

    def work(number, durations):
        for duration_s in durations:
            clock.sleep(duration_s)
            seen.append((elapsed(scheduler), number))

    for number, durations in enumerate(sleeps):
        scheduler.start(lambda number=number, durations=durations: work(number, durations), scheduler.program, "")
    clock.sleep(100.0)
    expected = []
    for number, durations in enumerate(sleeps):
        expected += [(sum(durations[: count + 1]), number) for count in range(len(durations))]
    assert seen == sorted(expected)
    assert elapsed(scheduler) == 100.0


def test_computing_takes_no_time(scheduler, clock):
    begin_s = clock.now_s()
    sum(range(100_000))
    assert clock.now_s() == begin_s
    clock.sleep(0.0)
    clock.sleep(-1.0)
    assert clock.now_s() == begin_s


def test_dates_advance_with_the_clock(clock):
    before = clock.utc()
    clock.sleep(90.0)
    assert (clock.utc() - before).total_seconds() == 90.0


def test_an_actor_that_ends_goes_over_to_one_that_has_not_started(scheduler, clock):
    ran = []

    def first():
        scheduler.start(lambda: ran.append("second"), scheduler.program, "second")

    scheduler.start(first, scheduler.program, "first")
    clock.sleep(1.0)
    assert ran == ["second"]
    assert scheduler.failures == []


# Stalls and ends.


@settings(max_examples=scaled(100))
@given(TIMES, TIMES, TIMES)
def test_a_stalled_actor_runs_once_the_stall_is_over(due_s, from_s, duration_s):
    scheduler = Scheduler()
    clock, group, seen = VirtualClock(scheduler), Group("slow"), []

    def work():
        clock.sleep(due_s)
        seen.append(elapsed(scheduler))

    scheduler.start(work, group, "slow")
    clock.sleep(from_s)
    group.stalled_until_s = scheduler.now_s + duration_s
    clock.sleep(10.0)
    if from_s == 0.0:  # it has not begun yet
        assert seen == [duration_s + due_s]
    elif from_s <= due_s < from_s + duration_s:  # the program is the first of those that are due
        assert seen == [from_s + duration_s]
    else:
        assert seen == [due_s]


def test_a_killed_actor_ends_where_it_waits_and_cleans_up(scheduler, clock):
    group, seen = Group("victim"), []

    def work():
        try:
            clock.sleep(5.0)
            seen.append("went on")
        finally:
            seen.append(elapsed(scheduler))

    scheduler.start(work, group, "victim")
    clock.sleep(1.0)
    scheduler.kill(group)
    clock.sleep(10.0)
    assert seen == [1.0]
    assert group.actors == []
    assert scheduler.failures == []


def test_one_that_was_killed_before_it_started_never_runs(scheduler, clock):
    group, seen = Group("victim"), []
    actor = scheduler.start(lambda: seen.append("ran"), group, "victim")
    scheduler.kill(group)
    clock.sleep(1.0)
    assert seen == []
    assert actor.ended


def test_an_actor_that_kills_its_own_group_ends_when_it_waits(scheduler, clock):
    group, seen = Group("self"), []

    def work():
        scheduler.kill(group)
        seen.append("still here")
        clock.sleep(1.0)
        seen.append("went on")

    scheduler.start(work, group, "self")
    clock.sleep(5.0)
    assert seen == ["still here"]


def test_an_error_ends_its_actor_alone_and_is_kept(scheduler, clock):
    seen = []
    scheduler.start(lambda: 1 / 0, scheduler.program, "bad")
    scheduler.start(lambda: seen.append("good"), scheduler.program, "good")
    clock.sleep(1.0)
    ((name, error),) = scheduler.failures
    assert (name, type(error)) == ("bad", ZeroDivisionError)
    assert seen == ["good"]


def test_ctrl_c_interrupts_the_program_at_once_and_no_actor(scheduler, clock):
    seen = []

    def work():
        clock.sleep(1.0)
        signal.raise_signal(signal.SIGINT)
        for _ in range(3):
            clock.sleep(1.0)
            seen.append(elapsed(scheduler))

    scheduler.start(work, scheduler.program, "busy")
    with pytest.raises(KeyboardInterrupt):
        clock.sleep(1e9)
    assert elapsed(scheduler) == 1.0
    clock.sleep(10.0)
    assert seen == [2.0, 3.0, 4.0]


def test_an_exit_in_an_actor_reaches_the_program(scheduler, clock):
    scheduler.start(sys.exit, scheduler.program, "leaves")
    with pytest.raises(SystemExit):
        clock.sleep(1.0)
    clock.sleep(1.0)  # which goes on


@pytest.mark.parametrize(("until_s", "at_s"), [(0.5, 0.5), (2.0, 2.0), (9.0, 3.0), (math.inf, 3.0)])
def test_a_join_ends_with_the_actor_or_its_time(scheduler, clock, until_s, at_s):
    actor = scheduler.start(lambda: clock.sleep(3.0), scheduler.program, "sleeper")
    scheduler.join(actor, BEGIN_S + until_s)
    assert elapsed(scheduler) == at_s
    assert actor.ended == (at_s == 3.0)


# Events and locks.


@settings(max_examples=scaled(100))
@given(TIMES, TIMES)
def test_an_event_wakes_who_waits_for_it(set_s, timeout_s):
    scheduler = Scheduler()
    clock, event = VirtualClock(scheduler), VirtualEvent(scheduler)

    def work():
        clock.sleep(set_s)
        event.set()

    scheduler.start(work, scheduler.program, "setter")
    found = event.wait(timeout_s)
    # The program has the lowest number: at one time it runs first.
    assert found == (set_s < timeout_s)
    assert elapsed(scheduler) == (set_s if found else timeout_s)
    clock.sleep(2.0)
    assert event.is_set()
    assert event.wait(5.0)
    assert elapsed(scheduler) == (set_s if found else timeout_s) + 2.0
    event.clear()
    assert not event.wait(1.0)


@settings(max_examples=scaled(50))
@given(st.lists(st.tuples(TIMES, TIMES), min_size=2, max_size=5))
def test_one_actor_holds_a_lock_at_a_time(holders):
    scheduler = Scheduler()
    clock, lock, held = VirtualClock(scheduler), VirtualLock(scheduler), []

    def work(begin_s, hold_s):
        clock.sleep(begin_s)
        with lock:
            taken_s = scheduler.now_s
            clock.sleep(hold_s)
            held.append((taken_s, scheduler.now_s))

    for begin_s, hold_s in holders:
        scheduler.start(lambda begin_s=begin_s, hold_s=hold_s: work(begin_s, hold_s), scheduler.program, "")
    clock.sleep(100.0)
    assert len(held) == len(holders)
    assert all(before[1] <= after[0] for before, after in itertools.pairwise(held))


def test_an_error_releases_a_lock(scheduler):
    lock = VirtualLock(scheduler)
    with pytest.raises(ZeroDivisionError), lock:
        raise ZeroDivisionError
    with lock:
        pass


# What would never go on.


def test_actors_that_all_wait_for_ever_are_an_error_of_the_program(scheduler):
    lock = VirtualLock(scheduler)
    with lock, pytest.raises(VirtualCellError, match="all actors wait for ever"), lock:
        pass


def test_such_an_error_reaches_the_program_from_another_actor(scheduler):
    lock = VirtualLock(scheduler)

    def stuck():
        with lock:
            pass

    actor = scheduler.start(stuck, scheduler.program, "stuck")
    with lock, pytest.raises(VirtualCellError, match="all actors wait for ever"):
        scheduler.join(actor, math.inf)


def test_actors_that_wake_each_other_for_ever_are_named(scheduler, clock, monkeypatch):
    monkeypatch.setattr(module, "_MOST_TURNS", 1000)
    events = [VirtualEvent(scheduler), VirtualEvent(scheduler)]
    turns = []

    def busy(mine, other):
        while True:
            turns.append(1)
            other.set()
            mine.wait(1.0)
            mine.clear()

    for name, pair in (("ping", events), ("pong", events[::-1])):
        scheduler.start(lambda pair=pair: busy(*pair), scheduler.program, name)
    with pytest.raises(VirtualCellError, match=r"1000 turns.*the last of p[io]ng"):
        clock.sleep(1.0)
    assert len(turns) <= 1001


@pytest.mark.parametrize("poll", [lambda clock: clock.sleep(0.0), lambda clock: clock.wait((), clock.now_s())])
@pytest.mark.parametrize("who", ["program", "actor"])
def test_an_actor_that_polls_without_sleeping_is_named(scheduler, clock, monkeypatch, poll, who):
    monkeypatch.setattr(module, "_MOST_TURNS", 1000)

    def busy():
        while True:
            poll(clock)

    if who == "actor":
        scheduler.start(busy, scheduler.program, "actor")
    with pytest.raises(VirtualCellError, match=rf"1000 turns.*the last of {who}"):
        clock.sleep(1.0) if who == "actor" else busy()


def test_another_thread_is_refused(scheduler, clock):
    found = []

    def use():
        try:
            clock.sleep(1.0)
        except VirtualCellError as error:
            found.append(str(error))

    thread = threading.Thread(target=use)
    thread.start()
    thread.join()
    assert "another thread" in found[0]
