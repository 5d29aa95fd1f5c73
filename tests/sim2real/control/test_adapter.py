"""The servoj adapter and its limiter: no lag, no exceeded limit, no dead end, and the same answer every time."""

from __future__ import annotations

import copy
import pickle

import numpy as np
import pytest

from dual_ur10.assets.settings import HOME_Q_RAD
from dual_ur10.errors import UnknownNameError
from dual_ur10.sim2real.control.adapter import (
    _NOW,
    JOINT_MARGIN_RAD,
    TCP_ROTATION_RAD_S,
    TCP_STEP_M_S,
    ServojAdapter,
)
from dual_ur10.sim2real.control.limits import HISTORY, Envelope, MotionLimits
from dual_ur10.sim2real.runtime.arm_memory import ArmMemory
from tests.pairwise import pairwise
from tests.sim2real.control.motion_checks import (
    ACTION_KINDS,
    HARD,
    NARROW,
    TIGHT,
    TOOL,
    adversarial_action,
    assert_within,
    cartesian_use,
    limit_use,
)
from ur_core.kernel import call
from ur_core.kinematics import flange_pose
from ur_core.kinematics.ur10 import JOINT_RANGE_RAD, NOMINAL_DH, nominal_dh
from ur_core.servoj import ServojLaw, ServojProfile

MODES = ("joint_delta", "joint_position", "tcp_delta")
CB3, E_SERIES = ServojProfile(), ServojProfile(family="e-series")
SLOW = MotionLimits(tcp_speed_m_s=0.25)


def at_home(n: int = 1, profile: ServojProfile = CB3, ticks: int = 5, limits: MotionLimits = HARD, **more):
    adapter = ServojAdapter(profile, limits, ticks, n=n, **{"dh": [NOMINAL_DH] * 2, **more})
    adapter.reset(np.tile(HOME_Q_RAD, (n, 1, 1)))
    return adapter


def played(adapter: ServojAdapter, actions: np.ndarray) -> np.ndarray:
    """Return the targets of all actions, (periods, n, 2, size), as (n, periods * ticks, 2, 6)."""
    return np.concatenate([adapter(action).targets_rad for action in actions], axis=1)


def actions_of_all_kinds(n: int, periods: int, seed: int = 0, size: int = 6) -> np.ndarray:
    rng = np.random.default_rng(seed)
    kinds = [ACTION_KINDS[(row + seed) % len(ACTION_KINDS)] for row in range(n)]
    return np.array(
        [[adversarial_action(kind, k, rng, (1, 2, size))[0] for kind in kinds] for k in range(periods)], dtype=float
    )


# ------------------------------------------------------------------------------------------------ following


def sine_error(profile: ServojProfile, compensate_lag: bool, true_s: float | None = None, **more) -> float:
    """Return the largest settled error of the law's output from a 0.5 Hz, 0.25 rad sine.

    `true_s` is the lookahead of the arms; None: what their controllers are told.
    """
    ticks = profile.ticks_per_action(25)
    adapter = at_home(profile=profile, ticks=ticks, mode="joint_position", compensate_lag=compensate_lag, **more)
    transition = ServojLaw(true_s or profile.lookahead_s, profile.gain).transition(profile.tick_s)
    start = adapter.commanded_q_rad.reshape(12).copy()
    state, worst, phase = np.stack([start, np.zeros(12)]), 0.0, np.linspace(0.0, 1.0, 12)
    # All joints together would exceed the Cartesian speed.
    amplitude = 0.25 * np.array([1.0, 0, 0, 0, 0, 1.0, 0, 0, 0, 1.0, -1.0, 1.0])
    for k in range(1, 175):
        time = k * 0.04
        ramp = min(time / 4.0, 1.0)  # from rest without meeting a limit
        smooth = ramp**4 * (35 - 84 * ramp + 70 * ramp**2 - 20 * ramp**3)
        wanted = start + amplitude * smooth * np.sin(2 * np.pi * 0.5 * time + phase)
        for target in adapter(wanted.reshape(1, 2, 6)).targets_rad[0].reshape(ticks, 12):
            offset = np.stack([target, np.zeros(12)])
            state = offset + transition @ (state - offset)
        if time > 4.5:
            worst = max(worst, float(np.abs(state[0] - wanted).max()))
    return worst


@pytest.mark.parametrize(
    ("family", "lookahead_s", "gain"), [("cb3", 0.03, 2000.0), ("e-series", 0.03, 2000.0), ("cb3", 0.05, 500.0)]
)
def test_compensated_the_arm_is_where_it_was_commanded(family: str, lookahead_s: float, gain: float) -> None:
    profile = ServojProfile(family, lookahead_s, gain)
    assert sine_error(profile, compensate_lag=True) < (7e-6 if family == "cb3" else 5e-6)
    assert sine_error(profile, compensate_lag=False) > 0.25 * np.pi * lookahead_s  # positive control


@pytest.mark.parametrize("true_s", [0.024, 0.045])
def test_a_measured_lag_is_compensated(true_s: float) -> None:
    assert sine_error(CB3, True, true_s) > 0.2 * np.pi * abs(true_s - CB3.lookahead_s)
    assert sine_error(CB3, True, true_s, lookahead_s=true_s) < 1e-5


