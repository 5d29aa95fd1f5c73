"""Measure how well `cell calibrate` finds the right base, on simulated cells.

Each cell has arms with kinematics of their own (1 mm and 1 mrad, one standard deviation per parameter), which the
estimator knows, as from the controllers, and a right base that stands up to 5 mm and 0.5° beside where the cell
file has it, tilted by 0.05° (one standard deviation about each axis). `touch`: the eight touches that `--suggest`
names, 0.1 mm of noise along each axis. `nominal`: the same data, read with the kinematics of the nominal arm.
`bar`: 40 random poses of a bar that sits in each hand up to 0.05 mm and 0.1 mrad. `suggested`: 20 of them, the first
four near each other, the others as `--suggest` names them one after the other. `board`: 20 views of a board on the
right flange by a camera on the left one, with 0.5 mm and 1 mrad. Coverage is the fraction of all components inside
their 95 % interval; `region` that of the poses inside the joint 95 % region. `carry`: internal force of a bar
welded to both grippers, on bases that are 5 mm and 0.5° off, before and after a calibration from eight touches, the
worst of several cells. No real arm is in this.

    python benchmarks/calibration.py --json calibration.json
"""

from __future__ import annotations

import os

os.environ.setdefault("OMP_NUM_THREADS", "1")  # before numpy reads it
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import argparse
import json
import math
import sys
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import stats

sys.path.insert(0, str(Path(__file__).parents[1]))  # simulated observations are those of the tests

from demo.carry import CARRY_ID, TASK
from demo.case import Case
from dual_ur10 import ArmMount, CellConfig
from dual_ur10.sim2real.calibration.estimate import BaseEstimate, estimate
from dual_ur10.sim2real.calibration.intervals import LEVEL
from dual_ur10.sim2real.calibration.observations import BarPose, Noise, Observation, Touch
from dual_ur10.sim2real.calibration.recording import touched
from dual_ur10.sim2real.calibration.suggestions import bar_candidates, best, plan, touch_candidates
from dual_ur10.sim2real.calibration.transforms import right_in_left, rotation_of, rotvec_of
from dual_ur10.sim2real.cell.perturbation import Perturbation
from tests.sim2real.calibration.simulated import bar_poses, board_views, held, random_dh
from ur_core.kinematics.ur10 import NOMINAL_DH, DHParameters

Array = NDArray[np.float64]
Arms = tuple[DHParameters, DHParameters]

CELLS = 1000
CARRIES = 20
TOUCHES, BAR_POSES, SUGGESTED, VIEWS = 8, 40, 20, 20
FIRST_POSES, FIRST_RAD = 4, 0.3
ROWS = ("touch", "nominal", "bar", "suggested", "board", "carry")
OFF_M, OFF_RAD = 0.005, math.radians(0.5)
TILT_RAD = math.radians(0.05)
TIP_M = (0.0, 0.0, 0.17)
NOMINAL: Arms = (NOMINAL_DH, NOMINAL_DH)


def drawn_base(near: Array, rng: np.random.Generator, tilt_rad: float = TILT_RAD) -> Array:
    """Return a right base (4, 4) that stands beside the place in the cell file."""
    direction = rng.normal(size=3)
    base = near.copy()
    base[:3, 3] += OFF_M * rng.uniform() ** (1 / 3) * direction / np.linalg.norm(direction)
    rotation = [*rng.normal(0.0, tilt_rad, 2), rng.uniform(-OFF_RAD, OFF_RAD)]
    base[:3, :3] = rotation_of(rotation) @ base[:3, :3]
    return base


def error_of(found: BaseEstimate, true: Array) -> Array:
    """Return the error of an estimate, (6,): m and rad."""
    error: Array = np.concatenate([found.position_m - true[:3, 3], rotvec_of(found.pose[:3, :3] @ true[:3, :3].T)])
    return error


def study(
    cells: int,
    seed: int,
    observe: Callable[[Arms, Array, np.random.Generator], Sequence[Observation]],
    near: Array,
    known: Arms | None = None,
) -> dict[str, Any]:
    """Return errors and coverage over many cells.

    Args:
        cells: Number of cells.
        seed: Of all of them.
        observe: Returns the observations of arms and a base.
        near: (4, 4) where the cell file has the right base.
        known: Kinematics that the estimator uses; None: those of the cell's arms.
    """
    errors, inside, regions, rejected, scales = [], [], [], 0, []
    for cell in range(cells):
        rng = np.random.default_rng((seed, cell))
        base, arms = drawn_base(near, rng), (random_dh(rng), random_dh(rng))
        found = estimate(observe(arms, base, rng), known or arms, near)
        error = error_of(found, base)
        errors.append((1e3 * np.linalg.norm(error[:3]), np.degrees(np.linalg.norm(error[3:]))))
        inside.append(np.abs(error) <= found.half_widths)
        limit = 6 * stats.f.ppf(LEVEL, 6, found.degrees_of_freedom)
        regions.append(error @ np.linalg.solve(found.covariance, error) <= limit)
        rejected += sum(each.rejected for each in found.residuals)
        scales.append(found.noise_scale)
    position, rotation = np.array(errors).T
    return {
        "cells": cells,
        "error_mm": {"median": float(np.median(position)), "p95": float(np.percentile(position, 95))},
        "error_deg": {"median": float(np.median(rotation)), "p95": float(np.percentile(rotation, 95))},
        "coverage_95": float(np.mean(inside)),
        "coverage_95_of_each": np.mean(inside, axis=0).tolist(),
        "coverage_95_region": float(np.mean(regions)),
        "noise_scale": float(np.median(scales)),
        "rejected": rejected,
    }


