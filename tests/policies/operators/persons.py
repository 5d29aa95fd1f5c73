"""Synthetic persons: they act through devices alone, by the reports that those send."""

import math

import gymnasium as gym
import numpy as np

from dual_ur10 import policies
from dual_ur10.kinematics.rotations import quat_from_rotvec, quat_multiply
from dual_ur10.policies.operators.device import FULL_TWIST
from dual_ur10.policies.operators.leader import Leader
from dual_ur10.policies.operators.spacemouse import SpaceMouse
from tests.policies.operators.hands import Hand, commanded, operator_of, twist
from tests.policies.operators.rigs import RawLeader, RawMouse, RawPage

LEAST = 0.004  # of full speed: smaller steps are no deflection of the cap


class MousePerson:
    """Person with a SpaceMouse in each hand, who moves tools to their goals and presses buttons for the grippers."""

    mode = "tcp_delta"

    def __init__(self, folder, task, **keywords):
        self._plan = policies.load("scripted", f"DualUR10/{task}-v0", action_mode="tcp_delta", **keywords)
        self._mice = [RawMouse(folder, "left"), RawMouse(folder, "right", new=True)]
        self.device = SpaceMouse(left=self._mice[0].path, right=self._mice[1].path)
        self.dead_zone = 0.08

    def begin(self, observation):
        self._plan.reset()
        self._open = np.ones(2, dtype=bool)

    def move(self, observation):
        actions = self._plan(observation).reshape(2, -1)
        for arm, mouse in enumerate(self._mice):
            share = actions[arm, :6].astype(float)
            # It pushes the cap until the tool moves: beyond the dead zone.
            pushed = np.copysign(self.dead_zone + (1 - self.dead_zone) * np.abs(share), share)
            mouse.deflect(np.where(np.abs(share) < LEAST, 0.0, pushed) * FULL_TWIST)
            if actions.shape[1] > 6 and (actions[arm, 6] > 0) != self._open[arm]:
                self._open[arm] = not self._open[arm]
                mouse.press(1)
                mouse.press(0)

    def close(self):
        self.device.close()
        for mouse in self._mice:
            mouse.unplug()


class LeaderPerson:
    """Person who moves both leader arms so that tools go to their goals, and pulls their triggers.

    The steps of the tools become joints by an operator of this person's own: what an eye and a hand do.
    """

    mode = "joint_delta"

    def __init__(self, folder, task, **keywords):
        self._plan = policies.load("scripted", f"DualUR10/{task}-v0", action_mode="tcp_delta", **keywords)
        self._hand = Hand(**twist(*[0] * 6))
        self._eye = operator_of(self._hand, task, {"dead_zone": 0.0}, action_mode="joint_position", **keywords)
        self._chains = [RawLeader(), RawLeader()]
        self.device, self._now_s = None, 0.0

    def begin(self, observation):
        self._plan.reset()
        for arm, chain in enumerate(self._chains):
            turns = 2 * math.pi * np.array([1, 0, -1, 0, 2, 0])  # whole turns off, as after power-on
            chain.place(commanded(observation)[arm] + turns, opening=1.0)
        if self.device is None:
            left, right = (chain.path for chain in self._chains)
            self.device = Leader(left=left, right=right, gripper_deg=(200, 100), clock=lambda: self._now_s)
        self.device.read()

    def move(self, observation):
        self._now_s += 0.04
        actions = self._plan(observation).reshape(2, -1).astype(float)
        # It lowers a tool at half speed, turns it first, and stays 2 mm higher: a servo's count moves it that far.
        turning = np.minimum(np.abs(actions[:, 3:6]).max(axis=1), 1.0)
        lowered = 0.7 * np.minimum(actions[:, 2] + 0.06, 0.0)
        actions[:, 2] = np.where(actions[:, 2] < 0, np.maximum(lowered, 0.4 * turning - 0.5), actions[:, 2])
        self._hand.set(**twist(*(actions[:, :6] * FULL_TWIST)))
        here = commanded(observation)
        step = self._eye(observation).reshape(2, -1)[:, :6] - here
        for arm, chain in enumerate(self._chains):
            opening = (actions[arm, 6] + 1) / 2 if actions.shape[1] > 6 else None
            # The arm takes three quarters of the way in each period: the hand goes that much farther.
            chain.place(here[arm] + step[arm] / self._eye._share, opening=opening)

    def close(self):
        if self.device is not None:
            self.device.close()
        for chain in self._chains:
            chain.close()


class PagePerson:
    """Person at the live page, who drags both handles to where the tools are to go, and presses open and close."""

    mode = "tcp_delta"

    def __init__(self, folder, task, **keywords):
        self._plan = policies.load("scripted", f"DualUR10/{task}-v0", action_mode="tcp_delta", **keywords)
        self._eye = operator_of(Hand(**twist(*[0] * 6)), task, action_mode="tcp_delta", **keywords)
        self._page = RawPage(task, **keywords)
        self.device = self._page.device

    def begin(self, observation):
        self._plan.reset()

    def move(self, observation):
        actions = self._plan(observation).reshape(2, -1).astype(float)
        tools = self._eye._tools(commanded(observation))
        # The arm takes three quarters of the way in each period: the hand goes that much farther.
        way = actions[:, :6] * FULL_TWIST * self._eye.timing.period_s / self._eye._share
        turned = quat_multiply(quat_from_rotvec(way[:, 3:]), tools.quat)
        opening = (actions[:, 6] + 1) / 2 if actions.shape[1] > 6 else np.full(2, np.nan)
        self._page.drag(np.concatenate([tools.position_m + way[:, :3], turned], axis=1), [True, True], opening)

    def close(self):
        self._page.close()


PERSONS = {"spacemouse": MousePerson, "leader": LeaderPerson, "page": PagePerson}


def finished(person, env, operator, observation):
    """Return True if a person finishes the episode that begins with an observation."""
    operator.reset()
    over = False
    while not over:
        person.move(observation)
        observation, _, terminated, truncated, info = env.step(operator(observation))
        over = terminated or truncated
    return bool(info["is_success"])


def successes(device, task, seeds, folder, **keywords):
    """Return the number of episodes that a person with a device finishes in simulation."""
    person = PERSONS[device](folder, task, **keywords)
    env = gym.make(f"DualUR10/{task}-v0", action_mode=person.mode, **keywords)
    try:
        count = 0
        for seed in seeds:
            observation, _ = env.reset(seed=seed)
            person.begin(observation)
            operator = operator_of(person.device, task, action_mode=person.mode, **keywords)
            count += finished(person, env, operator, observation)
        return count
    finally:
        person.close()
        env.close()
