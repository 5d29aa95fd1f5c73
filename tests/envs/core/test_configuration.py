"""Check of a configuration of both arms, against the safety gate and the inverse kinematics."""

import functools

import numpy as np
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st

from dual_ur10.assets.settings import HOME_Q_RAD
from dual_ur10.envs.core.configuration import check_configuration
from dual_ur10.envs.core.setup import EnvSetup
from dual_ur10.envs.tasks.reach import check_reach, reach
from dual_ur10.errors import SettingsError, WorkspaceError
from dual_ur10.sim2real.cell.cell_config import CellConfig
from dual_ur10.sim2real.control.gate import SafetyGate
from ur_core.kinematics.inverse import try_nearest
from ur_core.kinematics.poses import Poses, rotation_angle
from ur_core.kinematics.rotations import quat_conjugate, quat_multiply

KEYWORDS = {
    "SineTracking": {},
    "Handover": {"cell": CellConfig(uncertainty=((0.004, 0.002), (0.003, 0.001)))},
    "SyncCarry": {"robot": "ur10e"},
}
SEEDS = st.integers(0, 2**31)


@functools.cache
def gate_of(task):
    setup = EnvSetup.resolve(task, KEYWORDS[task])
    return SafetyGate(setup.limits, setup.config.servoj.tick_s, setup.ticks, setup.make_clearance())


@settings(max_examples=60)
@given(st.sampled_from([*KEYWORDS]), SEEDS, st.floats(0.1, 1.5))
def test_the_gate_refuses_exactly_what_is_in_the_way(task, seed, most_rad):
    q = HOME_Q_RAD + np.random.default_rng(seed).uniform(-most_rad, most_rad, (2, 6))
    report, gate = check_configuration(task, q_rad=q, **KEYWORDS[task]), gate_of(task)
    worst = report.clearances[0]
    assume(abs(worst.spare_m) > 1e-5 and np.abs(report.margin_rad).min() > 1e-4)
    assert (report.q_rad == q).all()
    # The last 1e-7 rad of a way to the configuration: the gate measures nothing of arms that rest.
    gate.reset((q - 1e-7)[None])
    targets = q - 1e-7 * np.linspace(1.0, 0.0, gate.ticks)[:, None, None] ** 2
    verdict = gate(targets[None]).verdicts.get(0)
    assert (verdict is None) == report.is_legal
    if verdict is not None:
        blocked = [each.pair for each in report.in_the_way]
        assert verdict.kind == "joint position" if (report.margin_rad < 0).any() else verdict.subject == blocked[0]
        if verdict.kind == "distance":
            assert verdict.found == pytest.approx(worst.distance_m, abs=1e-6)
            assert verdict.allowed == pytest.approx(worst.allowed_m, abs=1e-6)


@settings(max_examples=40)
@given(SEEDS, st.floats(0.05, 1.2))
def test_an_arm_misses_a_pose_exactly_if_it_cannot_reach_it(seed, most_m):
    rng = np.random.default_rng(seed)
    home = check_configuration("Free").tools
    quat = home.quat + rng.uniform(-0.5, 0.5, (2, 4))
    wanted = Poses(home.position_m + rng.uniform(-most_m, most_m, (2, 3)), quat / np.linalg.norm(quat, axis=1)[:, None])
    report, cell = check_configuration("Free", tools=wanted), EnvSetup.resolve("Free", {}).config
    batch = Poses(wanted.position_m[None], wanted.quat[None])
    try:
        check_reach(cell, {"it": batch})
    except WorkspaceError:
        assert not all(report.reached)
        assert not report.is_legal
    else:
        assert all(report.reached)
    goal = reach(cell, batch, HOME_Q_RAD)
    away_m = np.linalg.norm(report.tools.position_m - wanted.position_m, axis=1)
    turned = rotation_angle(quat_multiply(quat_conjugate(wanted.quat), report.tools.quat))
    for arm, mount in enumerate((cell.left, cell.right)):
        if report.missed_m[arm] == np.inf:
            assert (report.q_rad[arm] == HOME_Q_RAD[arm]).all()
            continue
        assert away_m[arm] == pytest.approx(report.missed_m[arm], abs=1e-6)
        assert turned[arm] < 1e-6
        if not report.reached[arm]:  # and nothing clearly nearer is in reach
            nearer = rng.normal(size=(300, 3))
            nearer *= rng.uniform(size=(300, 1)) / np.linalg.norm(nearer, axis=1, keepdims=True)
            nearer *= max(report.missed_m[arm] - 0.01, 0.0)
            rotations, near = np.tile(goal.rotation[0, arm], (300, 1, 1)), np.tile(HOME_Q_RAD[arm], (300, 1))
            assert not try_nearest(goal.flange_m[0, arm] + nearer, rotations, near, mount.dh)[1].any()


def test_joint_positions_choose_among_the_solutions_of_poses():
    home = check_configuration("Handover")
    flipped = HOME_Q_RAD + np.array([0.0, 0.0, 0.0, np.pi, 0.0, np.pi])
    flipped[:, 4] *= -1.0
    other = check_configuration("Handover", tools=home.tools, q_rad=flipped)
    np.testing.assert_allclose(other.tools.position_m, home.tools.position_m, atol=1e-9)
    assert np.abs(other.q_rad - home.q_rad).max() > 1.0


def test_a_report_prints_what_is_in_the_way_and_what_is_out_of_reach():
    text = str(check_configuration("SineTracking", q_rad=np.zeros((2, 6))))
    assert text.startswith("DualUR10/SineTracking-v0: not legal\nleft: tool at (")
    assert "in the way: left/wrist_2_link and table are -57.2 mm apart, allowed are 20.0 mm or more" in text
    assert "at a singularity" in text
    home = check_configuration("Handover")
    assert str(home).startswith("DualUR10/Handover-v0: legal\n")
    far = Poses(home.tools.position_m + np.array([[0.0, 0.0, 0.0], [0.9, 0.0, 0.0]]), home.tools.quat)
    text = str(check_configuration("Handover", tools=far))
    assert "right: out of reach by " in text


@pytest.mark.parametrize(
    ("values", "words"),
    [
        ({"q_rad": np.zeros(6)}, r"q_rad .* must be \(2, 6\)"),
        ({"q_rad": np.full((2, 6), np.nan)}, "finite"),
        ({"tools": (np.zeros((2, 3)), np.zeros((2, 4)))}, "must have length 1"),
        ({"tools": (np.zeros((1, 3)), np.zeros((2, 4)))}, r"position of the tools .* \(2, 3\)"),
    ],
)
def test_values_that_are_no_configuration_are_refused(values, words):
    with pytest.raises(SettingsError, match=words):
        check_configuration("Handover", **values)
