"""Tracking errors of arms and controllers, and hot joints."""

from __future__ import annotations

import math

import numpy as np
import pytest

from dual_ur10.sim2real.runtime.tracking import DEVIATION_RAD, Deviation, Following, PayloadWarning, TrackingMonitor
from tests.ur_emulator.statuses import status_of
from ur_core.kinematics.ur10 import JOINTS
from ur_core.servoj import ServojLaw, ServojProfile

HOME = np.array([0.1, -1.2, 1.5, -1.8, -1.5, 0.3])


def state(target, actual=None):
    return status_of(target_q=tuple(target), actual_q=tuple(target if actual is None else actual))


def off(joint, by, q=HOME):
    result = np.array(q)
    result[joint] += by
    return result


# The arm, and where its controller wants it.


@pytest.mark.parametrize("joint", range(6))
@pytest.mark.parametrize("sign", [-1, 1])
def test_a_deviation_stops_the_arm_at_the_third_state(joint, sign):
    tracking, bad = TrackingMonitor(), state(HOME, off(joint, sign * (DEVIATION_RAD + 1e-3)))
    assert tracking(bad) is None
    assert tracking(bad) is None
    reason = tracking(bad)
    assert reason == f"{JOINTS[joint]} is 0.101 rad from where its controller wants it, allowed are 0.100"
    assert tracking(bad) == reason


def test_a_single_bad_state_is_tolerated():
    tracking = TrackingMonitor()
    good, bad = state(HOME), state(HOME, off(2, 0.5))
    for _ in range(20):
        assert tracking(bad) is None
        assert tracking(bad) is None
        assert tracking(good) is None


def test_allowed_deviations_are_tolerated():
    tracking = TrackingMonitor()
    for _ in range(20):
        assert tracking(state(HOME, off(4, DEVIATION_RAD - 1e-6))) is None


@pytest.mark.parametrize("bad", [math.nan, math.inf, -math.inf])
def test_a_target_that_is_no_number_stops(bad):
    for values in ([*HOME[:5], bad], [bad] * 6):
        tracking, following = TrackingMonitor(), Following(ServojProfile())
        following.sent(HOME.tolist(), 0.0)
        status = state(values, HOME)
        for judge in (tracking, following):
            found = [judge(status) for _ in range(3)]
            assert found[:2] == [None, None]
            assert found[2] is not None
            assert "replaced" not in found[2]
            assert (JOINTS[5] if len(set(map(str, values))) > 1 else JOINTS[0]) in found[2]


def test_the_worst_joint_is_named():
    deviation = Deviation("{joint} {found} {allowed}")
    apart = np.array([0.0, 0.3, 0.1, 0.5, 0.0, 0.0])
    found = [deviation(apart, np.array([0.1, 0.1, 0.1, 0.4, 0.1, 0.1])) for _ in range(3)]
    assert found == [None, None, f"{JOINTS[1]} 0.300 0.100"]


# The controller, and what it is sent.


def follow(following, profile, targets, *, taken=True, delay=0):
    """Send targets to a controller with the servoj law, and check its states."""
    transition = ServojLaw(profile.lookahead_s, profile.gain).transition(profile.tick_s)
    now = np.stack([targets[0], np.zeros(6)])
    for number, target in enumerate(targets):
        following.sent(target.tolist(), number)
        if taken:
            held = np.stack([targets[max(number - delay, 0)], np.zeros(6)])
            now = held + transition @ (now - held)
        reason = following(state(now[0]))
        if reason is not None:
            return number, reason
    return None


PROFILES = [ServojProfile(), ServojProfile("e-series"), ServojProfile(lookahead_s=0.2, gain=300.0)]
UNDAMPED = ServojProfile(gain=300.0)


def wave(profile, speed, seconds=1.7):
    time = np.arange(0.0, seconds, profile.tick_s)[:, None]
    return HOME + speed / 4.0 * (1.0 - np.cos(4.0 * time)) * np.array([1, -1, 1, 1, -1, 0.5])


@pytest.mark.parametrize(
    ("profile", "speed"), [*zip([*PROFILES, UNDAMPED], (2.0, 2.0, 0.5, 2.0), strict=True), (PROFILES[0], 0.0)]
)
def test_a_controller_that_follows_may_continue(profile, speed):
    for delay in (0, 4):
        assert follow(Following(profile), profile, wave(profile, speed), delay=delay) is None


@pytest.mark.parametrize("profile", PROFILES)
def test_a_stop_from_full_speed_is_tolerated(profile):
    """The arm catches up with targets at rest."""
    moving = HOME + 0.5 * profile.tick_s * np.arange(200)[:, None]
    assert follow(Following(profile), profile, np.concatenate([moving, np.repeat(moving[-1:], 200, 0)])) is None


@pytest.mark.parametrize("profile", PROFILES)
@pytest.mark.parametrize("speed", [0.1, 0.5])
def test_a_controller_that_takes_no_targets_is_noticed(profile, speed):
    found = follow(Following(profile), profile, wave(profile, speed), taken=False)
    assert found is not None
    number, reason = found
    assert "the controller does not follow" in reason
    # Before it is further behind than it may be, and than twice of what it is then.
    behind = np.abs(wave(profile, speed)[number] - HOME).max()
    assert behind < 2 * speed * (profile.lookahead_s + 10 * profile.tick_s) + 0.05


