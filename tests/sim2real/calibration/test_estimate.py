"""Estimates of the right base: accuracy, intervals, outliers, and observations that do not determine it."""

import dataclasses
import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from dual_ur10.errors import CalibrationError
from dual_ur10.sim2real.calibration.estimate import BaseEstimate, estimate
from dual_ur10.sim2real.calibration.observations import BarPose, BoardView, Noise, Touch
from dual_ur10.sim2real.calibration.transforms import flange, inverse_of, right_in_left, rotation_of, transform
from tests.sim2real.calibration.cells import CANDIDATES, MOUNTS, NEAR, NOISE, NOMINAL, error_of, shifted, touches
from tests.sim2real.calibration.simulated import bar_poses, board_views, random_dh
from tests.soak import scaled
from ur_core.kinematics.frames import ArmMount
from ur_core.kinematics.ur10 import NOMINAL_DH

EXACT = Noise(1e-9, 1e-9, 1e-9, 1e-9, 1e-9)


def test_exact_touches_give_the_exact_base_of_arms_as_built():
    rng = np.random.default_rng(1)
    base, arms = shifted(rotation_rad=(0.01, -0.02, 0.3)), (random_dh(rng), random_dh(rng))
    found = estimate(touches(base, rng, dh=arms, noise=EXACT), arms, NEAR)
    assert error_of(found, base) == pytest.approx((0.0, 0.0), abs=1e-4)


def test_an_exact_bar_gives_the_exact_base_and_its_length():
    rng = np.random.default_rng(2)
    base, arms = shifted(), (random_dh(rng), random_dh(rng))
    found = estimate(bar_poses(6, arms, base, EXACT, rng), arms, NEAR)
    assert error_of(found, base) == pytest.approx((0.0, 0.0), abs=1e-3)
    (between,) = found.constants.values()
    assert np.linalg.norm(between[:3, 3]) == pytest.approx(1.0, abs=1e-6)


def fixed_views(base, rng, camera_on):
    """Return views in which one part stands in the surroundings and the other part is on each arm in turn."""
    still, carried = transform((-0.7, 0.6, 1.2), rotation_of((2.8, 0.1, 0.2))), transform((0.02, 0.01, 0.1), np.eye(3))
    views = []
    for each in bar_poses(8, NOMINAL, base, NOISE, rng):
        for arm, q, frame in (("left", each.left_q_rad, np.eye(4)), ("right", each.right_q_rad, base)):
            moving = frame @ flange(q, NOMINAL[0]) @ carried
            seen = inverse_of(still) @ moving if camera_on == "fixed" else inverse_of(moving) @ still
            joints = (q, None) if arm == "left" else (None, q)
            pose = (tuple(seen[:3, 3]), tuple(rotation_vector(seen)))
            views.append(
                BoardView(
                    "fixed" if camera_on == "fixed" else arm, arm if camera_on == "fixed" else "fixed", *joints, *pose
                )
            )
    return views


def rotation_vector(pose):
    from dual_ur10.sim2real.calibration.transforms import rotvec_of

    return rotvec_of(pose[:3, :3])


@pytest.mark.parametrize("camera_on", ["fixed", "arms"])
def test_a_fixed_camera_or_board_relates_the_arms(camera_on):
    base = shifted()
    found = estimate(fixed_views(base, np.random.default_rng(3), camera_on), NOMINAL, NEAR)
    assert error_of(found, base) == pytest.approx((0.0, 0.0), abs=1e-3)


def test_a_board_on_one_arm_and_a_camera_on_the_other_relate_them():
    rng = np.random.default_rng(4)
    base = shifted()
    found = estimate(board_views(12, NOMINAL, base, EXACT, rng), NOMINAL, NEAR)
    assert error_of(found, base) == pytest.approx((0.0, 0.0), abs=1e-3)
    assert set(found.constants) == {"camera on left", "board on right"}


def test_kinds_mix_and_each_adds_information():
    rng = np.random.default_rng(5)
    base = shifted()
    touched, bars = touches(base, rng), bar_poses(10, NOMINAL, base, NOISE, rng)
    alone, both = estimate(touched, NOMINAL, NEAR), estimate([*bars, *touched], NOMINAL, NEAR)
    assert both.position_bound_m < alone.position_bound_m
    assert error_of(both, base)[0] < 0.3
    kinds = [each.angle_rad > 0.0 for each in both.residuals]
    assert kinds == [True] * 10 + [False] * 8  # in the order of the observations