@pytest.mark.parametrize("mode", MODES)
def test_a_measured_lag_equal_to_the_nominal_changes_no_bit(mode: str) -> None:
    actions = actions_of_all_kinds(5, 40)
    plain, measured = (at_home(5, mode=mode, **more) for more in ({}, {"lookahead_s": CB3.lookahead_s}))
    np.testing.assert_array_equal(played(measured, actions), played(plain, actions))


# ------------------------------------------------------------------------------------------------ never past a command


def commanded_arms(adapter: ServojAdapter, commands: np.ndarray, joints=((0, 5),)) -> np.ndarray:
    """Return the way of nominal arms, (n, k, ticks), where `joints` are commanded (n, 1 + k) rad beside HOME_Q_RAD."""
    start = np.tile(HOME_Q_RAD, (len(commands), 1, 1))
    adapter.reset(start)
    arm, joint = joints[0]
    transition = ServojLaw(adapter.profile.lookahead_s, adapter.profile.gain).transition(adapter.profile.tick_s)
    state, way = np.zeros((2, len(commands))), []
    for command in commands[:, 1:].T:
        action = start.copy()
        for each in joints:
            action[:, each[0], each[1]] += command
        sent = adapter(action).targets_rad[:, :, arm, joint] - start[:, arm, joint, None]
        for target in sent.T:
            offset = np.stack([target, np.zeros_like(target)])
            state = offset + transition @ (state - offset)
            way.append(state[0])
    return np.stack(way, axis=1).reshape(len(commands), -1, adapter.ticks)


def passed(
    profile: ServojProfile, limits: MotionLimits, rate_hz: float, speed: np.ndarray, joints=((0, 5),)
) -> np.ndarray:
    """Return how far arms that begin to move at a constant speed run past their commands, (n,) rad."""
    adapter = at_home(len(speed), profile, profile.ticks_per_action(rate_hz), limits, mode="joint_position")
    commands = -speed[:, None] * np.arange(1 + round(1.6 * rate_hz)) / rate_hz
    return (commands[:, 1:, None] - commanded_arms(adapter, commands, joints)).max(axis=(1, 2))


RATES_HZ = (5, 12.5, 25, 62.5, 125)


@pairwise(rate_hz=RATES_HZ, profile=[CB3, E_SERIES, ServojProfile("cb3", 0.1, 400.0)], limits=[HARD, TIGHT])
def test_an_arm_that_begins_to_move_never_passes_its_command(
    rate_hz: float, profile: ServojProfile, limits: MotionLimits
) -> None:
    speed = np.concatenate([np.linspace(0, 0.05, 80)[1:], np.linspace(0.05, min(limits.speed_rad_s), 80)])
    assert passed(profile, limits, rate_hz, speed).max() < 2e-4


@pairwise(rate_hz=[12.5, 25, 62.5], profile=[CB3, E_SERIES], limits=[HARD, TIGHT, SLOW])
def test_with_a_cartesian_limit_no_arm_passes_its_command(
    rate_hz: float, profile: ServojProfile, limits: MotionLimits
) -> None:
    fast = min(*limits.speed_rad_s, limits.tcp_speed_m_s / 1.2)
    speed = np.concatenate([np.linspace(0, 0.05, 40)[1:], np.linspace(0.05, fast, 40)])
    assert passed(profile, limits, rate_hz, speed, ((0, 0), (1, 1), (1, 3))).max() < 2e-4


@pytest.mark.parametrize("rate_hz", RATES_HZ)
@pytest.mark.parametrize(("profile", "limits"), [(CB3, HARD), (CB3, TIGHT), (E_SERIES, HARD)])
def test_smooth_commands_within_the_limits_are_followed(
    rate_hz: float, profile: ServojProfile, limits: MotionLimits
) -> None:
    """Ramps, sines and random sums of sines, from rest, up to 15 % of the limit of acceleration and 75 % of speed."""
    slow = min(1.0, rate_hz / 25)  # a motion needs as many commands at any rate
    rng, time = np.random.default_rng(0), np.arange(round(3 * rate_hz / slow)) / (rate_hz / slow)
    frequency = np.linspace(0.1, 0.5, 40)[:, None]
    ease = np.clip(time / 2, 0, 1)
    ease = ease**4 * (35 - 84 * ease + 70 * ease**2 - 20 * ease**3)
    sine = np.sin(2 * np.pi * frequency * time) * ease
    ramp = np.cumsum(np.cumsum(np.tile(np.hanning(len(time)), (40, 1)), axis=1), axis=1)
    phases = rng.uniform(0, 2 * np.pi, (40, 3, 1))
    random = np.sin(2 * np.pi * rng.uniform(0.05, 0.4, (40, 3, 1)) * time + phases).sum(axis=1)
    random = random * ease
    shapes = np.concatenate([sine, ramp, random])
    shapes -= shapes[:, :1]
    derived = [np.abs(np.diff(shapes, order) * rate_hz**order).max(axis=1) for order in (1, 2)]
    most = np.minimum(0.75 * min(limits.speed_rad_s) / derived[0], 0.15 * limits.acceleration_rad_s2 / derived[1])
    most = np.minimum(most, 3.0 / np.abs(shapes).max(axis=1))  # joints have a range
    commands = -shapes * (most * np.tile(np.linspace(0.02, 1, 40), 3))[:, None]
    adapter = at_home(len(commands), profile, profile.ticks_per_action(rate_hz), limits, mode="joint_position")
    way = commanded_arms(adapter, commands)
    low, high = (op(commands[:, 1:], commands[:, :-1])[..., None] for op in (np.minimum, np.maximum))
    # Between two commands of a curve lies its sagitta.
    curve = np.abs(np.diff(commands, 2, prepend=0.0)).max(axis=1, keepdims=True)[..., None] / 8
    beside = np.maximum(low - way, way - high) - curve
    assert beside.max() < 2e-4, np.unravel_index(beside.argmax(), beside.shape)


