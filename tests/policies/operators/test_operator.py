"""Operators: what hands do to the arms, on the dry run of a cell."""

import numpy as np
import pytest

from dual_ur10.errors import (
    ActionError,
    DeviceGarbageError,
    DeviceSilentError,
    LeaderConfigurationError,
    SettingsError,
    StopPressedError,
    UnknownNameError,
)
from dual_ur10.policies.operators.device import FULL_TWIST
from dual_ur10.policies.operators.mapping import Mapping
from dual_ur10.policies.operators.operator import Operator
from tests.policies.operators.hands import Hand, commanded, led, operator_of, twist
from ur_core.kinematics.poses import Poses, relative_to
from ur_core.kinematics.rotations import quat_from_rotvec, quat_multiply

MODES = ("tcp_delta", "joint_delta", "joint_position")
FORWARD = (0.25, 0, 0, 0, 0, 0)


def run(env, operator, steps, seed=0):
    """Return the commanded tools after each step, (steps + 1, 2, 7), and the last observation."""
    observation, _ = env.reset(seed=seed)
    operator.reset()
    tools = []
    for _ in range(steps):
        action = operator(observation)
        tools.append(operator.tools_m)
        observation, *_, info = env.step(action)
        assert "safety" not in info
    operator(observation)
    return np.array([*tools, operator.tools_m]), observation


@pytest.mark.parametrize("mode", MODES)
def test_both_hands_move_their_tools_at_full_speed_in_every_action_mode(mode):
    device = Hand(**twist(FORWARD, (0, 0, -0.25, 0, 0, 0.5)))
    env, operator = led(device, action_mode=mode)
    tools, _ = run(env, operator, 10)
    moved = tools[-1, :, :3] - tools[0, :, :3]
    np.testing.assert_allclose(moved, [[0.1, 0, 0], [0, 0, -0.1]], atol=2e-5)
    half = np.cos(0.2 / 2)
    assert abs(tools[0, 0, 3:] @ tools[-1, 0, 3:]) == pytest.approx(1.0, abs=1e-9)
    assert abs(tools[0, 1, 3:] @ tools[-1, 1, 3:]) == pytest.approx(half, abs=1e-6)


@pytest.mark.parametrize(
    ("keywords", "moved_m"),
    [
        ({"action_mode": "tcp_delta", "action_scale": 0.5}, 0.05),
        ({"action_mode": "tcp_delta", "action_scale": {"translation": 0.1}}, 0.01),
        ({"action_mode": "joint_delta", "action_scale": 0.5}, 0.05),
        *(({"action_mode": mode, "observation": "goals"}, 0.05) for mode in MODES),
    ],
)
def test_speeds_do_not_depend_on_the_scale_of_steps_nor_on_the_view(keywords, moved_m):
    env, operator = led(Hand(**twist(FORWARD)), mapping={"scale": 0.5}, **keywords)
    tools, _ = run(env, operator, 10)
    np.testing.assert_allclose(tools[-1, :, :3] - tools[0, :, :3], [[moved_m, 0, 0]] * 2, atol=5e-5)


def test_arms_slide_along_what_is_in_their_way_and_are_free_to_leave_it():
    device = Hand(**twist((0.15, 0, -0.2, 0, 0, 0)))
    env, operator = led(device, "Free", objects=())
    table, observation = run(env, operator, 40)  # without a refusal
    np.testing.assert_allclose(table[-5:, :, 2], table[-1, 0, 2], atol=1e-4)
    assert (np.diff(table[-5:, :, 0], axis=0) > 0.004).all()  # it goes on along the table
    device.set(**twist((0, 0, 0.2, 0, 0, 0)))
    observation, *_ = env.step(operator(observation))
    operator(observation)
    assert (operator.tools_m[:, 2] > table[-1, :, 2] + 0.005).all()


@pytest.mark.parametrize("mode", MODES)
def test_a_released_clutch_leaves_arm_and_gripper(mode):
    device = Hand(**twist(FORWARD, clutch=(True, False), gripper=np.zeros(2)))
    env, operator = led(device, "Handover", action_mode=mode)
    observation, _ = env.reset(seed=0)
    action = operator(observation).reshape(2, 7)
    still = commanded(observation)[1] if mode == "joint_position" else np.zeros(6)
    np.testing.assert_allclose(action[1], [*still, 1.0], atol=1e-7)
    assert action[0, 6] == -1.0
    assert np.abs(action[0, :6] - (commanded(observation)[0] if mode == "joint_position" else 0)).max() > 1e-3
    np.testing.assert_array_equal(operator.leads, [True, False])