def test_eight_touches_reach_the_goal_and_intervals_cover():
    """Goals: 0.3 mm and 0.02°; 95 % intervals cover 93 to 97 % of 1,000 cells."""
    cells = scaled(1000, 33)
    inside, errors = [], []
    for seed in range(cells):
        rng = np.random.default_rng((7, seed))
        base = shifted(rng.uniform(-0.005, 0.005, 3), rng.uniform(-0.008, 0.008, 3))
        found = estimate(touches(base, rng), NOMINAL, NEAR)
        difference = np.concatenate([found.position_m - base[:3, 3], rotation_vector_between(found.pose, base)])
        inside.append(np.abs(difference) <= found.half_widths)
        errors.append(error_of(found, base))
    assert (np.median(errors, axis=0) < (0.15, 0.011)).all()
    assert (np.percentile(errors, 95, axis=0) < (0.3, 0.02)).all()
    # Binomial: the six components of a cell count as two independent ones.
    spread = 3.3 * math.sqrt(0.05 * 0.95 / (2 * cells))
    assert abs(np.mean(inside) - 0.95) < spread


def rotation_vector_between(pose, base):
    return rotation_vector(transform(np.zeros(3), pose[:3, :3] @ base[:3, :3].T))


@pytest.mark.parametrize("wrong", [(2,), (0, 5)])
def test_touches_that_missed_are_rejected(wrong):
    rng = np.random.default_rng(8)
    base = shifted()
    observed = touches(base, rng)
    for k in wrong:
        tip = np.add(observed[k].right_tcp_m, (0.004, -0.003, 0.002))
        observed[k] = dataclasses.replace(observed[k], right_tcp_m=tuple(tip))
    found = estimate(observed, NOMINAL, NEAR)
    assert [k for k, each in enumerate(found.residuals) if each.rejected] == list(wrong)
    assert all(found.residuals[k].distance_m > 0.003 for k in wrong)
    assert error_of(found, base)[0] < 0.5


def test_observations_of_which_most_are_wrong_are_stated_as_uncertain():
    rng = np.random.default_rng(9)
    observed = touches(shifted(), rng)
    for k in range(5):
        tip = np.add(observed[k].right_tcp_m, rng.uniform(-0.1, 0.1, 3))
        observed[k] = dataclasses.replace(observed[k], right_tcp_m=tuple(tip))
    assert estimate(observed, NOMINAL, NEAR).uncertainty_at_lever_m > 0.05


def points_of(planned):
    return np.array([(flange(each.left_q_rad, NOMINAL[0]) @ [*each.left_tcp_m, 1.0])[:3] for each in planned])


def near_line(start, direction, far=0.02):
    points = points_of(CANDIDATES)
    along = (points - start) @ direction
    distance = np.linalg.norm(points - start - along[:, None] * direction, axis=1)
    return [CANDIDATES[k] for k in np.flatnonzero(distance < far)][:8]


@pytest.mark.parametrize(
    ("planned", "words"),
    [
        (CANDIDATES[:1], ("1 touch leaves ", "undetermined", "--suggest")),
        (CANDIDATES[:2], ("2 touches leave a rotation about the line",)),
        ([CANDIDATES[7]] * 6, ("6 touches leave a rotation", "0.3 m from it")),
        (near_line(np.array([-0.5, 0.6, 0.4]), np.array([0.0, 0.0, 1.0])), ("along (0.00, 0.00, 1.00)",)),
    ],
)
def test_degenerate_touches_are_refused_with_the_direction(planned, words):
    with pytest.raises(CalibrationError) as refused:
        estimate(touches(shifted(), np.random.default_rng(10), planned), NOMINAL, NEAR)
    for word in words:
        assert word in str(refused.value)


