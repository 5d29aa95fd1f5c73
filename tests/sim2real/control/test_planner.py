"""Collision-free paths in joint space."""

from __future__ import annotations

import itertools

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from dual_ur10.assets.obstacles import Box
from dual_ur10.assets.props import BAR
from dual_ur10.assets.settings import HOME_Q_RAD, Equipment, SceneSettings
from dual_ur10.errors import PlanningError
from dual_ur10.sim2real.control.clearance import Clearance
from dual_ur10.sim2real.control.gate import SafetyGate
from dual_ur10.sim2real.control.limits import MotionLimits
from dual_ur10.sim2real.control.planner import MARGIN_RAD, TOLERANCE_RAD, nearest_on_straight, plan_path
from dual_ur10.sim2real.runtime.approach import Approach, Rates, retreat_clearance
from tests.sim2real.control.motion_checks import AlwaysClear, Measured
from tests.soak import scaled
from ur_core.kernel import call

HOME = np.array(HOME_Q_RAD).reshape(12)
LIMITS = MotionLimits()
SCENES = {
    "bare": SceneSettings(),
    "pillar": SceneSettings(obstacles=(Box(name="pillar", position_m=(-0.3, 0.0, 0.4), size_m=(0.3, 0.3, 0.8)),)),
    "grippers and bar": SceneSettings(equipment=Equipment(grippers=True, props=(BAR,))),
}


@pytest.fixture(scope="module", params=SCENES)
def clearance(request):
    return Clearance(SCENES[request.param])


def free_pairs(clearance, count, rng):
    """Yield pairs of random free configurations, (2, 12), each joint within ±pi."""
    limit = np.tile(np.minimum(LIMITS.upper_rad, 3.1), 2)
    for _ in range(count):
        found = []
        while len(found) < 2:
            q = rng.uniform(-limit, limit, (100, 12))
            found += list(q[clearance.is_clear(q)])
        yield np.array(found[:2])


def along(path, step_rad=0.004):
    """Return configurations on all straight parts of a path."""
    return np.concatenate(
        [
            start + np.linspace(0.0, 1.0, 2 + int(np.abs(end - start).max() / step_rad))[:, None] * (end - start)
            for start, end in itertools.pairwise(path)
        ]
    )


def test_random_pairs_are_connected_by_paths_that_keep_the_margin(clearance):
    rng = np.random.default_rng(1)
    margin = MARGIN_RAD * clearance.kernel.values["levers"].sum(axis=1)
    for seed, (start, goal) in enumerate(free_pairs(clearance, scaled(400, 40), rng)):
        path = plan_path(clearance, start, goal, LIMITS, np.random.default_rng(seed))
        assert (path[[0, -1]] == [start, goal]).all()
        assert (np.abs(path) <= np.tile(LIMITS.upper_rad, 2)).all()
        if len(path) > 2:  # else both ends may be too near for it
            assert (clearance.spare_m(path[1:-1]) >= margin - 2e-6).all()
        # What is nearer than the margin is nearer at an end, but for the tolerance.
        spare = clearance.spare_m(along(path))
        ends = np.minimum(*clearance.spare_m(path[[0, -1]]))
        assert (spare >= np.minimum(ends, margin) - margin * TOLERANCE_RAD / MARGIN_RAD - 2e-6).all()


