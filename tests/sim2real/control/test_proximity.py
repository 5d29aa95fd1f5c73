"""Proximity scaling: its law, and paths into obstacles in real time, without processes."""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from dual_ur10.assets.settings import HOME_Q_RAD, Equipment, SceneSettings
from dual_ur10.sim2real.control.adapter import ServojAdapter
from dual_ur10.sim2real.control.clearance import MINIMUM_M, Clearance
from dual_ur10.sim2real.control.gate import SafetyGate, Verdict
from dual_ur10.sim2real.control.pipeline import ServojPipeline
from dual_ur10.sim2real.control.proximity import (
    LEAST_SCALING,
    LEAST_SPEED_M_S,
    NEAR_M,
    NEAR_SPEED_M_S,
    ProximityScaling,
    proximity_scaling,
)
from dual_ur10.sim2real.control.time_scaling import STEP, TimeScaling, interpolate
from tests.sim2real.control.motion_checks import HARD, adversarial_action
from ur_core.kinematics.ur10 import NOMINAL_DH
from ur_core.servoj import ServojProfile
from ur_core.types import Array

SPARE = st.floats(-0.05, 0.2)
SPEED = st.floats(-2.0, 2.0)
_AHEAD_S = 0.024  # of the supervisor
_RESTING_S = 1.2  # of windows, after which the brake is over
_MOST_WINDOWS = 3000


def make_pipeline(
    profile: ServojProfile,
    ticks: int,
    proximity: Callable[[Clearance, float], ProximityScaling] | None = None,
    factor: float = 1.0,
) -> ServojPipeline:
    clearance = Clearance(SceneSettings())
    adapter = ServojAdapter(profile, HARD, ticks, dh=[NOMINAL_DH] * 2, speed_factor=factor)
    gate = SafetyGate(HARD, profile.tick_s, ticks, clearance)
    made = None if proximity is None else proximity(clearance, adapter.period_s)
    pipeline = ServojPipeline(adapter, gate, held=None, leads=False, proximity=made)
    pipeline.reset(HOME_Q_RAD[None])
    return pipeline


def towards(*moves: tuple[int, int, float]) -> Callable[[int], Array]:
    """Return a policy that rotates joints, given as arm, joint and rad/s."""
    action = np.zeros((1, 2, 6))
    for arm, joint, speed in moves:
        action[0, arm, joint] = speed / HARD.speed_rad_s[joint]
    return lambda window: action


SELF = towards((1, 2, 0.5), (1, 1, -0.25))
ARMS = towards((0, 0, -0.5), (1, 0, 0.5))
TABLE = towards((0, 1, 0.5))


# ------------------------------------------------------------------------------------------------ the law


def law(spare_m: float, speed_m_s: float) -> float:
    return proximity_scaling(np.array([[spare_m]]), np.array([[speed_m_s]]))


@given(SPARE, SPEED)
def test_the_scaling_is_bounded_and_keeps_the_speed_of_approach(spare, speed):
    scaling = law(spare, speed)
    assert LEAST_SCALING <= scaling <= 1.0
    if spare >= NEAR_M - MINIMUM_M or speed <= 0.0:
        assert scaling == 1.0
    elif scaling > LEAST_SCALING:
        assert scaling * speed <= NEAR_SPEED_M_S + 1e-12


@given(SPARE, SPARE, SPEED)
def test_less_distance_is_never_faster(one, other, speed):
    near, far = sorted((one, other))
    assert law(near, speed) <= law(far, speed)


@given(SPARE, SPEED, SPEED)
def test_a_faster_approach_is_never_slowed_down_less(spare, one, other):
    slow, fast = sorted((one, other))
    assert law(spare, fast) <= law(spare, slow)


@given(st.lists(st.tuples(SPARE, SPEED), min_size=1, max_size=6))
def test_the_pair_with_the_least_scaling_counts(pairs):
    spare, speed = np.array(pairs).T
    assert proximity_scaling(spare, speed) == min(law(*each) for each in pairs)


def test_the_law_at_its_ends():
    edge = math.nextafter(NEAR_M - MINIMUM_M, 0.0)
    assert law(NEAR_M - MINIMUM_M, 1.5) == 1.0
    assert law(edge, 0.5) == pytest.approx(NEAR_SPEED_M_S / 0.5)
    assert law(edge, NEAR_SPEED_M_S * 0.999) == 1.0
    assert law(0.0, 0.1) == pytest.approx(LEAST_SPEED_M_S / 0.1)
    assert law(0.0, LEAST_SPEED_M_S) == law(-0.01, LEAST_SPEED_M_S) == 1.0
    assert law(0.0, 1.5) == LEAST_SCALING


class Line:
    """Stub of `Clearance`: two bodies at the same distance along the first joint, one of them exempt."""

    exempt = np.array([True, False])

    def __init__(self, exempt_m: float = 1.0) -> None:
        self.exempt_m = exempt_m

    def spare_m(self, q_rad: Array) -> Array:
        return np.stack([q_rad[:, 0] * self.exempt_m, q_rad[:, 0]], axis=1)


