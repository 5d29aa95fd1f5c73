"""Targets of the stop ramp."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from dual_ur10.sim2real.runtime.arm_sender import STOP_RAD_S2, STOP_RAD_S3, StopRamp
from tests.soak import scaled

speeds = st.lists(st.floats(-2.5, 2.5), min_size=6, max_size=6)


def targets_of(speed, tick_s):
    start = np.array([np.zeros(6), np.asarray(speed) * tick_s])
    ramp, targets = StopRamp(start, tick_s), [*start]
    for _ in range(round(3.0 / tick_s)):
        targets.append(ramp())
        if ramp.at_rest:
            break
    assert ramp.at_rest
    return np.array(targets)


@settings(max_examples=scaled(300, 3))
@given(speeds, st.sampled_from([0.008, 0.002]))
def test_a_ramp_is_straight_and_within_its_limits(speed, tick_s):
    targets = targets_of(speed, tick_s)
    rates = np.diff(targets, axis=0) / tick_s
    slowing = -np.diff(np.abs(rates).max(axis=1)) / tick_s
    assert (np.abs(rates) <= np.abs(rates[0]) + 1e-9).all()  # never faster
    assert (slowing <= STOP_RAD_S2 + 1e-6).all()
    assert (np.diff(slowing) <= STOP_RAD_S3 * tick_s + 1e-6).all()
    top = np.abs(speed).max()
    if top > 1e-9:
        assert np.allclose(rates / top, np.outer(np.abs(rates).max(axis=1) / top, np.asarray(speed) / top), atol=1e-9)


@pytest.mark.parametrize("tick_s", [0.008, 0.002])
def test_half_a_radian_per_second_takes_no_longer_than_promised(tick_s):
    targets = targets_of([0.5, 0, 0, 0, 0, 0], tick_s)
    assert (len(targets) - 2) * tick_s <= 0.5 / STOP_RAD_S2 + STOP_RAD_S2 / STOP_RAD_S3 + 3 * 0.008
    assert targets[-1][0] - targets[1][0] <= 0.05


def test_an_arm_at_rest_stays():
    ramp = StopRamp(np.ones((2, 6)), 0.008)
    assert ramp.at_rest
    assert np.array_equal(ramp(), np.ones(6))