def test_a_slow_motion_along_each_path_passes_the_gate(clearance):
    rng = np.random.default_rng(2)
    for seed, (start, goal) in enumerate(free_pairs(clearance, scaled(60), rng)):
        path = plan_path(clearance, start, goal, LIMITS, np.random.default_rng(seed))
        targets = Approach(path, rates=Rates(acceleration_rad_s2=0.1, robots=LIMITS.robots)).targets(0.008)
        gate = SafetyGate(LIMITS, 0.008, 5, clearance)
        gate.reset(start.reshape(1, 2, 6))
        for window in targets[: len(targets) // 5 * 5].reshape(-1, 1, 5, 2, 6):
            assert not gate(window).verdicts


def test_the_same_generator_gives_the_same_path():
    rng, clearance = np.random.default_rng(3), Clearance(SCENES["pillar"])
    for start, goal in free_pairs(clearance, 5, rng):
        first, again, other = (
            plan_path(clearance, start, goal, LIMITS, np.random.default_rng(seed)) for seed in (1, 1, 2)
        )
        np.testing.assert_array_equal(first, again)
        assert len(first) < 4 or first.shape != other.shape or (first != other).any()


@pytest.mark.parametrize("arm", [0, 1])
def test_an_arm_that_has_to_stay_stays(clearance, arm):
    rng = np.random.default_rng(4)
    held = slice(6 - 6 * arm, 12 - 6 * arm)
    around = 0
    for start, goal in free_pairs(clearance, 10, rng):
        goal[held] = start[held]
        if clearance.is_clear(goal[None]).all():
            path = plan_path(clearance, start, goal, LIMITS, rng, arms=(("left", "right")[arm],))
            assert (path[:, held] == start[held]).all()
            around += len(path) > 2
    assert around


def test_arms_that_are_too_close_separate_first(clearance):
    """By the distances with which an approach passes the gate."""
    rng = np.random.default_rng(5)
    found = 0
    while found < 8:
        start = rng.uniform(-2.0, 2.0, 12)
        if not -0.03 < clearance.spare_m(start[None]).min() < 0.0:
            continue
        try:
            path = plan_path(clearance, start, HOME, LIMITS, rng)
        except PlanningError:
            continue  # what is inside something may find no way out
        spare = retreat_clearance(clearance, start.reshape(2, 6)).spare_m(along(path))
        assert spare.min() >= -5e-3
        assert clearance.spare_m(path[1:2]).min() >= -1e-6
        found += 1


class Terrain(Measured):
    """Distance that depends on the left base joint alone, by at most 1 m per rad.

    Args:
        heights_m: Distances at equal steps of the joint from 0 to 1 rad.
    """

    def __init__(self, heights_m):
        super().__init__(np.eye(12)[:1])
        self.heights_m = heights_m

    def spare_m(self, q_rad):
        return np.array([np.interp(q_rad[0], np.linspace(0.0, 1.0, len(self.heights_m)), self.heights_m)])


@st.composite
def terrains(draw):
    steps = draw(st.lists(st.floats(-1.0, 1.0), min_size=3, max_size=40))
    return draw(st.floats(-0.02, 0.1)) + np.append(0.0, np.cumsum(steps)) / len(steps)


@given(terrains(), st.floats(0.0, 0.05), st.floats(1e-3, 0.05))
@settings(deadline=None, max_examples=scaled(2000, 40))
def test_what_is_proven_clear_is_clear(heights_m, margin_m, tolerance_m):
    terrain, fractions = Terrain(heights_m), np.empty(2)
    path = np.zeros((2, 12))
    path[1, 0] = 1.0
    call("clear_fractions", terrain.kernel, path, np.array([margin_m]), np.array([tolerance_m]), fractions, 1)
    clear, kept = fractions
    at = np.linspace(0.0, 1.0, 2001)
    spare = np.interp(at, np.linspace(0.0, 1.0, len(heights_m)), heights_m)
    least = np.minimum(np.maximum.accumulate(spare), margin_m)  # nearer than this it must not come again
    good = spare >= least - 1e-6
    assert 0.0 <= kept <= clear <= 1.0
    assert (spare >= least - tolerance_m - 2e-6)[at <= clear].all()
    if good.all():
        assert clear == 1.0
    if kept > 0.0:
        assert np.interp(kept, np.linspace(0.0, 1.0, len(heights_m)), heights_m) >= margin_m - 2e-6
    if clear == 1.0 and heights_m[-1] >= margin_m:
        assert kept == 1.0


# Refusals.


def test_a_goal_that_is_too_close_is_refused():
    clearance, goal = Clearance(SceneSettings()), HOME.copy()
    goal[1] = -0.5
    with pytest.raises(PlanningError, match=r"in the goal left/.* would be -?\d+\.\d mm apart, allowed are 20\.0 mm"):
        plan_path(clearance, HOME, goal, LIMITS, np.random.default_rng(0))


@pytest.mark.parametrize("value", [np.nan, np.inf, 6.4, -6.4])
@pytest.mark.parametrize("end", ["start", "goal"])
def test_an_end_outside_the_joint_range_is_refused(value, end):
    ends = {"start": HOME.copy(), "goal": HOME.copy()}
    ends[end][9] = value
    with pytest.raises(PlanningError, match=rf"{end}: right/wrist_1_joint is at .*, allowed are -6\.283 to 6\.283"):
        plan_path(AlwaysClear(), ends["start"], ends["goal"], LIMITS, np.random.default_rng(0))


def test_a_goal_of_an_arm_that_stays_is_refused():
    with pytest.raises(PlanningError, match=r"the right arm has to stay, but the goal differs in shoulder_lift_joint"):
        plan_path(AlwaysClear(), HOME, HOME + np.eye(12)[7] * 0.1, LIMITS, np.random.default_rng(0), arms=("left",))


def test_without_a_path_the_pair_in_the_way_is_named():
    wall = Terrain([0.4, 0.2, -0.1, 0.2, 0.4])
    goal = np.eye(12)[0]
    with pytest.raises(
        PlanningError, match=r"with 40 samples: \d+ .* reached from the start, and \d+ from the goal"
    ) as e:
        plan_path(wall, np.zeros(12), goal, LIMITS, np.random.default_rng(0), iterations=40)
    assert nearest_on_straight(wall, np.zeros(12), goal) in str(e.value)
    assert "pair 0 would come within -80 mm, allowed are 20 mm" in str(e.value)


def test_what_measuring_raises_is_raised():
    class Broken(AlwaysClear):
        def _measure(self, q_rad, spare_m):
            raise ZeroDivisionError

    with pytest.raises(ZeroDivisionError):
        plan_path(Broken(), HOME, HOME + 0.1, LIMITS, np.random.default_rng(0))
