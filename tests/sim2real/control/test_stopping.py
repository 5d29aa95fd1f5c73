"""Commands that stop, turn back or are no numbers: arms go little farther than the limits make them."""

from __future__ import annotations

from functools import cache

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from dual_ur10.assets.settings import HOME_Q_RAD
from dual_ur10.sim2real.control import stopping
from dual_ur10.sim2real.control.limits import HISTORY
from tests.sim2real.control.motion_checks import HARD, NARROW, TIGHT, limit_use
from tests.sim2real.control.test_adapter import CB3, E_SERIES, at_home, commanded_arms, played
from ur_core.servoj import ServojLaw, ServojProfile

SPEEDS_RAD_S = np.array([0.005, 0.02, 0.05, 0.1, 0.2, 0.5, 1.0])
LEAST_MRAD = {  # past a stop at these speeds: the optimum of a linear program, `benchmarks/adapter.py`
    "cb3": np.array([0.005, 0.133, 0.641, 1.941, 5.617, 23.505, 72.601]),
    "e-series": np.array([0.042, 0.286, 1.015, 2.673, 7.135, 27.271, 80.161]),
}


def beyond(profile: ServojProfile, rate_hz: float, speed: np.ndarray, change: float, joints=((0, 5),)) -> np.ndarray:
    """Return how far arms are past commands that go on at `change` times their speed, (n, k) rad, from there on."""
    ticks, last = profile.ticks_per_action(rate_hz), round(0.6 * rate_hz)
    number = np.arange(1 + 3 * last)
    commands = -speed[:, None] / rate_hz * (np.minimum(number, last) + change * np.maximum(number - last, 0))
    adapter = at_home(len(speed), profile, ticks, mode="joint_position")
    way = commanded_arms(adapter, commands, joints)
    between = commands[:, :-1, None] + np.diff(commands, axis=1)[..., None] * np.arange(1, ticks + 1) / ticks
    return (between - way)[:, last:].reshape(len(speed), -1)


@pytest.mark.parametrize("rate_hz", [12.5, 25, 62.5, 125])
@pytest.mark.parametrize("profile", [CB3, E_SERIES], ids=["cb3", "e-series"])
def test_an_arm_stops_little_past_its_command_and_returns_once(profile: ServojProfile, rate_hz: float) -> None:
    past = beyond(profile, rate_hz, SPEEDS_RAD_S, 0.0)
    assert (1e3 * past.max(axis=1) <= 1.3 * LEAST_MRAD[profile.family] + 0.1).all()
    assert past.min() > -1e-5
    assert np.abs(past[:, -1]).max() < 1e-6


@pytest.mark.parametrize("rate_hz", [25, 62.5])
@pytest.mark.parametrize("change", [0.5, -1.0])
def test_a_turn_of_the_commands_is_braked_as_a_stop(change: float, rate_hz: float) -> None:
    """In the frame of the commands it is one, from the difference of both speeds."""
    difference = np.array([0.05, 0.1, 0.2])
    past = beyond(CB3, rate_hz, difference / (1 - change), change)
    assert (1e3 * past.max(axis=1) <= 1.3 * LEAST_MRAD["cb3"][2:5] + 0.1).all()


def test_an_arm_that_stops_does_not_hold_the_other() -> None:
    adapter, alone = at_home(mode="joint_position"), at_home(mode="joint_position")
    for period in range(60):
        action = np.tile(HOME_Q_RAD, (1, 1, 1))
        action[0, 1] += 0.02 * np.sin(0.1 * period) ** 4
        wanted = alone(action).targets_rad[:, :, 1]
        action[0, 0] += 0.004 * min(period, 30)
        found = adapter(action).targets_rad[:, :, 1]
        # While the left arm is on its commands, and while it brakes; both arms share the time of its way back.
        if period >= 20:
            np.testing.assert_allclose(found, wanted, atol=1e-9 if period <= 31 else 1e-4)


def test_joints_that_stop_together_keep_their_direction() -> None:
    """One number of ticks for all joints of a cell: two arms that hold one object do not bend it."""
    adapter = at_home()
    action = np.random.default_rng(0).uniform(-0.1, 0.1, (1, 2, 6))
    sent = played(adapter, np.array([action * (period < 25) for period in range(35)]))[0].reshape(-1, 12)
    steps, direction = np.diff(sent[125:], axis=0), action.ravel() * adapter.joint_step_rad
    along = steps @ direction / (direction**2).sum()
    assert np.abs(steps).max() > 1e-4
    assert np.abs(steps - along[:, None] * direction).max() < 1e-9


PIECES = st.lists(
    st.tuples(st.integers(1, 8), st.sampled_from([0.0, 0.0, -1.0, 0.5, 1.0]), st.integers(0, 5)), max_size=8
)


