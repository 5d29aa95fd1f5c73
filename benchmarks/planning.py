"""Measure collision-free paths, their timing, and the reduction of trajectories: CPU time of one core.

Random pairs of configurations, each joint uniform within ±pi, that the safety gate allows. A path is solved if it was
found within 1 s. It passes the gate if the slow approach along it does, at the speeds of an approach, and its timed
trajectory, as the executor sends it. Reduced are the sine of both flanges and random trajectories, some of them wild:
the largest deviation at random times is divided by the bound that the reduction promises.
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
from dual_ur10.kinematics import flange_pose, nearest
from dual_ur10.kinematics.ur10 import NOMINAL_DH
from dual_ur10.sim2real.control.clearance import Clearance
from dual_ur10.sim2real.control.gate import SafetyGate
from dual_ur10.sim2real.control.limits import MotionLimits
from dual_ur10.sim2real.control.planner import plan_path
from dual_ur10.sim2real.control.servoj import ServojProfile
from dual_ur10.sim2real.runtime.approach import Approach, Rates
from dual_ur10.sim2real.trajectory.interpolation import Interpolation
from dual_ur10.sim2real.trajectory.joint_trajectory import JointTrajectory
from dual_ur10.sim2real.trajectory.path_check import TargetLaw
from dual_ur10.sim2real.trajectory.path_timing import refusal_of, time_path
from dual_ur10.sim2real.trajectory.reduction import Kind, reduce_points

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


def sine(duration_s: float = 10.0, amplitude_m: float = 0.1, rate_hz: float = 0.5) -> JointTrajectory:
    """Return a sine of both flanges along y at 125 Hz, which begins and ends at rest."""
    time_s = np.arange(0.0, duration_s + PROFILE.tick_s / 2, PROFILE.tick_s)
    ramp = np.clip(np.minimum(time_s, duration_s - time_s), 0.0, 1.0)
    wanted = amplitude_m * ramp**3 * (10 - 15 * ramp + 6 * ramp**2) * np.sin(2 * np.pi * rate_hz * time_s)
    q = np.empty((len(time_s), 2, 6))
    for arm, here in enumerate(np.array(HOME_Q_RAD)):
        position, rotation = flange_pose(here, NOMINAL_DH)
        for k, away in enumerate(wanted):
            q[k, arm] = here = nearest(position + away * np.eye(3)[1], rotation, here, NOMINAL_DH)
    speeds = np.gradient(q, time_s, axis=0)
    speeds[[0, -1]] = 0.0
    return JointTrajectory(("left", "right"), time_s, q, speeds)


def random_trajectory(rng: np.random.Generator) -> JointTrajectory:
    """Return points with any speeds and accelerations: smooth ones, or wild ones."""
    count, order = int(rng.integers(2, 40)), int(rng.integers(3))
    time_s = np.append(0.0, np.cumsum(rng.uniform(0.01, 0.5, count - 1)))
    size, shape = rng.choice([1e-4, 0.1, 3.0]), (count, 2, 6)
    if rng.random() < 0.5:
        values = [size * rng.uniform(-1, 1, shape) for _ in range(3)]
    else:
        phase, pulse = rng.uniform(0.1, 6.0, (2, 2, 6))
        angle = time_s[:, None, None] * pulse + phase
        values = [size * np.sin(angle), size * pulse * np.cos(angle), -size * pulse**2 * np.sin(angle)]
    return JointTrajectory(("left", "right"), time_s, *values[: order + 1])


def deviation_rad(trajectory: JointTrajectory, reduced: JointTrajectory, time_s: Array) -> float:
    """Return the largest deviation of a joint at some times."""
    return float(np.abs(Interpolation(trajectory)(time_s).q_rad - Interpolation(reduced)(time_s).q_rad).max())


def reduced(paths: int, seed: int) -> dict[str, Any]:
    """Reduce the sine to 36 points, and random trajectories to few."""
    original, figures = sine(), {}
    rng = np.random.default_rng(seed)
    times = rng.uniform(0.0, original.duration_s, 100_000)
    kinds: tuple[Kind, Kind] = ("cubic", "linear")
    for kind in kinds:
        begin = time.process_time()
        best = reduce_points(original, 36, None, kind)
        figures[f"sine_36_points_{kind}"] = {
            "bound_mrad": 1e3 * best.deviation_rad,
            "deviation_mrad": 1e3 * deviation_rad(original, best.trajectory, times),
            "cpu_s": time.process_time() - begin,
        }
    figures["sine_points_for_1_mrad"] = len(reduce_points(original, 1000, 1e-3).trajectory)
    figures["sine_points_for_1_mrad_linear"] = len(reduce_points(original, 1000, 1e-3, "linear").trajectory)
    ratios = []
    for _ in range(paths):
        trajectory = random_trajectory(rng)
        found = reduce_points(trajectory, int(rng.integers(2, 12)), None, kinds[rng.integers(2)])
        at = rng.uniform(0.0, trajectory.duration_s, 300)
        ratios.append(deviation_rad(trajectory, found.trajectory, at) / max(found.deviation_rad, 1e-12))
    figures["random_paths"] = {
        "paths": paths,
        "exceeded": int((np.array(ratios) > 1.0).sum()),
        "largest_of_bound": float(np.max(ratios)),
        "median_of_bound": float(np.median(ratios)),
    }
    return figures


def main() -> None:
    """Run all scenes, print a table and write the figures."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--json", type=Path, help="write the figures here")
    parser.add_argument("--pairs", type=int, default=1000, help="pairs of configurations in each scene")
    parser.add_argument("--paths", type=int, default=10_000, help="random trajectories to reduce")
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
    reduction = reduced(arguments.paths, arguments.seed)
    for kind in ("cubic", "linear"):
        row = reduction[f"sine_36_points_{kind}"]
        print(f"sine of 10 s, 36 points, {kind}: {row['deviation_mrad']:.3f} mrad, bound {row['bound_mrad']:.3f} mrad")
    print(
        f"points for 1 mrad: {reduction['sine_points_for_1_mrad']} cubic, "
        f"{reduction['sine_points_for_1_mrad_linear']} linear"
    )
    print(
        "{paths} random trajectories: bound exceeded {exceeded} times, largest deviation {largest_of_bound:.4f} of "
        "its bound, median {median_of_bound:.3f}".format(**reduction["random_paths"])
    )
    if arguments.json:
        figures = {"scenes": scenes, "reduction": reduction, "load": load}
        arguments.json.write_text(json.dumps(figures, indent=2) + "\n")


if __name__ == "__main__":
    main()
