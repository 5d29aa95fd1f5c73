"""Takeovers on a virtual cell: limits, path and delay at any instant, by the controllers' clock."""

import itertools

import numpy as np

import dual_ur10  # noqa: F401  # registers the environments
from dual_ur10.policies.evaluation.rollout import act
from dual_ur10.policies.operators.takeover import HAND_BACK_S, Takeover
from dual_ur10.sim2real.runtime.runner import least_latency_ticks
from dual_ur10.testing import VirtualCell
from tests.policies.operators.hands import Hand, operator_of, twist
from ur_core.kinematics import flange_pose
from ur_core.kinematics.robot_model import TICK_S
from ur_emulator.controller.controller import Controller

RATE_HZ = 125.0
KEYWORDS = {
    "action_mode": "joint_delta",
    "policy_rate_hz": RATE_HZ,
    "action_latency_ticks": least_latency_ticks(TICK_S["e-series"]),
    "duration_s": 3600.0,
}
SPEED = 0.1  # of the limit, for the policy
HAND = 0.1  # m/s and rad/s along and about each axis
MOVED_RAD = 1e-5
MOST_MM, MOST_S = 1.0, 0.05
AROUND = 60  # steps, within which the arms come to where they were commanded: 15, at a quarter of the pace 60
REST_STEPS = round((HAND_BACK_S + 0.3) * RATE_HZ)  # after each of them, until it moves steadily again


class Swing:
    """Policy that moves a joint of both arms at one speed, and turns 0.1 rad from where it began."""

    def __init__(self):
        self.reset()

    def reset(self):
        self.origin, self.sign, self.speed = None, np.ones(2), np.zeros(2)

    def __call__(self, observation):
        commanded = np.asarray(observation).reshape(2, -1)[:, 12:18]
        self.origin = commanded[:, 0].copy() if self.origin is None else self.origin
        away = commanded[:, 0] - self.origin
        self.sign = np.where(np.abs(away) > 0.1, -np.sign(away), self.sign)
        self.speed += np.clip(SPEED * self.sign - self.speed, -SPEED / 30, SPEED / 30)
        step = np.zeros((2, 6))
        step[:, 0] = self.speed
        return step.reshape(-1)


class Shared:
    """Virtual cell on which a person and a policy take turns.

    Attributes:
        seen: Time, arm and joint positions of every tick of both controllers.
        commanded: Time and commanded joint positions, (2, 6), after each step.
        targets: (ticks, 2, 6) targets of each step.
    """

    def __init__(self, monkeypatch):
        self.seen, self.commanded, self.targets = ([], []), [], []
        shared, tick = self, Controller.tick

        def noted(controller, reading):
            for arm, each in enumerate(shared.controllers):
                if each is controller:
                    shared.seen[arm].append((shared.cell.now_s, np.array(reading.q_rad)))
            return tick(controller, reading)

        self.controllers = []
        monkeypatch.setattr(Controller, "tick", noted)
        self.cell = VirtualCell(task="SineTracking", plant="nominal", family="e-series")
        self.controllers = [self.cell.emulators[arm].servers[arm].controller for arm in range(2)]
        self.env = self.cell.make("DualUR10/SineTracking-v0", disable_env_checker=True, **KEYWORDS)
        self.hand = Hand(**twist(*[0] * 6))
        operator = operator_of(self.hand, "SineTracking", cell=self.cell, **KEYWORDS)
        self.takeover = Takeover(Swing(), operator)
        self.observation, _ = self.env.reset(seed=0)
        self.takeover.reset()
        self.core = self.env.unwrapped.core

    def steps(self, count, button=None):
        for k in range(count):
            self.hand.set(**twist(*self.rows, buttons=frozenset({button} if button and not k else ())))
            self.observation, *_ = self.env.step(act(self.takeover, self.observation, self.env, np.float32))
            self.commanded.append((self.cell.now_s, self.observation.reshape(2, -1)[:, 12:18].copy()))
            self.targets.append(self.core.pipeline.adapter.targets_rad[0])

    def close(self):
        self.env.close()
        self.cell.close()


