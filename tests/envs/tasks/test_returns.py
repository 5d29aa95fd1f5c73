"""Order of returns in the tasks with objects: nothing that stops short of success earns as much as success."""

from __future__ import annotations

from itertools import pairwise

import numpy as np

from dual_ur10 import policies
from dual_ur10.envs.api.vector_env import DualArmVectorEnv
from tests.soak import SOAK

HANDOVER, CARRY = "DualUR10/Handover-v0", "DualUR10/SyncCarry-v0"


def hold(action):
    """Stop all joints; the grippers keep their command."""
    arms = action.reshape(2, -1)
    arms[:, :6] = 0.0
    return action


def release(action):
    """Stop all joints and open the grippers."""
    arms = action.reshape(2, -1)
    arms[:, :6], arms[:, 6] = 0.0, 1.0
    return action


class Row:
    """The scripted policy until a condition on reward terms holds, and from then on something else."""

    def __init__(self, env_id, ends, instead):
        self.policy, self.ends, self.instead = policies.load("scripted", env_id), ends, instead
        self.changed = self.over = False
        self.earned = 0.0

    def __call__(self, observation, seen):
        self.changed = self.changed or self.ends(seen)
        action = self.policy(observation).copy()
        return self.instead(action) if self.changed else action


def returns(env_id, rows, seed=3):
    """Return the return of an episode of each row."""
    env = DualArmVectorEnv(len(rows), env_id, autoreset_mode="Disabled")
    observation, info = env.reset(seed=[seed] * len(rows))
    seen = dict.fromkeys(("stage", "clock_s"), np.full(len(rows), -np.inf))
    while not all(row.over for row in rows):
        shown = [{name: values[k] for name, values in seen.items()} for k in range(len(rows))]
        action = [np.zeros(14) if row.over else row(observation[k], shown[k]) for k, row in enumerate(rows)]
        observation, reward, terminated, truncated, info = env.step(np.array(action, dtype=np.float32))
        seen = {name: info[name] for name in seen if name in info}
        over = terminated | truncated
        for k, row in enumerate(rows):
            if not row.over:
                row.earned += float(reward[k])
                row.over = bool(over[k])
        if over.any() and not all(row.over for row in rows):
            observation, _ = env.reset(options={"reset_mask": over})
    env.close()
    return [row.earned for row in rows]


def never(seen):
    return False


def at_once(seen):
    return True


def test_no_stage_of_a_handover_is_worth_staying_in():
    """The script, then: nothing, random steps, then holding still in each stage, and letting go in each."""
    rng = np.random.default_rng(0)

    def randomly(action):
        return rng.uniform(-1.0, 1.0, 14)

    def stage(k):
        return lambda seen: seen["stage"] >= k

    rows = [Row(HANDOVER, never, hold), Row(HANDOVER, at_once, hold), Row(HANDOVER, at_once, randomly)]
    rows += [Row(HANDOVER, stage(k), instead) for k in range(1, 7) for instead in (hold, release)]
    script, zero, random, *cheats = returns(HANDOVER, rows)
    assert random < zero < min(cheats[:2])
    assert max(cheats) < 0.9 * script
    held = cheats[::2]
    assert all(early <= late for early, late in pairwise(held)), held  # no stage is worth less than the one before


def test_no_part_of_a_carry_is_worth_staying_in():
    """The script, then: nothing, random steps; holding still, and letting go, with the bar gripped or lifted."""
    rng = np.random.default_rng(0)

    def randomly(action):
        return rng.uniform(-1.0, 1.0, 14)

    def clock(s):
        return lambda seen: seen["clock_s"] >= s

    rows = [Row(CARRY, never, hold), Row(CARRY, at_once, hold), Row(CARRY, at_once, randomly)]
    instants = (-0.5, 8.0, 20.0) if SOAK else (-0.5, 20.0)
    rows += [Row(CARRY, clock(s), instead) for s in instants for instead in (hold, release)]
    script, zero, random, *cheats = returns(CARRY, rows)
    assert random < zero < min(cheats)
    assert max(cheats) < 0.9 * script
