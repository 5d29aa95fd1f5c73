"""Operators under any input: within the limits, still when released, and one body when an object is held."""

import numpy as np
from hypothesis import example, given, settings
from hypothesis import strategies as st

from tests.policies.operators.hands import Hand, led, twist
from ur_core.kinematics.poses import Poses, relative_to

SPEEDS = st.lists(st.floats(-1.0, 1.0), min_size=6, max_size=6)
INPUTS = st.lists(st.tuples(SPEEDS, SPEEDS, st.booleans(), st.booleans()), min_size=4, max_size=25)


@settings(deadline=None, max_examples=20, database=None)
@given(inputs=INPUTS, mode=st.sampled_from(["tcp_delta", "joint_delta", "joint_position"]),
       frame=st.sampled_from(["cell", "base", "tool"]))  # fmt: skip
def test_no_input_exceeds_the_speeds_and_a_released_hand_never_moves(inputs, mode, frame):
    device = Hand(**twist(*[0] * 6))
    env, operator = led(device, action_mode=mode, mapping={"frame": frame})
    observation, _ = env.reset(seed=0)
    most_rad = np.array(env.unwrapped.core.setup.limits.speed_rad_s) * 0.04
    for left, right, *clutch in inputs:
        device.set(twist=np.array([left, right]), clutch=np.array(clutch))
        action = operator(observation).reshape(2, 6)
        before, tools = np.asarray(observation).reshape(2, -1)[:, 12:18], operator.tools_m
        joints = action if mode == "tcp_delta" else (action - before if mode == "joint_position" else action * most_rad)
        for arm in range(2):
            if not clutch[arm]:
                np.testing.assert_allclose(joints[arm], 0.0, atol=1e-6)
        if mode == "tcp_delta":
            assert np.linalg.norm(action.reshape(2, 2, 3), axis=2).max() <= 1.0 + 1e-6
        else:
            assert (np.abs(joints) <= most_rad + 1e-6).all()
        observation, *_ = env.step(action.reshape(-1))
        operator(observation)
        assert np.linalg.norm(operator.tools_m[:, :3] - tools[:, :3], axis=1).max() <= 0.25 * 0.04 + 1e-4


@settings(deadline=None, max_examples=15, database=None)
@given(moves=st.lists(st.tuples(SPEEDS, st.integers(1, 12), st.booleans()), min_size=1, max_size=6),
       mode=st.sampled_from(["tcp_delta", "joint_delta"]))  # fmt: skip
@example(moves=[([0.25, 0, 0, 0, 0, 0.5], 30, True)], mode="tcp_delta")  # one tool would be too fast
def test_a_held_object_is_one_body_with_both_tools(moves, mode):
    device = Hand(hands=1, **twist(*[0] * 6))
    env, operator = led(device, "SyncCarry", {"arms": "held"}, action_mode=mode, grasp="rigid")
    observation, _ = env.reset(seed=0)
    tools = []
    for speeds, steps, clutch in moves:
        device.set(twist=np.array([speeds, speeds]), clutch=np.array([clutch, clutch]))
        for _ in range(steps):
            action = operator(observation)
            tools.append(operator.tools_m)
            if not clutch:
                assert not action.any()
            observation, _, terminated, *_ = env.step(action)
            if terminated:
                break
    tools = np.array(tools)
    grips = relative_to(Poses(tools[:, 0, :3], tools[:, 0, 3:]), Poses(tools[:, 1, :3], tools[:, 1, 3:]))
    assert np.linalg.norm(grips.position_m - grips.position_m[0], axis=1).max() < 1e-3
