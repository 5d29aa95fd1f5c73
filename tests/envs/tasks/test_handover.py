import numpy as np
import pytest

from dual_ur10 import errors
from dual_ur10.envs.core.core import Core
from dual_ur10.envs.tasks.handover.goals import WIDTH_M
from dual_ur10.envs.tasks.handover.settings import GRIPS, HandoverSettings, block_pose, laid_quat, presented_quat
from dual_ur10.envs.tasks.handover.task import Handover, facts_of
from dual_ur10.sim2real.cell.cell_config import CellConfig
from tests.soak import scaled
from ur_core.kinematics import flange_pose_quat
from ur_core.kinematics.frames import ArmMount
from ur_core.kinematics.poses import yaw_quat
from ur_core.kinematics.rotations import quat_to_matrix, rotate
from ur_core.kinematics.ur10 import NOMINAL_DH

BEHIND, ASIDE = ArmMount((-1.1, -0.6, 0.0)), ArmMount((-0.75, 1.2, 0.0))
STAGES = Handover.stages
STAY = np.tile([0.0] * 6 + [1.0], 2).astype(np.float32)


def begun(seed=0, **keywords):
    core = Core("Handover", keywords)
    observation, _ = core.reset([np.random.default_rng(seed)])
    return core, observation


def put(core, position_m, quat=(1.0, 0.0, 0.0, 0.0)):
    """Put the block somewhere without an arm."""
    block = core.cell._physics._props.objects["block"]
    block.position_m[0], block.quat[0] = position_m, quat


def gripper(between=False, holds=False, opening=0.085, near=0.5, closes=False):
    return between, holds, opening, near, closes


def facts(giving=None, receiving=None, height=0.02, meeting=0.5, placed=False, error=5.0):
    """Return the facts of one handover, or, from tuples of values, of several."""
    between, holds, opening, near, closes = zip(giving or gripper(), receiving or gripper(), strict=True)
    wider = [(each - WIDTH_M) / (0.085 - WIDTH_M) for each in opening]
    opened, closed = [min(max(each, 0.0), 1.0) for each in wider], [max(1.0 - abs(each), 0.0) for each in wider]
    clear = [min(max((each - WIDTH_M) / 0.007, 0.0), 1.0) for each in opening]
    return facts_of(
        between=between,
        holds=holds,
        closes=closes,
        nearness=near,
        opened=opened,
        closed=closed,
        clear=clear,
        height_m=height,
        off_m=meeting,
        laid=placed,
        error=error,
        lost=False,
    )


TASK = Core("Handover", {}).task


def passed_after(scene, passed=0):
    """Return the number of stages passed after a scene."""
    TASK.passed[:] = passed
    TASK._advance(scene)
    return int(TASK.passed[0])


def holds(scene, stage):
    return bool(getattr(TASK, STAGES[stage])(scene)[0])


def terms(scene, passed):
    """Return the terms of giver and receiver, (2, 7), for stages that are passed, whatever the scene passes."""
    blocked = scene._replace(placed=False)
    progress = [getattr(TASK, name)(blocked)[1] for name in STAGES]
    found = np.array([each if isinstance(each, tuple) else (each, each) for each in progress]).T
    return found * TASK._due[passed] + TASK._earned[passed]


HOLDS = gripper(True, True, WIDTH_M, 0.99, closes=True)
# What passes each stage, and no later one but those that it must.
SCENES = [
    facts(gripper(True)),
    facts(HOLDS),
    facts(HOLDS, height=0.1),
    facts(HOLDS, height=0.3, meeting=0.03),
    facts(HOLDS, HOLDS, height=0.3, meeting=0.03),
    facts(gripper(), HOLDS, height=0.3, meeting=0.03),
    facts(placed=True),
]


def test_stages_are_passed_one_after_the_other():
    for k, scene in enumerate(SCENES):
        assert passed_after(scene, k) == k + 1


@pytest.mark.parametrize("left_out", [0, 1, 2, 4, 5])
def test_no_stage_can_be_skipped(left_out, monkeypatch):
    methods = [
        lambda *_, each=each: (False, 0.0) if each == left_out else Handover._stages[each](*_) for each in range(7)
    ]
    monkeypatch.setattr(TASK, "_stages", methods, raising=False)
    passed = 0
    for scene in SCENES:
        passed = passed_after(scene, passed)
    assert passed == left_out


