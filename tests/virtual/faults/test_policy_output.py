"""Faults of a policy: rows 1 to 16 of the table of faults in `docs/reference/faults.md`."""

import gymnasium as gym
import numpy as np
import pytest

from dual_ur10 import policies
from dual_ur10.errors import ActionError, CellFaulted
from dual_ur10.policies.evaluation.rollout import rollout
from dual_ur10.sim2real.recording.reader import read_run
from dual_ur10.sim2real.recording.run import LATE
from tests import soak
from tests.virtual.faults.lab import ARMS, Swing


def with_number(value, arm=0, joint=2, kind=np.float32):
    action = np.zeros((2, 6), dtype=kind)
    action[arm, joint] = value
    return action.reshape(-1)


MALFORMED = [
    pytest.param(lambda: with_number(np.nan), "number 2 of the left arm's action is nan", id="1-nan"),
    pytest.param(lambda: with_number(-np.inf, 1, 5), "number 5 of the right arm's action is -inf", id="2-inf"),
    pytest.param(lambda: np.zeros(5), "found (5,)", id="3-shape"),
    pytest.param(lambda: np.zeros(12, dtype=complex), "found complex128", id="4-complex"),
    pytest.param(lambda: with_number(np.nan, 1, 0, np.float64), "number 0 of the right", id="1-double"),
    pytest.param(lambda: with_number(np.inf), "number 2 of the left arm's action is inf", id="2-positive"),
    pytest.param(lambda: np.zeros(7), "found (7,)", id="3-seven"),
    pytest.param(lambda: np.zeros((6, 2)), "found (6, 2)", id="3-turned"),
    pytest.param(lambda: np.float64(0.1), "found ()", id="3-one"),
    pytest.param(lambda: np.zeros((12, 1)), "found (12, 1)", id="3-column"),
    pytest.param(list, "found (0,)", id="3-none"),
    pytest.param(lambda: [None] * 12, "object", id="4-object"),
    pytest.param(lambda: "0" * 12, "str", id="4-text"),
    pytest.param(lambda: np.zeros(12, dtype=bool), "bool", id="4-bool"),
    pytest.param(lambda: np.full(12, 1e9).astype(np.float16), "inf", id="4-half"),
    pytest.param(lambda: [[0.0] * 6, [0.0] * 5], "list", id="4-ragged"),
]


@pytest.mark.filterwarnings("ignore:overflow encountered")
@pytest.mark.parametrize(("action", "text"), MALFORMED if soak.SOAK else MALFORMED[:4])  # one of each row
def test_1_2_3_4_what_is_no_action_stops_both(lab, action, text):
    lab.begin()
    lab.note()
    with pytest.raises(ActionError) as found:
        lab.env.unwrapped.step(action())
    assert text in str(found.value)
    lab.assert_stopped(found.value, "the policy's action was refused", text, ramped=ARMS)


@pytest.mark.filterwarnings("ignore:overflow encountered")
@pytest.mark.parametrize(("action", "text"), MALFORMED)
def test_1_2_3_4_the_cell_is_told_to_stop_by_whatever_is_no_action(monkeypatch, action, text):
    env = gym.make("DualUR10/SineTracking-v0", disable_env_checker=True)
    env.reset(seed=0)
    told = []
    monkeypatch.setattr(env.unwrapped.core.cell, "stop", told.append)
    with pytest.raises(ActionError) as found:
        env.unwrapped.step(action())
    assert text in str(found.value)
    assert told == [f"the policy's action was refused: {found.value}"]


@pytest.mark.parametrize(
    "actions",
    [
        pytest.param(lambda k: np.where(np.arange(12) % 2 == k % 2, 1e9, -1e9), id="5-huge"),
        pytest.param(lambda k: np.full(12, (-1.0) ** k), id="6-oscillating"),
    ],
)
def test_5_6_the_wildest_legal_actions_keep_to_the_limits(lab, actions):
    lab.begin(steps=1)
    home = lab.executed("left")[-1]
    over = False
    for k in range(40):
        if over:
            break
        _, _, over, _, info = lab.env.step(actions(k))
    # Whatever there is room for is done, and the gate sees to the rest.
    assert not over or info["safety"].kind == "distance"
    lab.assert_within_limits()
    moved = np.abs(lab.executed("left") - home)
    assert 1e-3 < moved.max() < 0.5


def test_5_actions_are_clipped_as_in_simulation(lab):
    env = gym.make("DualUR10/SineTracking-v0", action_latency_ticks=5, disable_env_checker=True)
    env.reset(seed=0)
    lab.begin(steps=0)
    wild = [share * np.random.default_rng(0).choice([-1.0, 1.0], 12) for share in (1.0, 50.0, 1e9)]
    ends = []
    for made in (env, lab.env):
        core = made.unwrapped.core
        for action in wild:
            made.unwrapped.step(action)
        assert core.clipped_actions == 2  # the first one is within
        ends.append(core.pipeline.gate.last_targets_rad)
    env.close()
    assert np.array_equal(*ends)


