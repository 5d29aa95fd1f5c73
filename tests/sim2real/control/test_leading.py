"""Motion that the gate would refuse is led along what is in its way, within all limits; legal motion is untouched."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st

from dual_ur10.assets.obstacles import Box, Capsule
from dual_ur10.assets.settings import HOME_Q_RAD, SceneSettings
from dual_ur10.sim2real.control.adapter import TCP_STEP_M_S, ServojAdapter
from dual_ur10.sim2real.control.clearance import Clearance
from dual_ur10.sim2real.control.gate import SWEEP_TOLERANCE_M, SafetyGate
from dual_ur10.sim2real.control.limits import MotionLimits
from dual_ur10.sim2real.control.pipeline import MARGIN_M, ServojPipeline
from tests.sim2real.control.motion_checks import HARD, TIGHT, AlwaysClear, assert_within, braked
from ur_core.kernel import call
from ur_core.kinematics import flange_pose
from ur_core.kinematics.ur10 import NOMINAL_DH
from ur_core.servoj import ServojProfile

MODES = ("joint_delta", "joint_position", "tcp_delta")
PLATE = Box(name="plate", position_m=(0.3, 0.0, 0.9), size_m=(0.6, 0.01, 0.4))
ROD = Capsule(name="rod", from_m=(0.0, -0.5, 0.7), to_m=(0.0, 0.5, 0.7), radius_m=0.004)
SCENES = {name: SceneSettings(obstacles=each) for name, each in {"": (), "plate": (PLATE,), "rod": (ROD,)}.items()}
CLEARANCES = {name: Clearance(scene) for name, scene in SCENES.items()}
SLOW = MotionLimits(speed_rad_s=1.0)


def at_home(clearance=CLEARANCES[""], n=1, ticks=5, limits=SLOW, leads=True, **more) -> ServojPipeline:
    profile = ServojProfile()
    held = more.pop("held", None)
    adapter = ServojAdapter(profile, limits, ticks, n=n, dh=[NOMINAL_DH] * 2, **more)
    gate = SafetyGate(limits, profile.tick_s, ticks, clearance, n=n)
    pipeline = ServojPipeline(adapter, gate, held=held, leads=leads)
    pipeline.reset(np.tile(HOME_Q_RAD, (n, 1, 1)))
    return pipeline


def tool(pipeline: ServojPipeline, arm: int) -> tuple[np.ndarray, np.ndarray]:
    """Return position and rotation of a flange at the last target, in its arm's `base`."""
    position, rotation = flange_pose(pipeline.gate.last_targets_rad[:1, arm], NOMINAL_DH)
    return position[0], rotation[0]


def moving(arm: int, *twist: float) -> np.ndarray:
    action = np.zeros((1, 2, 6))
    action[0, arm, : len(twist)] = twist
    return action


DOWN_AND_ALONG = moving(0, 0.0, 0.2, -0.6)

# ------------------------------------------------------------------------------------------------ what is legal


@pytest.mark.parametrize("mode", MODES)
def test_legal_motion_is_the_same_to_the_bit(mode: str) -> None:
    led, refused = at_home(n=8, mode=mode), at_home(n=8, mode=mode, leads=False)
    rng, stopped = np.random.default_rng(0), np.zeros(8, dtype=bool)
    periods = 0
    home = HOME_Q_RAD if mode == "joint_position" else 0.0
    drift = rng.uniform(-0.5, 0.5, (8, 2, 6))
    for period in range(150):
        action = home + drift * (period / 50 if mode == "joint_position" else 1.0) + rng.uniform(-0.3, 0.3, (8, 2, 6))
        (command, _), (plain, verdicts) = led(action), refused(action)
        stopped |= led.led
        assert {*verdicts} <= {*np.flatnonzero(stopped)}, "what is not led is what was released"
        np.testing.assert_array_equal(command.targets_rad[~stopped], plain.targets_rad[~stopped])
        rows = np.flatnonzero(~stopped)
        np.testing.assert_array_equal(led.adapter.commanded_q_rad[rows], refused.adapter.commanded_q_rad[rows])
        periods += int(rows.size)
    assert stopped.any()
    assert periods > 200


