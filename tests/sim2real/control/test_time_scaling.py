"""Target numbers of control periods: the same for both arms, and continuous."""

from __future__ import annotations

import itertools
import math
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import example, given
from hypothesis import strategies as st

from dual_ur10.sim2real.control.time_scaling import (
    FULL,
    SLOPE_PER_S,
    SLOWING_PER_S,
    STEP,
    TimeScaling,
    scaling_from_slider,
)

TICKS_S = (0.008, 0.002)
RATES = st.one_of(st.sampled_from([0.0, STEP, 0.25, 0.5, 1.0]), st.floats(0.0, 1.0))
PERIODS = st.floats(-50.0, 3000.0)


@st.composite
def scalings(draw):
    slope = SLOPE_PER_S * draw(st.sampled_from(TICKS_S))
    bend = draw(st.sampled_from([0.0, slope, -slope]))
    rate, plateau = draw(RATES), draw(RATES)
    if bend * (rate - plateau) < 0.0:  # it fell from above, or rose from below
        rate, plateau = plateau, rate
    return TimeScaling(draw(st.floats(0, 1e5)), draw(st.floats(0, 1e5)), rate, draw(RATES), slope, bend, plateau)


@given(st.integers(0, 2**40))
def test_at_a_scaling_of_1_each_target_has_its_period(period):
    assert TimeScaling().at(float(period)) == period
    assert TimeScaling().period_of(float(period)) == period
    assert TimeScaling().rate_at(float(period)) == 1.0


@pytest.mark.parametrize("factor", [0.5, 0.25, STEP])
def test_at_a_constant_scaling_some_periods_have_whole_targets(factor):
    scaling = TimeScaling(0.0, 0.0, factor, factor)
    for number in range(2000):
        assert scaling.at(number / factor) == number


@given(scalings(), PERIODS, st.floats(0.0, 1.0))
def test_time_goes_on_and_never_faster_than_it_may(scaling, period, more):
    begin = scaling.period + period
    ahead = scaling.at(begin + more) - scaling.at(begin)
    passed = (begin + more) - begin
    assert -1e-9 <= ahead <= passed + 1e-9
    if period >= 0.0:
        slow, fast = sorted((scaling.rate, scaling.goal))
        assert slow * passed - 1e-9 <= ahead <= fast * passed + 1e-9


@given(scalings(), st.floats(0.0, 3000.0), st.floats(0.01, 5.0))
def test_the_rate_is_the_slope_and_changes_slowly(scaling, period, width):
    begin = scaling.period + period
    first, second = scaling.rate_at(begin), scaling.rate_at(begin + width)
    assert min(scaling.rate, scaling.goal) <= first <= max(scaling.rate, scaling.goal)
    assert abs(second - first) <= scaling.slope * width * (1 + 1e-6) + 1e-12
    slope = (scaling.at(begin + width) - scaling.at(begin)) / width
    assert min(first, second) - 1e-6 <= slope <= max(first, second) + 1e-6
    # It arrives, and stays there.
    end = scaling.period + abs(scaling.goal - scaling.rate) / scaling.slope
    assert scaling.rate_at(end + 1.0) == scaling.goal
    assert scaling.at(end + 11.0) - scaling.at(end + 1.0) == pytest.approx(10.0 * scaling.goal, abs=1e-8)


@given(scalings(), PERIODS)
def test_the_period_of_a_target_is_the_inverse(scaling, period):
    begin = scaling.period + period
    index = scaling.at(begin)
    found = scaling.period_of(index)
    if scaling.rate_at(begin) > 1e-3:
        assert found == pytest.approx(begin, abs=1e-5)
    else:  # many periods share it, nearly
        assert scaling.at(found) == pytest.approx(index, abs=1e-6)


@example(TimeScaling(65478.0, 0.0, 0.47050340054328077, 0.0, 0.008), 1.0)
@example(TimeScaling(4041.0, 0.0, 0.4463786048942159, 0.0, 0.008), 1.0)
@given(scalings(), st.floats(1e-3, 1e4))
def test_a_target_that_never_comes_never_comes(scaling, ahead):
    scaling = replace(scaling, goal=0.0)
    end = scaling.at(scaling.period + scaling.rate / scaling.slope)
    assert scaling.period_of(end + ahead) == math.inf
    assert scaling.period_of(end) < math.inf
    assert scaling.period_of(scaling.at(scaling.period + 56.0)) < math.inf


def test_the_last_target_before_a_standstill_has_its_period():
    scaling = TimeScaling(0.0, 0.0, 1.0, 0.0, 0.25)
    assert scaling.at(4.0) == scaling.at(9.0) == 2.0
    assert scaling.period_of(2.0) == pytest.approx(4.0, abs=1e-6)
    assert scaling.period_of(2.5) == math.inf
    assert TimeScaling(3.0, 7.0, 0.0, 0.0).period_of(7.0) == 3.0


@given(scalings(), st.floats(0.0, 3000.0), RATES, st.sampled_from(TICKS_S))
def test_the_next_scaling_continues_the_last_one(scaling, period, goal, tick_s):
    begin = scaling.period + period
    after = scaling.towards(goal, begin, tick_s)
    assert after.at(begin) == scaling.at(begin)
    assert after.rate_at(begin) == scaling.rate_at(begin)
    assert after.goal == goal
    slope = (SLOWING_PER_S if goal < after.rate else SLOPE_PER_S) * tick_s
    assert after.slope == slope
    # In real time a rate of 1 takes a second.
    assert abs(after.rate_at(begin + 1.0) - after.rate_at(begin)) <= slope * (1 + 1e-9)
    assert after.rate_at(begin + 1.01 / tick_s) == goal