def test_7_one_action_for_ever_ends_at_rest(lab):
    lab.begin(steps=0, at_limits="refuse")
    action = np.zeros((2, 6))
    action[:, 1] = 1.0  # both arms bow to the table
    over, steps = False, 0
    while not over and steps < 500:
        _, _, over, _, info = lab.env.step(action.reshape(-1))
        steps += 1
    assert over
    assert info["safety"].kind == "distance"
    lab.assert_within_limits()
    lab.clock.sleep(0.5)
    for arm in ARMS:
        assert np.abs(lab.ask(arm, "actual_qd")[0]).max() < 1e-2
    assert lab.nearest_m() >= 0.0199
    assert lab.latch.read() is None
    lab.reset(seed=0)  # from there a path leads back


@pytest.mark.parametrize("late_s", [0.08, 0.3])
def test_8_9_a_late_action_finds_both_arms_stopped(lab, late_s, tmp_path):
    lab.begin(record=str(tmp_path))
    core = lab.env.unwrapped.core
    before = core.late_actions
    lab.clock.sleep(late_s)
    lab.env.step(lab.policy())
    assert core.late_actions == before + 1
    for _ in range(10):
        lab.env.step(lab.policy())
    assert lab.latch.read() is None
    lab.assert_within_limits()
    for memory in lab.runner.arms:  # none of what was late was made up for in a hurry
        assert (np.diff(memory.sent()[0].period) >= 1).all()
    # What was sent for each action, and for which there was nothing, is in the record.
    lab.close_env()
    run = read_run(next(tmp_path.iterdir()))
    (episode,) = run.episodes
    late = episode.first_target == LATE
    assert late.sum() == sum(each.kind == "late" for each in run.events) == 1
    for arm in range(2):
        sent = run.arms[arm].sent
        index, target_rad = sent["index"], sent["target_rad"]
        first = episode.first_target[~late]
        first_rad = episode.targets_rad[~late, 0, arm]
        within = (first >= index[0]) & (first <= index[-1])
        assert within.sum() >= 5
        assert np.array_equal(target_rad[np.searchsorted(index, first[within])], first_rad[within])


def test_10_a_policy_that_is_silent_for_long_stops_both(lab):
    lab.begin()
    lab.note()
    lab.clock.sleep(1.0)
    with pytest.raises(CellFaulted) as found:
        lab.env.step(lab.policy())
    lab.assert_within_limits()
    # Half a second after the last action's targets, which are no more than these, rest and brake.
    core = lab.env.unwrapped.core
    waiting = 0.5 / lab.tick_s + core.cell.latency_ticks + core.cell.ticks
    lab.assert_stopped(found.value, "the policy gave no action for", seen_ticks=waiting + 3, ramped=ARMS)


def test_12_a_policy_that_raises_stops_both(lab):
    class Failing(Swing):
        def __call__(self, observation=None):
            if self._steps == 20:
                lab.note()
                raise ZeroDivisionError("of this policy")
            return super().__call__(observation)

    lab.make()
    with pytest.raises(ZeroDivisionError, match="of this policy") as found:
        rollout(lab.env, Failing(), seed=0)
    assert found.traceback[-1].name == "__call__"
    with pytest.raises(CellFaulted) as again:
        lab.env.step(lab.policy())
    lab.assert_stopped(found.value, "the policy failed: ZeroDivisionError: of this policy")
    # The traceback of a policy may fill the screen: its last line names the cause and how to go on, as the cell does.
    (last,) = found.value.__notes__
    assert last.startswith("both arms were stopped: the policy failed: ZeroDivisionError: of this policy. Check both")
    assert last == str(again.value)


@pytest.mark.parametrize("wrong", ["missing", "extra"])
def test_13_both_agents_are_identified_by_name(lab, wrong):
    from dual_ur10.envs.api.parallel_env import parallel_env

    lab.close_env()
    lab.mark()
    lab.env = env = parallel_env("SineTracking", cell=lab.where)
    env.reset(seed=0)
    lab.assert_watched()
    begin = [len(lab.executed(arm)) for arm in ARMS]
    actions = dict(zip(ARMS, np.zeros((2, 6), dtype=np.float32), strict=True))
    actions["left"][4] = 0.2
    for _ in range(10):
        env.step(dict(reversed(actions.items())))
    moved = [np.abs(np.ptp(lab.executed(arm)[first:], axis=0)).max() for arm, first in zip(ARMS, begin, strict=True)]
    assert moved[0] > 1e-3
    assert moved[1] < 1e-4
    if wrong == "missing":
        del actions["right"]
    else:
        actions["middle"] = actions["left"]
    lab.note()
    with pytest.raises(ActionError, match=r"right|middle"):
        env.step(actions)
    lab.assert_at_rest()
    lab.assert_nothing_more()
    lab.close_env()
    lab.assert_latched("the policy")


def test_15_an_action_that_its_policy_changes_later_was_copied(lab):
    lab.begin(steps=3)
    action = np.zeros(12)
    for value in (0.1, -0.1, 0.1):
        action[:] = value
        lab.env.step(action)
        action[:] = np.nan
    assert np.isfinite(lab.executed("left")).all()
    assert lab.latch.read() is None


def test_16_a_policy_for_other_observations_is_refused(lab):
    lab.make()
    policy = policies.load("scripted", "DualUR10/SyncCarry-v0")
    with pytest.raises(ActionError):
        rollout(lab.env, policy, seed=0)
    lab.note()  # they rest, where the episode begins
    lab.assert_stopped(None, "the policy failed: ActionError")