@pairwise(rate_hz=[12.5, 25, 125], profile=[CB3, E_SERIES], limits=[HARD, TIGHT], jumps=[False, True])
def test_arms_that_had_to_pass_their_command_return_once(
    rate_hz: float, profile: ServojProfile, limits: MotionLimits, jumps: bool
) -> None:
    """After commands that stop at once, or that jump: no arm swings."""
    adapter = at_home(40, profile, profile.ticks_per_action(rate_hz), limits, mode="joint_position")
    half = round(1.6 * rate_hz)
    number = np.arange(2 * half + 1)
    if jumps:
        commands = np.where(number > 4, np.geomspace(1e-4, 0.4, 40)[:, None], 0.0)
    else:
        commands = np.geomspace(1e-3, min(limits.speed_rad_s), 40)[:, None] * np.minimum(number, half) / rate_hz
    way = commanded_arms(adapter, -commands).reshape(40, -1)
    beyond = -commands[:, -1:] - way
    assert beyond[:, -20:].max() < 1e-4
    for row in beyond:
        after = row[row.argmax() :]
        assert after.min() > -2e-4
        assert np.diff(after).max() < 2e-4


@pairwise(mode=["joint_delta", "tcp_delta"], robots=[("ur10", "ur10"), ("ur3e", "ur20")], profile=[CB3, E_SERIES])
def test_steady_steps_of_every_mode_pass_no_command(mode: str, robots, profile: ServojProfile) -> None:
    size = np.linspace(0.002, 0.1, 60)
    limits, ticks = HARD.of(robots), profile.ticks_per_action(25)
    adapter = at_home(len(size), profile, ticks, limits, mode=mode, dh=[nominal_dh(robot) for robot in robots])
    direction = np.random.default_rng(3).uniform(-1, 1, (2, 6))
    action, before = size[:, None, None] * direction, adapter.commanded_q_rad
    transition = ServojLaw(profile.lookahead_s, profile.gain).transition(profile.tick_s)
    state = np.stack([before, np.zeros_like(before)])
    for _ in range(35):
        sent, now = adapter(action).targets_rad, adapter.commanded_q_rad
        for k in range(ticks):
            offset = np.stack([sent[:, k], np.zeros_like(now)])
            state = offset + np.einsum("ij,j...->i...", transition, state - offset)
            ahead = (state[0] - now) * np.sign(now - before)
            assert ahead.max() < 2e-4
        before = now


# ------------------------------------------------------------------------------------------------ slowed down


def in_real_time(sent: np.ndarray, start: np.ndarray, profile: ServojProfile, factor: float, count: int) -> np.ndarray:
    """Return the arms' positions after each control period, (count, 12), of targets, (t, 2, 6), at a time scaling."""
    memories = [ArmMemory(), ArmMemory()]
    for arm, memory in enumerate(memories):
        for first in range(0, len(sent), 1000):
            memory.put(first, sent[first : first + 1000, arm])
    transition = ServojLaw(profile.lookahead_s, profile.gain).transition(profile.tick_s)
    state, result = np.stack([start, np.zeros(12)]), []
    for number in range(count):
        target = np.concatenate([memory.target(number * factor) for memory in memories])
        offset = np.stack([target, np.zeros(12)])
        state = offset + transition @ (state - offset)
        result.append(state[0])
    for memory in memories:
        memory.close()
    return np.array(result)


