"""Measure the speed of the environments against the bare physics in them.

Efficiency is the time of MuJoCo's `Batch.rollout` on the same model, states, controls and number of steps, divided by
the time of the environment's step. Both are measured alternately in one run: block by block the environment repeats an
episode whose actions are already known, so that nothing else runs in between, and records its controls; then the same
rollouts are repeated bare from the same states. The result is the median over the blocks. Absolute figures hold for
this machine and its printed load; only the ratio carries over to others. Scripted blocks begin where the object is held
and lifted, because contacts dominate the cost of physics; random ones begin with the episode.

Beside the steps, `--parts` has the extra time per step of PettingZoo's parallel view (see interfaces.py), environment
steps per second with one camera of 84 x 84 pixels, and what a program waits for and stores: time of the imports, from
there to the first step, and memory per environment.

    python benchmarks/throughput.py --json throughput.json
    python benchmarks/throughput.py --parts steps pixels --task Handover
    python benchmarks/throughput.py --parts steps --task SineTracking --contacts
    python benchmarks/throughput.py --parts steps --task SineTracking --randomization mild

With `--peer` or `--against`, only a comparison is measured, block by block in turn (see interleaved.py): simulated
seconds per processor second against robosuite in a virtual environment of its own, or environment steps per second
against another checkout of this project.

    python benchmarks/throughput.py --peer robosuite --peer-python PEER/bin/python
    python benchmarks/throughput.py --against OTHER --against-python OTHER/.venv/bin/python
"""

from __future__ import annotations

import os
import subprocess
import sys

for _name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"):
    os.environ.setdefault(_name, "1")  # the batch has its own threads; small matrices gain nothing from more

import argparse
import json
import statistics
import time
from pathlib import Path
from typing import Any

import gymnasium as gym
import interleaved
import numpy as np
from interfaces import measure_views

import dual_ur10
from dual_ur10 import policies
from dual_ur10.envs.core.setup import EnvSetup

PERIOD_S = 0.04
HELD_AFTER = {"SyncCarry": 140, "Handover": 60}
"""Steps of the scripted policy after which the object is held and moves."""

VIEW_GOAL_US = 8.0
PIXELS = {"observation": "pixels", "cameras": ("front",), "width": 84, "height": 84}
PIXEL_ENVS = 8


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
    env_id: str,
    n: int,
    actions: str,
    blocks: int,
    steps: int,
    threads: int,
    begin_after: int = 0,
    randomization: str = "none",
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
        randomization: Preset of the environment. SineTracking computes contacts only with one.
    """
    if n == 1:
        env: Any = gym.make(env_id, randomization=randomization)
    else:
        env = gym.make_vec(env_id, num_envs=n, threads=threads, randomization=randomization)
    policy = policies.load("scripted", env_id)
    rng = np.random.default_rng(0)
    recorder = Recorder(env)
    efficiency, duration, cpu = [], [], []
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
        begin, begin_cpu = time.perf_counter(), time.process_time()
        for action in known[begin_after:]:
            step_on(env, action, n)
        env_time = time.perf_counter() - begin
        cpu.append(time.process_time() - begin_cpu)
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
        "sim_s_per_cpu_s": round(n * steps * PERIOD_S / statistics.median(cpu), 1),
        "overhead_us": round(step_s * (1 - ratio) * 1e6 / n, 1),
    }


def measure_steps(env_id: str, arguments: argparse.Namespace) -> dict[str, Any]:
    """Measure one environment and a batch with scripted and random actions, and print each row when it is done."""
    figures: dict[str, Any] = {}
    task = name_of(env_id)
    held = HELD_AFTER.get(task, 0)
    for key, n, steps in (("single", 1, 200), (f"vector{arguments.envs}", arguments.envs, 25)):
        # A batch of cells with contacts needs long until the object is held.
        blocks = arguments.blocks if n == 1 or not held else max(1, arguments.blocks // 5)
        for actions in ("scripted", "random"):
            begin_after = held if actions == "scripted" else 0
            result: dict[str, Any] = measure(
                env_id, n, actions, blocks, steps, arguments.threads, begin_after, arguments.randomization
            )
            row = f"{f'{task}, {key}, {actions}':34}{result['efficiency']:12.3f}{result['env_steps_per_s']:14.0f}"
            row += f"{result['sim_s_per_s']:10.1f}{result['sim_s_per_cpu_s']:14.1f}{result['overhead_us']:19.1f}"
            print(row, flush=True)
            if n > 1:
                result["threads"] = arguments.threads
            figures[key if actions == "scripted" else f"{key}_random"] = result
    return figures


def measure_parallel(env_id: str, arguments: argparse.Namespace) -> dict[str, Any]:
    """Measure the extra time per step of PettingZoo's parallel view."""
    views = measure_views(env_id, arguments.rounds, 20)  # short blocks: other work spoils few of them
    found = {name: views[f"parallel, {name}"] for name in ("shared", "individual")}
    extra = ", ".join(f"{value:.1f} µs with {name} rewards" for name, value in found.items())
    print(
        f"{name_of(env_id)}, PettingZoo's parallel view, beyond gym.make per step: {extra} (goal {VIEW_GOAL_US:g} µs)"
    )
    return {"parallel_extra_us": found}


