"""Measure exploration: refused and led motion with random actions, and what leading costs in time.

Each policy acts on a batch, once with `at_limits="refuse"` and once with "lead", in turn within one run: uniform
actions, normal ones with a standard deviation of 0.3, and "towards", one corner of the action space for two seconds at
a time. A refusal is a step that the gate refuses after one that it released. Led are steps whose motion was led. The
time ratio is that of processor time per step, refuse to lead: above 1 leading is faster.

With `--too-low`, the follower of Handover's goals is sent below its goals by so many mm, and the way down to the table
is counted alike, with episodes that end at a refusal, as on two controllers.

    python benchmarks/exploration.py --json exploration.json
    python benchmarks/exploration.py --task SyncCarry --action-mode tcp_delta
    python benchmarks/exploration.py --too-low 5 10 20
"""

from __future__ import annotations

import os

for _name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"):
    os.environ.setdefault(_name, "1")

import argparse
import json
import statistics
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from dual_ur10 import policies
from dual_ur10.envs.core.core import Core
from dual_ur10.sim2real.control.adapter import TCP_STEP_M_S

TASKS = ("SineTracking", "SyncCarry", "Handover")
MODES = ("joint_delta", "tcp_delta")
REACTIONS = ("refuse", "lead")
TOWARDS_STEPS = 50
NORMAL = 0.3
RATIO = 0.3
"""Part of what is left to its goal that the follower moves in a step."""

Policy = Callable[[np.random.Generator, int, tuple[int, int]], np.ndarray]


def uniform(rng: np.random.Generator, step: int, shape: tuple[int, int]) -> np.ndarray:
    """Return uniform actions."""
    return rng.uniform(-1.0, 1.0, shape)


def normal(rng: np.random.Generator, step: int, shape: tuple[int, int]) -> np.ndarray:
    """Return normal actions."""
    return rng.normal(0.0, NORMAL, shape)


def towards(rng: np.random.Generator, step: int, shape: tuple[int, int]) -> np.ndarray:
    """Return a corner of the action space, another one every two seconds."""
    return np.sign(np.random.default_rng(step // TOWARDS_STEPS).uniform(-1.0, 1.0, shape))


POLICIES: dict[str, Policy] = {"uniform": uniform, "normal": normal, "towards": towards}


class Side:
    """A batch with one reaction, its policy's generator, and what was counted."""

    def __init__(self, task: str, reaction: str, mode: str, n: int) -> None:
        self.core = Core(task, {"at_limits": reaction, "action_mode": mode}, n=n, threads=1, autoreset=True)
        self.core.reset([np.random.default_rng(row) for row in range(n)])
        self.rng, self.step, self.n = np.random.default_rng(0), 0, n
        self.refusals = self.led = 0
        self._refused: set[int] = set()

    def run(self, policy: Policy, steps: int) -> float:
        """Take steps and return the processor time that they took."""
        core, begin = self.core, time.process_time()
        for _ in range(steps):
            done = core.step(policy(self.rng, self.step, (self.n, core.action_space.shape[0])))
            refused = set(done.verdicts)
            self.refusals += len(refused - self._refused)
            self.led += int(np.count_nonzero(done.info["led"]))
            self.step += 1
            over = np.flatnonzero(done.terminated | done.truncated)
            self._refused = refused - set(over.tolist())
            if over.size:
                core.reset([np.random.default_rng((self.step, row)) for row in over.tolist()], over)
        return time.process_time() - begin


def explore(task: str, mode: str, policy: Policy, n: int, blocks: int, steps: int) -> dict[str, float]:
    """Return refusals in 1,000 steps with both reactions, the share of led steps, and the ratio of times."""
    sides = [Side(task, reaction, mode, n) for reaction in REACTIONS]
    times = [[side.run(policy, steps) for side in sides] for _ in range(blocks)]
    refuse, lead = sides
    count = n * blocks * steps
    for side in sides:
        side.core.close()
    return {
        "refusals_per_1000_refuse": round(1000.0 * refuse.refusals / count, 2),
        "refusals_per_1000_lead": round(1000.0 * lead.refusals / count, 3),
        "led_share": round(lead.led / count, 4),
        "time_ratio": round(statistics.median(a / b for a, b in times), 3),
        "steps": count,
    }


def too_low(low_mm: float, reaction: str, n: int) -> dict[str, Any]:
    """Return how episodes of Handover end whose tools are sent below their goals, within the first 8 s."""
    keywords = {"action_mode": "tcp_delta", "at_limits": reaction, "on_refusal": "terminate"}
    core = Core("Handover", keywords, n=n, threads=1)
    follower = policies.load("scripted", "DualUR10/Handover-v0", action_mode="tcp_delta")
    observation, _ = core.reset([np.random.default_rng(row) for row in range(n)])
    refused, led, over = 0, np.zeros(n, dtype=bool), np.zeros(n, dtype=bool)
    lower = -RATIO * low_mm * 1e-3 / (TCP_STEP_M_S * core.timing.period_s)
    for _ in range(200):
        action = follower(observation).reshape(n, 2, 7)
        action[..., 2] = np.clip(action[..., 2] + lower, -1.0, 1.0)
        done = core.step(action.reshape(n, -1))
        observation = done.observation
        refused += sum(not over[row] for row in done.verdicts)
        led |= done.info["led"] & ~over
        over |= done.terminated | done.truncated
        if over.all():
            break
        if done.terminated.any():
            rows = np.flatnonzero(done.terminated | done.truncated)
            core.reset([np.random.default_rng(row) for row in rows.tolist()], rows)
    core.close()
    return {"refused": refused, "led": int(np.count_nonzero(led)), "episodes": n}


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--json", type=Path, help="write the figures to this file")
    parser.add_argument("--task", action="append", choices=TASKS, help="one of the tasks; may be repeated")
    parser.add_argument("--action-mode", action="append", choices=MODES, help="one of the modes; may be repeated")
    parser.add_argument("--envs", type=int, default=16)
    parser.add_argument("--blocks", type=int, default=10)
    parser.add_argument("--steps", type=int, default=50, help="steps of each block")
    parser.add_argument("--too-low", type=float, nargs="+", default=[], help="measure these disturbed scripts instead")
    arguments = parser.parse_args()
    figures: dict[str, Any] = {}
    for low_mm in arguments.too_low:
        for reaction in REACTIONS:
            found = figures.setdefault(f"{low_mm:g} mm too low", {})[reaction] = too_low(
                low_mm, reaction, arguments.envs
            )
            print(f"Handover, {low_mm:g} mm too low, {reaction}: {found}", flush=True)
    for task in () if arguments.too_low else arguments.task or TASKS:
        for mode in arguments.action_mode or MODES:
            for name, policy in POLICIES.items():
                found = explore(task, mode, policy, arguments.envs, arguments.blocks, arguments.steps)
                figures.setdefault(task, {}).setdefault(mode, {})[name] = found
                print(f"{task}, {mode}, {name}: {found}", flush=True)
    if arguments.json:
        arguments.json.write_text(json.dumps(figures, indent=1) + "\n")


if __name__ == "__main__":
    main()