def slowed_error(profile: ServojProfile, factor: float, told: float, compensate_lag: bool = True) -> float:
    """Return the largest tracking error of an arm at a time scaling.

    Args:
        profile: Of its controller, which knows nothing of that: its law goes on in real time.
        factor: Of the targets' time.
        told: What the adapter believes of it.
        compensate_lag: Whether the adapter sends ahead.
    """
    ticks, periods = profile.ticks_per_action(25), 175
    adapter = at_home(
        profile=profile, ticks=ticks, mode="joint_position", compensate_lag=compensate_lag, speed_factor=told
    )
    start = adapter.commanded_q_rad.reshape(12).copy()
    amplitude = 0.25 * np.array([1.0, 0, 0, 0, 0, 1.0, 0, 0, 0, 1.0, -1.0, 1.0])

    def wanted(time_s: float) -> np.ndarray:
        ramp = min(time_s / 4.0, 1.0)
        smooth = ramp**4 * (35 - 84 * ramp + 70 * ramp**2 - 20 * ramp**3)
        return start + amplitude * smooth * np.sin(2 * np.pi * 0.5 * time_s + np.linspace(0.0, 1.0, 12))

    sent = played(adapter, np.array([wanted(k * 0.04).reshape(1, 2, 6) for k in range(1, periods + 1)]))[0]
    per_period = round(ticks / factor)
    arms = in_real_time(sent, start, profile, factor, per_period * (periods - 1))
    ends = range(per_period - 1, len(arms), per_period)
    times_s = [(end + 1) * factor * profile.tick_s for end in ends]
    return max(
        float(np.abs(arms[end] - wanted(time_s)).max())
        for end, time_s in zip(ends, times_s, strict=True)
        if time_s > 4.5
    )


@pytest.mark.parametrize(
    ("profile", "factor"), [(CB3, 0.25), (E_SERIES, 0.5), (ServojProfile("cb3", 0.05, 500.0), 0.5)]
)
def test_a_scaled_arm_follows_the_same_path_without_lag(profile: ServojProfile, factor: float) -> None:
    assert slowed_error(profile, factor, factor) < 1e-5
    # As if time were not slowed down, the arms would be ahead; without compensation they lag behind.
    way = 0.25 * np.pi * profile.lookahead_s
    assert slowed_error(profile, factor, 1.0) > 0.7 * (1 - factor) * way
    assert slowed_error(profile, factor, factor, compensate_lag=False) > 0.7 * factor * way


@pairwise(mode=MODES, profile=[CB3, E_SERIES, ServojProfile("cb3", 0.05, 501.0)], limits=[HARD, TIGHT])
def test_full_speed_changes_no_bit(mode: str, profile: ServojProfile, limits: MotionLimits) -> None:
    actions = actions_of_all_kinds(5, 40)
    plain, full = (at_home(5, profile, limits=limits, mode=mode, **more) for more in ({}, {"speed_factor": 1.0}))
    assert (full._matrices.law.lookahead_s, full._matrices.law.gain) == (profile.lookahead_s, profile.gain)
    assert full._matrices.lead_s == profile.tick_s / 2
    np.testing.assert_array_equal(played(full, actions), played(plain, actions))
    slow = at_home(5, profile, limits=limits, mode=mode, speed_factor=0.5)
    assert (played(slow, actions) != played(at_home(5, profile, limits=limits, mode=mode), actions)).any()


@pairwise(limits=[TIGHT, TOOL], factor=[1.0, 0.5, 0.1], mode=MODES)
def test_at_any_speed_no_limit_is_exceeded(mode: str, factor: float, limits: MotionLimits) -> None:
    adapter = at_home(9, limits=limits, mode=mode, speed_factor=factor)
    sent = played(adapter, actions_of_all_kinds(9, 60))
    before = np.tile(HOME_Q_RAD, (9, 3, 1, 1))
    assert_within(np.concatenate([before, sent], axis=1), limits, 0.008)
    assert np.ptp(sent, axis=1).max() > 0.05  # they move


@pairwise(
    factor=[0.7, 0.5, 0.25, 0.1, 0.05],
    profile__ticks=[(CB3, 5), (E_SERIES, 20), (CB3, 1), (ServojProfile("cb3", 0.1, 400.0), 5)],
    limits=[HARD, TIGHT],
)
def test_slowed_down_after_a_limit_was_met_the_arms_follow_again(
    factor: float, profile: ServojProfile, ticks: int, limits: MotionLimits
) -> None:
    adapter = at_home(profile=profile, ticks=ticks, limits=limits, speed_factor=factor)
    push = np.random.default_rng(0).choice([-1.0, 1.0], (1, 2, 6))
    for _ in range(5):
        adapter(push)
    steady = np.full((1, 2, 6), 0.1)
    for _ in range(2 * max(25, round(1.0 / adapter.period_s))):
        adapter(steady)
    now = adapter.commanded_q_rad.copy()
    adapter(steady)
    wanted = 0.1 * np.asarray(limits.speed_rad_s) * adapter.period_s
    np.testing.assert_allclose(adapter.commanded_q_rad - now, np.tile(wanted, (1, 2, 1)), rtol=1e-3)


@pairwise(
    factor=[1.0, 0.5, 0.25, 0.1],
    profile__ticks=[(CB3, 5), (E_SERIES, 20), (ServojProfile("cb3", 0.1, 400.0), 5)],
    limits=[HARD, TIGHT],
)
def test_the_path_is_where_the_arm_is_also_after_a_limit_was_met(
    factor: float, profile: ServojProfile, ticks: int, limits: MotionLimits
) -> None:
    adapter = at_home(profile=profile, ticks=ticks, limits=limits, speed_factor=factor)
    rng, sent, path, periods = np.random.default_rng(0), [], [], 60
    for period in range(periods):
        pushed = period % 12 < 4
        sent.append(adapter(rng.choice([-1.0, 1.0], (1, 2, 6)) if pushed else np.full((1, 2, 6), 0.05)).targets_rad[0])
        path.append(adapter._state[0, _NOW].copy())
    start, per_period = HOME_Q_RAD.reshape(12), round(ticks / factor)
    arms = in_real_time(np.concatenate(sent), start, profile, factor, per_period * (periods - 1))
    away = arms[per_period - 1 :: per_period] - np.array(path[:-1])
    assert np.abs(away).max() < 3e-4