def test_a_deviation_at_rest_is_noticed():
    following = Following(ServojProfile())
    assert [following(state(off(3, 1.0))) for _ in range(5)] == [None] * 5  # nothing was sent yet
    following.sent(HOME.tolist(), 0.0)
    found = [following(state(off(3, 0.008))) for _ in range(3)]
    assert found[:2] == [None, None]
    text = "has a target 0.008 rad from those sent, allowed are 0.006: another program replaced the control script"
    assert found[2] == f"{JOINTS[3]} {text}"
    following.sent(HOME.tolist(), 1.0)
    allowed = following._slack_rad
    found = [following(state(off(3, allowed + 3e-5))) for _ in range(3)]
    assert f"{allowed + 3e-5:.5f} rad from those sent, allowed are {allowed:.5f}:" in found[2]
    fine = Following(ServojProfile())
    fine.sent(HOME.tolist(), 0.0)
    assert [fine(state(off(3, 0.005))) for _ in range(5)] == [None] * 5


@pytest.mark.parametrize("profile", PROFILES)
def test_a_target_may_be_anywhere_behind_but_not_ahead_nor_aside(profile):
    """As far as a controller lags, and in no other joint than those that moved."""
    lag = math.floor((profile.lookahead_s + 0.09) / profile.tick_s)
    line = HOME + 0.5 * profile.tick_s * np.arange(lag + 1)[:, None] * np.eye(6)[1]
    for found, words in (
        (line[0], None),
        (line[-1], None),
        (off(1, -0.006, line[0]), "replaced"),
        (off(1, 0.006, line[-1]), "replaced"),
        (off(2, 0.006, line[0]), "replaced"),
    ):
        following = Following(profile)
        for number, target in enumerate(line):
            following.sent(target.tolist(), number)
        reason = [following(state(found)) for _ in range(3)][2]
        assert (reason is None) == (words is None)
        assert words is None or words in reason
        assert following.lost == (words is not None)


def test_a_slider_lets_a_controller_lag_for_longer():
    """By as many targets: it slows down the controller's law, too."""
    following, first = Following(ServojProfile()), HOME
    for period in range(100):
        following.sent((HOME + 4e-4 * period).tolist(), 0.1 * period)
    assert [following(state(first)) for _ in range(5)] == [None] * 5


@pytest.mark.parametrize("profile", [ServojProfile("cb3", 0.2, 100.0), ServojProfile("cb3", 0.15, 178.0), *PROFILES])
def test_a_joint_that_stops_from_full_speed_is_followed_slowly(profile):
    """Without compensation, also where the law has a double pole."""
    following, law = Following(profile), ServojLaw(profile.lookahead_s, profile.gain).transition(profile.tick_s)
    position, error = -2.5, np.array([-profile.lookahead_s, 1.0]) * 2.5
    for number in range(round(2.5 / profile.tick_s)):
        time_s = number * profile.tick_s
        step = profile.tick_s * min(2.5, max(0.0, 2.5 - 10.0 * (time_s - 1.0)))
        position += step
        following.sent(off(5, position).tolist(), number)
        error = law @ (error - [step, 0.0])
        if time_s > 0.9:
            assert following(state(off(5, position + error[0]))) is None


@pytest.mark.parametrize("profile", PROFILES)
def test_a_controller_that_is_late_was_not_replaced(profile):
    following = Following(profile)
    path = wave(profile, 0.5)[: round((0.5 if profile.lookahead_s < 0.1 else 1.2) / profile.tick_s)]
    for number, target in enumerate(path):
        following.sent(target.tolist(), number)
    reason = [following(state(path[0])) for _ in range(3)][2]
    assert "the controller does not follow" in reason
    assert following.lost


@pytest.mark.parametrize("profile", PROFILES[:2])
@pytest.mark.parametrize("speed", [0.05, 0.3])
def test_another_program_is_named_however_slow_it_is(profile, speed):
    """It moves one joint; the arm moved at 0.4 rad/s and stays behind."""
    following, path = Following(profile), wave(profile, 0.4)
    begin = round(0.6 / profile.tick_s)
    for number, target in enumerate(path):
        following.sent(target.tolist(), number)
        if number > begin:
            other = off(0, speed * profile.tick_s * (number - begin), path[begin])
            if reason := following(state(other)):
                break
    assert "another program replaced the control script" in reason


def test_a_payload_that_changes_in_motion_is_noted_once(caplog):
    note = PayloadWarning("left")
    for payload_kg in (None, 2.3, 2.3, 6.0, 6.0):
        note(status_of(payload=payload_kg))
    (record,) = caplog.records
    assert record.getMessage().startswith("left: the payload that is set on its controller changed from 2.3 to 6 kg")


def test_a_deviation_of_the_arm_is_noticed_too():
    following = Following(ServojProfile())
    following.sent(HOME.tolist(), 0.0)
    found = [following(state(HOME, off(1, 0.2))) for _ in range(3)]
    assert found[2] is not None
    assert "where its controller wants it" in found[2]
