"""Limits and their invariant: an accepted state can be braked within all limits, at once or later."""

from __future__ import annotations

import numpy as np
import pytest

from dual_ur10.errors import SettingsError
from dual_ur10.sim2real.control.limits import HISTORY, POINTS, Envelope, MotionLimits, reach_from_joint_m
from tests.pairwise import pairwise
from tests.sim2real.control.motion_checks import (
    HARD,
    NARROW,
    TIGHT,
    TOOL,
    assert_within,
    braked,
    cartesian_speed,
    cartesian_use,
    limit_use,
)
from ur_core.kinematics import flange_pose
from ur_core.kinematics.ur10 import HARD_SPEED_RAD_S, JOINT_RANGE_RAD, NOMINAL_DH, nominal_dh

SLUGGISH = MotionLimits(speed_rad_s=1.0, acceleration_rad_s2=0.5, jerk_rad_s3=2.0)
LIMITS = (HARD, TIGHT, NARROW, SLUGGISH)
TICKS_S = (0.008, 0.002)


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("speed_rad_s", 1.69),
        ("speed_rad_s", (1.0, 1.0, 2.52, 1.0, 1.0, 1.0)),
        ("speed_rad_s", 0.0),
        ("speed_rad_s", float("nan")),
        ("speed_rad_s", (1.0, 1.0)),
        ("speed_rad_s", "fast"),
        ("speed_rad_s", 10**400),
        ("acceleration_rad_s2", "fast"),
        ("acceleration_rad_s2", None),
        ("jerk_rad_s3", 10**400),
        ("tcp_speed_m_s", [0.1, 0.2]),
        ("robots", 3),
        ("robots", ("ur10",)),
        ("acceleration_rad_s2", 10.1),
        ("acceleration_rad_s2", -1.0),
        ("jerk_rad_s3", 2001.0),
        ("jerk_rad_s3", float("inf")),
        ("tcp_speed_m_s", 1.51),
        ("lower_rad", -6.4),
        ("upper_rad", 3.2),
        ("upper_rad", float("nan")),
        ("lower_rad", (0.0, 0.0, 3.2, 0.0, 0.0, 0.0)),
    ],
)
def test_limits_beyond_the_hard_ones_are_refused(name: str, value: object) -> None:
    with pytest.raises(SettingsError):
        MotionLimits(**{name: value})


def test_hard_limits_are_the_default_and_narrower_ones_are_kept() -> None:
    limits = MotionLimits()
    assert limits.speed_rad_s == tuple(HARD_SPEED_RAD_S)
    assert limits.upper_rad == tuple(JOINT_RANGE_RAD)
    assert TIGHT.speed_rad_s == (0.5,) * 6
    assert hash(TIGHT) == hash(MotionLimits(0.5, 4.0, 200.0, 0.25))


def test_a_narrowed_range_loses_the_margin_on_both_sides() -> None:
    narrowed = NARROW.narrowed(0.1)
    np.testing.assert_allclose(np.subtract(narrowed.lower_rad, NARROW.lower_rad), 0.1)
    np.testing.assert_allclose(np.subtract(NARROW.upper_rad, narrowed.upper_rad), 0.1)
    with pytest.raises(SettingsError):
        NARROW.narrowed(1.0)


@pytest.mark.parametrize("limits", LIMITS)
@pytest.mark.parametrize("tick_s", TICKS_S)
def test_the_brake_from_full_speed_keeps_acceleration_and_jerk(limits: MotionLimits, tick_s: float) -> None:
    middle = (np.asarray(limits.lower_rad) + limits.upper_rad) / 2
    past = middle + np.arange(-2, 1)[:, None, None] * np.asarray(limits.speed_rad_s) * tick_s * np.ones((2, 1))
    sent = braked(past[None], limits, tick_s)
    acceleration = np.diff(sent, n=2, axis=1) / tick_s**2
    jerk = np.diff(sent, n=3, axis=1) / tick_s**3
    assert np.abs(acceleration).max() <= limits.acceleration_rad_s2
    assert np.abs(jerk).max() <= limits.jerk_rad_s3
    assert np.abs(sent[:, -1] - sent[:, -2]).max() < 1e-4 * np.abs(sent[:, 2] - sent[:, 1]).max()


