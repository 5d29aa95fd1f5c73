"""Scripted policies of one arm, to prove that it alone does not succeed."""

import gymnasium as gym

from dual_ur10.policies import load


class OneArm:
    """Scripted policy of which one arm moves; the other one stays at home, and its gripper stays open."""

    def __init__(self, env_id, arm):
        self.script, self.other = load("scripted", env_id), 1 - arm

    def __call__(self, observation):
        action = self.script(observation).reshape(2, 7)
        action[self.other] = [0.0] * 6 + [1.0]
        return action.reshape(-1)


def reached_alone(env_id, arm, duration_s):
    """Return whether one arm alone succeeds in an episode, and the stage that it reaches."""
    with gym.make(env_id, duration_s=duration_s, on_refusal="terminate") as env:
        policy, (observation, _), over = OneArm(env_id, arm), env.reset(seed=0), False
        while not over:
            observation, _, terminated, truncated, info = env.step(policy(observation))
            over = terminated or truncated
        return info["is_success"], info["stage"]