def test_stages_that_hold_at_once_are_passed_at_once_and_never_lost():
    assert passed_after(SCENES[3]) == 4
    assert passed_after(facts(), 4) == 4


@pytest.mark.parametrize(
    ("scene", "stage"),
    [
        (facts(gripper(holds=True), height=0.07), 2),  # too low to be lifted
        (facts(HOLDS, height=0.3, meeting=0.06), 3),  # not where it is handed over
        (facts(HOLDS, gripper(True), height=0.3), 4),  # the receiver has not closed
        (facts(gripper(), HOLDS, height=0.05), 5),  # on the table
        (facts(gripper(True), HOLDS, height=0.3), 5),  # the giver has not left
        (facts(placed=False), 6),
    ],
)
def test_near_misses_do_not_pass_a_stage(scene, stage):
    assert not holds(scene, stage)
    assert holds(SCENES[stage], stage)


def test_terms_rise_within_a_stage_and_are_one_after_it():
    away, lifted = (*HOLDS[:3], 0.5, True), {"height": 0.3, "meeting": 0.03}
    nearer = [
        (0, facts(gripper(near=0.3)), facts(gripper(near=0.6))),
        (0, facts(gripper(opening=0.05)), facts(gripper())),
        (1, facts(gripper(True, near=0.8)), facts(gripper(True, near=0.9))),
        (1, facts(gripper(True, opening=0.08, closes=True)), facts(gripper(True, opening=0.05, closes=True))),
        (2, facts(HOLDS, height=0.02), facts(HOLDS, height=0.06)),
        (3, facts(HOLDS), facts(away, **lifted)),
        (3, facts(away, **lifted), facts(HOLDS, **lifted)),
        (4, facts(HOLDS, gripper(near=0.2), **lifted), facts(HOLDS, gripper(near=0.9), **lifted)),
        (4, facts(away, gripper(), **lifted), facts(HOLDS, gripper(), **lifted)),
        (5, facts(gripper(opening=0.045), HOLDS), facts(gripper(opening=0.07), HOLDS)),
        (5, facts(gripper(near=0.5), HOLDS), facts(gripper(near=0.9), HOLDS)),
        (5, facts(gripper(), away), facts(gripper(), HOLDS)),
        (6, facts(gripper(near=0.5), HOLDS), facts(gripper(near=0.9), HOLDS)),
        (6, facts(gripper(True), HOLDS), facts(gripper(), away)),
        (6, facts(receiving=away), facts(receiving=HOLDS)),
        (6, facts(error=5.0), facts(error=2.0)),  # let go beside the target
        (6, facts(error=1.1), facts(receiving=away)),
    ]
    for k, far, near in nearer:
        low, high = (terms(each, k).mean(axis=0) for each in (far, near))
        assert low[:k].tolist() == high[:k].tolist() == [1.0] * k
        assert 0.0 <= low[k] < high[k] <= 1.0
        assert (high[k + 1 :] < 1.0).all()
        assert high[[j for j in range(k + 1, 7) if STAGES[j] != "present"]].max(initial=0.0) == 0.0


def test_each_arm_earns_its_own_terms():
    expected = [2, 2, 2, 1.2, 1, 1.5, 0.4]
    done = terms(facts(), 7)
    assert done[0].tolist() == expected
    assert done[1].tolist() == [2 - value for value in expected]
    approach = [terms(facts(HOLDS, gripper(near=near), 0.3, 0.03), 4)[:, 4] for near in (0.2, 0.9)]
    assert approach[0][1] < approach[1][1]
    assert approach[0][0] == approach[1][0]


def test_the_receiver_earns_its_waiting_by_what_it_does_itself():
    """A share in the giver's progress kept PPO from learning the handover."""
    waiting = gripper(near=0.9)
    scenes = [facts(each, waiting) for each in (gripper(near=0.4), gripper(True), HOLDS)]
    assert {terms(scene, 0)[1, 3] for scene in scenes} == {0.8 * scenes[0].near[1]}


