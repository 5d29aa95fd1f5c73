"""Base of scripts: one coroutine per episode, run for each row of a batch."""

import gymnasium as gym
import numpy as np
import pytest

from dual_ur10.envs.tasks.handover.task import Handover
from dual_ur10.envs.tasks.sine_tracking.task import SineTracking
from dual_ur10.envs.tasks.task import Timing
from dual_ur10.errors import ActionError, SettingsError
from dual_ur10.policies.policy import EpisodeAware, Policy
from dual_ur10.policies.scripted.base import Script, Wish

N, TIMING = 3, Timing(0.04, 0.04)
RNG = np.random.default_rng(0)
SEEN = RNG.uniform(-1.0, 1.0, (5, N, 94))


class Nod(Script):
    """Two wishes relative to the first observation, then one that follows the observed speeds."""

    task = SineTracking

    def script(self, fields):
        start = fields["q_rad"]
        fields = yield Wish(start + 0.01)
        fields = yield Wish(start - 0.01)
        yield Wish(start + fields["qd_rad_s"])


class Grip(Script):
    """One wish with openings."""

    task = Handover

    def script(self, fields):
        yield Wish(fields["commanded_q_rad"], np.array([1.0, -1.0]))


class Stumble(Script):
    """Fails in the second step of its first episode."""

    task = SineTracking
    failed = False

    def script(self, fields):
        yield Wish(fields["q_rad"])
        if not self.failed:
            self.failed = True
            raise SettingsError("out of reach")
        yield Wish(fields["q_rad"] + 1.0)


class Nothing(Script):
    """No wish at all."""

    task = SineTracking

    def script(self, fields):
        yield from ()


def expected(row, first=0, steps=5):
    """Return the joint positions that row wishes, with an episode from the observation `first` on."""
    parts = [SineTracking.layout.split(each[row]) for each in SEEN]
    start = parts[first]["q_rad"].ravel()
    wishes = [start + 0.01, start - 0.01, start + parts[min(first + 2, 4)]["qd_rad_s"].ravel()]
    return [wishes[min(step, 2)] for step in range(steps)]


def test_each_row_runs_a_script_of_its_own_whose_last_wish_stays():
    policy = Nod(TIMING, "joint_position")
    assert isinstance(policy, Policy)
    assert isinstance(policy, EpisodeAware)
    found = np.array([policy(each) for each in SEEN])
    for row in range(N):
        assert found[:, row] == pytest.approx(np.array(expected(row)))


def test_rows_begin_again_by_themselves_and_a_reset_begins_all():
    policy = Nod(TIMING, "joint_position")
    policy.begin(np.array([0]), [0])  # before the first observation: nothing to do
    for each in SEEN[:2]:
        policy(each)
    policy.begin(np.array([1]), [7])
    later = np.array([policy(each) for each in SEEN[2:]])
    assert later[:, 1] == pytest.approx(np.array(expected(1, first=2, steps=3)))
    assert later[:, 0] == pytest.approx(np.array(expected(0)[2:]))
    policy.reset()
    assert policy(SEEN[0, 0]) == pytest.approx(expected(0)[0])  # one row now


def test_steps_lead_from_the_command_in_force():
    action = Nod(TIMING)(SEEN[0, 0])
    fields = SineTracking.layout.split(SEEN[0, 0])
    step = (fields["q_rad"] + 0.01 - fields["commanded_q_rad"]).ravel()
    assert action == pytest.approx(step / (1.2 * 0.04), rel=1e-5)


def test_openings_follow_the_joints_of_each_arm():
    action = Grip(TIMING)(RNG.uniform(-1.0, 1.0, 158))
    assert action.tolist() == [0.0] * 6 + [1.0] + [0.0] * 6 + [-1.0]


def test_a_script_acts_in_an_environment():
    class Still(Script):
        task = SineTracking

        def script(self, fields):
            yield Wish(fields["commanded_q_rad"])

    env, script = gym.make("DualUR10/SineTracking-v0"), Still(TIMING)
    observation, info = env.reset(seed=0)
    for _ in range(5):
        observation, *_, now = env.step(script(observation))
    assert np.abs(now["q_rad"] - info["q_rad"]).max() < 1e-3


def test_a_script_without_a_wish_and_another_number_of_rows_are_refused():
    with pytest.raises(SettingsError, match="Nothing ended before its first wish"):
        Nothing(TIMING)(SEEN[0])
    policy = Nod(TIMING)
    policy(SEEN[0])
    with pytest.raises(ActionError, match="2 observations after 3"):
        policy(SEEN[0, :2])


def test_openings_in_some_rows_only_are_refused():
    class Some(Script):
        task = Handover

        def script(self, fields):
            opened = self.opened = not getattr(self, "opened", False)
            yield Wish(fields["commanded_q_rad"], np.ones(2) if opened else None)

    policy, seen = Some(TIMING), RNG.uniform(-1.0, 1.0, (N, 2 * Handover.layout.size))
    with pytest.raises(SettingsError, match=r"Some states openings in row 0 and none in row 1: state them in every"):
        policy(seen)
    assert policy(seen[:1]).shape == (1, 12)  # all begin anew


def test_a_script_that_failed_begins_anew():
    policy = Stumble(TIMING, "joint_position")
    policy(SEEN[0][0])
    with pytest.raises(SettingsError, match="out of reach"):
        policy(SEEN[1][0])
    wanted = SineTracking.layout.split(SEEN[2][0])["q_rad"].ravel()
    assert policy(SEEN[2][0]) == pytest.approx(wanted, abs=1e-6)  # not the wish before
    assert policy(SEEN[3][0]) == pytest.approx(wanted + 1.0, abs=1e-6)
