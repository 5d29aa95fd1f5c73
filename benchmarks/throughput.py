"""Speed of the environments against the bare physics they contain.

Efficiency is the time of MuJoCo's `Batch.rollout` on the same model, states, controls and number of steps, divided by
the time of the environment's step. Both are taken alternately in one run: block by block the environment repeats an
episode whose actions are already known, so that nothing else runs in between, and records the controls it applies; then
the same rollouts are repeated bare from the same states. The median over the blocks is quoted. Absolute figures are of
the machine that the load is printed of; the ratio is what travels.

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

import dual_ur10
from dual_ur10 import policies

ENV_ID = dual_ur10.ENV_IDS[0]
PERIOD_S = 0.04


class Recorder:
    """Stands between an environment's cell and its batch: notes states and controls of every rollout."""

    def __init__(self, env: Any) -> None:
        self.cell = env.unwrapped.core.cell
        self._feedforward = self.cell._feedforward
        self.cell._feedforward = self
        self.recorded: list[tuple[np.ndarray, np.ndarray]] = []

    def __call__(self, *motion: np.ndarray) -> np.ndarray:
        """The feed-forward, noted on the way."""
        control = self._feedforward(*motion)
        self.recorded.append((self.cell._batch.state.copy(), control.copy()))
        return control

    def replay(self) -> float:
        """Time of the recorded rollouts without anything around them."""
        batch, total = self.cell._batch, 0.0
        now = batch.state.copy()
        for state, control in self.recorded:
            batch.state[:] = state
            begin = time.perf_counter()
            batch.rollout(control.shape[1], control, record=())
            total += time.perf_counter() - begin
        batch.state[:] = now
        self.recorded.clear()
        return total


def measure(n: int, actions: str, blocks: int, steps: int, threads: int) -> dict[str, float]:
    """Efficiency and rates of one environment, or of n of them in a batch."""
    if n == 1:
        env: Any = gym.make(ENV_ID)
    else:
        env = gym.make_vec(ENV_ID, num_envs=n, threads=threads)
    policy = policies.load("scripted", ENV_ID)
    rng = np.random.default_rng(0)
    recorder = Recorder(env)
    efficiency, duration = [], []
    for block in range(blocks):
        observation, _ = env.reset(seed=block)
        policy.reset()
        known = []
        for _ in range(steps):
            if actions == "scripted":
                known.append(policy(observation).astype(np.float32))
            else:
                known.append(rng.uniform(-1, 1, env.action_space.shape).astype(np.float32))
            observation = env.step(known[-1])[0]
        env.reset(seed=block)
        recorder.recorded.clear()
        begin = time.perf_counter()
        for action in known:
            _, _, terminated, truncated, _ = env.step(action)
            if n == 1 and (terminated or truncated):
                env.reset()
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


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--json", type=Path, help="write the figures to this file")
    parser.add_argument("--blocks", type=int, default=15)
    parser.add_argument("--envs", type=int, default=64)
    parser.add_argument("--threads", type=int, default=min(2, os.cpu_count() or 1))
    arguments = parser.parse_args()
    print(f"{ENV_ID} at 25 Hz, load {os.getloadavg()[0]:.2f} on {os.cpu_count()} processors")
    print(f"{'case':24}{'efficiency':>12}{'env-steps/s':>14}{'sim s/s':>10}{'overhead µs/step':>19}")
    figures: dict[str, Any] = {"load": os.getloadavg()[0]}
    for key, n, steps in (("single", 1, 200), (f"vector{arguments.envs}", arguments.envs, 25)):
        for actions in ("scripted", "random"):
            result: dict[str, Any] = measure(n, actions, arguments.blocks, steps, arguments.threads)
            row = f"{key + ', ' + actions:24}{result['efficiency']:12.3f}{result['env_steps_per_s']:14.0f}"
            print(f"{row}{result['sim_s_per_s']:10.1f}{result['overhead_us']:19.1f}")
            if n > 1:
                result["threads"] = arguments.threads
            if actions == "scripted":
                figures[key] = result
            else:
                figures[key]["random"] = result
    if arguments.json:
        arguments.json.write_text(json.dumps(figures, indent=2) + "\n")


if __name__ == "__main__":
    main()