def test_it_goes_on_from_what_is_commanded_and_not_from_what_is_measured():
    device = Hand(**twist(FORWARD))
    env, operator = led(device, action_mode="joint_position")
    observation, _ = env.reset(seed=0)
    action = operator(observation)
    sagging = observation.copy().reshape(2, -1)
    sagging[:, :6] += 0.1
    sagging[:, 18:21] -= 0.1
    np.testing.assert_array_equal(operator(sagging.reshape(-1)), action)
    sagging[:, 12] += 0.1
    assert np.abs(operator(sagging.reshape(-1)) - action).max() > 0.05


def test_frames_turn_the_axes_of_the_device():
    for mapping, expected in (
        ({"frame": "tool"}, [0, 0, -1]),  # tools point down: their z
        ({"frame": "base"}, [0, 0, 1]),
        ({"frame": "cell"}, [0, 0, 1]),
    ):
        env, operator = led(Hand(**twist((0, 0, 0.25, 0, 0, 0))), mapping=mapping)
        tools, _ = run(env, operator, 1)
        np.testing.assert_allclose(tools[1, 0, :3] - tools[0, 0, :3], np.array(expected) * 0.01, atol=1e-5)


def test_the_view_of_the_operator_turns_and_mirrors_the_axes():
    left = (0, 0.25, 0, 0.5, 0, 0)
    assert Mapping(yaw_rad=np.pi).speeds(np.array(left)) == pytest.approx([0, -0.25, 0, -0.5, 0, 0])
    assert Mapping(yaw_rad=np.pi / 2).speeds(np.array(FORWARD)) == pytest.approx([0, 0.25, 0, 0, 0, 0])
    assert Mapping(mirror=True).speeds(np.array(left)) == pytest.approx([0, -0.25, 0, -0.5, 0, 0])
    assert Mapping(mirror=True).speeds(np.array([0.25, 0, 0, 0, 0.5, 0])) == pytest.approx([0.25, 0, 0, 0, 0.5, 0])


def test_a_dead_zone_is_at_rest_and_the_rest_is_stretched():
    mapping = Mapping(dead_zone=0.2, scale=0.5)
    share = np.array([0.19, -0.6, 0, 0.1, 1.0, 0])
    assert mapping.speeds(share * FULL_TWIST) == pytest.approx([0, -0.0625, 0, 0, 0.5, 0])


def test_a_diagonal_is_no_faster_than_an_axis():
    speeds = Mapping().speeds(FULL_TWIST)
    assert np.linalg.norm(speeds[:3]) == pytest.approx(0.25)
    assert np.linalg.norm(speeds[3:]) == pytest.approx(0.5)


def test_one_hand_leads_one_arm_and_its_button_passes_it_on():
    device = Hand(hands=1, **twist(FORWARD, clutch=(True, False)))
    env, operator = led(device)
    observation, _ = env.reset(seed=0)
    assert np.abs(operator(observation).reshape(2, 6)).max(axis=1) == pytest.approx([1, 0])
    device.set(**twist(FORWARD, clutch=(True, False), buttons=frozenset({"switch"})))
    assert np.abs(operator(observation).reshape(2, 6)).max(axis=1) == pytest.approx([0, 1])
    assert operator.buttons == {"switch"}
    device.set(**twist(FORWARD, clutch=(True, False)))
    assert np.abs(operator(observation).reshape(2, 6)).max(axis=1) == pytest.approx([0, 1])


@pytest.mark.parametrize(("hands", "arms", "leads"), [(1, "right", (0, 1)), (2, "right", (0, 1)), (2, "left", (1, 0))])
def test_one_arm_alone_is_led(hands, arms, leads):
    env, operator = led(Hand(hands=hands, **twist(FORWARD)), mapping={"arms": arms})
    assert np.abs(operator(env.reset(seed=0)[0]).reshape(2, 6)).max(axis=1) == pytest.approx(leads)


