"""Worker of interleaved.py: steps environments of the checkout on its import path, a block for each line of input.

Input, one JSON object a line: the case (`task`, `envs`, `threads`), then the number of steps of a block at a time.
Output, one JSON object a line: where the package lies and its versions, then the figures of the block.
"""

import json
import os
import sys

for _name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"):
    os.environ.setdefault(_name, "1")

import time

import gymnasium as gym
import mujoco
import numpy as np

import dual_ur10

PERIOD_S = 0.04


def main() -> None:
    """Answer the lines of the standard input until it ends."""
    case = json.loads(sys.stdin.readline())
    env_id, n = f"DualUR10/{case['task']}-v0", case["envs"]
    env = gym.make(env_id) if n == 1 else gym.make_vec(env_id, num_envs=n, threads=case["threads"])
    rng = np.random.default_rng(0)
    env.reset(seed=0)
    about = {"file": dual_ur10.__file__, "mujoco": mujoco.__version__, "numpy": np.__version__}
    print(json.dumps(about), flush=True)
    for line in sys.stdin:
        steps = json.loads(line)
        actions = rng.uniform(-1, 1, (steps, *env.action_space.shape)).astype(np.float32)
        wall, cpu = time.perf_counter(), time.process_time()
        for action in actions:
            _, _, terminated, truncated, _ = env.step(action)
            if n == 1 and (terminated or truncated):
                env.reset()
        result = {
            "env_steps": n * steps,
            "simulated_s": n * steps * PERIOD_S,
            "wall_s": time.perf_counter() - wall,
            "cpu_s": time.process_time() - cpu,
        }
        print(json.dumps(result), flush=True)


if __name__ == "__main__":
    main()
