"""Measure accuracy and success of the scripted policy that carries the bar with both arms.

Rows of figures: known payload, nominal plant, the worst of several seeds, from the beginning of the path. `rigid` and
`grip` follow the path of 60 s: the bar is welded to the grippers, or friction holds it. `grip_short` follows that of
30 s, and `capped` the same in a cell with joint speeds of at most 0.5 rad/s, which slows it. Nominal figures are an
artefact of an exact model. `mild`: successes with the defaults of the task (30 s, friction) on plants that are sampled
for each episode. No real arm is in this.

    python benchmarks/carry.py --json carry.json
"""

from __future__ import annotations

import os

os.environ.setdefault("OMP_NUM_THREADS", "1")  # before numpy reads it
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import argparse
import json
from pathlib import Path
from typing import Any

import numpy as np
from speed_meter import SpeedMeter

from demo.carry import CARRY_ID, TASK
from demo.case import Case
from dual_ur10 import CellConfig, policies
from dual_ur10.envs.core.options import DEFAULT_RATE_HZ
from dual_ur10.envs.tasks.sync_carry.task import SyncCarry
from dual_ur10.policies import evaluate

SEEDS = 3
EPISODES = 300
GOAL = 0.99
CAP_RAD_S = 0.5

KEPT = ("relative_max_mm", "relative_max_deg", "squeeze_max_n", "slip_max_mm")
"""Figures of each row."""

RUNS: dict[str, dict[str, Any]] = {
    "rigid": {"duration_s": 60.0, "grasp": "rigid"},
    "grip": {"duration_s": 60.0},
    "grip_short": {"duration_s": 30.0},
    "capped": {"duration_s": 30.0, "cell": CellConfig(speed_rad_s=CAP_RAD_S)},
}


def worst(keywords: dict[str, Any], seeds: int) -> dict[str, float]:
    """Return the figures of a case, the worst of some seeds, and the number of successful episodes."""
    found = TASK.measure(Case("", "", CARRY_ID, {"payload": "known", **keywords}), range(seeds))
    figures = {name: max(each.figures[name] for each in found) for name in KEPT}
    return {
        **{name: value for name, value in figures.items() if np.isfinite(value)},
        "least_load_share": min(each.figures["least_load_share"] for each in found),
        "speed_share": max(each.speed_ratio for each in found),
        "episode_s": max(float(each.record.time_s[-1]) for each in found),
        "successes": sum(each.record.success for each in found),
        "episodes": seeds,
    }


def mild(episodes: int) -> dict[str, Any]:
    """Return the successes on plants that differ from episode to episode."""
    keywords = {"randomization": "mild"}
    policy = SpeedMeter(policies.load("scripted", CARRY_ID, **keywords), 1 / DEFAULT_RATE_HZ, SyncCarry)
    found = evaluate(CARRY_ID, policy, episodes=episodes, env_kwargs=keywords)
    return {
        "successes": found.successes,
        "episodes": episodes,
        "interval": list(found.interval),
        "slip_max_mm": 1e3 * max(found.spreads[f"slip_m/{arm}"].largest for arm in ("left", "right")),
        "median_time_s": found.median_time_s,
        "speed_share": policy.ratio,
    }


def run(seeds: int = SEEDS, episodes: int = EPISODES) -> dict[str, dict[str, Any]]:
    """Measure all rows, and print each when it is done."""
    print(f"carry, payload known, nominal plant, worst of {seeds} seeds, from the beginning of the path on")
    columns = (
        "relative mm",
        "relative °",
        "squeeze N",
        "slip mm",
        "least load %",
        "speed limit %",
        "length s",
        "success",
    )
    print(f"{'':12}" + "".join(f"{name:>15}" for name in columns))
    rows: dict[str, dict[str, Any]] = {}
    for name, keywords in RUNS.items():
        rows[name] = row = worst(keywords, seeds)
        values = [f"{row[key]:.4f}" if key in row else "-" for key in KEPT]
        values += [f"{100 * row['least_load_share']:.1f}", f"{100 * row['speed_share']:.0f}"]
        values += [f"{row['episode_s']:.1f}", f"{row['successes']} of {seeds}"]
        print(f"{name:12}" + "".join(f"{value:>15}" for value in values), flush=True)
    rows["mild"] = row = mild(episodes)
    low, high = (100 * each for each in row["interval"])
    print(
        f"carry, 30 s path, friction, randomization mild: success {row['successes']} of {episodes} (95 % interval "
        f"{low:.1f} to {high:.1f} %, goal {100 * GOAL:g} %), slip at most {row['slip_max_mm']:.2f} mm, "
        f"speed {100 * row['speed_share']:.0f} % of the limit",
        flush=True,
    )
    return rows


def main() -> None:
    """Run everything and write the figures."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--json", type=Path, help="write the figures here")
    parser.add_argument("--seeds", type=int, default=SEEDS, help="episodes of each row of figures")
    parser.add_argument("--episodes", type=int, default=EPISODES, help="episodes on random plants")
    arguments = parser.parse_args()
    before = os.getloadavg()
    rows = run(arguments.seeds, arguments.episodes)
    after = os.getloadavg()
    print(f"load {before[0]:.2f} before, {after[0]:.2f} after, {os.cpu_count()} processors")
    if arguments.json:
        load = {"before": before, "after": after, "processors": os.cpu_count()}
        arguments.json.write_text(json.dumps({"carry": rows, "load": load}, indent=2) + "\n")


if __name__ == "__main__":
    main()
