"""Path of an action from end to end: refusals, delay, and limits under any action."""

from __future__ import annotations

import pickle
from collections import Counter

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from dual_ur10.assets.settings import HOME_Q_RAD, SceneSettings
from dual_ur10.errors import ActionError
from dual_ur10.sim2real.control.adapter import ServojAdapter
from dual_ur10.sim2real.control.clearance import Clearance
from dual_ur10.sim2real.control.gate import SafetyGate
from dual_ur10.sim2real.control.limits import MotionLimits
from dual_ur10.sim2real.control.pipeline import ServojPipeline
from tests.sim2real.control.motion_checks import (
    ACTION_KINDS,
    HARD,
    NARROW,
    TIGHT,
    AlwaysClear,
    adversarial_action,
    assert_within,
    braked,
)
from tests.soak import scaled
from ur_core.kinematics.ur10 import NOMINAL_DH
from ur_core.servoj import ServojProfile

SOAK_TICKS = scaled(20_000_000, 500)
MODES = ("joint_delta", "joint_position", "tcp_delta")


def pipeline_at_home(
    n: int = 1,
    ticks: int = 5,
    limits: MotionLimits = HARD,
    profile: ServojProfile | None = None,
    clearance=None,
    held: int | None = None,
    leads: bool = True,
    **more,
) -> ServojPipeline:
    profile = profile or ServojProfile()
    adapter = ServojAdapter(profile, limits, ticks, n=n, **{"dh": [NOMINAL_DH] * 2, **more})
    gate = SafetyGate(limits, profile.tick_s, ticks, clearance or AlwaysClear(), n=n)
    pipeline = ServojPipeline(adapter, gate, held=held, leads=leads)
    pipeline.reset(np.tile(HOME_Q_RAD, (n, 1, 1)))
    return pipeline


# ------------------------------------------------------------------------------------------------ actions


@pytest.mark.parametrize("shape", [(3, 2, 6), (3, 12)])
def test_shapes_of_many_cells(shape: tuple[int, ...]) -> None:
    action = np.random.default_rng(0).uniform(-1, 1, shape)
    np.testing.assert_array_equal(pipeline_at_home(3).check(action), action.reshape(3, 2, 6))


def test_actions_beyond_the_action_space_are_counted() -> None:
    pipeline = pipeline_at_home(2, gripper=True)
    action = np.zeros((2, 2, 7))
    for value, arm, number, counted in ((1.0, 0, 2, 0), (-1.0, 1, 6, 0), (1.01, 0, 2, 1), (-7.0, 1, 6, 2)):
        action[:] = 0.0
        action[1, arm, number] = value
        pipeline(action)
        assert pipeline.clipped_actions == counted
    pipeline(np.full((2, 2, 7), -1e9))
    assert pipeline.clipped_actions == 4
    positions = pipeline_at_home(mode="joint_position")
    low, high = positions.adapter.action_bounds
    for bound in (low, high):
        positions(bound.astype(np.float32))  # as policies know it
    assert positions.clipped_actions == 0


@pytest.mark.parametrize("shape", [(1, 2, 6), (1, 12), (2, 6), (12,)])
def test_shapes_of_one_cell(shape: tuple[int, ...]) -> None:
    assert pipeline_at_home().check(np.zeros(shape)).shape == (1, 2, 6)


@pytest.mark.parametrize(
    ("n", "shape"),
    [
        (1, (6,)),
        (1, ()),
        (1, (1,)),
        (1, (6, 2)),
        (1, (7,)),
        (1, (2, 7)),
        (1, (1, 1, 12)),
        (1, (12, 1)),
        (1, (2, 2, 6)),
        (1, (0,)),
        (3, (2, 6)),
        (3, (1, 2, 6)),
        (3, (12,)),
        (3, (36,)),
        (3, (6, 6)),
        (3, (12, 3)),
        (2, (2, 6)),
    ],
)
def test_other_shapes_are_refused_and_never_broadcast(n: int, shape: tuple[int, ...]) -> None:
    with pytest.raises(ActionError, match="shape"):
        pipeline_at_home(n)(np.zeros(shape))


