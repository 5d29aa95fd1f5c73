"""Two arms keep in step although their controllers' clocks do not."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from dual_ur10.sim2real.links.controller_clock import APART_S, DriftCompensation

TICK_S = 0.008
BACK_S = 0.0005
MOST = 1e-3


@given(st.floats(-1e6, 1e6), st.lists(st.floats(-0.999, 0.999), max_size=60))
def test_within_two_milliseconds_nothing_is_ever_shifted(offset_s, parts):
    drift = DriftCompensation(TICK_S, offset_s)
    assert [drift(offset_s + part * APART_S) for part in parts] == [0.0] * len(parts)


@pytest.mark.parametrize("tick_s", [0.008, 0.002])
@pytest.mark.parametrize("off_s", [-0.05, -0.0021, 0.0021, 0.004, 0.05])
def test_a_step_is_made_good_slowly_and_then_nothing_moves_any_more(tick_s, off_s):
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
    # Where it is nearly right again, it starts anew only beyond the first bound.
    assert drift(10.0 + off_s * (1 - 1e-9) + np.sign(off_s) * (APART_S - 2 * BACK_S)) == shifts[-1]


def test_a_bound_holds_per_period_however_many_have_passed():
    drift = DriftCompensation(TICK_S, 0.0)
    assert drift(0.1, 7) == pytest.approx(7 * MOST)
    assert drift(0.1) == pytest.approx(8 * MOST)
    assert drift(-0.1, 3) == pytest.approx(5 * MOST)
    assert drift(0.0001, 1) == pytest.approx(5 * MOST)  # near what is right it stops


@given(st.lists(st.tuples(st.floats(-1.0, 1.0), st.integers(1, 12)), max_size=60))
def test_no_period_is_shifted_by_more(calls):
    drift, before = DriftCompensation(TICK_S, 0.3), 0.0
    for offset_s, periods in calls:
        shift = drift(0.3 + offset_s, periods)
        assert abs(shift - before) <= MOST * periods * (1 + 1e-9)
        before = shift


@pytest.mark.parametrize("ppm", [-100.0, 100.0, 20.0])
@pytest.mark.parametrize("tick_s", [0.008, 0.002])
def test_an_hour_on_a_clock_of_its_own(ppm, tick_s):
    """Of a controller whose time goes differently: its targets stay those of this machine's time."""
    drift, rng = DriftCompensation(tick_s, 5.0), np.random.default_rng(0)
    noise = rng.uniform(-0.0003, 0.0003, 1024)
    every = 20  # of the periods of an hour, for the sake of time: what it may do in them is given to it
    worst, shifted = 0.0, 0.0
    for k in range(0, round(3600.0 / tick_s), every):
        true_s = ppm * 1e-6 * k * tick_s
        shifted = drift(5.0 + true_s + noise[k // every % 1024], every)
        worst = max(worst, abs(shifted * tick_s - true_s))
    assert worst < APART_S + 0.0004
    assert abs(shifted * tick_s) == pytest.approx(abs(ppm) * 1e-6 * 3600.0, abs=0.0025)