@pytest.mark.parametrize("where", [{"height": 0.3, "meeting": 0.06}, {"height": 0.07, "meeting": 0.03}])
def test_the_receivers_approach_counts_while_the_block_is_presented(where):
    assert terms(facts(HOLDS, **where), 4)[1, 4] == 0.0
    assert terms(facts(HOLDS, HOLDS, **where), 4)[1, 4] == 1.0  # once it holds the block, anywhere


def test_fingers_that_close_before_they_are_there_earn_less():
    early, right = (facts(gripper(True, opening=0.05, closes=closes)) for closes in (False, True))
    assert terms(early, 1)[0, 1] < terms(facts(gripper(True)), 1)[0, 1] < terms(right, 1)[0, 1]


def test_a_block_that_only_lies_on_its_target_is_no_success():
    core, _ = begun()
    core.step(STAY)
    target = core.cell._physics._props.objects["target"]
    put(core, target.position_m[0], target.quat[0])
    for _ in range(40):
        step = core.step(STAY)
        assert step.info["object_error_m"][0] < 0.002
        assert step.info["stage"][0] == 0
        assert not step.info["is_success"][0]
        assert not step.terminated[0]


def test_after_all_stages_the_block_must_settle():
    core, _ = begun()
    core.step(STAY)
    target = core.cell._physics._props.objects["target"]
    core.task.passed[:] = 6
    put(core, target.position_m[0] + [0.1, 0.0, 0.0], target.quat[0])
    assert core.step(STAY).info["stage"][0] == 6  # off the target
    put(core, target.position_m[0], target.quat[0])
    assert core.step(STAY).info["stage"][0] == 6  # it has just moved
    steps = 0
    while True:
        step = core.step(STAY)
        steps += 1
        assert step.info["stage"][0] == 7
        if step.terminated[0]:
            break
        assert not step.info["is_success"][0]
    assert step.info["is_success"][0]
    assert step.ends == {0: "success"}
    assert not step.truncated[0]
    assert steps * core.timing.period_s == pytest.approx(Handover.settled_s, abs=core.timing.period_s)


def test_the_direction_of_the_block_matters_but_not_its_upper_side():
    core, _ = begun()
    target = core.cell._physics._props.objects["target"].quat[0]
    yaw = 2 * np.arctan2(target[3], target[0])
    for turn in (0.0, 0.4, np.pi):
        put(core, (0.0, 0.0, 0.5), laid_quat(np.array(yaw + turn)))  # it falls without turning
        assert core.step(STAY).info["object_error_rad"][0] == pytest.approx(turn, abs=1e-6)


@pytest.mark.parametrize(
    ("where", "reason"),
    [
        ((0.0, 0.0, -0.2), "block_fell"),
        ((1.5, 0.0, 0.02), "block_out_of_reach"),
        ((-0.75, 2.5, 0.02), "block_out_of_reach"),
    ],
)
def test_a_lost_block_ends_the_episode(where, reason):
    core, _ = begun()
    assert not core.step(STAY).terminated[0]
    put(core, where)
    step = core.step(STAY)
    assert step.terminated[0]
    assert step.ends == {0: reason}
    assert not step.truncated[0]
    assert not step.info["is_success"][0]


@pytest.mark.parametrize("where", [(0.5, 0.0, 0.02), (-0.45, 0.85, 0.02), (0.45, -0.85, 0.02)])
def test_a_block_anywhere_on_the_table_is_not_lost(where):
    core, _ = begun()
    put(core, where)
    assert not core.step(STAY).terminated[0]


def test_a_reset_forgets_the_slip_of_its_rows():
    task = Core("Handover", {}, n=2).task
    task._slip_m[:] = 0.004
    task.start(np.array([1]), [np.random.default_rng(0)])
    assert task._slip_m.tolist() == [[0.004, 0.004], [0.0, 0.0]]


