"""The safety gate alone: legal motion passes untouched, and released targets keep every limit."""

from __future__ import annotations

import copy
import pickle

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from dual_ur10.assets.collision_model import clearance_pairs
from dual_ur10.assets.settings import HOME_Q_RAD, SceneSettings
from dual_ur10.errors import ActionError, SettingsError
from dual_ur10.sim2real.control.adapter import ServojAdapter
from dual_ur10.sim2real.control.clearance import MINIMUM_M, Clearance
from dual_ur10.sim2real.control.gate import SafetyGate
from dual_ur10.sim2real.control.limits import MotionLimits
from tests.sim2real.control.motion_checks import HARD, NARROW, TIGHT, TOOL, AlwaysClear, assert_within
from tests.soak import scaled
from ur_core.kinematics.ur10 import ARMS, NOMINAL_DH
from ur_core.servoj import ServojProfile

TICKS = 5
TICK_S = {"cb3": 0.008, "e-series": 0.002}


def gate_at_home(
    n: int = 1, limits: MotionLimits = HARD, ticks: int = TICKS, tick_s: float = 0.008, clearance=None
) -> SafetyGate:
    gate = SafetyGate(limits, tick_s, ticks, clearance or AlwaysClear(), n=n)
    gate.reset(np.tile(HOME_Q_RAD, (n, 1, 1)))
    return gate


def legal_motion(n: int, periods: int, seed: int = 0, limits: MotionLimits = HARD, ticks: int = TICKS, family="cb3"):
    """Return targets from home, (periods, n, ticks, 2, 6), of an adapter under random actions."""
    adapter, rng = (
        ServojAdapter(ServojProfile(family), limits, ticks, n=n, dh=[NOMINAL_DH] * 2),
        np.random.default_rng(seed),
    )
    adapter.reset(np.tile(HOME_Q_RAD, (n, 1, 1)))
    push = rng.uniform(-1, 1, (n, 2, 6))
    return np.array(
        [adapter(np.clip(push + rng.uniform(-0.3, 0.3, (n, 2, 6)), -1, 1)).targets_rad.copy() for _ in range(periods)]
    )


def test_legal_motion_passes_unchanged() -> None:
    gate = gate_at_home(3)
    for targets in legal_motion(3, 40):
        before = targets.copy()
        result = gate(targets)
        assert result.verdicts == {}
        np.testing.assert_array_equal(result.targets_rad, before)
        np.testing.assert_array_equal(targets, before)
        np.testing.assert_array_equal(gate.last_targets_rad, before[:, -1])


@pytest.mark.parametrize(
    "spoil",
    [
        lambda targets: targets[:, :-1],
        lambda targets: targets[0],
        lambda targets: targets[:, :, :, :5],
        lambda targets: targets.reshape(2, TICKS, 12),
        lambda targets: np.concatenate([targets, targets]),
        lambda targets: np.float64(0.0),
        lambda targets: targets.astype(np.float32),
        lambda targets: targets.astype(complex),
        lambda targets: targets.astype(object),
        lambda targets: targets.astype(str),
        lambda targets: targets.astype(">f8"),
        lambda targets: targets.astype(int),
        lambda targets: targets.tolist(),
        lambda targets: None,
    ],
)
def test_malformed_targets_raise_and_change_nothing(spoil) -> None:
    gate, motion = gate_at_home(2), legal_motion(2, 12)
    for k, targets in enumerate(motion):
        with pytest.raises(ActionError):
            gate(spoil(targets))
        result = gate(targets)
        assert not result.verdicts, k
        np.testing.assert_array_equal(result.targets_rad, targets)


@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf])
@pytest.mark.parametrize("place", [(0, 0, 0, 0), (1, 2, 0, 5), (2, 4, 1, 3)])
def test_nan_and_infinity_raise_and_change_nothing(value: float, place: tuple[int, int, int, int]) -> None:
    gate, motion = gate_at_home(3), legal_motion(3, 8)
    row, tick, arm, _ = place
    for targets in motion:
        spoiled = targets.copy()
        spoiled[place] = value
        with pytest.raises(ActionError) as caught:
            gate(spoiled)
        assert ("left", "right")[arm] in str(caught.value)
        assert f"cell {row}, tick {tick}" in str(caught.value)
        assert not gate(targets).verdicts


