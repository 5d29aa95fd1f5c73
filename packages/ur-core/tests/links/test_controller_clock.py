"""Estimate of a controller's clock from packets that arrive late, and compensation of its drift."""

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from tests.pairwise import pairwise
from ur_core.errors import LinkError
from ur_core.links.controller_clock import APART_S, ControllerClock, DriftCompensation


def packets(tick_s, seconds, *, drift=0.0, latency_s=0.0002, jitter_s=0.001, stall=0.0, seed=0):
    """Yield timestamp, arrival and true beginning of every period."""
    rng = np.random.default_rng(seed)
    last = 0.0
    for k in range(round(seconds / tick_s)):
        timestamp = 5000.0 + k * tick_s
        true = 77.0 + k * tick_s * (1.0 + drift)
        late = latency_s + rng.exponential(jitter_s) + (0.05 if rng.random() < stall else 0.0)
        last = max(last, true + late)  # packets do not overtake
        yield timestamp, last, true


@pairwise(tick_s=[0.008, 0.002], drift=[0.0, 1e-4, -1e-4], stall=[0.0, 0.01])
def test_the_estimate_follows_a_drifting_clock(tick_s, drift, stall):
    clock = ControllerClock(tick_s)
    errors = []
    for timestamp, arrival, true in packets(tick_s, 30.0, drift=drift, stall=stall):
        clock.note(timestamp, arrival)
        errors.append((timestamp + clock.offset_s) - true)
    settled = np.array(errors[round(3.0 / tick_s) :])
    assert np.abs(settled - 0.0002).max() < 0.0005
    assert np.abs(np.diff(settled)).max() < 5e-5  # no jumps, even after a stall


def test_nothing_is_known_before_the_first_packet():
    clock = ControllerClock(0.008)
    assert math.isnan(clock.offset_s)
    assert not clock.is_settled
    with pytest.raises(LinkError, match="first packet"):
        clock.next_period(1.0, 0.5)
    with pytest.raises(LinkError, match="first packet"):
        clock.moment(1, 0.5)


@pytest.mark.parametrize("phase", [0.0, 0.3, 0.5, 0.95])
def test_periods_come_one_after_the_other(phase):
    clock = ControllerClock(0.008)
    for timestamp, arrival, _ in packets(0.008, 1.0, jitter_s=1e-5):
        clock.note(timestamp, arrival)
    now = 77.0 + 1.0
    numbers, moments = [], []
    for _ in range(50):
        number, at = clock.next_period(now, phase)
        assert at > now
        numbers.append(number)
        moments.append(at)
        now = at
    assert np.diff(numbers).tolist() == [1] * 49
    assert np.allclose(np.diff(moments), 0.008)
    # They agree with the controller's periods.
    into = math.fmod(moments[0] - (5000.0 + clock.offset_s), 0.008) / 0.008
    assert min(abs(into - phase), 1 - abs(into - phase)) < 1e-6


@pytest.mark.parametrize("timestamp", [0.0, 4999.0, 6000.0])
def test_a_restarted_controller_is_an_error(timestamp):
    clock = ControllerClock(0.008)
    arrival = 0.0
    for known, arrival, _ in packets(0.008, 1.0):
        clock.note(known, arrival)
    with pytest.raises(LinkError, match="restarted"):
        clock.note(timestamp, arrival + 0.008)


@pytest.mark.parametrize("waited", [10, 60, 400])
def test_packets_that_waited_to_be_read_do_not_spoil_the_estimate(waited):
    clock = ControllerClock(0.008)
    stream = list(packets(0.008, 5.0))
    read_s = stream[waited][1]
    for timestamp, arrival, _ in stream:
        clock.note(timestamp, max(arrival, read_s))
    timestamp, _, true = stream[-1]
    assert (timestamp + clock.offset_s) - true == pytest.approx(0.0002, abs=0.0005)


def test_scattered_packets_settle_nothing_until_some_agree():
    clock = ControllerClock(0.008)
    for packet in range(60):
        assert not clock.is_settled
        clock.note(5.0 + 0.008 * packet, 105.0 + 0.008 * packet + 0.001 * (60 - packet))
    for packet in range(60, 63):  # and now the machine has time
        assert not clock.is_settled
        clock.note(5.0 + 0.008 * packet, 105.0 + 0.008 * packet + 0.0001)
    assert clock.is_settled
    assert (5.0 + clock.offset_s) - 105.0 == pytest.approx(0.0001, abs=1e-9)


