"""Legal ranges and rates of the servoj profile, and the law against matrix exponentials and closed forms."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.linalg import expm

from ur_core.errors import RateError, SettingsError, UnknownNameError
from ur_core.servoj import ServojLaw, ServojProfile

# Under-, critically and over-damped; the second is exactly critical.
LAWS = ((0.03, 2000.0), (0.04, 2500.0), (0.2, 100.0), (0.2, 2000.0), (0.1, 300.0), (0.03, 100.0))


def law_matrix(lookahead_s: float, gain: float) -> np.ndarray:
    return np.array([[0.0, 1.0], [-gain, -gain * lookahead_s]])


@pytest.mark.parametrize(("family", "tick_s"), [("cb3", 0.008), ("e-series", 0.002)])
def test_each_family_has_its_tick(family: str, tick_s: float) -> None:
    assert ServojProfile(family=family).tick_s == tick_s


@pytest.mark.parametrize("lookahead_s", [0.03, 0.2])
@pytest.mark.parametrize("gain", [100.0, 2000.0])
def test_the_ends_of_the_ranges_are_legal(lookahead_s: float, gain: float) -> None:
    ServojProfile(lookahead_s=lookahead_s, gain=gain)


@pytest.mark.parametrize(
    ("name", "value", "allowed"),
    [
        ("lookahead_s", 0.0299, "0.03 to 0.2"),
        ("lookahead_s", 0.201, "0.03 to 0.2"),
        ("lookahead_s", float("nan"), "0.03 to 0.2"),
        ("gain", 99.9, "100.0 to 2000.0"),
        ("gain", 2000.1, "100.0 to 2000.0"),
        ("gain", float("inf"), "100.0 to 2000.0"),
    ],
)
def test_values_out_of_range_are_refused_by_name(name: str, value: float, allowed: str) -> None:
    with pytest.raises(SettingsError, match=name) as caught:
        ServojProfile(**{name: value})
    assert allowed in str(caught.value)


def test_an_unknown_family_is_refused_with_the_known_ones() -> None:
    with pytest.raises(UnknownNameError, match="'cb3', 'e-series'"):
        ServojProfile(family="ur10e")  # type: ignore[arg-type]


@pytest.mark.parametrize(
    ("family", "rate_hz", "ticks"),
    [("cb3", 25, 5), ("cb3", 125, 1), ("cb3", 5, 25), ("cb3", 125 / 7, 7), ("e-series", 500, 1), ("e-series", 25, 20)],
)
def test_a_legal_rate_is_a_whole_number_of_ticks(family: str, rate_hz: float, ticks: int) -> None:
    assert ServojProfile(family=family).ticks_per_action(rate_hz) == ticks


def test_an_impossible_rate_names_both_neighbours() -> None:
    with pytest.raises(RateError, match="30 Hz") as caught:
        ServojProfile().ticks_per_action(30)
    assert "25 Hz (5 ticks)" in str(caught.value)
    assert "31.25 Hz (4 ticks)" in str(caught.value)


def test_the_named_neighbours_are_legal() -> None:
    profile = ServojProfile(family="e-series")
    with pytest.raises(RateError):
        profile.ticks_per_action(300)
    assert (profile.ticks_per_action(250), profile.ticks_per_action(500)) == (2, 1)


@pytest.mark.parametrize("rate_hz", [0.0, -25.0, 126.0, float("nan"), float("inf")])
def test_a_rate_beyond_the_controllers_is_refused(rate_hz: float) -> None:
    with pytest.raises(RateError, match=r"0\.5 to 125 Hz"):
        ServojProfile().ticks_per_action(rate_hz)


@pytest.mark.parametrize(("lookahead_s", "gain"), LAWS)
@pytest.mark.parametrize("dt_s", [0.0005, 0.002, 0.008, 0.1])
def test_the_transition_is_the_matrix_exponential(lookahead_s: float, gain: float, dt_s: float) -> None:
    expected = expm(law_matrix(lookahead_s, gain) * dt_s)
    np.testing.assert_allclose(ServojLaw(lookahead_s, gain).transition(dt_s), expected, rtol=1e-9, atol=1e-12)


@pytest.mark.parametrize("hold", [1, 3, 4])
def test_the_response_is_the_law_with_each_target_held(hold: int) -> None:
    law, rng, steps, dt_s = ServojLaw(0.05, 700.0), np.random.default_rng(0), 10, 0.002
    rows = law.response(dt_s, steps, hold)
    assert rows.shape == (steps, 2, 2 + -(-steps // hold))
    start, targets = rng.normal(size=2), rng.normal(size=rows.shape[2] - 2)
    transition, state = expm(law_matrix(0.05, 700.0) * dt_s), start.copy()
    for step in range(steps):
        offset = np.array([targets[step // hold], 0.0])
        state = offset + transition @ (state - offset)
        np.testing.assert_allclose(rows[step] @ np.concatenate([start, targets]), state, rtol=1e-11, atol=1e-12)


def test_a_constant_target_is_reached_and_held() -> None:
    row = ServojLaw(0.03, 2000.0).response(0.008, 200, 1)[-1]
    assert row[0] @ np.concatenate([[0.3, -2.0], np.full(200, 0.7)]) == pytest.approx(0.7, abs=1e-12)
    assert row[1] @ np.concatenate([[0.3, -2.0], np.full(200, 0.7)]) == pytest.approx(0.0, abs=1e-10)


@pytest.mark.parametrize(
    ("lookahead_s", "gain", "tick_s", "lag_ms"),
    [(0.03, 2000.0, 0.008, 34.0), (0.03, 2000.0, 0.002, 31.0), (0.1, 300.0, 0.008, 104.0)],
)
def test_the_law_lags_a_sine_as_measured_on_real_arms(
    lookahead_s: float, gain: float, tick_s: float, lag_ms: float
) -> None:
    omega, steps = 2 * np.pi * 0.5, round(8.0 / tick_s)
    transition, state, position = ServojLaw(lookahead_s, gain).transition(tick_s), np.zeros(2), []
    for step in range(steps):
        offset = np.array([0.25 * np.sin(omega * step * tick_s), 0.0])
        state = offset + transition @ (state - offset)
        position.append(state[0])
    times = (np.arange(steps) + 1) * tick_s
    late = times > 4.0  # the start has died away, and two whole periods are left
    phase = np.angle(np.sum(np.array(position)[late] * np.exp(-1j * omega * times[late]))) + np.pi / 2
    assert -phase / omega * 1e3 == pytest.approx(lag_ms, abs=1.0)
