"""Measure collision-free paths and their timing: CPU time of one core.

Random pairs of configurations, each joint uniform within ±pi, that the safety gate allows. A path is solved if it was
found within 1 s. It passes the gate if the slow approach along it does, at the speeds of an approach, and its timed
trajectory, as the executor sends it.
"""

from __future__ import annotations

import os

os.environ["OMP_NUM_THREADS"] = "1"  # before numpy reads it
os.environ["OPENBLAS_NUM_THREADS"] = "1"

import argparse
import json
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from dual_ur10.assets.obstacles import Box
from dual_ur10.assets.props import BAR
from dual_ur10.assets.settings import HOME_Q_RAD, Equipment, SceneSettings
from dual_ur10.errors import PlanningError, TrajectoryError
from dual_ur10.sim2real.control.clearance import Clearance
from dual_ur10.sim2real.control.gate import SafetyGate
from dual_ur10.sim2real.control.limits import MotionLimits
from dual_ur10.sim2real.control.planner import plan_path
from dual_ur10.sim2real.runtime.approach import Approach, Rates
from dual_ur10.sim2real.trajectory.path_check import TargetLaw
from dual_ur10.sim2real.trajectory.path_timing import refusal_of, time_path
from ur_core.servoj import ServojProfile

Array = NDArray[np.float64]

SOLVED_S = 1.0
LIMITS = MotionLimits()
PROFILE = ServojProfile()
TICKS = 5
SCENES = {
    "bare": SceneSettings(),
    "pillar": SceneSettings(obstacles=(Box(name="pillar", position_m=(-0.3, 0.0, 0.4), size_m=(0.3, 0.3, 0.8)),)),
    "grippers and bar": SceneSettings(equipment=Equipment(grippers=True, props=(BAR,))),
}


def free_pairs(clearance: Clearance, count: int, rng: np.random.Generator) -> Iterator[Array]:
    """Yield pairs, (2, 12), of configurations that the gate allows."""
    limit = np.tile(np.minimum(LIMITS.upper_rad, np.pi), 2)
    found: list[Array] = []
    while count:
        q = rng.uniform(-limit, limit, (1000, 12))
        found += list(q[clearance.is_clear(q)])
        while count and len(found) > 1:
            yield np.array([found.pop(), found.pop()])
            count -= 1


def approach_passes(path: Array, clearance: Clearance) -> bool:
    """Return True if the gate releases a slow approach along a path."""
    targets = Approach(path, rates=Rates(LIMITS.robots).within(LIMITS, 1.0)).targets(PROFILE.tick_s).reshape(-1, 12)
    gate = SafetyGate(LIMITS, PROFILE.tick_s, TICKS, clearance)
    gate.reset(path[:1].reshape(1, 2, 6))
    rest = np.repeat(targets[-1:], -len(targets) % TICKS + TICKS, axis=0)
    windows = np.concatenate([targets, rest]).reshape(-1, 1, TICKS, 2, 6)
    return not any(gate(window).verdicts for window in windows)


def planned(scene: SceneSettings, pairs: int, seed: int) -> dict[str, Any]:
    """Plan and time paths between random pairs."""
    clearance = Clearance(scene)
    law = TargetLaw.of(PROFILE, TICKS, 1.0, None)
    gate = SafetyGate(LIMITS, law.tick_s, TICKS, clearance)
    planning, timing, durations, corners = [], [], [], []
    found = straight = slow = timed = 0
    for number, (start, goal) in enumerate(free_pairs(clearance, pairs, np.random.default_rng(seed))):
        begin = time.process_time()
        try:
            path = plan_path(clearance, start, goal, LIMITS, np.random.default_rng(number))
        except PlanningError:
            planning.append(np.inf)
            continue
        planning.append(time.process_time() - begin)
        found += 1
        straight += len(path) == 2
        corners.append(len(path) - 2)
        slow += approach_passes(path, clearance)
        begin = time.process_time()
        try:
            trajectory = time_path(path, gate, law)
        except TrajectoryError:
            continue
        timing.append(time.process_time() - begin)
        timed += refusal_of(trajectory, HOME_Q_RAD, gate, law) is None
        durations.append(trajectory.duration_s)
    took = np.array(planning)
    return {
        "pairs": pairs,
        "solved": float((took <= SOLVED_S).mean()),
        "median_s": float(np.median(took)),
        "p95_s": float(np.quantile(took, 0.95, method="higher")),
        "p99_5_s": float(np.quantile(took, 0.995, method="higher")),
        "longest_s": float(took.max()),
        "straight": straight / pairs,
        "mean_corners": float(np.mean(corners)),
        "approach_passes": slow / found,
        "timed_passes": timed / found,
        "timing_median_s": float(np.median(timing)),
        "timing_longest_s": float(np.max(timing)),
        "median_duration_s": float(np.median(durations)),
    }


def main() -> None:
    """Run all scenes, print a table and write the figures."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--json", type=Path, help="write the figures here")
    parser.add_argument("--pairs", type=int, default=1000, help="pairs of configurations in each scene")
    parser.add_argument("--seed", type=int, default=12345)
    arguments = parser.parse_args()

    load = os.getloadavg()
    print(f"paths between {arguments.pairs} random pairs, CPU time; load {load[0]:.2f}")
    print(
        f"{'scene':18}{'solved':>9}{'median':>10}{'p95':>9}{'p99.5':>9}{'straight':>10}{'corners':>9}{'approach':>10}"
        f"{'timed':>9}{'timing':>10}{'motion':>9}"
    )
    scenes = {}
    for name, scene in SCENES.items():
        row = scenes[name] = planned(scene, arguments.pairs, arguments.seed)
        print(
            f"{name:18}{row['solved']:9.2%}{1e3 * row['median_s']:7.1f} ms{1e3 * row['p95_s']:6.0f} ms"
            f"{1e3 * row['p99_5_s']:6.0f} ms{row['straight']:10.1%}{row['mean_corners']:9.2f}"
            f"{row['approach_passes']:10.2%}{row['timed_passes']:9.2%}{1e3 * row['timing_median_s']:7.0f} ms"
            f"{row['median_duration_s']:7.2f} s",
            flush=True,
        )
    if arguments.json:
        figures = {"scenes": scenes, "load": load}
        arguments.json.write_text(json.dumps(figures, indent=2) + "\n")


if __name__ == "__main__":
    main()