@given(
    pieces=PIECES,
    kind=st.sampled_from([(CB3, 1), (CB3, 5), (E_SERIES, 8)]),
    limits=st.sampled_from([HARD, TIGHT, NARROW]),
)
def test_lines_that_stop_and_turn_break_no_limit_and_are_reached(pieces, kind, limits) -> None:
    profile, ticks = kind
    adapter, actions = at_home(profile=profile, ticks=ticks, limits=limits), []
    for periods, speed, joint in pieces:
        action = np.zeros((1, 2, 6))
        action[0, 0, joint], action[0, 1] = speed, speed / 4
        actions += [action] * periods
    rest_s = 1.5 if limits is not TIGHT else 4.0
    actions += [np.zeros((1, 2, 6))] * round(rest_s / adapter.period_s)
    sent = played(adapter, np.array(actions))[0].reshape(-1, 12)
    history = np.concatenate([np.tile(HOME_Q_RAD.reshape(1, 12), (HISTORY, 1)), sent])
    windows = np.stack([history[k : k + HISTORY + ticks] for k in range(0, len(sent), ticks)])
    assert limit_use(adapter.envelope, windows).max() <= 1.0
    assert np.abs(sent[-1] - adapter.commanded_q_rad.ravel()).max() < 1e-6


@pytest.mark.parametrize("mode", ["joint_delta", "joint_position", "tcp_delta"])
@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf])
def test_an_action_that_is_no_number_is_no_motion(mode: str, value: float) -> None:
    adapter, alone = at_home(3, mode=mode, gripper=True), at_home(1, mode=mode, gripper=True)
    action = np.zeros((3, 2, 7))
    action[..., :6] = HOME_Q_RAD if mode == "joint_position" else 0.0
    action[..., 6] = 0.5
    first = adapter(action).gripper_m
    alone(action[:1])
    action[1, 0, 2], action[2, 1, 6] = value, value
    for _ in range(5):
        command = adapter(action)
        assert np.abs(command.targets_rad - HOME_Q_RAD).max() < 1e-9
        np.testing.assert_array_equal(command.gripper_m, first)
        np.testing.assert_array_equal(command.targets_rad[0], alone(action[:1]).targets_rad[0])


# ------------------------------------------------------------------------------------------------ the law of a stop


@cache
def law(family: str) -> tuple[np.ndarray, np.ndarray, float]:
    profile = ServojProfile(family)
    arm = np.zeros((2, 6))
    arm[:, HISTORY:] = ServojLaw(profile.lookahead_s, profile.gain).response(profile.tick_s, 1, 1)[0]
    return stopping.gains(arm, profile.tick_s, 10.0, 2000.0), arm, profile.tick_s


@pytest.mark.parametrize("family", ["cb3", "e-series"])
@pytest.mark.parametrize("count", [6, 12, 40])
def test_a_stop_is_the_least_squares_solution_that_ends_at_rest(family: str, count: int) -> None:
    gains, arm, tick_s = law(family)
    begin = np.array([-0.01, -0.005, 0.0, -0.015, 0.3])
    carried, plan = begin, []
    for k in range(count):
        plan.append(gains[count - 1 - k] @ carried)
        carried = np.array([*carried[1:3], plan[-1], *(arm @ [*carried, plan[-1]])])
    assert abs(carried[3] - plan[-1]) < 1e-6
    assert abs(carried[4]) < 2e-5

    # The same by one linear least-squares problem with the end as a constraint.
    def arm_after(targets: np.ndarray) -> np.ndarray:
        q, qd, past = begin[3], begin[4], list(begin[:3])
        for u in targets:
            q, qd = arm @ [*past, q, qd, u]
            past = [*past[1:], u]
        return np.array([q - past[-1], qd * tick_s])

    weight = 1.5 * 10.0 / 2000.0 / tick_s
    whole = np.eye(3 + count + 2, 3 + count)
    whole[-2:, -1] = 1.0
    rows = np.vstack([np.diff(whole, 2, axis=0)[1:], weight * np.diff(whole, 3, axis=0)])
    at_zero = arm_after(np.zeros(count))
    constraint = np.stack([arm_after(each) - at_zero for each in np.eye(count)], axis=1)
    normal = np.block([[rows[:, 3:].T @ rows[:, 3:], constraint.T], [constraint, np.zeros((2, 2))]])
    right = np.concatenate([-rows[:, 3:].T @ rows[:, :3] @ begin[:3], -at_zero])
    wanted = np.linalg.solve(normal, right)[:count]
    np.testing.assert_allclose(plan, wanted, atol=2e-6)
