"""Synthetic persons: they act through devices alone, by the reports that those send."""

import math
from contextlib import suppress

import gymnasium as gym
import numpy as np

from dual_ur10 import policies
from dual_ur10.errors import CellFaulted
from dual_ur10.policies.evaluation.rollout import act
from dual_ur10.policies.operators.device import FULL_TWIST
from dual_ur10.policies.operators.leader import Leader
from dual_ur10.policies.operators.spacemouse import SpaceMouse
from dual_ur10.testing import VirtualCell
from tests.policies.operators.hands import Hand, commanded, operator_of, twist
from tests.policies.operators.rigs import RawLeader, RawMouse, RawPage
from ur_core.kinematics.rotations import quat_from_rotvec, quat_multiply

LEAST = 0.004  # of full speed: smaller steps are no deflection of the cap


class MousePerson:
    """Person with a SpaceMouse in each hand, who moves tools to their goals and presses buttons for the grippers."""

    mode = "tcp_delta"

    def __init__(self, folder, task, **keywords):
        self._plan = policies.load("scripted", f"DualUR10/{task}-v0", action_mode="tcp_delta", **keywords)
        self._mice = [RawMouse(folder, "left"), RawMouse(folder, "right", new=True)]
        self._now_s = 0.0
        paths = [mouse.path for mouse in self._mice]
        self.device = SpaceMouse(left=paths[0], right=paths[1], clock=lambda: self._now_s)
        self.dead_zone = 0.08

    def begin(self, observation):
        self._plan.reset()
        self._open = np.ones(2, dtype=bool)

    def move(self, observation):
        self._now_s += 0.04
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
        # Tools that hold one object stay together.
        together = actions.shape[1] > 6 and (actions[:, 6] < 0).all()
        turning = np.minimum(np.abs(actions[:, 3:6]).max(axis=1), 1.0)
        lowered = 0.7 * np.minimum(actions[:, 2] + 0.06, 0.0)
        actions[:, 2] = np.where(
            together | (actions[:, 2] >= 0), actions[:, 2], np.maximum(lowered, 0.4 * turning - 0.5)
        )
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
        self.wanted, fast = actions, np.abs(actions[:, :3]).max(axis=1) > 0.5
        self._drag(tools.position_m + way[:, :3], turned, fast, opening)

    def _drag(self, positions_m, quat, fast, opening, holds=(True, True)):
        self._page.drag(np.concatenate([positions_m, quat], axis=1), holds, opening)

    def watch(self, action):
        """See the motion of a step."""

    def press(self, *buttons):
        self._page.press(*buttons)

    def close(self):
        self._page.close()


class ShakyPerson(PagePerson):
    """Person at the page whose hands tremble, who pauses, and who takes detours on the way.

    Tremor has 0.4 mm and 0.2° RMS, with a drift of 2 mm. About every 4 s the person lets go of both handles for 0.2 to
    1.2 s, or drags a tool that moves fast aside, by up to 4 cm within 0.6 s.
    """

    def __init__(self, folder, task, seed=0, **keywords):
        super().__init__(folder, task, **keywords)
        self._rng = np.random.default_rng(seed)

    def begin(self, observation):
        super().begin(observation)
        self._drift, self._pause, self._aside, self._left = np.zeros((2, 3)), 0, np.zeros((2, 3)), 0

    def move(self, observation):
        if self._rng.random() < 0.01:
            self._pause = int(self._rng.integers(5, 31))
        if self._rng.random() < 0.01:
            self._aside, self._left = self._rng.uniform(-0.04, 0.04, (2, 3)) / 15, 15
        self._pause, self._left = self._pause - 1, self._left - 1
        self._drift += 0.2 * (0.002 * self._rng.standard_normal((2, 3)) - self._drift)
        super().move(observation)

    def _drag(self, positions_m, quat, fast, opening):
        shake_m, turn = 0.0004 * self._rng.standard_normal((2, 3)), 0.0035 * self._rng.standard_normal((2, 3))
        aside = self._aside * fast[:, None] if self._left > 0 else 0.0
        holds = [self._pause <= 0] * 2
        quat = quat_multiply(quat_from_rotvec(turn), quat)
        super()._drag(positions_m + shake_m + 0.2 * self._drift + aside, quat, fast, opening, holds)


class Corrector(PagePerson):
    """Person at the page who watches a policy, takes both arms where it goes wrong, and hands them back.

    Attributes:
        corrections: Number of takeovers so far.
    """

    patience, led = 8, 40  # steps of wrong motion before the person takes over, and of the person

    def begin(self, observation):
        super().begin(observation)
        self._wrong, self._leads, self.corrections = 0.0, 0, getattr(self, "corrections", 0)

    def watch(self, action):
        """See the motion of a step."""
        wanted = self.wanted.reshape(2, -1)
        off = np.abs(np.clip(np.asarray(action, dtype=float).reshape(2, -1), -1, 1) - wanted)
        off[:, 6:] /= 2  # an opening is 0 to 1
        self._wrong = self._wrong + 1 if off.max() > 0.3 else max(0.0, self._wrong - 2)
        if self._leads:
            self._leads -= 1
            if not self._leads:
                self._page.press("hand_back")
                self._wrong = 0.0
        elif self._wrong > self.patience:
            self._page.press("take_both")
            self._leads, self.corrections = self.led, self.corrections + 1


class Watched(gym.Wrapper):
    """Environment that a person sees, who begins every episode at once."""

    def __init__(self, env, person):
        super().__init__(env)
        self.person = person
        person.press("record")

    def reset(self, **keywords):
        observation, info = self.env.reset(**keywords)
        self.person.begin(observation)
        self.person.move(observation)
        return observation, info

    def step(self, action):
        self.person.watch(action)
        observation, reward, terminated, truncated, info = self.env.step(action)
        if terminated or truncated:
            self.person.press("record")
        else:
            self.person.move(observation)
        return observation, reward, terminated, truncated, info


PERSONS = {"spacemouse": MousePerson, "leader": LeaderPerson, "page": PagePerson}


def finished(person, env, seed, **keywords):
    """Return True if a person finishes the episode of a seed."""
    observation, _ = env.reset(seed=seed)
    person.begin(observation)
    operator = operator_of(person.device, env.spec.id, action_mode=person.mode, **keywords)
    over = False
    while not over:
        person.move(observation)
        observation, _, terminated, truncated, info = env.step(act(operator, observation, env, np.float32))
        over = terminated or truncated
    return bool(info["is_success"])


def successes(device, task, seeds, folder, **keywords):
    """Return the number of episodes that a person with a device finishes in simulation."""
    person = PERSONS[device](folder, task, **keywords)
    env = gym.make(f"DualUR10/{task}-v0", action_mode=person.mode, **keywords)
    try:
        return sum(finished(person, env, seed, **keywords) for seed in seeds)
    finally:
        person.close()
        env.close()


def successes_on_controllers(device, task, seeds, folder, **options):
    """Return the number of episodes that a person finishes, each on new emulated controllers in virtual time."""
    count = 0
    for seed in seeds:
        own = folder / str(seed)
        own.mkdir()
        with VirtualCell(task=f"DualUR10/{task}-v0", seed=seed, **options) as cell:
            person = PERSONS[device](own, task, cell=cell)
            env = cell.make(f"DualUR10/{task}-v0", disable_env_checker=True, action_mode=person.mode)
            try:
                with suppress(CellFaulted):  # the cell says why
                    count += finished(person, env, seed, cell=cell)
            finally:
                person.close()
                env.close()
    return count
