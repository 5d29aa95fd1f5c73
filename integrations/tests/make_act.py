"""Save an untrained ACT of this package: make_act.py FOLDER [CAMERA]."""

from __future__ import annotations

import runpy
import sys
from pathlib import Path

from dual_ur10.policies.learned import checkpoint

# By its path: LeRobot's requirements bring another package `tests`.
act_parts = runpy.run_path(str(Path(__file__).parents[2] / "tests/policies/learned/acts.py"))["act_parts"]


def main(folder: str, *cameras: str) -> None:
    """Save a checkpoint of Handover whose weights are random and whose chunks are joint positions."""
    images = {"observation": "both", "cameras": cameras, "width": 80, "height": 64} if cameras else {}
    checkpoint.save(folder, *act_parts("DualUR10/Handover-v0", **images))


if __name__ == "__main__":
    main(*sys.argv[1:])