# ------------------------------------------------------------------------------------------------ modes


def test_bad_settings_are_refused() -> None:
    with pytest.raises(UnknownNameError, match="joint_delta"):
        ServojAdapter(CB3, HARD, 5, mode="joint_velocity", dh=[NOMINAL_DH] * 2)  # type: ignore[arg-type]


def test_action_bounds_are_those_of_the_mode() -> None:
    low, high = at_home(gripper=True).action_bounds
    assert low.shape == high.shape == (2, 7)
    assert (low == -1).all()
    assert (high == 1).all()
    low, high = at_home(mode="joint_position", limits=NARROW).action_bounds
    np.testing.assert_allclose(low, np.tile(np.add(NARROW.lower_rad, JOINT_MARGIN_RAD), (2, 1)))
    np.testing.assert_allclose(high, np.tile(np.subtract(NARROW.upper_rad, JOINT_MARGIN_RAD), (2, 1)))


def test_joint_delta_moves_in_fractions_of_the_speed_limit() -> None:
    adapter = at_home(limits=TIGHT)
    before = adapter.commanded_q_rad.copy()
    action = np.zeros((1, 2, 6))
    action[0, 0, 5], action[0, 1, 4] = 0.4, -0.2
    for _ in range(50):
        adapter(action)
    now = adapter.commanded_q_rad.copy()
    adapter(action)
    step = adapter.commanded_q_rad - now
    np.testing.assert_allclose(step, action * 0.5 * 0.04, atol=1e-7)
    assert (now - before)[0, 0, 5] > 0.3


def test_joint_position_arrives_and_stays() -> None:
    adapter = at_home(mode="joint_position", limits=TIGHT)
    goal = HOME_Q_RAD[None] + np.linspace(-0.3, 0.3, 12).reshape(1, 2, 6)
    sent = played(adapter, np.tile(goal, (100, 1, 1, 1)))
    np.testing.assert_allclose(sent[:, -1], goal, atol=1e-6)


@pytest.mark.parametrize("arm", [0, 1])
@pytest.mark.parametrize("axis", [0, 1, 2])
def test_tcp_delta_steps_along_the_axes_of_the_cell(arm: int, axis: int) -> None:
    yaw = (0.4, -1.1)
    adapter = at_home(mode="tcp_delta", yaw_rad=yaw)
    action = np.zeros((1, 2, 6))
    action[0, arm, axis] = 0.4
    start, turned = flange_pose(adapter.commanded_q_rad[0], NOMINAL_DH)
    for _ in range(25):
        adapter(action)
    end, turned_after = flange_pose(adapter.commanded_q_rad[0], NOMINAL_DH)
    # `base` is rotated by π from base_link, which is rotated by the yaw in the cell.
    cos, sin = np.cos(yaw[arm] + np.pi), np.sin(yaw[arm] + np.pi)
    moved = np.array([[cos, -sin, 0], [sin, cos, 0], [0, 0, 1]]) @ (end - start)[arm]
    wanted = np.zeros(3)
    wanted[axis] = 0.4 * TCP_STEP_M_S
    np.testing.assert_allclose(moved, wanted, atol=0.02)
    assert np.argmax(np.abs(moved)) == axis
    np.testing.assert_allclose((end - start)[1 - arm], 0.0, atol=1e-9)
    np.testing.assert_allclose(turned_after[arm], turned[arm], atol=2e-3)


@pytest.mark.parametrize("axis", [0, 1, 2])
def test_tcp_delta_rotates_about_the_axes_of_the_cell(axis: int) -> None:
    adapter = at_home(mode="tcp_delta", yaw_rad=(0.7, 0.0))
    action = np.zeros((1, 2, 6))
    action[0, 0, 3 + axis] = 0.5
    start = flange_pose(adapter.commanded_q_rad[0, 0], NOMINAL_DH)[1]
    for _ in range(25):
        adapter(action)
    turn = flange_pose(adapter.commanded_q_rad[0, 0], NOMINAL_DH)[1] @ start.T
    vector = np.array([turn[2, 1] - turn[1, 2], turn[0, 2] - turn[2, 0], turn[1, 0] - turn[0, 1]]) / 2
    cos, sin = np.cos(0.7 + np.pi), np.sin(0.7 + np.pi)
    in_cell = np.array([[cos, -sin, 0], [sin, cos, 0], [0, 0, 1]]) @ vector
    assert np.argmax(np.abs(in_cell)) == axis
    assert in_cell[axis] == pytest.approx(0.5 * TCP_ROTATION_RAD_S, abs=0.05)