@pytest.mark.parametrize("together", [1, 5])
def test_packets_that_never_agree_settle_it_in_the_end(together):
    clock = ControllerClock(0.008)
    first_s = None
    for packet in range(300):
        batch = packet // together
        read_s = 105.0 + 0.008 * together * (batch + 1) - 0.001 * batch  # each is quicker than the one before
        first_s = read_s if first_s is None else first_s
        clock.note(5.0 + 0.008 * packet, read_s)
        assert clock.is_settled == (read_s - first_s > 2.0)
    assert clock.is_settled


def test_a_round_trip_is_compensated():
    near, far = ControllerClock(0.008), ControllerClock(0.008, 0.003)
    for packet in range(50):
        near.note(5.0 + 0.008 * packet, 105.0 + 0.008 * packet)
        far.note(5.0 + 0.008 * packet, 105.0 + 0.0015 + 0.008 * packet)  # half of it
    number, at = near.next_period(105.5, 0.5)
    assert far.moment(number, 0.5) == pytest.approx(at - 0.0015, abs=1e-9)
    assert far.next_period(at - 0.0015 - 1e-6, 0.5)[0] == number
    assert far.next_period(at - 0.0015 + 1e-6, 0.5)[0] == number + 1


# Compensation of drift.

TICK_S = 0.008
BACK_S = 0.0005
MOST = 1e-3


@given(st.floats(-1e6, 1e6), st.lists(st.floats(-0.999, 0.999), max_size=60))
def test_errors_below_two_milliseconds_shift_nothing(offset_s, parts):
    drift = DriftCompensation(TICK_S, offset_s)
    assert [drift(offset_s + part * APART_S) for part in parts] == [0.0] * len(parts)


@pytest.mark.parametrize("tick_s", [0.008, 0.002])
@pytest.mark.parametrize("off_s", [-0.05, -0.0021, 0.0021, 0.004, 0.05])
def test_a_step_is_corrected_slowly_and_then_the_shift_stays(tick_s, off_s):
    drift, shifts = DriftCompensation(tick_s, 10.0), [0.0]
    for _ in range(round(abs(off_s) / tick_s / MOST) + 100):
        shifts.append(drift(10.0 + off_s))
    steps = np.diff(shifts)
    assert np.abs(steps).max() <= MOST * (1 + 1e-9)
    assert (steps * np.sign(off_s) >= 0.0).all()
    assert steps[0] == pytest.approx(np.sign(off_s) * MOST)
    assert abs(shifts[-1] * tick_s - off_s) <= BACK_S * (1 + 1e-9)
    assert abs(shifts[-1] * tick_s) <= abs(off_s)  # not beyond
    assert not steps[-50:].any()
    # Then a new shift begins only beyond the first bound.
    assert drift(10.0 + off_s * (1 - 1e-9) + np.sign(off_s) * (APART_S - 2 * BACK_S)) == shifts[-1]


def test_the_bound_is_per_period():
    drift = DriftCompensation(TICK_S, 0.0)
    assert drift(0.1, 7) == pytest.approx(7 * MOST)
    assert drift(0.1) == pytest.approx(8 * MOST)
    assert drift(-0.1, 3) == pytest.approx(5 * MOST)
    assert drift(0.0001, 1) == pytest.approx(5 * MOST)  # it stops near the true offset


@given(st.lists(st.tuples(st.floats(-1.0, 1.0), st.integers(1, 12)), max_size=60))
def test_no_period_exceeds_the_bound(calls):
    drift, before = DriftCompensation(TICK_S, 0.3), 0.0
    for offset_s, periods in calls:
        shift = drift(0.3 + offset_s, periods)
        assert abs(shift - before) <= MOST * periods * (1 + 1e-9)
        before = shift


@pytest.mark.parametrize("ppm", [-100.0, 100.0, 20.0])
@pytest.mark.parametrize("tick_s", [0.008, 0.002])
def test_an_hour_with_a_drifting_clock(ppm, tick_s):
    """Targets stay on this machine's time, although the controller's clock drifts."""
    drift, rng = DriftCompensation(tick_s, 5.0), np.random.default_rng(0)
    noise = rng.uniform(-0.0003, 0.0003, 1024)
    every = 20  # periods per call, to shorten the test
    worst, shifted = 0.0, 0.0
    for k in range(0, round(3600.0 / tick_s), every):
        true_s = ppm * 1e-6 * k * tick_s
        shifted = drift(5.0 + true_s + noise[k // every % 1024], every)
        worst = max(worst, abs(shifted * tick_s - true_s))
    assert worst < APART_S + 0.0004
    assert abs(shifted * tick_s) == pytest.approx(abs(ppm) * 1e-6 * 3600.0, abs=0.0025)
