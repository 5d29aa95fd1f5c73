"""Speed of a virtual cell relative to real time, and its equality to the bit.

    python benchmarks/virtual_cell.py [--seeds 20] [--seconds 10] [--json FILE]

SineTracking with its scripted policy, a record, the supervisor and both emulated controllers, in one process. Each
seed is run twice; packages at both controllers, observations and times of the record must be equal. The figure is the
virtual time of the motion divided by the processor time, which other programs on the machine do not change as much as
they change the elapsed time.
"""

import argparse
import hashlib
import json
import os
import pathlib
import tempfile
import time

import gymnasium as gym
import numpy as np

import dual_ur10  # noqa: F401  # registers the environments
from dual_ur10.policies import load
from dual_ur10.testing import VirtualCell

ENV_ID = "DualUR10/SineTracking-v0"


def run(seed: int, seconds: float) -> tuple[str, float, float]:
    """Return the fingerprint of an episode, and its virtual and processor time, s."""
    bits = hashlib.sha256()
    with tempfile.TemporaryDirectory() as folder, VirtualCell(task=ENV_ID, seed=seed) as cell:
        env = gym.make(ENV_ID, cell=cell, record=folder, disable_env_checker=True)
        policy = load("scripted", ENV_ID)
        observation, _ = env.reset(seed=seed)
        policy.reset()
        virtual, processor = cell.now_s, time.process_time()
        ended = False
        while not ended and cell.now_s - virtual < seconds:
            observation, reward, terminated, truncated, _ = env.step(policy(observation))
            bits.update(np.asarray(observation).tobytes() + np.float64(reward).tobytes())
            ended = terminated or truncated
        virtual, processor = cell.now_s - virtual, time.process_time() - processor
        env.close()
        bits.update(repr([cell.packages(arm) for arm in ("left", "right")]).encode())
        bits.update(next(pathlib.Path(folder).rglob("*.mcap")).read_bytes())
    return bits.hexdigest(), virtual, processor


def main() -> None:
    """Run the benchmark."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seeds", type=int, default=20)
    parser.add_argument("--seconds", type=float, default=10.0)
    parser.add_argument("--json", type=pathlib.Path)
    options = parser.parse_args()
    run(0, 1.0)  # imports, compiled models and ur_rtde's script
    ratios, unequal = [], []
    for seed in range(options.seeds):
        (first, virtual, processor), (second, again, more) = run(seed, options.seconds), run(seed, options.seconds)
        ratios.append((virtual + again) / (processor + more))
        if first != second:
            unequal.append(seed)
        print(f"seed {seed}: {ratios[-1]:.2f} x real time, {'equal' if first == second else 'NOT equal'}", flush=True)
    found = {
        "seeds": options.seeds,
        "real_time_factor_median": float(np.median(ratios)),
        "real_time_factor_min": min(ratios),
        "unequal_seeds": unequal,
        "load": os.getloadavg()[0],
    }
    print(json.dumps(found, indent=2))
    if options.json:
        options.json.write_text(json.dumps(found, indent=2))


if __name__ == "__main__":
    main()