@pytest.mark.parametrize(
    "action",
    [
        np.zeros((1, 2, 6), dtype=complex),
        np.zeros((1, 2, 6), dtype=object),
        np.zeros((1, 2, 6), dtype=bool),
        np.full((1, 2, 6), "0"),
        np.zeros((1, 2, 6), dtype="datetime64[s]"),
        None,
        "forward",
        {"left": np.zeros(6), "right": np.zeros(6)},
        [[0.0] * 6, [0.0] * 5],
        object(),
    ],
)
def test_other_types_are_refused(action: object) -> None:
    with pytest.raises(ActionError, match="numbers"):
        pipeline_at_home()(action)


@pytest.mark.parametrize("dtype", [np.float16, np.float32, np.int8, np.uint8, np.int64, ">f8"])
def test_all_plain_numbers_are_taken(dtype) -> None:
    action = np.ones((1, 2, 6), dtype=dtype)
    expected = pipeline_at_home()(np.ones((1, 2, 6)))[0].targets_rad
    np.testing.assert_array_equal(pipeline_at_home()(action)[0].targets_rad, expected)
    np.testing.assert_array_equal(pipeline_at_home()(action.tolist())[0].targets_rad, expected)


@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf])
@pytest.mark.parametrize(("arm", "name"), [(0, "left"), (1, "right")])
def test_nan_and_infinity_are_refused_with_the_arms_name(value: float, arm: int, name: str) -> None:
    action = np.zeros((3, 2, 6), dtype=np.float32)
    action[2, arm, 4] = value
    with pytest.raises(ActionError, match=f"number 4 of the {name} arm") as caught:
        pipeline_at_home(3)(action)
    assert "cell 2" in str(caught.value)


@pytest.mark.parametrize("mode", MODES)
def test_a_refused_action_changes_nothing(mode: str) -> None:
    rng = np.random.default_rng(0)
    pipeline, other = (pipeline_at_home(2, mode=mode) for _ in range(2))
    spoiled = np.zeros((2, 2, 6))
    spoiled[1, 0, 0] = np.nan
    for _ in range(15):
        action = rng.uniform(-1, 1, (2, 2, 6))
        for bad in (spoiled, np.zeros(5), "x"):
            with pytest.raises(ActionError):
                pipeline(bad)
        np.testing.assert_array_equal(pipeline(action)[0].targets_rad, other(action)[0].targets_rad)


def test_an_action_is_copied() -> None:
    pipeline, other = pipeline_at_home(), pipeline_at_home()
    action = np.full((1, 2, 6), 0.5)
    for _ in range(10):
        expected = other(action)[0].targets_rad
        given = action.copy()
        checked = pipeline.check(given)
        checked[:] = np.nan
        sent = pipeline(given)[0].targets_rad
        given[:] = np.nan
        np.testing.assert_array_equal(sent, expected)


def test_a_pipeline_continues_after_pickling() -> None:
    pipeline, rng = pipeline_at_home(2, clearance=Clearance(SceneSettings())), np.random.default_rng(0)
    for _ in range(5):
        pipeline(rng.uniform(-1, 1, (2, 2, 6)))
    restored = pickle.loads(pickle.dumps(pipeline))
    for _ in range(5):
        action = rng.uniform(-1, 1, (2, 2, 6))
        np.testing.assert_array_equal(pipeline(action)[0].targets_rad, restored(action)[0].targets_rad)


# ------------------------------------------------------------------------------------------------ limits


def play(pipeline: ServojPipeline, kinds: list[str], periods: int, seed: int) -> tuple[np.ndarray, dict]:
    """Return all released targets after the start, and the last verdicts."""
    n, rng = len(kinds), np.random.default_rng(seed)
    sent, verdicts = [np.tile(HOME_Q_RAD, (n, 4, 1, 1))], {}
    for period in range(periods):
        rows = [adversarial_action(kind, period, rng, (1, 2, 6)) for kind in kinds]
        command, verdicts = pipeline(rows[0] if n == 1 else np.concatenate(rows))
        sent.append(command.targets_rad)
    return np.concatenate(sent, axis=1), verdicts