def test_nan_raises_while_another_row_is_stopping() -> None:
    gate, motion = gate_at_home(2), legal_motion(2, 8)
    for targets in motion[:4]:
        gate(targets)
    jump = motion[4].copy()
    jump[0] += 0.5
    assert set(gate(jump).verdicts) == {0}
    spoiled = motion[5].copy()
    spoiled[0, 0, 0, 0] = np.nan
    with pytest.raises(ActionError):
        gate(spoiled)
    result = gate(motion[5])
    assert set(result.verdicts) == {0}
    np.testing.assert_array_equal(result.targets_rad[1], motion[5][1])


def push_beyond(kind: str, last: np.ndarray, targets: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    if kind == "jump":
        return targets + rng.uniform(-3, 3, (*targets.shape[:1], 1, 2, 6))
    if kind == "walk":
        return last[:, None] + np.cumsum(rng.normal(0, 0.02, targets.shape), axis=1)
    if kind == "huge":
        return targets + rng.choice([-1e9, 0.0, 1e300], targets.shape)
    if kind == "subtle":
        return targets + 1e-6 * rng.choice([-1.0, 1.0], targets.shape)
    return np.zeros_like(targets)


@settings(max_examples=scaled(24, 2))
@given(
    kind=st.sampled_from(["jump", "walk", "huge", "subtle", "zero"]),
    family=st.sampled_from(["cb3", "e-series"]),
    ticks=st.sampled_from([1, 2, 5, 25]),
    limits=st.sampled_from([HARD, TIGHT, NARROW, TOOL]),
    seed=st.integers(0, 2**31),
)
def test_a_refused_row_brakes_to_rest_within_all_limits(
    kind: str, family: str, ticks: int, limits: MotionLimits, seed: int
) -> None:
    n, tick_s, rng = 6, TICK_S[family], np.random.default_rng(seed)
    moving = max(4, round(0.3 / (ticks * tick_s)))
    resting = round(3.0 / (ticks * tick_s))
    motion = legal_motion(n, moving, seed, limits, ticks, family)
    gate = gate_at_home(n, limits, ticks, tick_s)
    sent = [np.tile(HOME_Q_RAD, (n, 4, 1, 1))]
    for targets in motion:
        sent.append(gate(targets).targets_rad)
    for _ in range(resting):
        result = gate(push_beyond(kind, gate.last_targets_rad, np.repeat(sent[-1][:, -1:], ticks, axis=1), rng))
        sent.append(result.targets_rad)
    assert_within(np.concatenate(sent, axis=1), limits, tick_s)
    stopped = sorted(result.verdicts)
    assert kind == "subtle" or len(stopped) == n
    np.testing.assert_array_equal(sent[-1][stopped, -1], sent[-2][stopped, 0])
    assert all(verdict.kind != "distance" for verdict in result.verdicts.values())


@pytest.mark.parametrize(
    ("stricter", "tick_s"),
    [
        (MotionLimits(tcp_speed_m_s=0.25), 0.008),
        (MotionLimits(tcp_speed_m_s=0.8), 0.002),
        (MotionLimits(speed_rad_s=0.4), 0.008),
        (MotionLimits(acceleration_rad_s2=4.0), 0.002),
        (MotionLimits(jerk_rad_s3=150.0), 0.008),
        (MotionLimits(jerk_rad_s3=15.0, acceleration_rad_s2=3.0), 0.008),
        (NARROW, 0.008),
        (TOOL, 0.008),
    ],
)
def test_motion_that_grows_into_a_limit_is_stopped_before_it(stricter: MotionLimits, tick_s: float) -> None:
    # The hardest case: accelerating at full, so that the brake still has to come round.
    n, ticks = 24, 2
    family = "cb3" if tick_s == 0.008 else "e-series"
    # A gentle start, so that the motion is refused for what it grows to.
    slow = MotionLimits(jerk_rad_s3=stricter.jerk_rad_s3, acceleration_rad_s2=stricter.acceleration_rad_s2)
    motion = legal_motion(n, round(0.8 / (ticks * tick_s)), 3, slow, ticks, family)
    gate = gate_at_home(n, stricter, ticks, tick_s)
    sent, passed = [np.tile(HOME_Q_RAD, (n, 4, 1, 1))], 0
    for targets in motion:
        result = gate(targets)
        passed += n - len(result.verdicts)
        sent.append(result.targets_rad)
    for _ in range(round(1.0 / (ticks * tick_s))):
        sent.append(gate(motion[-1]).targets_rad)
    assert passed > 0
    assert_within(np.concatenate(sent, axis=1), stricter, tick_s)


def test_a_refusal_names_joint_found_and_allowed() -> None:
    gate = gate_at_home(2)
    still = np.tile(HOME_Q_RAD, (2, TICKS, 1, 1))
    for _ in range(3):
        gate(still)
    beyond = still.copy()
    beyond[1, :, 1, 2] += 5.0 * np.arange(1, TICKS + 1) * 0.008
    verdict = gate(beyond).verdicts[1]
    assert verdict.subject == "right/elbow_joint"
    assert verdict.kind == "joint acceleration"
    assert verdict.found == pytest.approx(5.0 / 0.008)
    assert verdict.allowed == 10.0
    assert verdict.tick == 3 * TICKS
    for part in (
        "right/elbow_joint",
        "joint acceleration",
        "625 rad/s²",
        "at most 10 rad/s²",
        f"tick {3 * TICKS}",
    ):
        assert part in str(verdict)
    again = gate(still)
    assert again.verdicts[1] == verdict  # the first reason stays


@pytest.mark.parametrize("name", ["rows", "middle", "scale"])
@pytest.mark.parametrize("kind", ["joint speed", "joint acceleration", "joint jerk", "joint position"])
def test_a_limit_that_is_nan_refuses_and_is_named_first(name: str, kind: str) -> None:
    gate = gate_at_home(2)
    still = np.tile(HOME_Q_RAD, (2, TICKS, 1, 1))
    assert not gate(still).verdicts
    envelope = gate.envelope
    row, column = envelope.kinds.index(kind), 8
    where = (row, int(envelope.kernel.values["begins"][row])) if name == "rows" else (row, column)
    envelope.kernel.values[name].reshape(len(envelope.rows), -1)[where] = np.nan
    far = still.copy()
    far[1, :, 1, 3] += 1.0  # far beyond limits that are numbers
    result = gate(far)
    np.testing.assert_array_equal(result.targets_rad, still)
    assert {verdict.kind for verdict in result.verdicts.values()} == {kind}
    if name != "rows":  # a coefficient of all joints
        assert [result.verdicts[each].subject for each in range(2)] == ["right/elbow_joint"] * 2


@pytest.mark.parametrize("arm", [0, 1])
def test_a_speed_that_is_nan_refuses(arm: int) -> None:
    limits = MotionLimits(tcp_speed_m_s=0.2, tcp_m=((0.0, 0.0, 0.1), (0.0, 0.0, 0.1)))
    gate, speed = gate_at_home(1, limits), 0.0
    targets = np.tile(HOME_Q_RAD, (1, TICKS, 1, 1))
    for period in range(20):
        if period == 15:  # within the limit, which takes the points' positions to know
            gate.envelope.kernel.values["tcp_m"].reshape(2, 3)[arm, 0] = np.nan
        for tick in range(TICKS):
            speed = min(speed + 8e-5 * 0.5, 0.2 * 0.008)
            targets[0, tick:, :, 0] += speed
        result = gate(targets)
        assert bool(result.verdicts) == (period >= 15)
        targets[:] = targets[:, -1:]
    assert (result.verdicts[0].kind, result.verdicts[0].subject.split("/")[0]) == ("Cartesian speed", ARMS[arm])


@pytest.mark.parametrize("value", [np.nan, np.inf])
def test_a_start_that_is_not_finite_is_refused(value: float) -> None:
    gate = gate_at_home(2)
    start = np.tile(HOME_Q_RAD, (2, 1, 1)) + 0.1
    start[1, 1, 5] = value
    with pytest.raises(SettingsError, match="the gate must start from finite configurations"):
        gate.reset(start)
    np.testing.assert_array_equal(gate.last_targets_rad, np.tile(HOME_Q_RAD, (2, 1, 1)))


def test_a_position_out_of_range_is_reported_with_the_nearer_end() -> None:
    for sign, allowed in ((1, np.pi), (-1, -np.pi)):
        gate = gate_at_home()
        start = HOME_Q_RAD.copy()
        start[0, 2] = sign * (np.pi - 1e-3)
        gate.reset(start[None])
        beyond = np.tile(start, (1, TICKS, 1, 1))
        beyond[0, :, 0, 2] += sign * 3e-8 * np.arange(1, TICKS + 1) ** 4  # stops beyond
        beyond[0, :, 0, 2] += sign * 1e-3 * np.linspace(0, 1, TICKS) ** 3
        verdict = gate(beyond).verdicts.get(0)
        assert verdict is not None
        if verdict.kind == "joint position":
            assert verdict.allowed == pytest.approx(allowed)
            assert abs(verdict.found) > np.pi


def test_a_point_that_is_too_fast_is_named() -> None:
    limits = MotionLimits(tcp_speed_m_s=0.1)
    gate, motion = gate_at_home(1, limits), None
    slow = MotionLimits(acceleration_rad_s2=2.0, jerk_rad_s3=100.0)
    adapter = ServojAdapter(ServojProfile(), slow, TICKS, dh=[NOMINAL_DH] * 2)
    adapter.reset(HOME_Q_RAD[None])
    action = np.zeros((1, 2, 6))
    action[0, 1, 0] = 0.5
    for _ in range(30):
        motion = gate(adapter(action).targets_rad)
    verdict = motion.verdicts[0]
    assert (verdict.kind, verdict.subject) == ("Cartesian speed", "right/flange")
    assert verdict.allowed == 0.1 < verdict.found < 0.3
    assert "m/s" in str(verdict)


def test_other_rows_continue_and_a_reset_frees_only_its_rows() -> None:
    n, motion = 4, legal_motion(4, 40)
    gate = gate_at_home(n)
    for k, targets in enumerate(motion):
        spoiled = targets.copy()
        if k >= 10:
            spoiled[[0, 2]] += 1.0
        result = gate(spoiled)
        np.testing.assert_array_equal(result.targets_rad[[1, 3]], targets[[1, 3]])
        assert set(result.verdicts) == (set() if k < 10 else {0, 2})
    before = result
    gate.reset(HOME_Q_RAD[None], np.array([2]))
    assert set(before.verdicts) == {0, 2}  # a result is not changed afterwards
    fresh = legal_motion(4, 2)
    following = np.repeat(gate.last_targets_rad[:, None], TICKS, axis=1)
    following[2] = fresh[0][2]
    result = gate(following)
    assert 0 in result.verdicts
    assert 2 not in result.verdicts
    np.testing.assert_array_equal(result.targets_rad[2], fresh[0][2])
    jump = following.copy()
    jump[2] += 1.0
    assert gate(jump).verdicts[2].tick == TICKS  # counted from its own reset
    gate.reset(np.tile(HOME_Q_RAD, (n, 1, 1)))
    assert gate(np.tile(HOME_Q_RAD, (n, TICKS, 1, 1))).verdicts == {}


def test_no_caller_holds_the_gates_own_record() -> None:
    gate, motion = gate_at_home(), legal_motion(1, 20)
    other = copy.deepcopy(gate)
    for k, targets in enumerate(motion):
        given = targets + (1.0 if k >= 10 else 0.0)
        expected = other(given.copy()).targets_rad.copy()
        result = gate(given)
        np.testing.assert_array_equal(result.targets_rad, expected)
        given[:] = np.nan
        result.targets_rad[:] = 7.0
        result.verdicts.clear()  # a stop latches
        gate.last_targets_rad[:] = 9.0
    assert 0 in gate(motion[-1]).verdicts


def test_released_targets_do_not_change_with_the_input() -> None:
    gate, targets = gate_at_home(), legal_motion(1, 1)[0]
    expected = targets.copy()
    leaving = gate(targets).targets_rad
    targets[:] = 100.0
    np.testing.assert_array_equal(leaving, expected)


def drive(clearance: Clearance, action: np.ndarray, periods: int = 250):
    """Push until refused; return released targets, verdict and number of periods."""
    limits = MotionLimits(speed_rad_s=1.0)
    adapter = ServojAdapter(ServojProfile(), limits, TICKS, dh=[NOMINAL_DH] * 2)
    adapter.reset(HOME_Q_RAD[None])
    gate = gate_at_home(1, limits, clearance=clearance)
    sent = [np.tile(HOME_Q_RAD, (1, 4, 1, 1))]
    for _ in range(periods):
        result = gate(adapter(action).targets_rad)
        sent.append(result.targets_rad)
    return np.concatenate(sent, axis=1), result.verdicts.get(0)


DOWN, TOGETHER = np.zeros((1, 2, 6)), np.zeros((1, 2, 6))
DOWN[0, 0, 1] = 0.5
TOGETHER[0, :, 0] = -0.6, 0.6


@pytest.mark.parametrize(("action", "other"), [(DOWN, "table"), (TOGETHER, "right/")])
def test_an_arm_stops_before_it_comes_too_near(action: np.ndarray, other: str) -> None:
    sent, verdict = drive(Clearance(SceneSettings()), action)
    assert verdict is not None
    assert verdict.kind == "distance"
    assert "left/" in verdict.subject
    assert other in verdict.subject
    assert verdict.found < verdict.allowed == MINIMUM_M
    assert f"at least {MINIMUM_M}" in str(verdict)
    along = Clearance(SceneSettings()).measure(sent.reshape(-1, 12)).distances_m
    assert along.min() >= MINIMUM_M - 1e-4  # up to and at its final configuration
    assert along.min() < 0.1  # and it did come near
    np.testing.assert_array_equal(sent[0, -1], sent[0, -100])
    assert_within(sent, MotionLimits(speed_rad_s=1.0), 0.008)


def test_a_pair_may_come_as_near_as_it_is_allowed_to() -> None:
    tables = {pair: 0.0 for pair in clearance_pairs(SceneSettings()) if pair[1] == "table"}
    near, verdict = drive(Clearance(SceneSettings(), closer=tables), DOWN)
    far, _ = drive(Clearance(SceneSettings()), DOWN)
    assert near[0, -1, 0, 1] > far[0, -1, 0, 1] + 0.015
    assert verdict is not None
    assert verdict.allowed == 0.0


def test_a_wild_target_in_one_cell_does_not_blind_the_others() -> None:
    clearance = Clearance(SceneSettings())
    gate = gate_at_home(2, clearance=clearance)
    still = np.tile(HOME_Q_RAD, (2, TICKS, 1, 1))
    for value in (1e9, 1e300, -1e308):
        wild = still.copy()
        wild[0, :, 1, 3] = value
        result = gate(wild)
        assert set(result.verdicts) == {0}
        np.testing.assert_array_equal(result.targets_rad, still)
    gate.reset(HOME_Q_RAD[None], np.array([0]))
    assert gate(still).verdicts == {}


def test_a_gate_continues_after_pickling() -> None:
    gate, motion = gate_at_home(2, clearance=Clearance(SceneSettings())), legal_motion(2, 10)
    for targets in motion[:4]:
        gate(targets)
    jump = motion[4].copy()
    jump[1] += 1.0
    gate(jump)
    restored = pickle.loads(pickle.dumps(gate))
    for targets in motion[5:]:
        first, second = gate(targets), restored(targets)
        np.testing.assert_array_equal(first.targets_rad, second.targets_rad)
        assert first.verdicts == second.verdicts
        assert set(second.verdicts) == {1}
