"""Measure success and accuracy of the scripted policy that hands the block over.

Either arm may give, sampled for each episode. `known`: the block's pose is measured exactly; `noisy`: with an error
sampled for each episode, 2 mm along and 1° about each axis (standard deviations). Everything else is an exact model:
no real arm is in this.

    python benchmarks/handover.py --json handover.json
"""

from __future__ import annotations

import os

os.environ.setdefault("OMP_NUM_THREADS", "1")  # before numpy reads it
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import argparse
import json
import statistics
from pathlib import Path
from typing import Any

from speed_meter import SpeedMeter

from demo.case import Case
from demo.handover import CASES, HANDOVER_ID
from dual_ur10 import policies
from dual_ur10.envs.core.options import DEFAULT_RATE_HZ
from dual_ur10.envs.tasks.handover.task import Handover
from dual_ur10.policies import evaluate

EPISODES = 300


def measure(case: Case, episodes: int) -> dict[str, Any]:
    """Return successes of a case, and figures of the successful episodes."""
    policy = SpeedMeter(policies.load("scripted", HANDOVER_ID, **case.keywords), 1 / DEFAULT_RATE_HZ, Handover)
    found = evaluate(HANDOVER_ID, policy, episodes=episodes, env_kwargs=case.keywords)
    placed = [1e3 * (each.last["object_error_m"] or 0.0) for each in found.episodes if each.success]
    return {
        "successes": found.successes,
        "episodes": episodes,
        "interval": list(found.interval),
        "median_time_s": found.median_time_s,
        "p90_time_s": found.p90_time_s,
        "place_median_mm": statistics.median(placed) if placed else None,
        "place_max_mm": max(placed, default=None),
        "stage_scores": found.stage_scores,
        "failed_seeds": [each.seed for each in found.episodes if not each.success],
        "speed_share": policy.ratio,
    }


def run(episodes: int = EPISODES) -> dict[str, dict[str, Any]]:
    """Measure all rows, and print each when it is done."""
    print("handover, either arm gives; time and placing error: of the successes")
    columns = ("success", "95 % interval", "median s", "90 % s", "placed mm", "largest mm", "speed limit %")
    print(f"{'':12}" + "".join(f"{name:>16}" for name in columns))
    rows: dict[str, dict[str, Any]] = {}
    for each in CASES:
        rows[each.name] = row = measure(each, episodes)
        low, high = (100 * end for end in row["interval"])
        figures = [row[key] for key in ("median_time_s", "p90_time_s", "place_median_mm", "place_max_mm")]
        values = [f"{row['successes']} of {episodes}", f"{low:.1f} to {high:.1f} %"]
        values += ["-" if value is None else f"{value:.2f}" for value in figures]
        values.append(f"{100 * row['speed_share']:.0f}")
        print(f"{each.name:12}" + "".join(f"{value:>16}" for value in values), flush=True)
        if row["failed_seeds"]:
            print(f"{'':12}failed seeds: {', '.join(map(str, row['failed_seeds']))}")
    return rows


def main() -> None:
    """Run everything and write the figures."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--json", type=Path, help="write the figures here")
    parser.add_argument("--episodes", type=int, default=EPISODES, help="episodes of each row")
    arguments = parser.parse_args()
    before = os.getloadavg()
    rows = run(arguments.episodes)
    after = os.getloadavg()
    print(f"load {before[0]:.2f} before, {after[0]:.2f} after, {os.cpu_count()} processors")
    if arguments.json:
        load = {"before": before, "after": after, "processors": os.cpu_count()}
        arguments.json.write_text(json.dumps({"handover": rows, "load": load}, indent=2) + "\n")


if __name__ == "__main__":
    main()
