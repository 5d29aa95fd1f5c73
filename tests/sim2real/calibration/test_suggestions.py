"""Suggested observations: reachable, and better than others."""

import numpy as np
import pytest

from dual_ur10.errors import CalibrationError
from dual_ur10.sim2real.calibration.estimate import estimate
from dual_ur10.sim2real.calibration.suggestions import bar_candidates, best, plan, touch_candidates
from dual_ur10.sim2real.calibration.transforms import flange, transform
from tests.sim2real.calibration.cells import CANDIDATES, NEAR, NOISE, NOMINAL, PLANNED, TIP_M, shifted, touches
from tests.sim2real.calibration.simulated import bar_poses, held
from ur_core.kinematics.robots import robot_model
from ur_core.kinematics.ur10 import nominal_dh


def test_candidates_are_points_that_both_tips_reach():
    for each in CANDIDATES[::20]:
        left = flange(each.left_q_rad, NOMINAL[0]) @ [*each.left_tcp_m, 1.0]
        right = NEAR @ flange(each.right_q_rad, NOMINAL[1]) @ [*each.right_tcp_m, 1.0]
        np.testing.assert_allclose(left, right, atol=1e-6)
        assert left[0] < 0.0  # in front of the base, which is -x of `base`
        assert left[2] > 0.05


@pytest.mark.parametrize(("model", "least"), [("ur3e", 200), ("ur5e", 400), ("ur20", 400)])
def test_candidates_fill_the_reach_of_the_model(model, least):
    dh, base = (nominal_dh(model),) * 2, NEAR.copy()
    reach_m = robot_model(model).reach_m
    base[:3, 3] *= reach_m / robot_model("ur10").reach_m
    found = touch_candidates(dh, base, (TIP_M, TIP_M))
    assert len(found) > least
    flanges = flange([each.left_q_rad for each in found], dh[0])
    assert np.linalg.norm(flanges[:, :3, 3], axis=1).max() > 0.8 * reach_m


def test_planned_touches_are_better_than_random_ones():
    rng = np.random.default_rng(0)
    planned = estimate(touches(shifted(), rng), NOMINAL, NEAR)
    for _ in range(5):
        chosen = [CANDIDATES[k] for k in rng.choice(len(CANDIDATES), 8, replace=False)]
        found = estimate(touches(shifted(), rng, chosen), NOMINAL, NEAR)
        trace = [np.linalg.inv(each.information).trace() for each in (planned, found)]
        assert trace[0] < trace[1]


def test_a_suggestion_improves_what_is_known_least():
    rng = np.random.default_rng(1)
    close = [each for each in CANDIDATES if abs(each.left_q_rad[0] - CANDIDATES[50].left_q_rad[0]) < 0.3][:6]
    found = estimate(touches(shifted(), rng, close), NOMINAL, NEAR)
    suggested = best(CANDIDATES, NOMINAL, NEAR, estimate=found)
    assert "touch the point" in suggested.text
    better = estimate(touches(shifted(), rng, [*close, suggested.observation]), NOMINAL, NEAR)
    assert better.weakest.sigma_m < 0.7 * found.weakest.sigma_m
    assert suggested.expected_m < np.sqrt(np.linalg.inv(found.information).trace())


def test_without_an_estimate_the_touches_so_far_count():
    first = best(CANDIDATES, NOMINAL, NEAR)
    second = best(CANDIDATES, NOMINAL, NEAR, observed=[first.observation])
    assert second.observation != first.observation
    assert [each.observation for each in plan(2, CANDIDATES, NOMINAL, NEAR)] == [first.observation, second.observation]
    assert second.observation == PLANNED[1]


def test_a_bar_is_suggested_where_both_hands_reach():
    rng = np.random.default_rng(2)
    base = shifted()
    observed = bar_poses(8, NOMINAL, base, NOISE, rng, angle_rad=0.2)
    found = estimate(observed, NOMINAL, NEAR)
    candidates = bar_candidates(NOMINAL, found, observed)
    assert len(candidates) > 10
    suggested = best(candidates, NOMINAL, NEAR, estimate=found)
    assert "rotation vector" in suggested.text
    after = estimate([*observed, suggested.observation], NOMINAL, NEAR)
    assert np.linalg.inv(after.information).trace() < np.linalg.inv(found.information).trace()


def test_suggested_poses_of_a_bar_tell_more_than_random_ones():
    rng, base = np.random.default_rng(4), shifted()
    poses = bar_poses(4, NOMINAL, base, NOISE, rng, angle_rad=0.3)
    while len(poses) < 8:
        found = estimate(poses, NOMINAL, NEAR)
        candidates = bar_candidates(NOMINAL, found, poses)
        joints = np.array([(*each.left_q_rad, *each.right_q_rad) for each in candidates])
        assert np.ptp(joints, axis=0).max() < 3.0  # without letting go of the bar
        suggested = best(candidates, NOMINAL, NEAR, NOISE, estimate=found)
        poses.append(held(suggested.observation, NOMINAL, base, NOISE, rng))
    found = estimate(poses, NOMINAL, NEAR)
    assert np.linalg.norm(found.position_m - base[:3, 3]) < 3 * suggested.expected_m
    random = estimate(bar_poses(8, NOMINAL, base, NOISE, rng), NOMINAL, NEAR)
    traces = [np.linalg.inv(each.information).trace() for each in (found, random)]
    assert traces[0] < 0.75 * traces[1]


def test_bases_too_far_apart_have_no_candidates():
    far = transform((0.0, 3.0, 0.0), np.eye(3))
    assert touch_candidates(NOMINAL, far, (TIP_M, TIP_M)) == []
    with pytest.raises(CalibrationError, match="reach only 0 points"):
        plan(8, [], NOMINAL, far)
    with pytest.raises(CalibrationError, match="reach none"):
        best([], NOMINAL, far)