def measure_pixels(env_id: str, arguments: argparse.Namespace) -> dict[str, Any]:
    """Measure environment steps per second with one camera; blocks of one environment and of a batch alternate."""
    many = gym.make_vec(env_id, num_envs=PIXEL_ENVS, threads=arguments.threads, **PIXELS)
    sides = (("single", gym.make(env_id, **PIXELS), 1, 40), (f"vector{PIXEL_ENVS}", many, PIXEL_ENVS, 10))
    rng, rates = np.random.default_rng(0), {key: [] for key, *_ in sides}
    for block in range(arguments.blocks):
        for key, env, n, steps in sides:
            env.reset(seed=block)
            actions = rng.uniform(-1, 1, (steps, *env.action_space.shape)).astype(np.float32)
            begin = time.perf_counter()
            for action in actions:
                step_on(env, action, n)
            rates[key].append(n * steps / (time.perf_counter() - begin))
    for _, env, *_ in sides:
        env.close()
    found = {key: {"env_steps_per_s": round(statistics.median(values), 1)} for key, values in rates.items()}
    single, vector = rates.values()
    ratio = statistics.median(b / a for a, b in zip(single, vector, strict=True))
    found[f"vector{PIXEL_ENVS}"]["ratio"] = round(ratio, 2)
    one, batch = (each["env_steps_per_s"] for each in found.values())
    print(
        f"{name_of(env_id)}, one camera of 84 x 84 pixels: {one:.0f} env-steps/s, {PIXEL_ENVS} envs on "
        f"{arguments.threads} threads {batch:.0f}, {ratio:.2f} times as many",
        flush=True,
    )
    return {"pixels": found}


_START = """
import json, sys, time
begin = time.perf_counter()
import gymnasium, dual_ur10
imported = time.perf_counter()
env = gymnasium.make(sys.argv[1])
env.reset(seed=0)
env.step(env.action_space.sample() * 0)
print(json.dumps([imported - begin, time.perf_counter() - imported]))
"""


_MEMORY = """
import json, sys
import gymnasium, dual_ur10, psutil
kept = []
for envs in (2, int(sys.argv[2])):
    kept.append(gymnasium.make_vec(sys.argv[1], num_envs=envs))
    kept[-1].reset(seed=0)
    kept[-1].step(kept[-1].action_space.sample())
    kept.append(psutil.Process().memory_info().rss)
print(json.dumps((kept[3] - kept[1]) / int(sys.argv[2])))
"""


def fresh(code: str, *arguments: str) -> Any:
    """Return what Python code prints as JSON in a process of its own."""
    command = [sys.executable, "-c", code, *arguments]
    return json.loads(subprocess.run(command, capture_output=True, text=True, check=True).stdout)


