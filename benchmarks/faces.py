"""What an interface costs per step beyond the Gymnasium environment it is a view on.

Every environment plays the same actions from the same seed. Blocks of steps are taken in turn, in an order that
changes, so that whatever else the machine does meets all alike, and their processor time is taken. Quoted is the median
over the rounds of the difference to the Gymnasium environment's block in the same round. For the rows of one policy
(TwoAgentVecEnv, only with Stable-Baselines3) it is the difference to the vector environment with as many cells on one
thread, per cell and step.

    python benchmarks/faces.py --json faces.json
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
    """A block: an episode's first steps, and the processor time that they take in s."""

    def block() -> float:
        reset()
        begin = time.process_time()
        for action in actions:
            step(action)
        return time.process_time() - begin

    return block


def turns(env: Any) -> Callable[[Any], None]:
    """Both turns of an AEC environment, as its loop takes them."""

    def step(actions: dict[str, np.ndarray]) -> None:
        for agent in env.agents:
            env.last()
            env.step(actions[agent])

    return step


def extra(blocks: dict[str, Block], base: str, rounds: int, steps: int) -> dict[str, float]:
    """Median time of a step of the base, and of what the others take beyond it, in µs."""
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


def measure_faces(env_id: str, rounds: int, steps: int) -> dict[str, float]:
    """Step of the Gymnasium environment in µs, and what each view on one cell takes beyond it."""
    single = gym.make(env_id, disable_env_checker=True).unwrapped
    shape = single.action_space.shape
    joint = list((np.random.default_rng(0).uniform(-0.02, 0.02, (steps, *shape))).astype(np.float32))
    by_agent = [dict(zip(("left", "right"), action.reshape(2, -1), strict=True)) for action in joint]
    blocks = {"gymnasium": timed(lambda: single.reset(seed=0), single.step, joint)}
    for reward in ("shared", "individual"):
        env = parallel_env(env_id, reward=reward)
        blocks[f"parallel, {reward}"] = timed(lambda env=env: env.reset(seed=0), env.step, by_agent)
    aec = aec_env(env_id)
    blocks["aec"] = timed(lambda: aec.reset(seed=0), turns(aec), by_agent)
    deepmind = dm_env(env_id)
    blocks["dm_env"] = timed(deepmind.reset, deepmind.step, joint)
    return extra(blocks, "gymnasium", rounds, steps)


def measure_rows(env_id: str, cells: int, rounds: int, steps: int) -> dict[str, float]:
    """Step of the vector environment in µs per cell, and what the rows of one policy take beyond it."""
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
    print(f"load {load:.2f} on {os.cpu_count()} processors; µs per step, of a view what it takes beyond the first")
    figures: dict[str, Any] = {"load": load}
    for env_id in dual_ur10.ENV_IDS:
        figures[env_id] = {
            "one": measure_faces(env_id, arguments.rounds, arguments.steps),
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