@pytest.mark.parametrize("tcp_m", [0.0, 0.15])
def test_tcp_delta_rotates_about_the_tool_centre_point(tcp_m: float) -> None:
    adapter = at_home(mode="tcp_delta", tcp_m=(tcp_m, tcp_m))
    action = np.zeros((1, 2, 6))
    action[0, :, 3:] = [[0.5, 0.0, 0.2], [-0.3, 0.4, 0.0]]
    start, turned = flange_pose(adapter.commanded_q_rad[0], NOMINAL_DH)
    for _ in range(25):
        adapter(action)
    end, turned_after = flange_pose(adapter.commanded_q_rad[0], NOMINAL_DH)
    before, after = start + tcp_m * turned[..., 2], end + tcp_m * turned_after[..., 2]
    assert np.abs(after - before).max() < 1e-3
    assert np.linalg.norm(end - start, axis=1).min() >= 0.1 * tcp_m


def test_tcp_delta_out_of_reach_stops_that_arm_only() -> None:
    adapter = at_home(mode="tcp_delta")
    action = np.zeros((1, 2, 6))
    action[0, 0, 0] = 1.0  # away from the base for ever
    action[0, 1, 2] = 0.1
    sent = played(adapter, np.tile(action, (120, 1, 1, 1)))
    assert np.abs(sent[0, -1, 0] - sent[0, -50, 0]).max() < 0.02
    assert np.abs(sent[0, -1, 1] - sent[0, -50, 1]).max() > 0.005


def test_the_gripper_opens_with_the_seventh_number() -> None:
    adapter = at_home(n=2, gripper=True, stroke_m=(0.085, 0.14))
    action = np.zeros((2, 2, 7))
    action[..., 6] = [[-1.0, 1.0], [0.0, 9.0]]
    opening = adapter(action).gripper_m
    wanted = np.array([[0.0, 0.14], [0.085 / 2, 0.14]])
    assert opening is not None
    assert opening.shape == (2, adapter.ticks, 2)
    np.testing.assert_allclose(opening - wanted[:, None], 0.0, atol=1e-15)
    assert at_home()(np.zeros((1, 2, 6))).gripper_m is None


# ------------------------------------------------------------------------------------------------ limits


@pairwise(
    compensate_lag=[True, False],
    profile__ticks=[(CB3, 5), (E_SERIES, 20), (CB3, 1), (CB3, 2), (E_SERIES, 1), (E_SERIES, 5)],
    limits=[HARD, TIGHT],
)
def test_after_a_limit_was_met_the_arms_follow_again(
    compensate_lag: bool, profile: ServojProfile, ticks: int, limits: MotionLimits
) -> None:
    adapter = at_home(profile=profile, ticks=ticks, limits=limits, compensate_lag=compensate_lag)
    push = np.random.default_rng(0).choice([-1.0, 1.0], (1, 2, 6))
    settle = max(25, round(1.0 / adapter.period_s))
    for _ in range(5):
        adapter(push)  # from rest to full speed at once
    steady = np.full((1, 2, 6), 0.1)
    for _ in range(2 * settle):
        adapter(steady)
    now = adapter.commanded_q_rad.copy()
    adapter(steady)
    wanted = 0.1 * np.asarray(limits.speed_rad_s) * adapter.period_s
    np.testing.assert_allclose(adapter.commanded_q_rad - now, np.tile(wanted, (1, 2, 1)), rtol=1e-3)


@pytest.mark.parametrize(("profile", "ticks"), [(CB3, 5), (E_SERIES, 20)])
def test_discontinuous_commands_lead_no_arm_astray(profile: ServojProfile, ticks: int) -> None:
    """As after a late action has stopped both arms: a little back, then on as before."""
    adapter = at_home(profile=profile, ticks=ticks, limits=MotionLimits(speed_rad_s=(1.0,) * 6))
    direction = np.array([[0.1, 0.5, -0.5, 0.1, 0.0, 1.0], [-0.1, -0.8, 1.0, -0.2, 0.0, 0.8]])
    behind = []
    for fraction in [0.1] + 24 * [-0.23]:
        adapter(fraction * direction[None])
        now = adapter._state[:, _NOW].reshape(1, 2, 6)
        behind.append(float(np.abs(adapter.commanded_q_rad - now).max()))
    assert max(behind) < 0.03  # beyond 0.08, if a cubic through the commands is followed wherever it leads
    assert behind[-1] < 1e-4


@pytest.mark.parametrize("memory", [0.8, 0.95])
@pytest.mark.parametrize("noise_rad", [0.0003, 0.0006])
def test_commands_that_tremble_keep_the_arms_near(memory: float, noise_rad: float) -> None:
    """A learned policy that holds still trembles by this much."""
    adapter, rng = at_home(mode="joint_position"), np.random.default_rng(0)
    start, off, away = adapter.commanded_q_rad, np.zeros((1, 2, 6)), 0.0
    for _ in range(800):
        off = memory * off + np.sqrt(1 - memory**2) * noise_rad * rng.standard_normal((1, 2, 6))
        away = max(away, float(np.abs(adapter(start + off).targets_rad - start[:, None]).max()))
    assert away < 9e-3  # beyond 0.015, if the path's jerk is continued where every plan breaks a limit