def test_tighter_limits_prolong_the_episode():
    core, _ = begun(duration_s=0.4)
    over = [core.step(STAY).truncated[0] for _ in range(10)]
    assert over == [False] * 9 + [True]
    limits = Handover.limits
    for cell, factor in (
        (CellConfig(speed_rad_s=0.5), limits.speed_rad_s[0] / 0.5),
        (CellConfig(tcp_speed_m_s=0.25), limits.tcp_speed_m_s / 0.25),
        (CellConfig(speed_rad_s=3.0), 1.0),
    ):
        assert begun(cell=cell)[0].task.duration_s == pytest.approx(20.0 * factor)


def test_starts_are_sampled_on_the_givers_side():
    n = 200
    core = Core("Handover", {"giver": "random"}, n=n)
    core.reset([np.random.default_rng(seed) for seed in range(n)])
    settings, task = core.task.settings, core.task
    giver = task.first
    assert 0.35 < giver.mean() < 0.65
    state = core._state
    side = 1 - 2 * giver
    block = state.objects["block"].position_m - np.stack([0.0 * side, 0.5 * side, 0.02 + 0.0 * side], axis=1)
    target = state.objects["target"].position_m - np.stack([0.0 * side, -0.5 * side, 0.02 + 0.0 * side], axis=1)
    for away, reach in ((block, settings.object_range_m), (target, settings.target_range_m)):
        assert np.abs(away[:, :2]).max() <= reach
        assert np.abs(away[:, :2]).max(axis=0).min() > 0.9 * reach
        assert np.abs(away[:, 2]).max() < 1e-3
    yaw = 2 * np.arctan2(state.objects["block"].quat[:, 3], state.objects["block"].quat[:, 0])
    assert 0.9 * np.pi / 6 < np.abs(yaw).max() <= np.pi / 6


@pytest.mark.parametrize("giver", ["left", "right"])
def test_the_giver_can_be_chosen_and_is_observed(giver):
    core, observation = begun(giver=giver)
    role = 1.0 if giver == "left" else -1.0
    assert core.task.layout.split(observation)["role"].ravel().tolist() == [role, -role]
    assert core.step(STAY).info["giver"][0] == ("left", "right").index(giver)


@pytest.mark.parametrize("giver", [0, 1])
def test_the_term_of_reaching_is_the_givers(giver):
    core, _ = begun(giver=("left", "right")[giver])
    core.step(STAY)
    reach = core.agents.terms[0, :, 0]
    assert reach[giver] > 0.0
    assert reach[1 - giver] == 0.0


def test_the_grippers_meet_from_opposite_sides():
    for giver in (0, 1):
        block = quat_to_matrix(presented_quat(giver))
        grip = quat_to_matrix(GRIPS[giver].quat)
        tools = block @ grip
        assert np.allclose(tools[0, :, 2], -tools[1, :, 2])
        assert np.allclose(tools[:, 2, 2], 0.0, atol=1e-12)  # horizontal
        assert tools[0, 1, 2] < -0.5  # the left hand points to the right
        between = block @ (GRIPS[giver].position_m[1] - GRIPS[giver].position_m[0])
        assert between[0] > 0.05
        assert np.linalg.norm(between) == pytest.approx(0.1, abs=2e-3)
        pick = quat_to_matrix(GRIPS[giver].quat[giver])
        lay = quat_to_matrix(laid_quat(np.array(0.0))) @ grip[1 - giver]
        assert np.allclose(pick[:, 2], [0, 0, -1])
        assert np.allclose(lay[:, 2], [0, 0, -1])


def test_observation_is_what_the_table_says():
    cell = CellConfig(
        left=ArmMount((-0.7, 0.6, 0.02), 0.1), right=ArmMount((-0.8, -0.55, 0.03), -0.1), wrench_noise=(0.0, 0.0)
    )
    core, _ = begun(cell=cell, giver="right")
    rng = np.random.default_rng(0)
    for _ in range(10):
        action = rng.uniform(-0.3, 0.3, 14)
        action[[6, 13]] = 0.0, 0.5
        step = core.step(action.astype(np.float32))
    arms, state = core.task.layout.split(step.observation[0]), core._state
    position, quat = flange_pose_quat(state.q_rad[0], NOMINAL_DH)
    assert np.allclose(arms["flange_base_m"], position, atol=1e-6)
    assert np.allclose(np.abs((arms["flange_base_quat"] * quat).sum(axis=1)), 1.0)
    assert arms["gripper_m"].ravel().tolist() == state.gripper_m[0].tolist()
    assert arms["other_gripper_m"].ravel().tolist() == state.gripper_m[0, ::-1].tolist()
    for k, mount in enumerate((cell.left, cell.right)):
        turn = quat_to_matrix(yaw_quat(np.array(mount.yaw_rad + np.pi)))
        for name, there in (
            ("block_base_m", state.objects["block"].position_m[0]),
            ("target_base_m", state.objects["target"].position_m[0]),
        ):
            assert np.allclose(turn @ arms[name][k] + mount.position_m, there)
    relative = arms["other_flange_m"][0]
    assert np.allclose(rotate(state.flange_quat[0, 0], relative) + state.flange_m[0, 0], state.flange_m[0, 1])
    assert np.allclose(arms["progress"], 0.4 / 20.0)
    assert core.observation_space.contains(step.observation[0])