def test_a_mirrored_arm_is_the_mirror_image_of_the_other():
    env, operator = led(Hand(hands=1, **twist((0.1, 0.1, 0.1, 0.2, 0.2, 0.2))), mapping={"arms": "mirrored"})
    left, right = operator(env.reset(seed=0)[0]).reshape(2, 6)
    assert right == pytest.approx(left * [1, -1, 1, -1, 1, -1])
    assert left[1] > 0.1


@pytest.mark.parametrize("mode", MODES)
def test_a_held_object_keeps_the_pose_of_one_grip_in_the_other(mode):
    device = Hand(hands=1, **twist((0.1, 0.15, 0.1, 0.1, 0.3, -0.5)))
    env, operator = led(device, "SyncCarry", {"arms": "held"}, action_mode=mode, cell="echo", grasp="rigid")
    tools, _ = run(env, operator, 40)
    assert np.linalg.norm(tools[-1, :, :3] - tools[0, :, :3], axis=1).min() > 0.05
    grips = relative_to(Poses(tools[:, 0, :3], tools[:, 0, 3:]), Poses(tools[:, 1, :3], tools[:, 1, 3:]))
    assert np.linalg.norm(grips.position_m - grips.position_m[0], axis=1).max() < 1e-3
    assert np.abs(grips.quat @ grips.quat[0]).min() > np.cos(1e-3 / 2)
    assert abs(tools[0, 0, 3:] @ tools[-1, 0, 3:]) < np.cos(0.15)  # it turned, too


def test_wanted_poses_are_reached_and_a_released_handle_is_left():
    device = Hand(**twist(*[0] * 6))
    env, operator = led(device)
    tools, observation = run(env, operator, 0)
    turn = quat_from_rotvec(np.array([0.0, 0.0, 0.2]))
    goal = tools[0].copy()
    goal[:, :3] += [0.03, 0.02, -0.05]
    goal[0, 3:] = quat_multiply(turn, goal[0, 3:])
    device.set(poses=goal, clutch=np.array([True, True]))
    for _ in range(40):
        observation, *_ = env.step(operator(observation))
    operator(observation)
    np.testing.assert_allclose(operator.tools_m[:, :3], goal[:, :3], atol=1e-5)
    assert abs(operator.tools_m[0, 3:] @ goal[0, 3:]) > 1 - 1e-8
    device.set(poses=goal + 1.0, clutch=np.array([False, False]))
    assert not operator(observation).any()


@pytest.mark.parametrize("mode", MODES)
def test_a_leader_arm_leads_joint_for_joint_whatever_its_turns(mode):
    device = Hand(**twist(*[0] * 6))
    env, operator = led(device, action_mode=mode)
    observation, _ = env.reset(seed=0)
    goal = commanded(observation) + np.array([0.3, -0.2, 0.1, 0.4, -0.3, 0.5])
    turns = 2 * np.pi * np.array([[1, 0, -1, 2, 0, 1], [0, 1, 0, -1, 1, 0]])
    device.set(joints_rad=goal + turns, clutch=np.array([True, True]))
    operator.reset()
    fastest, before = 0.0, commanded(observation)
    for _ in range(120):
        observation, *_ = env.step(operator(observation))
        fastest = max(fastest, np.abs(commanded(observation) - before).max() / 0.04)
        before = commanded(observation)
    np.testing.assert_allclose(commanded(observation), goal, atol=2e-3)
    assert fastest < 0.25  # it comes to its leader slowly


def test_a_leader_that_passes_half_a_turn_does_not_wrap():
    device = Hand(**twist(*[0] * 6))
    env, operator = led(device, action_mode="joint_position")
    observation, _ = env.reset(seed=0)
    leader = commanded(observation).copy()
    for step in range(110):
        leader[0, 5] += 0.04 * (step > 0)
        counted = (leader + np.pi) % (2 * np.pi) - np.pi  # as after power-on, within one turn
        device.set(joints_rad=counted, clutch=np.array([True, True]))
        observation, *_ = env.step(operator(observation))
    assert commanded(observation)[0, 5] == pytest.approx(leader[0, 5], abs=0.2)
    assert leader[0, 5] > 5.5


def test_a_leader_too_far_from_its_arm_is_refused():
    device = Hand(**twist(*[0] * 6))
    env, operator = led(device)
    observation, _ = env.reset(seed=0)
    leader = commanded(observation).copy()
    leader[1, 2] += 0.7
    device.set(joints_rad=leader, clutch=np.array([True, True]))
    with pytest.raises(LeaderConfigurationError, match=r"joint 3 of the leader of the right arm.*0\.6 rad"):
        operator(observation)
    device.set(joints_rad=leader, clutch=np.array([True, False]))
    assert np.abs(operator(observation)).max() < 1e-12