@pairwise(compensate_lag=[True, False], mode=["joint_delta", "joint_position"], direction=[-1.0, 1.0])
def test_a_joint_at_its_limit_does_not_hold_the_others(compensate_lag: bool, mode: str, direction: float) -> None:
    adapter = at_home(limits=NARROW, mode=mode, compensate_lag=compensate_lag)
    periods, joint = 400, 2
    actions = np.zeros((periods, 1, 2, 6)) if mode == "joint_delta" else np.tile(HOME_Q_RAD, (periods, 1, 1, 1))
    actions[:, 0, 0, joint] = direction * 100.0
    swing = 0.3 * np.sin(np.arange(periods) * 0.04 * 2 * np.pi * 0.5)
    actions[:, 0, 1, 4] += swing
    sent = played(adapter, actions)
    limit = (NARROW.upper_rad if direction > 0 else NARROW.lower_rad)[joint]
    assert (direction * (limit - sent[..., 0, joint]) > 0.0).all()
    assert abs(sent[0, -1, 0, joint] - limit) < 3 * JOINT_MARGIN_RAD
    assert np.abs(np.diff(sent[0, -100:, 0, joint])).max() < 1e-5
    late = sent[0, -500:, 1, 4]
    assert np.ptp(late) > (0.1 if mode == "joint_delta" else 0.4)
    # ... and it comes back when asked.
    back = actions[:60].copy()
    back[:, 0, 0, joint] = -direction if mode == "joint_delta" else HOME_Q_RAD[0, joint]
    returned = played(adapter, back)
    assert direction * (sent[0, -1, 0, joint] - returned[0, -1, 0, joint]) > 0.1
    assert_within(np.concatenate([sent, returned], axis=1), NARROW, 0.008)


def test_a_start_between_the_margin_and_the_limit_can_be_left() -> None:
    adapter = ServojAdapter(CB3, NARROW, 5, dh=[NOMINAL_DH] * 2)
    q = HOME_Q_RAD.copy()
    q[0, 2] = NARROW.upper_rad[2] - JOINT_MARGIN_RAD / 3
    adapter.reset(q[None])
    action = np.zeros((1, 2, 6))
    action[0, 0, 2] = -0.5
    action[0, 1, 4] = 0.5
    sent = played(adapter, np.tile(action, (50, 1, 1, 1)))
    assert sent[0, -1, 0, 2] < q[0, 2] - 0.2
    assert sent[0, -1, 1, 4] > q[1, 4] + 0.2
    assert_within(np.concatenate([np.tile(q, (1, 3, 1, 1)), sent], axis=1), NARROW, 0.008)


def limited_windows(envelope: Envelope, past: np.ndarray, planned: np.ndarray) -> np.ndarray:
    """Return past and planned targets, (n, 3 + ticks, 12), as the adapter's limiter scales them down."""
    result = np.concatenate([past, planned], axis=1)
    assert result.shape[1:] == (HISTORY + envelope.ticks, 12)
    call("envelope_limit", envelope.kernel, result, len(result))
    return result