def test_measuring_changes_nothing():
    core, _ = begun()
    core.step(STAY)
    first, second = (core.task.measure(core._state) for _ in range(2))
    assert all(np.array_equal(one, other) for one, other in zip(first.grasped, second.grasped, strict=True))
    assert core.task._count[0] == 1


def test_rows_are_bit_equal_to_single_cells():
    n, steps = 3, scaled(600)
    rng = np.random.default_rng(0)
    actions = rng.uniform(-0.15, 0.15, (steps, n, 14)).astype(np.float32)
    together = Core("Handover", {"giver": "random"}, n=n, threads=2)
    together.reset([np.random.default_rng(seed) for seed in range(n)])
    alone = []
    for seed in range(n):
        core = Core("Handover", {"giver": "random"})
        core.reset([np.random.default_rng(seed)])
        alone.append(core)
    for action in actions:
        both = together.step(action)
        for row, core in enumerate(alone):
            step = core.step(action[row])
            assert np.array_equal(step.observation[0], both.observation[row])
            assert step.reward[0] == both.reward[row]
            for name, values in step.info.items():
                assert np.array_equal(values[0], both.info[name][row]), name


def test_lying_blocks_are_on_their_side():
    block = block_pose(np.array([[0.01, 0.02, 0.3], [0.01, 0.02, 0.3]]), np.array([0, 1]))
    assert np.allclose(block.position_m, [[0.01, 0.52, 0.02], [0.01, -0.48, 0.02]])


@pytest.mark.parametrize(
    ("keywords", "error", "text"),
    [
        ({"giver": "both"}, errors.UnknownNameError, "random"),
        ({"duration_s": 0.0}, errors.SettingsError, "duration_s"),
        ({"object_range_m": -0.1}, errors.SettingsError, "object_range_m"),
        ({"object_turn_rad": "wide"}, errors.SettingsError, "object_turn_rad"),
        ({"target_range_m": float("nan")}, errors.SettingsError, "target_range_m"),
        ({"target_turn_rad": 9.0}, errors.SettingsError, "target_turn_rad"),
        ({"success_error_m": 0.0}, errors.SettingsError, "success_error_m"),
        ({"success_turn_rad": True}, errors.SettingsError, "success_turn_rad"),
        ({"grip_force_n": 1.0}, errors.SettingsError, "grip_force_n"),
        ({"reach_m": 1.0}, errors.UnknownNameError, "object_range_m"),
        (
            {"object_range_m": 0.3, "giver": "right", "cell": CellConfig(right=BEHIND)},
            errors.WorkspaceError,
            "right arm .* the block .* object_range_m",
        ),
        (
            {"target_range_m": 0.3, "cell": CellConfig(right=BEHIND)},
            errors.WorkspaceError,
            "right arm .* the target .* target_range_m",
        ),
        ({"cell": CellConfig(left=ASIDE)}, errors.WorkspaceError, "left arm .* handed over, .* move the base"),
    ],
)
def test_bad_keywords_are_refused_by_name(keywords, error, text):
    with pytest.raises(error, match=text):
        Core("Handover", keywords)


def test_settings_are_equal_by_value():
    assert HandoverSettings(duration_s=20) == HandoverSettings()
    assert HandoverSettings(giver="random").givers == (0, 1)