def random_windows(envelope: Envelope, rng: np.random.Generator, count: int) -> np.ndarray:
    """Return windows of single-joint motions with speeds and accelerations within and beyond the limits."""
    limits, tick_s, ticks = envelope.limits, envelope.tick_s, envelope.ticks
    lower, upper = np.asarray(limits.lower_rad), np.asarray(limits.upper_rad)
    start = rng.uniform(lower, upper, (count, 2, 6)).reshape(count, 12)
    speed = rng.uniform(-1.1, 1.1, (count, 12)) * np.tile(limits.speed_rad_s, 2)
    acceleration = rng.uniform(-1.1, 1.1, (count, 12)) * limits.acceleration_rad_s2
    jerk = rng.uniform(-1.1, 1.1, (count, 12)) * limits.jerk_rad_s3 * rng.random((count, 1))
    n = (np.arange(HISTORY + ticks) - HISTORY + 1)[None, :, None]
    return (
        start[:, None]
        + speed[:, None] * tick_s * n
        + acceleration[:, None] * tick_s**2 * n * (n + 1) / 2
        + jerk[:, None] * tick_s**3 * n * (n + 1) * (n + 2) / 6
    )


@pytest.mark.parametrize(("limits", "tick_s"), [*zip(LIMITS, TICKS_S * 2, strict=True)])
def test_an_accepted_window_can_be_braked_within_all_limits(limits: MotionLimits, tick_s: float) -> None:
    envelope = Envelope(limits, tick_s, 5)
    windows = random_windows(envelope, np.random.default_rng(0), 200)
    # Each joint is a sample of its own: the rest of its cell is at rest.
    accepted = limit_use(envelope, windows).max(axis=1) <= 1.0
    still = (np.asarray(limits.lower_rad) + limits.upper_rad) / 2
    sent = np.where(accepted[:, None, :], windows, np.tile(still, 2))
    assert 0.01 < accepted.mean() < 0.9
    motion = np.concatenate(
        [sent, braked(sent[:, -HISTORY:].reshape(-1, 3, 2, 6), limits, tick_s).reshape(len(sent), -1, 12)[:, HISTORY:]],
        axis=1,
    ).reshape(len(sent), -1, 2, 6)
    speed = np.diff(motion[:, HISTORY - 1 :], axis=1) / tick_s
    acceleration = np.diff(motion[:, HISTORY - 2 :], n=2, axis=1) / tick_s**2
    jerk = np.diff(motion, n=3, axis=1) / tick_s**3
    assert (np.abs(speed) <= np.asarray(limits.speed_rad_s) * (1 + 1e-9)).all()
    assert np.abs(acceleration).max() <= limits.acceleration_rad_s2 * (1 + 1e-9)
    assert np.abs(jerk).max() <= limits.jerk_rad_s3 * (1 + 1e-8)  # rounding of a third difference at 2 ms
    new = motion[:, HISTORY:]
    assert (new <= np.asarray(limits.upper_rad) + 1e-9).all()
    assert (new >= np.asarray(limits.lower_rad) - 1e-9).all()


@pytest.mark.parametrize("limits", LIMITS)
def test_the_rows_are_the_finite_differences(limits: MotionLimits) -> None:
    envelope = Envelope(limits, 0.008, 4)
    windows = random_windows(envelope, np.random.default_rng(1), 500)
    use = limit_use(envelope, windows)
    kinds = np.array(envelope.kinds)
    for kind, order, limit in (
        ("joint speed", 1, np.tile(limits.speed_rad_s, 2)),
        ("joint acceleration", 2, limits.acceleration_rad_s2),
        ("joint jerk", 3, limits.jerk_rad_s3),
    ):
        found = np.abs(np.diff(windows[:, HISTORY - order :], n=order, axis=1)).max(axis=1) / 0.008**order / limit
        assert (use[:, kinds == kind].max(axis=1) + 1e-6 >= found).all()