def at(x_m: float) -> Array:
    return np.array([x_m, *np.zeros(11)])


def test_scalings_are_steps_and_begin_at_full_speed():
    scaling = ProximityScaling(Line(), 0.04)
    far = np.ones(2)
    scaling.reset(at(0.02))
    assert scaling(at(0.02), far) == 1.0
    found = scaling(at(0.01), far)  # 0.25 m/s
    assert found == int((LEAST_SPEED_M_S + (NEAR_SPEED_M_S - LEAST_SPEED_M_S) / 3) / 0.25 / STEP) * STEP < 1.0
    assert scaling(at(0.02), far) == 1.0  # apart
    scaling.reset(at(0.0))
    assert scaling(at(0.0), far) == 1.0
    scaling.reset(at(0.02))
    assert scaling(at(0.01), far) == found


def test_the_end_of_the_brake_counts_as_the_newest_target_does():
    scaling = ProximityScaling(Line(), 0.04)
    scaling.reset(at(1.0))
    assert scaling(at(1.0), np.array([1.0, 0.05])) == 1.0
    assert scaling(at(1.0), np.array([1.0, 0.01])) == LEAST_SCALING


def test_pairs_that_meet_on_purpose_slow_nothing_down():
    line = Line(0.0)  # it is at its smallest legal distance all the time
    scaling = ProximityScaling(line, 0.04)
    scaling.reset(at(0.5))
    assert scaling(at(0.5), np.array([0.03, 1.0])) == 1.0
    line.exempt_m = -0.1
    assert scaling(at(0.4), np.array([0.0, 1.0])) == 1.0


def test_the_exempt_pairs_of_a_clearance_are_those_that_a_task_names():
    pair = ("left/fingers", "table")
    clearance = Clearance(SceneSettings(equipment=Equipment(grippers=True)), closer={pair: 0.02})
    assert [name for name, exempt in zip(clearance.pairs, clearance.exempt, strict=True) if exempt] == [pair]


class Falling:
    """Stub of `ProximityScaling`: less with each window."""

    def __init__(self) -> None:
        self.found: list[float] = []
        self.begun: list[Array] = []

    def reset(self, q_rad: Array) -> None:
        self.begun.append(q_rad)

    def __call__(self, q_rad: Array, rest_spare_m: Array) -> float:
        self.found.append(1.0 / (2 + len(self.found)))
        return self.found[-1]


def test_the_brake_keeps_the_scaling_of_the_last_released_window():
    stub = Falling()
    pipeline = make_pipeline(ServojProfile(), 5, lambda clearance, period_s: stub)
    np.testing.assert_array_equal(stub.begun, [HOME_Q_RAD.reshape(12)])
    commands = [pipeline(TABLE(0)) for _ in range(100)]
    released = sum(not verdicts for _, verdicts in commands)
    assert 10 < released < 90
    scalings = [command.scaling for command, _ in commands]
    assert scalings == stub.found + [stub.found[-1]] * (100 - released)


def test_a_pipeline_without_it_slows_nothing_down():
    pipeline = make_pipeline(ServojProfile(), 5)
    assert {pipeline(TABLE(0))[0].scaling for _ in range(100)} == {1.0}


# ------------------------------------------------------------------------------------------------ in real time


@dataclass
class Played:
    """Motion of both arms in real time.

    Attributes:
        released_rad: (k, 12) targets as the gate released them.
        sent_rad: (periods, 12) targets of the control periods.
        rate: (periods,) targets per control period.
        window: (periods,) window that had been made last.
        verdict: Verdict of the gate, if it refused one.
    """

    released_rad: Array
    sent_rad: Array
    rate: Array
    window: Array
    verdict: Verdict | None


def play(
    policy: Callable[[int], Array],
    *,
    slows: bool = True,
    family: str = "cb3",
    ticks: int = 5,
    latency: int = 5,
    factor: float = 1.0,
    most: int = _MOST_WINDOWS,
) -> Played:
    """Play a policy until the arms rest, with the latencies of program, supervisor and arms."""
    profile = ServojProfile(family=family)
    pipeline = make_pipeline(profile, ticks, ProximityScaling if slows else None, factor)
    released = [HOME_Q_RAD.reshape(12)] * latency
    scaling, allowed, verdict, windows, left = TimeScaling(0.0, 0.0, factor, factor), 1.0, None, 0, most
    sent, rate, window = [], [], []
    for period in itertools.count():
        now = float(period)
        goal = min(factor, allowed)
        begin = max(float(int(now + _AHEAD_S / profile.tick_s)), scaling.period)
        if goal != scaling.goal and scaling.may_change(now - 1.0, begin):
            scaling = scaling.towards(goal, begin, profile.tick_s, factor)
        index = scaling.at(now)
        if index >= windows * ticks:
            if not left:
                break
            command, verdicts = pipeline(policy(windows))
            released.extend(command.targets_rad[0].reshape(-1, 12))
            allowed, windows, left = command.scaling, windows + 1, left - 1
            if verdicts and verdict is None:
                verdict, left = verdicts[0], math.ceil(_RESTING_S / pipeline.adapter.period_s)
        below = int(index)
        points = [released[min(max(below + k, 0), len(released) - 1)] for k in (-1, 0, 1, 2)]
        sent.append(interpolate(*points, index - below))
        rate.append(scaling.rate_at(now))
        window.append(windows)
    return Played(np.array(released), np.array(sent), np.array(rate), np.array(window), verdict)