def squeeze_n(right: ArmMount, base_shift_m: Sequence[float], base_turn_rad: float) -> float:
    """Return the largest internal force along a welded bar."""
    off = Perturbation(
        base_shift_m=((0.0, 0.0, 0.0), tuple(base_shift_m)),  # type: ignore[arg-type]  # nested
        base_turn_rad=(0.0, base_turn_rad),
    )
    cell = CellConfig(right=right, perturbation=off)
    keywords = {"payload": "known", "duration_s": 30.0, "grasp": "rigid", "cell": cell}
    (found,) = TASK.measure(Case("", "", CARRY_ID, keywords), range(1))
    return found.figures["squeeze_max_n"]


def carry(count: int, touches: Sequence[Touch]) -> dict[str, Any]:
    """Return the internal force before and after calibrations of cells whose right base is 5 mm and 0.5° off."""
    left, right = CellConfig().left, CellConfig().right
    before, after = [], []
    for cell in range(count):
        rng = np.random.default_rng((3, cell))
        direction = rng.normal(size=3)
        shift, turn = OFF_M * direction / np.linalg.norm(direction), OFF_RAD * rng.choice([-1.0, 1.0])
        true = replace(
            right, position_m=tuple(np.add(right.position_m, shift).tolist()), yaw_rad=right.yaw_rad + float(turn)
        )
        base = right_in_left(left, true)
        observed = [touched(each, NOMINAL, base, Noise(), rng) for each in touches]
        found = estimate(observed, NOMINAL, right_in_left(left, right)).mount(left, NOMINAL_DH)
        before.append(squeeze_n(right, shift.tolist(), float(turn)))
        rest = np.subtract(true.position_m, found.position_m)
        after.append(squeeze_n(found, rest.tolist(), true.yaw_rad - found.yaw_rad))
    return {"cells": count, "squeeze_before_n": max(before), "calibrated_squeeze_n": max(after)}


def run(cells: int, carries: int, names: Sequence[str] = ROWS) -> dict[str, dict[str, Any]]:
    """Measure rows, and print each when it is done."""
    near = right_in_left(CellConfig().left, CellConfig().right)
    series = plan(TOUCHES, touch_candidates(NOMINAL, near, (TIP_M, TIP_M)), NOMINAL, near)
    touches = [each.observation for each in series if isinstance(each.observation, Touch)]
    noise = Noise()

    def touch(arms: Arms, base: Array, rng: np.random.Generator) -> list[Observation]:
        return [touched(each, arms, base, noise, rng) for each in touches]

    def bar(arms: Arms, base: Array, rng: np.random.Generator) -> list[Observation]:
        return [*bar_poses(BAR_POSES, arms, base, noise, rng)]

    def suggested(arms: Arms, base: Array, rng: np.random.Generator) -> list[Observation]:
        poses = [*bar_poses(FIRST_POSES, arms, base, noise, rng, FIRST_RAD)]
        while len(poses) < SUGGESTED:
            found = estimate(poses, arms, near)
            following = best(bar_candidates(arms, found, poses), arms, near, noise, estimate=found).observation
            if isinstance(following, BarPose):
                poses.append(held(following, arms, base, noise, rng))
        return [*poses]

    def board(arms: Arms, base: Array, rng: np.random.Generator) -> list[Observation]:
        return [*board_views(VIEWS, arms, base, noise, rng)]

    some = max(cells // 5, 1)
    rows: dict[str, dict[str, Any]] = {}
    for name, row in (
        ("touch", lambda: study(cells, 0, touch, near)),
        ("nominal", lambda: study(some, 0, touch, near, NOMINAL)),
        ("bar", lambda: study(some, 1, bar, near)),
        ("suggested", lambda: study(some, 1, suggested, near)),
        ("board", lambda: study(some, 2, board, near)),
    ):
        if name not in names:
            continue
        rows[name] = found = row()
        mm, deg = found["error_mm"], found["error_deg"]
        print(
            f"{name:9} {found['cells']:5} cells: median {mm['median']:.3f} mm {deg['median']:.4f}°, p95 "
            f"{mm['p95']:.3f} mm {deg['p95']:.4f}°; 95 % intervals cover {100 * found['coverage_95']:.1f} %, regions "
            f"{100 * found['coverage_95_region']:.1f} %; noise {found['noise_scale']:.2f} times the stated one, "
            f"{found['rejected']} observations rejected",
            flush=True,
        )
    if "carry" not in names:
        return rows
    rows["carry"] = found = carry(carries, touches)
    print(
        f"carry, welded, worst of {carries} cells: internal force {found['squeeze_before_n']:.1f} N before, "
        f"{found['calibrated_squeeze_n']:.1f} N after"
    )
    return rows


def main() -> None:
    """Run everything and write the figures."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--json", type=Path, help="write the figures here")
    parser.add_argument("--cells", type=int, default=CELLS, help="cells of touches; a fifth of them for the other rows")
    parser.add_argument("--carries", type=int, default=CARRIES)
    parser.add_argument("--rows", nargs="+", choices=ROWS, default=ROWS)
    arguments = parser.parse_args()
    rows = run(arguments.cells, arguments.carries, arguments.rows)
    print(f"load {os.getloadavg()[0]:.2f}, {os.cpu_count()} processors")
    if arguments.json:
        figures: dict[str, Any] = dict(rows)
        if "touch" in rows:
            figures["base_error_mm"] = rows["touch"]["error_mm"]["median"]
            figures["base_error_deg"] = rows["touch"]["error_deg"]["median"]
            figures["coverage_95"] = rows["touch"]["coverage_95"]
        if "carry" in rows:
            figures["calibrated_squeeze_n"] = rows["carry"]["calibrated_squeeze_n"]
        arguments.json.write_text(json.dumps(figures, indent=2) + "\n")


if __name__ == "__main__":
    main()
