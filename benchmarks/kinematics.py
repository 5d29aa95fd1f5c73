"""Measure inverse kinematics: success, accuracy and CPU time, on one core.

Random reachable poses are the forward kinematics of uniform random joints, once over the whole joint range (±2 pi,
elbow ±pi) and once over ±pi. An independent product of DH matrices judges every answer: solved means within 1e-5 m and
1e-5 rad of its pose and inside the joint range. The reference of each is a random configuration, not the one it came
from.
"""

from __future__ import annotations

import os

os.environ["OMP_NUM_THREADS"] = "1"  # before numpy reads it
os.environ["OPENBLAS_NUM_THREADS"] = "1"

import argparse
import json
import time
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ur_core import kinematics
from ur_core.kinematics.robots import ROBOTS
from ur_core.kinematics.ur10 import JOINT_RANGE_RAD, NOMINAL_DH, DHParameters, nominal_dh

Array = NDArray[np.float64]

BATCH = 1000
SINGLES = 2000
TOLERANCE = 1e-5  # m and rad


def independent_pose(q: Array, dh: DHParameters = NOMINAL_DH) -> tuple[Array, Array]:
    """Return positions (n, 3) and rotations (n, 3, 3) by the textbook product of DH matrices."""
    pose = np.tile(np.eye(4), (len(q), 1, 1))
    for joint in range(6):
        cos, sin = np.cos(q[:, joint]), np.sin(q[:, joint])
        cos_a, sin_a = np.cos(dh.alpha_rad[joint]), np.sin(dh.alpha_rad[joint])
        link = np.zeros((len(q), 4, 4))
        link[:, 0] = np.stack([cos, -sin * cos_a, sin * sin_a, dh.a_m[joint] * cos], -1)
        link[:, 1] = np.stack([sin, cos * cos_a, -cos * sin_a, dh.a_m[joint] * sin], -1)
        link[:, 2] = [0.0, sin_a, cos_a, dh.d_m[joint]]
        link[:, 3, 3] = 1.0
        pose = pose @ link
    return pose[:, :3, 3], pose[:, :3, :3]


def judge(limit: Array, poses: int, seed: int, dh: DHParameters) -> dict[str, float]:
    """Solve random poses in batches and one at a time; return success, worst errors and CPU time."""
    rng = np.random.default_rng(seed)
    q = rng.uniform(-limit, limit, (poses, 6))
    reference = rng.uniform(-limit, limit, (poses, 6))
    position, rotation = independent_pose(q, dh)
    kinematics.try_nearest(position[:BATCH], rotation[:BATCH], reference[:BATCH], dh)  # warm up

    found, ok = np.empty_like(q), np.empty(poses, dtype=np.bool_)
    batches = []
    for first in range(0, poses, BATCH):
        part = slice(first, first + BATCH)
        start = time.process_time()
        found[part], ok[part] = kinematics.try_nearest(position[part], rotation[part], reference[part], dh)
        batches.append((time.process_time() - start) / len(q[part]))
    blocks = []
    for first in range(0, min(SINGLES, poses), 200):
        rows = range(first, min(first + 200, poses))
        start = time.process_time()
        for row in rows:
            kinematics.try_nearest(position[row], rotation[row], reference[row], dh)
        blocks.append((time.process_time() - start) / len(rows))

    reached, orientation = independent_pose(found, dh)
    position_error = np.linalg.norm(reached - position, axis=-1)
    # Norm of R1 - R2 is 2 sqrt(2) sin(angle / 2).
    rotation_error = 2 * np.arcsin(np.minimum(np.linalg.norm(orientation - rotation, axis=(1, 2)) / np.sqrt(8), 1.0))
    inside = (np.abs(found) <= JOINT_RANGE_RAD).all(-1)
    solved = ok & inside & (position_error < TOLERANCE) & (rotation_error < TOLERANCE)
    return {
        "success": float(solved.mean()),
        "worst_position_m": float(position_error.max()),
        "worst_rotation_rad": float(rotation_error.max()),
        "us_per_pose_batch": 1e6 * float(np.median(batches)),
        "us_per_pose_single": 1e6 * float(np.median(blocks)),
    }


def main() -> None:
    """Run both ranges, print a table and write the figures."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--json", type=Path, help="write the figures here")
    parser.add_argument("--poses", type=int, default=20_000, help="random poses in each range")
    parser.add_argument("--seed", type=int, default=12345)
    parser.add_argument("--robot", choices=(*ROBOTS, "all"), default="ur10", help="model of the arm")
    arguments = parser.parse_args()

    load = os.getloadavg()
    names = tuple(ROBOTS) if arguments.robot == "all" else (arguments.robot,)
    ranges = {}
    for name in names:
        prefix, dh = "" if len(names) == 1 else f"{name} ", nominal_dh(name)
        ranges[f"{prefix}±2 pi"] = judge(JOINT_RANGE_RAD, arguments.poses, arguments.seed, dh)
        ranges[f"{prefix}±pi"] = judge(np.full(6, np.pi), arguments.poses, arguments.seed + 1, dh)
    print(
        f"inverse kinematics, nearest of all branches and rotations; {arguments.poses} poses each; load {load[0]:.2f}"
    )
    print(f"{'range':14}{'solved':>10}{'worst m':>11}{'worst rad':>11}{'us, batch':>11}{'us, single':>12}")
    for name, row in ranges.items():
        print(
            f"{name:14}{row['success']:10.3%}{row['worst_position_m']:11.1e}{row['worst_rotation_rad']:11.1e}"
            f"{row['us_per_pose_batch']:11.2f}{row['us_per_pose_single']:12.1f}"
        )
    if arguments.json:
        rows = list(ranges.values())
        figures = {
            "success": float(np.mean([row["success"] for row in rows])),
            "us_per_pose_batch": max(row["us_per_pose_batch"] for row in rows),
            "us_per_pose_single": max(row["us_per_pose_single"] for row in rows),
            "poses": arguments.poses,
            "batch": BATCH,
            "ranges": ranges,
            "load": load,
        }
        arguments.json.write_text(json.dumps(figures, indent=2) + "\n")


if __name__ == "__main__":
    main()