def closing(played: Played, family: str) -> tuple[Array, Array]:
    """Return the distance of the pair that the gate found and its speed of approach, (periods - 1,) each."""
    assert played.verdict is not None
    clearance = Clearance(SceneSettings())
    pair = [" and ".join(each) for each in clearance.pairs].index(played.verdict.subject)
    distance = np.array([clearance.measure(q[None]).distances_m[0, pair] for q in played.sent_rad])
    return distance[1:], -np.diff(distance) / ServojProfile(family=family).tick_s


@pytest.mark.parametrize(
    ("policy", "family", "ticks", "latency"),
    [
        pytest.param(SELF, "cb3", 5, 5, id="48-self"),
        pytest.param(SELF, "cb3", 10, 16, id="48-self-late"),
        pytest.param(SELF, "e-series", 20, 13, id="48-self-e-series"),
        pytest.param(ARMS, "cb3", 5, 3, id="49-arms"),
        pytest.param(ARMS, "cb3", 1, 3, id="49-arms-125-hz"),
        pytest.param(ARMS, "e-series", 5, 32, id="49-arms-e-series"),
        pytest.param(TABLE, "cb3", 5, 5, id="50-table"),
    ],
)
def test_48_49_50_an_approach_slows_down_from_50_mm_on_and_stops_at_20(policy, family, ticks, latency):
    slow, fast = (play(policy, slows=slows, family=family, ticks=ticks, latency=latency) for slows in (True, False))
    np.testing.assert_array_equal(slow.released_rad[: len(fast.released_rad)], fast.released_rad)  # the same path
    assert fast.rate.min() == 1.0
    assert LEAST_SCALING <= slow.rate.min() < 0.4
    for played in (slow, fast):
        assert np.abs(np.diff(played.sent_rad[-3:], axis=0)).max() < 1e-6  # at rest
    distance, speed = closing(slow, family)
    before, speed_before = closing(fast, family)
    assert distance.min() >= MINIMUM_M - 1e-6
    assert distance.min() == pytest.approx(before.min(), abs=2e-4)
    near = distance < NEAR_M
    allowed = LEAST_SPEED_M_S + (distance - MINIMUM_M) / (NEAR_M - MINIMUM_M) * (NEAR_SPEED_M_S - LEAST_SPEED_M_S)
    assert (speed[near] <= allowed[near]).all()
    # The gate's brake alone is two to ten times as fast.
    assert speed[near].max() <= 0.5 * speed_before[before < NEAR_M].max()


def test_arms_that_are_slow_already_are_not_slowed_down_more():
    assert play(ARMS, factor=0.125).rate.min() == 0.125


def test_a_retreat_is_fast_again_within_a_second():
    def policy(window):
        return (1.0 if window < turn else -1.0) * TABLE(window)

    turn = _MOST_WINDOWS
    found = play(policy).verdict
    assert found is not None
    turn = found.tick // 5 - 1  # the window before the gate brakes
    played = play(policy, most=turn + 40)
    assert played.verdict is None
    slowest = int(played.rate.argmin())
    assert played.rate[slowest] < 0.9
    assert played.window[slowest] <= turn + 2
    after = played.rate[slowest : slowest + round(1.0 / 0.008)]
    assert (np.diff(after) >= 0.0).all()
    assert after[-1] == 1.0


@pytest.mark.parametrize(("family", "ticks", "latency"), [("cb3", 5, 5), ("cb3", 1, 3), ("e-series", 5, 13)])
@pytest.mark.parametrize("seed", range(4))
def test_no_policy_accelerates_the_arms_beyond_the_limits(family, ticks, latency, seed):
    rng = np.random.default_rng(seed)
    kind = ("random", "sine", "steps", "constant")[seed]
    bias = 0.4 * (ARMS if seed % 2 else SELF)(0) / 0.3

    def policy(window):
        return bias + 0.3 * adversarial_action(kind, window * ticks // 5, rng, (1, 2, 6))

    played = play(policy, family=family, ticks=ticks, latency=latency, most=400)
    tick_s = ServojProfile(family=family).tick_s
    speed = np.diff(played.sent_rad, axis=0) / tick_s
    acceleration = np.diff(speed, axis=0) / tick_s
    # docs/explanation/safety.md
    assert (np.abs(acceleration) <= 1.05 * HARD.acceleration_rad_s2 + 4.0 * np.abs(speed[1:])).all()
    assert (np.abs(speed) <= 1.05 * np.tile(HARD.speed_rad_s, 2)).all()
    assert (np.diff(played.rate) >= -4.0 * tick_s - 1e-9).all()
    assert (np.diff(played.rate) <= 1.0 * tick_s + 1e-9).all()