@pytest.mark.parametrize("limits", [HARD, TIGHT, NARROW])
@pytest.mark.parametrize(("tick_s", "ticks"), [(0.008, 5), (0.008, 1), (0.002, 20)])
def test_a_limited_step_keeps_the_direction_of_all_twelve_joints(
    limits: MotionLimits, tick_s: float, ticks: int
) -> None:
    envelope, rng, n = Envelope(limits, tick_s, ticks), np.random.default_rng(0), 40
    past = np.tile(HOME_Q_RAD.reshape(12), (n, HISTORY, 1))
    speed = rng.uniform(-0.2, 0.2, (n, 1, 12)) * np.tile(limits.speed_rad_s, 2)
    speed[n // 2 :] *= limits.tcp_speed_m_s / 4  # slow enough to coast
    past = past + speed * tick_s * np.arange(-2, 1)[:, None]
    planned = past[:, -1:] + rng.uniform(-1, 1, (n, 1, 12)) * np.linspace(0, 0.5, ticks + 1)[1:, None]
    window = limited_windows(envelope, past, planned)
    np.testing.assert_array_equal(window[:, :HISTORY], past)
    limited = window[:, HISTORY:]
    bases = [last @ past for last in (envelope.coast, envelope.brake)]
    found = set()
    for row in range(n):
        fits = []
        for kind, base in zip(("coast", "brake"), bases, strict=True):
            way, went = (planned - base)[row], (limited - base)[row]
            fraction = (went * way).sum() / (way * way).sum()
            fits.append((np.abs(went - fraction * way).max(), kind, fraction))
        off, kind, fraction = min(fits)
        assert off < 1e-10
        assert -1e-9 <= fraction < 1.0
        found.add((kind, fraction > 1e-9))
    assert ("coast", True) in found
    assert limit_use(envelope, window).max() <= 1.0
    assert cartesian_use(envelope, window)[0].max() <= 1.0


def test_a_fraction_is_as_large_as_the_limits_allow() -> None:
    envelope = Envelope(TIGHT, 0.008, 5)
    past = np.tile(HOME_Q_RAD.reshape(12), (1, HISTORY, 1))
    planned = past[:, -1:] + np.linspace(0, 0.5, 6)[1:, None] * np.eye(12)[5]
    use = limit_use(envelope, limited_windows(envelope, past, planned))
    assert 0.99999 < use.max() <= 1.0


# ------------------------------------------------------------------------------------------------ purity


@pytest.mark.parametrize("mode", MODES)
@pytest.mark.parametrize("limits", [HARD, TIGHT])
def test_a_cell_is_the_same_alone_and_among_others(mode: str, limits: MotionLimits) -> None:
    n, periods = 9, 40
    actions = actions_of_all_kinds(n, periods)
    together, alone = at_home(n=n, mode=mode, limits=limits), [at_home(mode=mode, limits=limits) for _ in range(n)]
    sent = []
    for action in actions:  # interleaved: nothing may be shared between adapters
        all_rows = together(action).targets_rad
        for row in range(n):
            np.testing.assert_array_equal(alone[row](action[row : row + 1]).targets_rad[0], all_rows[row])
        sent.append(all_rows)
    assert np.ptp(np.concatenate(sent, axis=1), axis=1).max() > 0.05


@pytest.mark.parametrize("mode", MODES)
@pytest.mark.parametrize("through", [lambda adapter: pickle.loads(pickle.dumps(adapter)), copy.deepcopy])
def test_equal_actions_give_equal_targets_after_pickling(mode: str, through) -> None:
    actions = actions_of_all_kinds(9, 40)
    first, second = at_home(n=9, mode=mode), at_home(n=9, mode=mode)
    np.testing.assert_array_equal(played(first, actions[:20]), played(second, actions[:20]))
    copied = through(second)
    played(second, actions[::-1])  # the copy is independent
    np.testing.assert_array_equal(played(first, actions[20:]), played(copied, actions[20:]))


def test_neither_actions_nor_results_are_held_on_to() -> None:
    first, second, rng = at_home(n=3), at_home(n=3), np.random.default_rng(0)
    for _ in range(20):
        action = rng.uniform(-1, 1, (3, 2, 6))
        spoiled = action.copy()
        sent = first(spoiled).targets_rad
        expected = second(action).targets_rad.copy()
        np.testing.assert_array_equal(sent, expected)
        spoiled[:] = np.nan
        sent[:] = np.nan
    start = np.tile(HOME_Q_RAD, (3, 1, 1))
    first.reset(start)
    start[:] = np.nan
    assert np.isfinite(first.commanded_q_rad).all()


def test_resetting_rows_resets_only_them() -> None:
    actions = actions_of_all_kinds(4, 30, seed=4)
    adapter, other, fresh = at_home(n=4), at_home(n=4), at_home(n=4)
    played(adapter, actions[:15])
    played(other, actions[:15])
    adapter.reset(HOME_Q_RAD[None], np.array([2]))
    went_on, reset, expected = (played(each, actions[15:]) for each in (other, adapter, fresh))
    np.testing.assert_array_equal(reset[[0, 1, 3]], went_on[[0, 1, 3]])
    np.testing.assert_array_equal(reset[2], expected[2])


def test_the_first_target_after_a_reset_is_the_start() -> None:
    for ticks in (1, 5):
        sent = at_home(ticks=ticks)(np.ones((1, 2, 6))).targets_rad
        assert np.abs(sent[:, 0] - HOME_Q_RAD).max() < 1e-3
        assert np.abs(at_home(ticks=ticks)(np.zeros((1, 2, 6))).targets_rad - HOME_Q_RAD).max() < 1e-12


def test_the_commanded_range_is_the_hard_one_by_default() -> None:
    adapter = at_home(mode="joint_position")
    np.testing.assert_allclose(adapter.action_bounds[1][0], JOINT_RANGE_RAD - JOINT_MARGIN_RAD)


def test_steps_of_translation_keep_the_orientation_of_each_tool():
    adapter = at_home(mode="tcp_translation", gripper=True, tcp_m=(0.15, 0.15))
    assert adapter.action_size == 4
    before = [flange_pose(adapter.commanded_q_rad[:, arm], NOMINAL_DH) for arm in range(2)]
    rng, step = np.random.default_rng(0), np.zeros((1, 2, 4))
    for k in range(60):
        if k % 10 == 0:
            step = rng.uniform(-1.0, 1.0, (1, 2, 4))
        adapter(step)
        if k == 30:  # a brake leaves the arms rotated a little
            turned = adapter.commanded_q_rad
            turned[..., 5] += 0.02
            adapter.reset(turned, begins=False)
    after = [flange_pose(adapter.commanded_q_rad[:, arm], NOMINAL_DH) for arm in range(2)]
    for (begin_m, begin), (end_m, end) in zip(before, after, strict=True):
        assert np.linalg.norm(end_m - begin_m) > 0.02
        np.testing.assert_allclose(end, begin, atol=1e-6)
