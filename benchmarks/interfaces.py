"""Measure the cost per step of each interface beyond the Gymnasium environment behind it.

Every environment replays the same actions from the same seed. Blocks of steps alternate, in an order that changes, so
that other work of the machine affects all alike, and their processor time is measured. The result is the median over
the rounds of the difference to the Gymnasium environment's block in the same round. For the rows of one policy
(TwoAgentVecEnv, only with Stable-Baselines3) it is the difference to the vector environment with as many cells on one
thread, per cell and step.

    python benchmarks/interfaces.py --json interfaces.json
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

import gymnasium as gym
import numpy as np

import dual_ur10
from dual_ur10.envs import aec_env, dm_env, parallel_env
from dual_ur10.errors import MissingExtraError

Block = Callable[[], float]


def timed(reset: Callable[[], Any], step: Callable[[Any], Any], actions: list[Any]) -> Block:
    """Return a block: it runs the first steps of an episode and returns their processor time in s."""

    def block() -> float:
        reset()
        begin = time.process_time()
        for action in actions:
            step(action)
        return time.process_time() - begin

    return block


def aec_step(env: Any) -> Callable[[Any], None]:
    """Return a function that steps both agents of an AEC environment."""

    def step(actions: dict[str, np.ndarray]) -> None:
        for agent in env.agents:
            env.last()
            env.step(actions[agent])

    return step


def extra(blocks: dict[str, Block], base: str, rounds: int, steps: int) -> dict[str, float]:
    """Return the median time of a step of the base, and the extra time of the others, in µs."""
    names, taken = list(blocks), {name: [] for name in blocks}
    for block in blocks.values():
        block()
    for k in range(rounds):
        for name in names[k % len(names) :] + names[: k % len(names)]:
            taken[name].append(blocks[name]() / steps * 1e6)
    result = {base: statistics.median(taken[base])}
    for name in names:
        if name != base:
            result[name] = statistics.median(a - b for a, b in zip(taken[name], taken[base], strict=True))
    return {name: round(value, 2) for name, value in result.items()}


def measure_views(env_id: str, rounds: int, steps: int) -> dict[str, float]:
    """Return the time of a step of the Gymnasium environment, and the extra time of each view on one cell, in µs."""
    single = gym.make(env_id, disable_env_checker=True).unwrapped
    shape = single.action_space.shape
    joint = list((np.random.default_rng(0).uniform(-0.02, 0.02, (steps, *shape))).astype(np.float32))
    by_agent = [dict(zip(("left", "right"), action.reshape(2, -1), strict=True)) for action in joint]
    blocks = {"gymnasium": timed(lambda: single.reset(seed=0), single.step, joint)}
    for reward in ("shared", "individual"):
        env = parallel_env(env_id, reward=reward)
        blocks[f"parallel, {reward}"] = timed(lambda env=env: env.reset(seed=0), env.step, by_agent)
    aec = aec_env(env_id)
    blocks["aec"] = timed(lambda: aec.reset(seed=0), aec_step(aec), by_agent)
    deepmind = dm_env(env_id)
    blocks["dm_env"] = timed(deepmind.reset, deepmind.step, joint)
    return extra(blocks, "gymnasium", rounds, steps)


def measure_rows(env_id: str, cells: int, rounds: int, steps: int) -> dict[str, float]:
    """Return the time of a step of the vector environment, and the extra time of its SB3 rows, in µs per cell."""
    try:
        from dual_ur10.envs.api.sb3_bridge import TwoAgentVecEnv
    except MissingExtraError:
        return {}
    many = gym.make_vec(env_id, num_envs=cells, autoreset_mode="Disabled", threads=1)
    shape = many.single_action_space.shape
    joint = list(np.random.default_rng(0).uniform(-0.02, 0.02, (steps, cells, *shape)).astype(np.float32))
    blocks = {"vector": timed(lambda: many.reset(seed=0), many.step, joint)}
    for reward in ("shared", "individual"):
        env = TwoAgentVecEnv(env_id, cells, reward=reward, threads=1)

        def begin(env: Any = env) -> None:
            env.seed(0)
            env.reset()

        blocks[f"rows, {reward}"] = timed(begin, env.step, [action.reshape(2 * cells, -1) for action in joint])
    return {name: round(value / cells, 2) for name, value in extra(blocks, "vector", rounds, steps).items()}


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--json", type=Path, help="write the figures to this file")
    parser.add_argument("--rounds", type=int, default=60)
    parser.add_argument("--steps", type=int, default=100)
    parser.add_argument("--cells", type=int, default=64)
    arguments = parser.parse_args()
    load = os.getloadavg()[0]
    print(f"load {load:.2f} on {os.cpu_count()} processors; µs per step; of a view the time beyond the first")
    figures: dict[str, Any] = {"load": load}
    for env_id in dual_ur10.ENV_IDS:
        figures[env_id] = {
            "one": measure_views(env_id, arguments.rounds, arguments.steps),
            f"cells{arguments.cells}": measure_rows(
                env_id, arguments.cells, arguments.rounds // 4, arguments.steps // 4
            ),
        }
        for kind, values in figures[env_id].items():
            print(f"{env_id}, {kind}: " + ", ".join(f"{name} {value:.2f}" for name, value in values.items()))
    if arguments.json:
        arguments.json.write_text(json.dumps(figures, indent=2) + "\n")


if __name__ == "__main__":
    main()
