"""Measure the speed of the environments against the bare physics in them.

Efficiency is the time of MuJoCo's `Batch.rollout` on the same model, states, controls and number of steps, divided by
the time of the environment's step. Both are measured alternately in one run: block by block the environment repeats an
episode whose actions are already known, so that nothing else runs in between, and records its controls; then the same
rollouts are repeated bare from the same states. The result is the median over the blocks. Absolute figures hold for
this machine and its printed load; only the ratio carries over to others. Scripted blocks begin where the object is held
and lifted, because contacts dominate the cost of physics; random ones begin with the episode.

The extra time per step of PettingZoo's parallel view is measured, too: see interfaces.py.

    python benchmarks/throughput.py --json throughput.json
"""

from __future__ import annotations

import os

for _name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"):
    os.environ.setdefault(_name, "1")  # the batch has its own threads; small matrices gain nothing from more

import argparse
import json
import statistics
import time
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
from interfaces import measure_views

import dual_ur10
from dual_ur10 import policies

PERIOD_S = 0.04
HELD_AFTER = {"SyncCarry": 140, "Handover": 60}
"""Steps of the scripted policy after which the object is held and moves."""

VIEW_GOAL_US = 10.0


class Recorder:
    """Recorder of states and controls of every rollout, between an environment's cell and its batch."""

    def __init__(self, env: Any) -> None:
        self.cell = env.unwrapped.core.cell
        self._control = self.cell._physics._control
        self.cell._physics._control = self
        self.recorded: list[tuple[np.ndarray, np.ndarray]] = []

    def __call__(self, *command: Any) -> np.ndarray:
        """Record and return the controls of a command."""
        control = self._control(*command)
        self.recorded.append((self.cell._physics._batch.state.copy(), control.copy()))
        return control

    def replay(self) -> float:
        """Return the time of the recorded rollouts alone."""
        batch, total = self.cell._physics._batch, 0.0
        now = batch.state.copy()
        for state, control in self.recorded:
            batch.state[:] = state
            begin = time.perf_counter()
            batch.rollout(control.shape[1], control, record=())
            total += time.perf_counter() - begin
        batch.state[:] = now
        self.recorded.clear()
        return total


def step_on(env: Any, action: np.ndarray, n: int) -> np.ndarray:
    """Return the observation after a step, or of the next episode, which a batch begins by itself."""
    observation, _, terminated, truncated, _ = env.step(action)
    if n == 1 and (terminated or truncated):
        observation, _ = env.reset()
    return observation


def measure(
    env_id: str, n: int, actions: str, blocks: int, steps: int, threads: int, begin_after: int = 0
) -> dict[str, float]:
    """Return efficiency and rates of one environment, or of n in a batch.

    Args:
        env_id: Id of the environment.
        n: Number of cells.
        actions: "scripted" or "random".
        blocks: Number of blocks, of which the median counts.
        steps: Steps of each block.
        threads: Threads of the batch.
        begin_after: Scripted steps before those of the block.
    """
    if n == 1:
        env: Any = gym.make(env_id)
    else:
        env = gym.make_vec(env_id, num_envs=n, threads=threads)
    policy = policies.load("scripted", env_id)
    rng = np.random.default_rng(0)
    recorder = Recorder(env)
    efficiency, duration = [], []
    for block in range(blocks):
        observation, _ = env.reset(seed=block)
        policy.reset()
        known = []
        for step in range(begin_after + steps):
            if actions == "scripted" or step < begin_after:
                known.append(policy(observation).astype(np.float32))
            else:
                known.append(rng.uniform(-1, 1, env.action_space.shape).astype(np.float32))
            observation = step_on(env, known[-1], n)
        env.reset(seed=block)
        for action in known[:begin_after]:
            env.step(action)
        recorder.recorded.clear()
        begin = time.perf_counter()
        for action in known[begin_after:]:
            step_on(env, action, n)
        env_time = time.perf_counter() - begin
        bare = recorder.replay()
        efficiency.append(bare / env_time)
        duration.append(env_time / steps)
    env.close()
    step_s = statistics.median(duration)
    ratio = statistics.median(efficiency)
    return {
        "efficiency": round(ratio, 3),
        "env_steps_per_s": round(n / step_s, 1),
        "sim_s_per_s": round(n * PERIOD_S / step_s, 1),
        "overhead_us": round(step_s * (1 - ratio) * 1e6 / n, 1),
    }


def measure_task(env_id: str, arguments: argparse.Namespace) -> dict[str, Any]:
    """Measure all rows of one task, and print each when it is done."""
    figures: dict[str, Any] = {}
    task = env_id.split("/")[1].rsplit("-v", 1)[0]
    held = HELD_AFTER.get(task, 0)
    for key, n, steps in (("single", 1, 200), (f"vector{arguments.envs}", arguments.envs, 25)):
        # A batch of cells with contacts needs long until the object is held.
        blocks = arguments.blocks if n == 1 or not held else max(1, arguments.blocks // 5)
        for actions in ("scripted", "random"):
            begin_after = held if actions == "scripted" else 0
            result: dict[str, Any] = measure(env_id, n, actions, blocks, steps, arguments.threads, begin_after)
            row = f"{f'{task}, {key}, {actions}':34}{result['efficiency']:12.3f}{result['env_steps_per_s']:14.0f}"
            print(f"{row}{result['sim_s_per_s']:10.1f}{result['overhead_us']:19.1f}", flush=True)
            if n > 1:
                result["threads"] = arguments.threads
            if actions == "scripted":
                figures[key] = result
            else:
                figures[key]["random"] = result
    views = measure_views(env_id, arguments.rounds, 100)
    figures["parallel_extra_us"] = {name: views[f"parallel, {name}"] for name in ("shared", "individual")}
    extra = ", ".join(f"{value:.1f} µs with {name} rewards" for name, value in figures["parallel_extra_us"].items())
    print(
        f"{task}, PettingZoo's parallel view, beyond gym.make per step: {extra} (goal {VIEW_GOAL_US:g} µs)", flush=True
    )
    return figures


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--json", type=Path, help="write the figures to this file")
    parser.add_argument("--blocks", type=int, default=15)
    parser.add_argument("--envs", type=int, default=64)
    parser.add_argument("--rounds", type=int, default=30, help="rounds of blocks for PettingZoo's view")
    parser.add_argument("--threads", type=int, default=min(2, os.cpu_count() or 1))
    parser.add_argument("--task", action="append", help="one of the tasks, such as SyncCarry; may be repeated")
    arguments = parser.parse_args()
    load = os.getloadavg()[0]
    print(
        f"{arguments.envs} envs on {arguments.threads} threads, 25 Hz; load {load:.2f} on {os.cpu_count()} processors"
    )
    print(f"{'case':34}{'efficiency':>12}{'env-steps/s':>14}{'sim s/s':>10}{'overhead µs/step':>19}")
    figures: dict[str, Any] = {"load": load}
    for env_id in dual_ur10.ENV_IDS:
        task = env_id.split("/")[1].rsplit("-v", 1)[0]
        if not arguments.task or task in arguments.task:
            figures[task] = measure_task(env_id, arguments)
    # The figures of SineTracking stand at the top level, too.
    figures = {**figures.get("SineTracking", {}), **figures}
    if arguments.json:
        arguments.json.write_text(json.dumps(figures, indent=2) + "\n")


if __name__ == "__main__":
    main()