def test_a_bar_rotated_about_one_axis_only_is_refused():
    rng = np.random.default_rng(11)
    base = shifted()
    poses = bar_poses(1, NOMINAL, base, EXACT, rng, angle_rad=0.0)
    same = [dataclasses.replace(poses[0]) for _ in range(5)]
    with pytest.raises(CalibrationError, match=r"5 poses of a bar leave .* undetermined .* Rotate the bar"):
        estimate(same, NOMINAL, NEAR)


def test_no_observation_is_refused():
    with pytest.raises(CalibrationError, match="no observations"):
        estimate([], NOMINAL, NEAR)


def test_touches_close_together_state_how_uncertain_they_are():
    rng = np.random.default_rng(12)
    points = points_of(CANDIDATES)
    close = np.argsort(np.linalg.norm(points - points[200], axis=1))[:8]
    base = shifted()
    found = estimate(touches(base, rng, [CANDIDATES[k] for k in close]), NOMINAL, NEAR)
    assert found.uncertainty_at_lever_m > 0.002
    assert "rotation about the line" in found.weakest.text


@given(st.floats(-3.0, 3.0), st.floats(-2.0, 2.0), st.floats(-1.0, 1.0))
def test_the_mount_stands_where_the_estimate_does(yaw, x, turn):
    left = ArmMount((x, 0.5, 0.1), yaw)
    right = ArmMount((x + 0.3, -0.6, 0.2), turn)
    pose = right_in_left(left, right)
    six = np.eye(6)
    direction = None
    found = BaseEstimate(pose, 1e-8 * six, 18, 1.0, (), {}, 1e8 * six, 1e8 * six, direction)
    mount = found.mount(left, NOMINAL_DH)
    np.testing.assert_allclose(mount.position_m, right.position_m, atol=1e-12)
    assert math.remainder(mount.yaw_rad - turn, 2 * math.pi) == pytest.approx(0.0, abs=1e-12)
    np.testing.assert_allclose(mount.tilt_rad, 0.0, atol=1e-12)
    left = dataclasses.replace(left, tilt_rad=(0.01, -0.02))
    right = dataclasses.replace(right, tilt_rad=(-0.03, 0.05))
    found = dataclasses.replace(found, pose=right_in_left(left, right))
    np.testing.assert_allclose(right_in_left(left, found.mount(left, NOMINAL_DH)), found.pose, atol=1e-12)
    np.testing.assert_allclose(found.mount(left, NOMINAL_DH).tilt_rad, right.tilt_rad, atol=1e-12)


@pytest.mark.parametrize(
    ("make", "text"),
    [
        (lambda: Touch((0.0,) * 5, (0.0,) * 6), "left_q_rad must be 6 finite"),
        (lambda: Touch((math.nan,) * 6, (0.0,) * 6), "finite"),
        (lambda: Touch((90.0,) * 6, (0.0,) * 6), "Check the units"),
        (lambda: BarPose((0.0,) * 6, (0.0,) * 6 + (1.0,)), "right_q_rad"),
        (lambda: BoardView("left", "left", (0.0,) * 6, None, (0.0,) * 3, (0.0,) * 3), "relates no arms"),
        (lambda: BoardView("left", "fixed", None, None, (0.0,) * 3, (0.0,) * 3), "needs left_q_rad"),
        (lambda: Noise(touch_m=0.0), "touch_m"),
    ],
)
def test_bad_observations_are_refused(make, text):
    with pytest.raises(CalibrationError, match=text):
        make()


def test_mounts_of_the_scene_are_one_frame():
    assert np.allclose(NEAR[:3, 3], (0.0, 1.2, 0.0))
    assert np.allclose(right_in_left(*reversed(MOUNTS)), inverse_of(NEAR))


def test_a_board_of_another_size_is_refused():
    rng = np.random.default_rng(13)
    views = board_views(8, NOMINAL, shifted(), NOISE, rng)
    estimate(views, NOMINAL, NEAR)
    wrong = [dataclasses.replace(each, position_m=tuple(np.divide(each.position_m, 1.04))) for each in views]
    with pytest.raises(CalibrationError, match=r"the board is [\d.]+ times as large.*square_m") as refused:
        estimate(wrong, NOMINAL, NEAR)
    assert float(str(refused.value).split()[3]) == pytest.approx(1.04, abs=0.005)