def effect_s(seen, pressed_s):
    """Return the time from a button to the first motion of an arm that does not continue the one before."""
    times, q_rad = (np.array(each) for each in zip(*seen, strict=True))
    here = int(np.searchsorted(times, pressed_s))
    last, first = here - 1, here - 20
    speed = (q_rad[last] - q_rad[first]) / (times[last] - times[first])
    away = np.abs(q_rad - q_rad[last] - speed * (times - times[last])[:, None]).max(axis=1)
    if away[first:here].max() > MOVED_RAD / 10:
        return np.nan  # it was not steady
    return times[here + int((away[here:] > MOVED_RAD).argmax())] - pressed_s


def off_path_m(shared, arm):
    """Return the largest distance of the measured flange from the line through the commanded ones around its time."""
    dh = shared.takeover.operator._dh[arm]
    line = flange_pose(np.array([each[arm] for _, each in shared.commanded]), dh)[0]
    times = np.array([at for at, _ in shared.commanded])
    points = flange_pose(np.array([q for _, q in shared.seen[arm]]), dh)[0]
    here = np.searchsorted(times, [at for at, _ in shared.seen[arm]])
    least = np.full(len(points), np.inf)
    for k in range(-AROUND, 2):
        begin = np.clip(here + k, 0, len(line) - 2)
        along = line[begin + 1] - line[begin]
        share = ((points - line[begin]) * along).sum(1) / np.maximum((along**2).sum(1), 1e-18)
        off = line[begin] + np.clip(share, 0.0, 1.0)[:, None] * along - points
        least = np.minimum(least, np.linalg.norm(off, axis=1))
    return least.max()


def takeovers(monkeypatch, count, seed=0):
    """Take over and hand back at random instants.

    Returns:
        Of `count` of them, the number above a cap, the largest distance from the path (mm), the delays (ms) of those
        arms that moved steadily before, and the number of late actions.
    """
    rng, shared = np.random.default_rng(seed), Shared(monkeypatch)
    limits, tick_s = shared.core.pipeline.adapter.limits, shared.core.config.servoj.tick_s
    shared.rows = np.zeros((2, 6))
    shared.steps(REST_STEPS)
    above, off_m, waits, before = 0, 0.0, [], np.zeros((0, 12))
    buttons = itertools.cycle(["take", "hand_back"])
    for _ in range(count):
        shared.seen[0].clear(), shared.seen[1].clear(), shared.targets.clear()
        del shared.commanded[:-AROUND]
        shared.rows = rng.uniform(-HAND, HAND, (2, 6)) * rng.integers(0, 2) if next(buttons) == "take" else shared.rows
        shared.steps(int(rng.integers(8, 40)))
        taken = shared.takeover.commander.any()
        if not taken:
            shared.rows = rng.uniform(-HAND, HAND, (2, 6))
        button = "hand_back" if taken else str(rng.choice(["take_left", "take_right", "take_both"]))
        moves = shared.takeover.commander.copy()
        read_s = shared.cell.now_s
        shared.steps(1, button)
        moves ^= shared.takeover.commander
        shared.steps(int(rng.integers(30, REST_STEPS)))
        for arm in np.flatnonzero(moves):
            waits.append(effect_s(shared.seen[arm], read_s) + rng.uniform(0.0, 1.0 / RATE_HZ))
        off_m = max(off_m, *(off_path_m(shared, arm) for arm in range(2)))
        path = np.concatenate([before, np.concatenate(shared.targets).reshape(-1, 12)])
        before = path[-4:]
        caps = (limits.speed_rad_s * 2, limits.acceleration_rad_s2, limits.jerk_rad_s3)
        reached = [np.abs(np.diff(path, k + 1, axis=0)) / tick_s ** (k + 1) for k in range(3)]
        above += any((each > np.array(cap) * (1 + 1e-6)).any() for each, cap in zip(reached, caps, strict=True))
    shared.close()
    return above, 1e3 * off_m, [1e3 * each for each in waits if np.isfinite(each)], shared.core.late_actions


def test_takeovers_keep_limits_and_path_and_act_at_once(monkeypatch):
    above, off_mm, delays_ms, late = takeovers(monkeypatch, 3)
    assert above == late == 0
    assert off_mm < MOST_MM
    assert len(delays_ms) >= 2
    assert 18 < max(delays_ms) < 1e3 * MOST_S  # the queue alone takes 18 ms