def assert_legal_and_stoppable(sent: np.ndarray, pipeline: ServojPipeline, stops: int) -> None:
    limits, tick_s, ticks = pipeline.gate.limits, pipeline.adapter.profile.tick_s, pipeline.adapter.ticks
    assert_within(sent, limits, tick_s)
    # The gate takes over at the ends of its windows.
    ends = np.arange(4 + ticks, sent.shape[1] + 1, ticks)
    for end in np.random.default_rng(0).choice(ends, min(stops, len(ends)), replace=False):
        assert_within(braked(sent[:, end - 3 : end], limits, tick_s), limits, tick_s)


@settings(max_examples=scaled(500))
@given(
    kinds=st.one_of(
        st.lists(st.sampled_from(ACTION_KINDS), min_size=1, max_size=1),
        st.lists(st.sampled_from(ACTION_KINDS), min_size=3, max_size=3),
    ),
    mode=st.sampled_from(MODES),
    family=st.sampled_from(["cb3", "e-series"]),
    ticks=st.sampled_from([1, 2, 5, 25]),
    limits=st.sampled_from([HARD, TIGHT, NARROW]),
    compensate_lag=st.booleans(),
    seed=st.integers(0, 2**31),
)
def test_no_action_exceeds_a_limit(
    kinds: list[str],
    mode: str,
    family: str,
    ticks: int,
    limits: MotionLimits,
    compensate_lag: bool,
    seed: int,
) -> None:
    pipeline = pipeline_at_home(
        len(kinds), ticks, limits, ServojProfile(family), mode=mode, compensate_lag=compensate_lag
    )
    sent, verdicts = play(pipeline, kinds, max(12, 300 // ticks), seed)
    assert_legal_and_stoppable(sent, pipeline, stops=3)
    assert verdicts == {}  # the adapter leaves the gate nothing to refuse but distances


def test_soak_of_adversarial_actions() -> None:
    cells, done, seed = 18, 0, 0
    while done < SOAK_TICKS:
        rng = np.random.default_rng(seed)
        family = str(rng.choice(["cb3", "e-series"]))
        profile = ServojProfile(family)
        if rng.random() < 0.5:
            profile = ServojProfile(family, rng.uniform(0.03, 0.2), rng.uniform(100.0, 2000.0))
        ticks = int(rng.choice([1, 2, 5, 25]))
        pipeline = pipeline_at_home(
            cells,
            ticks,
            (HARD, TIGHT, NARROW)[rng.integers(3)],
            profile,
            mode=str(rng.choice(MODES)),
            compensate_lag=bool(rng.random() < 0.75),
            yaw_rad=(0.3, -0.2),
        )
        kinds = [ACTION_KINDS[row % len(ACTION_KINDS)] for row in range(cells)]
        sent, verdicts = play(pipeline, kinds, max(8, 450 // ticks), seed)
        assert_legal_and_stoppable(sent, pipeline, stops=3)
        assert verdicts == {}, (seed, {row: str(verdict) for row, verdict in verdicts.items()})
        done += cells * (sent.shape[1] - 4)
        seed += 1


@pytest.mark.parametrize("mode", ["joint_delta", "tcp_delta"])
def test_random_actions_meet_the_gate_only_for_distances(mode: str) -> None:
    n, limits = 40, MotionLimits(speed_rad_s=1.0)
    pipeline = pipeline_at_home(n, limits=limits, clearance=Clearance(SceneSettings()), mode=mode, leads=False)
    rng, found = np.random.default_rng(0), Counter()
    drift = rng.uniform(-0.6, 0.6, (n, 2, 6))
    sent = [np.tile(HOME_Q_RAD, (n, 4, 1, 1))]
    for _ in range(150):
        command, verdicts = pipeline(drift + rng.uniform(-0.4, 0.4, (n, 2, 6)))
        sent.append(command.targets_rad)
    found = Counter(verdict.kind for verdict in verdicts.values())
    assert set(found) == {"distance"}, found
    assert_within(np.concatenate(sent, axis=1), limits, 0.008)


# ------------------------------------------------------------------------------------------------ one arm alone


@pytest.mark.parametrize(("mode", "held"), [*zip(MODES, (0, 1, 0), strict=True)])
def test_a_held_arm_stays_where_it_is_bit_for_bit(mode: str, held: int) -> None:
    n = 3 * len(ACTION_KINDS)
    pipeline, both = (pipeline_at_home(n, mode=mode, limits=TIGHT, held=each) for each in (held, None))
    start = HOME_Q_RAD + np.random.default_rng(0).uniform(-0.2, 0.2, (n, 2, 6))
    rng, sent, free = np.random.default_rng(1), [], []
    for each in (pipeline, both):
        each.reset(start)
    for period in range(60):
        action = np.concatenate([adversarial_action(kind, period, rng, (3, 2, 6)) for kind in ACTION_KINDS])
        sent.append(pipeline(action)[0].targets_rad)
        free.append(both(action)[0].targets_rad)
    targets, expected = np.concatenate(sent, axis=1), np.concatenate(free, axis=1)
    assert (targets[:, :, held] == start[:, None, held]).all()
    # The other one does what it would have done.
    np.testing.assert_array_equal(targets[:, :, 1 - held], expected[:, :, 1 - held])
    before = np.repeat(start[:, None], 3, axis=1)
    assert_within(np.concatenate([before, targets], axis=1), TIGHT, 0.008)


def test_after_another_start_a_held_arm_is_held_there() -> None:
    pipeline = pipeline_at_home(2, held=1)
    for _ in range(10):
        pipeline(np.full((2, 2, 6), 0.5))
    q = HOME_Q_RAD + 0.1
    pipeline.reset(q[None], np.array([1]))
    found = pipeline(np.full((2, 2, 6), 0.5))[0].targets_rad
    assert (found[1, :, 1] == q[1]).all()
    assert (found[0, :, 1] == HOME_Q_RAD[1]).all()
    assert (found[:, -1, 0] != q[0]).all()


def test_distances_are_measured_to_where_a_held_arm_stays() -> None:
    class Seen(AlwaysClear):
        configurations: list[np.ndarray] = []  # noqa: RUF012

        def spare_m(self, q_rad):
            self.configurations.append(np.array(q_rad).reshape(-1, 2, 6))
            return super().spare_m(q_rad)

    seen = Seen()
    pipeline = pipeline_at_home(clearance=seen, held=0)
    for _ in range(20):
        pipeline(np.ones((1, 2, 6)))
    configurations = np.concatenate(seen.configurations)
    assert np.abs(configurations[:, 0] - HOME_Q_RAD[0]).max() < 1e-12
    assert np.ptp(configurations[:, 1], axis=0).max() > 0.05


# ------------------------------------------------------------------------------------------------ grippers


def with_grippers(widths: np.ndarray) -> np.ndarray:
    """Return actions that hold the arms still with gripper widths between -1 and 1, (n, 2)."""
    action = np.zeros((len(widths), 2, 7))
    action[..., 6] = widths
    return action


def test_a_refused_row_keeps_its_gripper_widths() -> None:
    class Closed(AlwaysClear):
        """Nothing is clear in row 1, the second of two, from the third period on."""

        def spare_m(self, q_rad):
            return np.array([0.1 if self.checks <= 4 or self.checks % 2 else -0.1])

        def worst(self, q_rad):
            return "left/palm and table", 0.0, 0.02

    pipeline = pipeline_at_home(2, gripper=True, clearance=Closed(), leads=False)
    both = [pipeline(with_grippers(np.full((2, 2), value))) for value in (0.5, -0.2, 0.9, -1.0, 1.0, 1.0)]
    widths = np.concatenate([command.gripper_m for command, _ in both], axis=1)
    assert 1 in both[2][1]
    last = widths[1, 9]  # what was sent last before the refusal
    np.testing.assert_array_equal(widths[1, 10:], np.broadcast_to(last, (20, 2)))
    assert np.ptp(widths[0, 10:, 0]) > 0.01  # the other row continues
    pipeline.reset(HOME_Q_RAD[None], np.array([0]), np.full((1, 2), 0.03))  # and begins another episode
    command, verdicts = pipeline(with_grippers(np.full((2, 2), 0.5)))
    assert 1 in verdicts
    np.testing.assert_array_equal(command.gripper_m[1], np.broadcast_to(last, (5, 2)))
