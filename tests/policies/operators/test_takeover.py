"""Takeover: who commands which arm, and what changes at that instant, on the dry run of a cell."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from dual_ur10.errors import DeviceUnpluggedError
from dual_ur10.policies.operators.takeover import HAND_BACK_S, Takeover
from tests.policies.operators.hands import Hand, commanded, led, twist

MODES = ("tcp_delta", "joint_delta", "joint_position")
REST = (0,) * 6
FORWARD = (0.25, 0, 0, 0, 0, 0)
FULL = [1, 0, 0, 0, 0, 0]


class Steady:
    """Policy of equal steps, which turn after some of them."""

    def __init__(self, step=0.2, opening=None, turns=10_000):
        self.step, self.opening, self.turns, self.seen = step, opening, turns, 0

    def reset(self):
        self.seen = 0

    def __call__(self, observation):
        self.seen += 1
        action = np.full((2, 6), self.step * (-1) ** (self.seen // self.turns))
        if self.opening is not None:
            action = np.concatenate([action, np.full((2, 1), self.opening)], axis=1)
        return action.reshape(-1)


def shared(policy=None, task="SineTracking", hands=2, **keywords):
    """Return an environment, a takeover, its device, and the first observation."""
    device = Hand(hands=hands, **twist(REST))
    env, operator = led(device, task, **keywords)
    said = []
    takeover = Takeover(policy or Steady(), operator, tell=said.append)
    observation, _ = env.reset(seed=0)
    takeover.reset()
    takeover.said = said
    return env, takeover, device, observation


def press(device, name, hand=REST, **more):
    device.set(**twist(hand, buttons=frozenset({name} if name else ()), **more))


def joints(action):
    return np.asarray(action).reshape(2, -1)[:, :6]


def test_it_says_who_commands_what():
    _, takeover, device, _ = shared()
    mode = takeover.operator.action_mode
    assert repr(takeover) == f"Takeover({takeover.policy!r}, Operator({device.name}, {mode}))"


@pytest.mark.parametrize(("button", "taken"), [("take_left", [1, 0]), ("take_right", [0, 1]), ("take_both", [1, 1])])
def test_an_arm_is_taken_in_the_action_of_its_button_and_the_other_goes_on(button, taken):
    _, takeover, device, observation = shared()
    assert not takeover.commander.any()
    np.testing.assert_allclose(joints(takeover(observation)), 0.2)
    press(device, button, FORWARD)
    for ratio in (0.2, 0.4, 0.6, 0.8, 1.0, 1.0):
        action = joints(takeover(observation))
        led = np.array(FULL) * ratio + 0.2 * (1 - ratio)
        np.testing.assert_allclose(action, [led if each else [0.2] * 6 for each in taken], atol=1e-6)
        np.testing.assert_array_equal(takeover.commander, taken)
    press(device, None)
    np.testing.assert_allclose(joints(takeover(observation))[np.array(taken, bool)], 0.0)
    assert takeover.policy.seen == 8
    press(device, "hand_back")
    takeover(observation)
    assert not takeover.commander.any()
    assert len(takeover.said) == 2 * sum(taken)


@pytest.mark.parametrize("mode", MODES)
def test_an_arm_handed_back_passes_from_its_motion_to_that_of_the_policy(mode):
    _, takeover, device, observation = shared(Steady(0.4), action_mode=mode)
    origin = commanded(observation) if mode == "joint_position" else np.zeros((2, 6))
    most = takeover.operator.step_rad if mode == "joint_position" else 1.0
    aim = np.clip(0.4 - origin, -most, most)
    press(device, "take_left", (0, 0.1, 0, 0, 0, 0))
    first = [joints(takeover(observation))[0] - origin[0] for _ in range(6)][-1]
    press(device, "hand_back", FORWARD)
    count = int(HAND_BACK_S / 0.04)
    steps = np.array([joints(takeover(observation))[0] - origin[0] for _ in range(count + 1)])
    ratio = 0.04 * np.arange(1, count + 1)[:, None] / HAND_BACK_S
    np.testing.assert_allclose(steps[:-1], ratio * aim[0] + (1 - ratio) * first, atol=1e-6)
    np.testing.assert_allclose(steps[-1], 0.4 - origin[0], atol=1e-6)


def test_a_gripper_stays_as_it_is_until_the_person_uses_it():
    _, takeover, device, observation = shared(Steady(0.0, opening=-1.0), "Handover")
    takeover(observation)
    press(device, "take_both", gripper=np.array([1.0, np.nan]))  # the left trigger is open
    assert takeover(observation).reshape(2, 7)[:, 6].tolist() == [-1, -1]
    for trigger, opening in ((0.6, 0.0), (0.1, 0.1), (0.8, 0.8)):
        press(device, None, gripper=np.array([trigger, np.nan]))
        assert takeover(observation).reshape(2, 7)[:, 6] == pytest.approx([2 * opening - 1, -1], abs=1e-6)
    press(device, "grip_right")
    assert takeover(observation).reshape(2, 7)[:, 6] == pytest.approx([0.6, 1.0], abs=1e-6)
    press(device, "hand_back")
    assert takeover(observation).reshape(2, 7)[:, 6].tolist() == [-1, -1]


def test_a_trigger_that_passes_where_the_gripper_is_counts_too():
    _, takeover, device, observation = shared(Steady(0.0, opening=0.0), "Handover")  # half open
    takeover(observation)
    press(device, "take_both", gripper=np.array([1.0, 0.0]))
    takeover(observation)
    press(device, None, gripper=np.array([0.0, 0.0]))
    assert takeover(observation).reshape(2, 7)[:, 6] == pytest.approx([-1, 0])


def test_one_hand_leads_the_arm_that_it_takes():
    _, takeover, device, observation = shared(hands=1)
    for button, expected in (("take_right", [[0.2] * 6, FULL]), ("take_left", [FULL, [0] * 6])):
        press(device, button, FORWARD)
        np.testing.assert_allclose([joints(takeover(observation)) for _ in range(6)][-1], expected, atol=1e-6)


def test_a_leader_elsewhere_does_not_take_its_arm_and_says_why():
    _, takeover, device, observation = shared()
    leader = commanded(observation).copy()
    leader[0, 2] += 0.7
    lead = {"joints_rad": leader, "clutch": np.array([True, True])}
    device.set(**lead)
    takeover(observation)
    device.set(**lead, buttons=frozenset({"take_both"}))
    action = joints(takeover(observation))
    np.testing.assert_allclose(action, [[0.2] * 6, [0.16] * 6], atol=1e-6)
    assert takeover.commander.tolist() == [False, True]
    assert "the left arm is not taken: joint 3 of the leader" in takeover.said[-1]
    device.set(**lead)
    for _ in range(5):
        takeover(observation)
    device.set(**lead | {"clutch": np.array([True, False])})
    takeover(observation)
    leader[1, 0] += 0.7
    said = len(takeover.said)
    device.set(**lead)
    for _ in range(2):
        assert np.abs(joints(takeover(observation))[1]).max() < 1e-12
    assert len(takeover.said) == said + 1
    assert "joint 1 of the leader of the right arm" in takeover.said[-1]


def test_an_episode_begins_with_the_policy_and_a_device_that_fails_ends_it():
    _, takeover, device, observation = shared()
    press(device, "take_both")
    takeover(observation)
    takeover.reset()
    assert not takeover.commander.any()
    assert takeover.policy.seen == 0
    device.set(**twist(REST))
    device.read = lambda: (_ for _ in ()).throw(DeviceUnpluggedError("a hand was unplugged"))
    with pytest.raises(DeviceUnpluggedError):
        takeover(observation)


EVENTS = st.lists(
    st.tuples(
        st.integers(1, 12),
        st.sampled_from(["take_left", "take_right", "take_both", "hand_back", None]),
        st.lists(st.floats(-0.25, 0.25), min_size=6, max_size=6),
    ),
    min_size=1,
    max_size=8,
)


@settings(deadline=None, max_examples=12, derandomize=True, database=None)
@given(events=EVENTS, mode=st.sampled_from(MODES), turns=st.integers(2, 12))
def test_takeovers_at_any_instant_keep_every_limit(events, mode, turns):
    env, takeover, device, observation = shared(Steady(0.5, turns=turns), action_mode=mode)
    core = env.unwrapped.core
    limits, tick_s = core.pipeline.adapter.limits, core.config.servoj.tick_s
    targets = [np.tile(commanded(observation), (4, 1, 1))]
    for count, button, hand in events:
        for k in range(count):
            press(device, None if k else button, hand)
            observation, *_ = env.step(takeover(observation))
            targets.append(core.pipeline.adapter.targets_rad[0])
    assert takeover.policy.seen == len(targets) - 1
    path = np.concatenate(targets).reshape(-1, 12)
    for order, most in ((1, limits.speed_rad_s * 2), (2, limits.acceleration_rad_s2), (3, limits.jerk_rad_s3)):
        reached = np.abs(np.diff(path, order, axis=0)) / tick_s**order
        assert (reached <= np.array(most) * (1 + 1e-6)).all(), order