def measure_start(env_id: str, arguments: argparse.Namespace) -> dict[str, Any]:
    """Measure time to the first step and memory per environment of a batch, in fresh processes."""
    times = [fresh(_START, env_id) for _ in range(5)]
    imports, first = (statistics.median(values) for values in zip(*times, strict=True))
    memory = fresh(_MEMORY, env_id, str(arguments.envs)) / 2**20
    print(
        f"{name_of(env_id)}, a fresh process: imports {imports:.2f} s, from there to the first step {first:.2f} s; "
        f"memory of a batch of {arguments.envs}: {memory:.2f} MiB per environment",
        flush=True,
    )
    return {
        "start": {
            "import_s": round(imports, 3),
            "first_step_s": round(first, 3),
            "memory_per_env_mib": round(memory, 3),
        }
    }


def name_of(env_id: str) -> str:
    """Return the task in an id."""
    return env_id.split("/")[1].rsplit("-v", 1)[0]


PARTS = {"steps": measure_steps, "parallel": measure_parallel, "pixels": measure_pixels, "start": measure_start}


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--json", type=Path, help="write the figures to this file")
    parser.add_argument("--blocks", type=int, default=15)
    parser.add_argument("--envs", type=int, default=64)
    parser.add_argument("--rounds", type=int, default=200, help="rounds of blocks for PettingZoo's view")
    parser.add_argument("--threads", type=int, default=min(2, os.cpu_count() or 1))
    parser.add_argument("--task", action="append", help="one of the tasks, such as SyncCarry; may be repeated")
    parser.add_argument("--randomization", default="none", help="preset of the environments of the steps")
    parser.add_argument("--contacts", action="store_true", help="compute contacts also where nothing can touch")
    parser.add_argument("--parts", nargs="+", choices=PARTS, default=list(PARTS))
    parser.add_argument(
        "--peer", choices=["robosuite"], help="compare with its two-arm tasks, and measure nothing else"
    )
    parser.add_argument("--peer-python", type=Path, help="interpreter with the peer")
    parser.add_argument("--against", type=Path, help="compare with this checkout, and measure nothing else")
    parser.add_argument("--against-python", type=Path, default=Path(sys.executable), help="interpreter for --against")
    arguments = parser.parse_args()
    if (arguments.peer is None) != (arguments.peer_python is None):
        parser.error("--peer and --peer-python belong together")
    if arguments.contacts:
        EnvSetup.contacts = property(lambda setup: True)
    load = os.getloadavg()[0]
    print(
        f"{arguments.envs} envs on {arguments.threads} threads, 25 Hz; load {load:.2f} on {os.cpu_count()} processors"
    )
    figures: dict[str, Any] = {"load": load}
    tasks = [each for each in dual_ur10.ENV_IDS if name_of(each) != "Free"]  # it has no scripted policy
    env_ids = [each for each in tasks if not arguments.task or name_of(each) in arguments.task]
    batch = arguments.envs, arguments.threads, arguments.blocks
    if arguments.peer:
        figures[arguments.peer] = interleaved.robosuite(arguments.peer_python, *batch)
    if arguments.against:
        names = [name_of(each) for each in env_ids]
        figures["against"] = interleaved.against(arguments.against, arguments.against_python, names, *batch)
    if not (arguments.peer or arguments.against):
        if "steps" in arguments.parts:
            heads = (
                ("efficiency", 12),
                ("env-steps/s", 14),
                ("sim s/s", 10),
                ("sim s/CPU s", 14),
                ("overhead µs/step", 19),
            )
            print(f"{'case':34}" + "".join(f"{head:>{width}}" for head, width in heads))
        for env_id in env_ids:
            own = figures[name_of(env_id)] = {}
            for part in arguments.parts:
                own.update(PARTS[part](env_id, arguments))
        # The figures of SineTracking stand at the top level, too.
        figures = {**figures.get("SineTracking", {}), **figures}
    if arguments.json:
        arguments.json.write_text(json.dumps(figures, indent=2) + "\n")


if __name__ == "__main__":
    main()
