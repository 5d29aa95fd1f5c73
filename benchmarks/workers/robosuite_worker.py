"""Worker of interleaved.py for a Python with robosuite: two UR5e, random actions at 20 Hz, nothing rendered.

Input and output are those of dual_ur10_worker.py, with cases of a `task` alone. Episodes do not end, so that no reset
is measured.
"""

import json
import os
import sys

for _name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"):
    os.environ.setdefault(_name, "1")

import time

import mujoco
import numpy as np
import robosuite

RATE_HZ = 20


def main() -> None:
    """Answer the lines of the standard input until it ends."""
    answers, sys.stdout = sys.stdout, sys.stderr  # robosuite prints
    case = json.loads(sys.stdin.readline())
    env = robosuite.make(
        case["task"],
        robots=["UR5e", "UR5e"],
        control_freq=RATE_HZ,
        has_renderer=False,
        has_offscreen_renderer=False,
        use_camera_obs=False,
        ignore_done=True,
    )
    low, high = env.action_spec
    rng = np.random.default_rng(0)
    env.reset()
    about = {"robosuite": robosuite.__version__, "mujoco": mujoco.__version__, "numpy": np.__version__}
    print(json.dumps(about), file=answers, flush=True)
    for line in sys.stdin:
        steps = json.loads(line)
        actions = rng.uniform(low, high, (steps, len(low)))
        wall, cpu = time.perf_counter(), time.process_time()
        for action in actions:
            env.step(action)
        result = {
            "env_steps": steps,
            "simulated_s": steps / RATE_HZ,
            "wall_s": time.perf_counter() - wall,
            "cpu_s": time.process_time() - cpu,
        }
        print(json.dumps(result), file=answers, flush=True)


if __name__ == "__main__":
    main()