@pytest.mark.parametrize("limits", LIMITS)
@pytest.mark.parametrize("tick_s", TICKS_S)
def test_an_accepted_state_is_accepted_one_brake_tick_later(limits: MotionLimits, tick_s: float) -> None:
    envelope = Envelope(limits, tick_s, 1)
    windows = random_windows(envelope, np.random.default_rng(2), 3000)
    accepted = limit_use(envelope, windows).max(axis=1) <= 1.0
    following = np.concatenate([windows[:, 1:], envelope.brake @ windows[:, -HISTORY:]], axis=1)
    use = limit_use(envelope, following).max(axis=1)
    assert accepted.any()
    assert use[accepted].max() <= 1.0 + 1e-8


def test_the_resting_row_is_where_the_brake_ends() -> None:
    envelope = Envelope(HARD, 0.008, 5)
    windows = random_windows(envelope, np.random.default_rng(3), 50)
    rest = (envelope.rows @ windows)[:, envelope.rest_row]
    end = braked(windows[:, -HISTORY:].reshape(-1, 3, 2, 6), HARD, 0.008)[:, -1].reshape(-1, 12)
    np.testing.assert_allclose(rest, end, atol=1e-4)


@pairwise(
    limits=[HARD, TIGHT, NARROW, TOOL], tick_s=TICKS_S, moving=[(0,), (1,), (0, 1, 2), (3, 4), (4,), (0, 1, 2, 3, 4, 5)]
)
def test_the_cartesian_speed_is_never_underestimated(
    limits: MotionLimits, tick_s: float, moving: tuple[int, ...]
) -> None:
    envelope = Envelope(limits, tick_s, 5)
    rng, count = np.random.default_rng(4), 200
    windows = random_windows(envelope, rng, count)
    still = np.ones(12, dtype=bool)
    still[[joint + 6 * arm for joint in moving for arm in (0, 1)]] = False
    windows[:, :, still] = windows[:, :1, still]
    windows[: count // 2, :, [0, 1, 2]] -= windows[: count // 2, -1:, [0, 1, 2]]  # stretched out: the longest lever
    use = limit_use(envelope, windows)
    windows, use = windows[use.max(axis=(1, 2)) <= 2.0], use[use.max(axis=(1, 2)) <= 2.0]
    motion = np.concatenate(
        [
            windows[:, HISTORY - 1 :],
            braked(windows[:, -HISTORY:].reshape(-1, 3, 2, 6), limits, tick_s).reshape(len(windows), -1, 12)[
                :, HISTORY:
            ],
        ],
        axis=1,
    ).reshape(len(windows), -1, 2, 6)
    peak = cartesian_speed(motion, tick_s, limits.tcp_m).max(axis=1) / limits.tcp_speed_m_s
    fraction = cartesian_use(envelope, windows)[0].max(axis=1)
    assert len(windows) > 20
    assert (fraction >= peak * (1 - 1e-9)).all()
    assert (fraction <= peak * 1.0061).all()
    # From the joint speeds alone: where this bound is within the limit, the kernel computes nothing else.
    fastest = use[:, np.array(envelope.kinds) == "joint speed"].max(axis=1)
    assert ((fastest @ envelope.kernel.values["lever"]).max(axis=1) >= peak * (1 - 1e-9)).all()


def test_the_cartesian_use_names_the_faster_point() -> None:
    envelope = Envelope(HARD, 0.008, 1)
    pan = np.zeros((1, 4, 12))
    pan[0, :, 0] = np.arange(4) * 0.001  # stretched: the flange is further out
    pan[0, :, 7] = np.arange(4) * 0.001
    pan[0, :, 8] = -np.arange(4) * 0.004  # folds while it lifts
    pan[0, :, 8] -= 2.6
    fraction, point = cartesian_use(envelope, pan)
    assert fraction.shape == point.shape == (1, 2)
    assert POINTS[point[0, 0]] == "flange"
    turn = np.zeros((1, 4, 12))
    turn[0, :, 5] = np.arange(4) * 0.001  # the last joint moves no flange, but a tool beside its axis
    turn[0, :, 11] = np.arange(4) * 0.001
    beside = Envelope(MotionLimits(tcp_speed_m_s=0.25, tcp_m=((0.2, 0.0, 0.1), (0.0, 0.0, 0.1))), 0.008, 1)
    (fraction,), (point,) = cartesian_use(beside, turn)
    np.testing.assert_allclose(fraction, [0.2 * 0.001 / 0.008 / 0.25, 0.0], rtol=1e-2, atol=1e-9)
    assert POINTS[point[0]] == "TCP"


@pytest.mark.parametrize("tcp_m", [((0, 0, 0),), (0.1, 0.2), ((0, 0, float("nan")), (0, 0, 0)), "x", None])
def test_tool_centre_points_are_three_numbers_for_each_arm(tcp_m: object) -> None:
    with pytest.raises(SettingsError, match="tcp_m is"):
        MotionLimits(tcp_m=tcp_m)  # type: ignore[arg-type]


@pytest.mark.parametrize("robot", ["ur10", "ur3e", "ur20"])
def test_the_assumed_reach_from_each_axis_is_an_upper_bound(robot: str) -> None:
    from ur_core.kinematics import jacobian

    q = np.random.default_rng(5).uniform(-np.pi, np.pi, (20000, 6))
    q[:5000] = np.round(q[:5000] / (np.pi / 2)) * (np.pi / 2)  # the corners of the workspace
    lever = np.linalg.norm(jacobian(q, nominal_dh(robot))[:, :3], axis=1)
    assert (lever.max(axis=0) <= reach_from_joint_m(robot) + 1e-12).all()
    assert (lever.max(axis=0) >= 0.7 * reach_from_joint_m(robot)).all()


@pytest.mark.parametrize("speed", [1e-4, 1e-3, 1e-2, 0.1])
@pytest.mark.parametrize("tick_s", TICKS_S)
def test_very_slow_limits_work_too(speed: float, tick_s: float) -> None:
    envelope = Envelope(MotionLimits(speed_rad_s=speed, tcp_speed_m_s=0.001), tick_s, 2)
    fraction, _ = cartesian_use(envelope, np.zeros((1, 5, 12)))
    assert fraction.max() == 0.0
    assert envelope.rest_speed_rad_s <= 1e-4


def test_stops_within_a_window_are_checked_as_its_end_is() -> None:
    both = Envelope(HARD, 0.008, 5, stops=(2, 5))
    short = Envelope(HARD, 0.008, 2)
    windows = random_windows(both, np.random.default_rng(6), 500)
    use_both = limit_use(both, windows).max(axis=(1, 2))
    use_short = limit_use(short, windows[:, :5]).max(axis=(1, 2))
    assert (use_both >= use_short * (1 - 1e-9)).all()
    tips, tips_short = cartesian_use(both, windows)[0], cartesian_use(short, windows[:, :5])[0]
    assert (tips >= tips_short * (1 - 1e-9)).all()


def test_flange_pose_of_the_checks_is_the_one_of_the_package() -> None:
    # The checks of these tests would pass on anything if their own Cartesian speed were wrong.
    q = np.zeros((1, 2, 2, 6))
    q[0, 1, 0, 0] = 0.001
    moved = np.linalg.norm(flange_pose(q[0, 1, 0], NOMINAL_DH)[0] - flange_pose(q[0, 0, 0], NOMINAL_DH)[0])
    assert cartesian_speed(q, 0.008)[0, 0] == pytest.approx(moved / 0.008)
    assert_within(np.zeros((1, 6, 2, 6)), HARD, 0.008)