def test_silence_stops_the_arms_and_then_gives_the_device_up():
    device = Hand(**twist(FORWARD, age_s=0.07))
    env, operator = led(device)
    observation, _ = env.reset(seed=0)
    assert operator(observation).any()
    device.set(**twist(FORWARD, age_s=0.09))
    assert not operator(observation).any()
    device.set(**twist(FORWARD, age_s=1.1))
    with pytest.raises(DeviceSilentError, match=r"a hand has been silent for 1\.1 s"):
        operator(observation)


def test_the_button_to_stop_ends_what_runs_unless_that_acts_on_it():
    device = Hand(**twist(FORWARD, buttons=frozenset({"stop"})))
    env, operator = led(device)
    observation, _ = env.reset(seed=0)
    with pytest.raises(StopPressedError, match="the button to stop was pressed on a hand"):
        operator(observation)
    with pytest.raises(StopPressedError):
        operator.poll()
    operator.stops = False
    assert operator(observation).any()
    assert operator.buttons == {"stop"}


@pytest.mark.parametrize(
    ("reading", "message"),
    [
        ({}, "nothing"),
        ({"twist": np.zeros((2, 6)), "poses": np.zeros((2, 7))}, "twist and poses"),
        ({"twist": np.zeros(6)}, "shape"),
        ({"twist": np.full((2, 6), np.nan), "clutch": np.array([True, False])}, "finite"),
        ({"twist": np.zeros((2, 6)), "gripper": np.array([0.0, 2.0])}, "0 to 1"),
        ({"twist": np.zeros((2, 6)), "clutch": np.array([1.0, 0.0])}, "True and False"),
        ({"twist": np.zeros((2, 6)), "age_s": -1.0}, "age_s"),
        ({"twist": "fast"}, "numbers"),
        ({"twist": np.zeros((2, 6)), "buttons": frozenset({3})}, "names"),
    ],
)
def test_garbage_of_a_device_is_named(reading, message):
    device = Hand(**reading)
    env, operator = led(device)
    with pytest.raises(DeviceGarbageError, match=f"a hand gave.*{message}"):
        operator(env.reset(seed=0)[0])


def test_numbers_of_a_released_hand_may_be_anything():
    device = Hand(twist=np.full((2, 6), np.nan), clutch=np.array([False, False]))
    env, operator = led(device)
    assert not operator(env.reset(seed=0)[0]).any()


@pytest.mark.parametrize("shape", [(4, 50), (7,), (1, 2, 50), ()])
def test_only_one_cell_is_led(shape):
    _, operator = led(Hand(**twist(FORWARD)))
    with pytest.raises(ActionError, match="one cell"):
        operator(np.zeros(shape))


def test_wrong_settings_are_named():
    with pytest.raises(UnknownNameError, match="frame of an operator"):
        Mapping(frame="camera")
    with pytest.raises(SettingsError, match="mirror"):
        Mapping(mirror="yes")
    with pytest.raises(SettingsError, match="scale is 2"):
        Mapping(scale=2.0)
    with pytest.raises(SettingsError, match="no input device"):
        operator_of(object(), "SineTracking")
    env, operator = led(Hand(joints_rad=np.zeros((2, 6))), mapping={"arms": "held"})
    observation, _ = env.reset(seed=0)
    with pytest.raises(SettingsError, match="gives joints_rad"):
        operator(observation)


def test_actions_are_paced_by_a_clock_if_there_is_one():
    now, slept = [10.0], []

    def wait(seconds):
        slept.append(seconds)
        now[0] += seconds

    env, plain = led(Hand(**twist(FORWARD)))
    paced = Operator(plain.device, timing=plain.timing, limits=env.unwrapped.core.setup.limits, grippers=False,
                     clock=lambda: now[0], wait=wait)  # fmt: skip
    observation, _ = env.reset(seed=0)
    for busy in (0.01, 0.03, 0.09, 0.01):
        paced(observation)
        now[0] += busy
    paced(observation)
    np.testing.assert_allclose(slept, [0.03, 0.01, 0.03], atol=1e-9)
