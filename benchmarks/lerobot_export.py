"""Measure the export of a recorded run as a LeRobot dataset, state only: processor time of one core.

The scripted policy runs SineTracking, which is recorded and exported. One episode takes 30 s.

    python benchmarks/lerobot_export.py --json lerobot_export.json
    python benchmarks/lerobot_export.py --minutes 2 --robot ur10e
"""

from __future__ import annotations

import os

for _name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"):
    os.environ.setdefault(_name, "1")

import argparse
import json
import tempfile
import time
from pathlib import Path

from dual_ur10 import policies
from dual_ur10.lerobot.lerobot_export import runs_of, to_lerobot
from dual_ur10.sim2real.recording.run_folder import RUN_FILE

TASK = "DualUR10/SineTracking-v0"
EPISODE_MIN = 0.5


def measure(minutes: float, robot: str) -> dict[str, float]:
    """Record a run of some minutes, export it, and return figures of the export, also for an hour."""
    with tempfile.TemporaryDirectory() as folder:
        root = Path(folder)
        env, policy = policies.make("scripted", TASK, robot=robot, record=str(root / "runs"))
        for episode in range(max(1, round(minutes / EPISODE_MIN))):
            policies.rollout(env, policy, seed=episode)
        env.close()
        runs = runs_of([root / "runs"])
        begin, began = time.perf_counter(), time.process_time()
        found = to_lerobot(runs, root / "dataset")
        wall_s, cpu_s = time.perf_counter() - begin, time.process_time() - began
        hours = found.frames / found.fps / 3600.0
        return {
            "minutes": 60.0 * hours,
            "frames": found.frames,
            "record_mib": sum((run / RUN_FILE).stat().st_size for run in runs) / 2**20,
            "wall_s": wall_s,
            "cpu_s": cpu_s,
            "cpu_s_per_hour": cpu_s / hours,
        }


def main() -> None:
    """Measure, and print what was found."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--minutes", type=float, default=60.0)
    parser.add_argument("--robot", default="ur10")
    parser.add_argument("--json", type=Path)
    options = parser.parse_args()
    found = measure(options.minutes, options.robot)
    for name, value in found.items():
        print(f"{name:16} {value:.1f}")
    if options.json:
        options.json.write_text(json.dumps(found, indent=2) + "\n")


if __name__ == "__main__":
    main()