def test_a_question_changes_nothing_that_the_gate_knows() -> None:
    """Targets that were planned, and led, are refused as if nobody had asked."""
    asked, plain = at_home(mode="tcp_delta"), at_home(mode="tcp_delta", leads=False)
    for _ in range(120):
        _, expected = plain(DOWN_AND_ALONG)
        if expected:
            break
        asked(DOWN_AND_ALONG)
    asked.adapter(DOWN_AND_ALONG)
    planned = asked.adapter.targets_rad
    assert asked._leading().all()
    released, found = asked.gate(planned)
    assert found == expected
    np.testing.assert_array_equal(released, plain.gate._targets)


# ------------------------------------------------------------------------------------------------ what is not


@settings(max_examples=10)
@given(
    st.integers(0, 2**32 - 1),
    st.sampled_from(MODES),
    st.sampled_from(sorted(SCENES)),
    st.sampled_from([(5, HARD), (5, SLOW), (5, TIGHT), (2, SLOW), (25, TIGHT)]),
    st.floats(0.0, 1.0),
    st.booleans(),
)
@example(0, "joint_delta", "", (5, HARD), 1.0, False)
@example(1, "tcp_delta", "rod", (5, SLOW), 0.7, False)
@example(2, "joint_position", "plate", (25, TIGHT), 1.0, False)
def test_led_motion_keeps_every_limit_and_every_distance(seed, mode, scene, kind, steady, coupled) -> None:
    (ticks, limits), n = kind, 4
    pipeline, clearance, rng = (
        at_home(CLEARANCES[scene], n, ticks, limits, mode=mode),
        CLEARANCES[scene],
        np.random.default_rng(seed),
    )
    sent = [np.tile(HOME_Q_RAD, (n, 4, 1, 1))]
    for period in range(300 // ticks):
        if period % 12 == 0:
            drive = rng.choice([-1.0, 1.0], (n, 2, 6))
        action = steady * drive + (1.0 - steady) * rng.uniform(-1.0, 1.0, (n, 2, 6))
        command, verdicts = pipeline(action * (3.0 if mode == "joint_position" else 1.0), np.full(n, coupled))
        sent.append(command.targets_rad)
        stopping = braked(
            command.targets_rad[:, -3:] if ticks > 2 else np.concatenate(sent, axis=1)[:, -3:], limits, 0.008
        )
        legal = [row for row in range(n) if row not in verdicts]
        assert clearance.spare_m(stopping[legal, -1].reshape(-1, 12)).min() >= -1e-6
    path = np.concatenate(sent, axis=1)
    assert_within(path, limits, 0.008)
    assert clearance.spare_m(path.reshape(-1, 12)).min() >= -SWEEP_TOLERANCE_M


def test_tools_slide_along_the_table() -> None:
    pipeline = at_home(mode="tcp_delta")
    start, upright = tool(pipeline, 0)
    led, passed = 0, []
    for _ in range(135):
        before, _ = tool(pipeline, 0)
        _, verdicts = pipeline(DOWN_AND_ALONG)
        assert not verdicts
        led += int(pipeline.led[0])
        passed.append(tool(pipeline, 0)[0] - before)
    assert led > 40
    spare = CLEARANCES[""].spare_m(pipeline.gate.last_targets_rad.reshape(1, 12)).min()
    assert 0.0 <= spare <= 3.0 * MARGIN_M
    # It goes on as fast as it was commanded, in that direction, and does not turn.
    along = np.array(passed[-20:])
    assert np.abs(along[:, 1]).mean() == pytest.approx(0.2 * TCP_STEP_M_S * 0.04, rel=0.05)
    assert np.abs(along[:, [0, 2]]).mean(axis=0).max() < 2e-4
    assert np.abs(tool(pipeline, 0)[1] - upright).max() < 2e-3
    assert abs(tool(pipeline, 0)[0][0] - start[0]) < 0.015


def test_an_arm_leaves_at_once_what_it_was_pushed_against() -> None:
    pipeline = at_home(mode="tcp_delta")
    for _ in range(120):
        pipeline(moving(0, 0.0, 0.0, -1.0))
    assert pipeline.led[0]
    low = tool(pipeline, 0)[0][2]
    for _ in range(5):
        pipeline(moving(0, 0.0, 0.0, 0.5))
    assert not pipeline.led[0]
    assert tool(pipeline, 0)[0][2] - low > 0.01  # of 0.025 m that were commanded


@pytest.mark.parametrize("held", [None, 1])
def test_an_arm_that_rests_is_not_pushed_away(held: int | None) -> None:
    pipeline = at_home(held=held)
    start = HOME_Q_RAD.copy()
    start[1, 0] += 0.9  # in the way of the left arm
    pipeline.reset(start[None])
    action, led = moving(0, -0.5), 0
    action[0, 1] = 0.0 if held is None else np.linspace(-1.0, 1.0, 6)
    for _ in range(100):
        _, verdicts = pipeline(action)
        assert not verdicts
        led += int(pipeline.led[0])
        assert (pipeline.gate.last_targets_rad[0, 1] == start[1]).all()
    assert led > 20


def test_coupled_arms_slow_down_together() -> None:
    """Their relative pose stays that of the object between them."""
    pipeline = at_home(mode="tcp_delta")
    for _ in range(20):
        pipeline(moving(0, 0.0, 0.0, -0.6))  # the left one meets the table before the right one would
    for _ in range(30):
        pipeline(np.zeros((1, 2, 6)))
    down, between, led = np.zeros((1, 2, 6)), [], 0
    down[0, :, 2] = -0.6
    for _ in range(100):
        _, verdicts = pipeline(down, np.ones(1, dtype=bool))
        assert not verdicts
        led += int(pipeline.led[0])
        between.append(tool(pipeline, 1)[0] - tool(pipeline, 0)[0])
    assert led > 20
    assert np.ptp(between, axis=0).max() < 2e-3


def test_what_cannot_be_led_is_refused() -> None:
    """Something is where the arms are: no motion of theirs, and no brake, is legal."""

    class Closing(AlwaysClear):
        closed = False

        def spare_m(self, q_rad):
            return np.array([-0.01 if self.closed else 0.1])

        def worst(self, q_rad):
            return "left/palm and person", 0.01, 0.02

    seen = Closing()
    pipeline = at_home(seen)
    assert pipeline(np.ones((1, 2, 6)))[1] == {}
    seen.closed = True
    before = seen.checks
    _, verdicts = pipeline(np.ones((1, 2, 6)))
    assert verdicts[0].subject == "left/palm and person"
    assert not pipeline.led[0]
    assert seen.checks - before < 40, "the time is bounded"


def test_distances_that_are_measured_from_outside_lead_too() -> None:
    class Wall(AlwaysClear):
        """Of the left shoulder's pan angle."""

        def spare_m(self, q_rad):
            return np.array([HOME_Q_RAD[0, 0] + 0.3 - q_rad[0]])

    wall = Wall()
    wall.kernel.values["levers"][0, 0] = 1.0
    pipeline = at_home(wall)
    action = np.zeros((1, 2, 6))
    action[0, 0, :2] = 0.5, -0.2
    lifted = []
    for _ in range(80):
        assert not pipeline(action)[1]
        lifted.append(pipeline.gate.last_targets_rad[0, 0, 1])
    assert pipeline.led[0]
    pan = pipeline.gate.last_targets_rad[0, 0, 0] - HOME_Q_RAD[0, 0]
    assert 0.3 - 2.0 * MARGIN_M < pan <= 0.3
    assert np.diff(lifted)[-20:].mean() == pytest.approx(-0.2 * 1.0 * 0.04, rel=0.01)


def test_slopes_are_those_of_the_distances() -> None:
    clearance = Clearance(SCENES["plate"], uncertainty=((0.004, 0.01), (0.002, 0.02)))
    rng, compared = np.random.default_rng(0), 0
    for _ in range(10):
        q = rng.uniform(-2.0, 2.0, 12)
        for pair in rng.choice(len(clearance.pairs), 10, replace=False).tolist():
            exact, measured = np.empty(12), np.empty(12)
            call("clearance_slopes", clearance.kernel, q, pair, exact)
            call("measured_slopes", clearance.kernel, q, pair, measured)
            np.testing.assert_allclose(exact, measured, atol=2e-4)
            compared += int(np.abs(exact).max() > 0.01)
    assert compared > 30