def test_a_slider_that_moves_leaves_the_targets_on_one_path():
    scaling, tick_s, index = TimeScaling(), 0.008, []
    for period in range(3000):
        if period % 60 == 0:
            goal = (period // 60 * 7 % 17) / 16
            scaling = scaling.towards(goal, period + 3.0, tick_s) if goal != scaling.goal else scaling
        # Both arms may ask at any time: three periods pass until it holds.
        index.append(scaling.at(float(period)))
    steps = [after - before for before, after in itertools.pairwise(index)]
    assert min(steps) >= -1e-3
    assert max(steps) <= 1.001


@given(RATES, RATES, RATES, st.floats(5.0, 200.0), st.sampled_from(TICKS_S), st.floats(0.0, 3.0))
def test_a_reader_of_the_next_scaling_gets_the_same_past(rate, goal, other, after, tick_s, back):
    """One arm may read the next scaling a period before the other one."""
    scaling = TimeScaling(7.0, 3.0, rate, rate).towards(goal, 100.0, tick_s)
    begin = 100.0 + after
    next_one = scaling.towards(other, begin, tick_s)
    # At the end of a change there is a bend in three periods.
    bend = (
        0.0
        if (abs(goal - rate) / scaling.slope > after or abs(goal - rate) / scaling.slope < after - 3.0)
        else 4.5 * scaling.slope
    )
    assert next_one.at(begin - back) == pytest.approx(scaling.at(begin - back), abs=1e-7 + bend)
    assert next_one.rate_at(begin - back) == pytest.approx(scaling.rate_at(begin - back), abs=1e-7 + bend)


@given(
    st.lists(st.tuples(st.integers(1, 40), RATES), max_size=30),
    st.sampled_from([(0.008, 3), (0.002, 12)]),
)
def test_a_scaling_that_may_change_leaves_all_readers_their_past(changes, tick):
    (tick_s, ahead), scaling, now = tick, TimeScaling(), 0
    for wait, goal in changes:
        for _ in range(wait):
            now += 1
            if goal == scaling.goal or not scaling.may_change(now - 1.0, max(now + ahead, scaling.period)):
                continue
            after = scaling.towards(goal, float(max(now + ahead, scaling.period)), tick_s)
            for period in np.linspace(now - 1.0, after.period, 9):
                assert after.at(period) == pytest.approx(scaling.at(period), abs=1e-7)
            scaling = after


@given(RATES, RATES, st.sampled_from([(0.008, 3), (0.002, 12)]))
def test_a_scaling_may_change_soon(goal, other, tick):
    """Nobody waits longer than for the beginning of the last change and its end."""
    tick_s, ahead = tick
    scaling = TimeScaling().towards(goal, float(ahead), tick_s)
    waits = [now for now in range(200) if not scaling.may_change(now - 1.0, float(now + ahead))]
    assert len(waits) <= 2 * (ahead + 2)


def test_a_later_scaling_does_not_change_a_delay():
    tick_s = 0.008
    slowing = TimeScaling().towards(0.0, 0.0, tick_s)
    going_on = slowing.towards(1.0, 30.0, tick_s)
    assert going_on.period_of(slowing.at(27.5)) == pytest.approx(27.5, abs=1e-4)
    assert going_on.period_of(0.0) == pytest.approx(0.0, abs=1e-3)
    assert going_on.period_of(-100.0) == pytest.approx(-100.0, abs=1e-3)


def test_sliders_are_rounded_down_to_a_step():
    assert scaling_from_slider(1.0) == scaling_from_slider(1.5) == 1.0
    assert scaling_from_slider(FULL) == scaling_from_slider(0.9995) == 1.0
    assert scaling_from_slider(0.99) == scaling_from_slider(math.nextafter(FULL, 0.0)) == 1.0 - STEP
    assert scaling_from_slider(0.5) == 0.5
    assert scaling_from_slider(0.3) == 0.25
    assert scaling_from_slider(STEP) == STEP
    assert scaling_from_slider(STEP * 0.99) == scaling_from_slider(0.0) == scaling_from_slider(-1.0) == 0.0
    for number in range(17):
        assert scaling_from_slider(number / 16) == number / 16


@pytest.mark.parametrize("slider", [math.nan, -math.inf])
def test_a_slider_that_is_no_number_is_not_full_speed(slider):
    assert scaling_from_slider(slider) == 0.0


@given(st.floats(0.0, 1.0))
def test_rounding_never_speeds_up(fraction):
    found = scaling_from_slider(fraction)
    assert fraction - STEP < found <= (fraction + 1e-9 if fraction < FULL else 1.0)
    assert (found / STEP).is_integer()


@pytest.mark.parametrize("full", [1.0, 0.5, 0.25])
def test_slow_arms_are_not_slowed_down_faster(full):
    """An arm at a quarter of its speed takes as long from all of it to half of it as one at full speed."""
    tick_s = 0.008
    down = TimeScaling(0.0, 0.0, full, full).towards(full / 2, 10.0, tick_s, full)
    up = TimeScaling(0.0, 0.0, full / 2, full / 2).towards(full, 10.0, tick_s, full)
    assert down.period_of(down.index) == 10.0
    assert (full - down.rate_at(11.0)) / tick_s == pytest.approx(SLOWING_PER_S * full)
    assert (up.rate_at(11.0) - full / 2) / tick_s == pytest.approx(SLOPE_PER_S * full)
