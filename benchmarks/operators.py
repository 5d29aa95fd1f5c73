"""Operators: from an input to motion, takeovers, and tasks that synthetic persons finish through devices alone.

python benchmarks/operators.py [--episodes 20] [--devices spacemouse,leader] [--takeovers 1000] [--json FILE]

Persons act by the reports of their devices: SpaceMice as raw reports in a pipe, leader arms as chains of servos on
pseudo terminals, the handles of a page in its shared memory. Tasks run in simulation. Times are those of a virtual
cell, by the clock of its controllers. The cost of the page is that of live_page.py, on an emulated cell in real time.
"""

from __future__ import annotations

import os

for name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"):
    os.environ.setdefault(name, "1")

import argparse
import json
import sys
import tempfile
from pathlib import Path
from typing import Any

import numpy as np
import pytest

sys.path.insert(0, str(Path(__file__).parent.parent))

import live_page

from dual_ur10.policies.operators import leader
from tests.policies.operators.persons import PERSONS, successes
from tests.virtual import test_takeover
from tests.virtual.test_operator import Rig, input_to_motion_s

CELLS = 10
TASKS = {"handover": "Handover", "carry": "SyncCarry"}
INPUTS = 10


def input_to_motion_ms(family: str) -> float:
    """Return the 99th percentile of the time from an input, at any instant, to the first motion, at 125 Hz."""
    with tempfile.TemporaryDirectory() as folder, pytest.MonkeyPatch.context() as patch:
        rig = Rig(Path(folder), patch, family=family)
        waits = input_to_motion_s(rig, INPUTS)
        rig.close()
    instants = np.linspace(0.0, 0.008, 100)  # between two readings
    return float(1e3 * np.quantile(waits[:, None] + instants, 0.99))


def takeovers(count: int) -> dict[str, float]:
    """Return the figures of takeovers and hand-backs at random instants on virtual cells, at 125 Hz."""
    above, off_mm, delays_ms = 0, 0.0, []
    for seed in range(CELLS):
        with pytest.MonkeyPatch.context() as patch:
            found = test_takeover.takeovers(patch, count // CELLS, seed)
        above, off_mm, delays_ms = above + found[0], max(off_mm, found[1]), [*delays_ms, *found[2]]
        print(f"{(seed + 1) * (count // CELLS)} takeovers: {above} above a cap, {off_mm:.2f} mm off", flush=True)
    return {
        "takeovers": CELLS * (count // CELLS),
        "takeover_above_caps": above,
        "takeover_off_path_mm": round(float(off_mm), 2),
        "takeover_delay_ms_most": round(float(max(delays_ms)), 1),
        "takeover_delays": len(delays_ms),
    }


def finished(device: str, episodes: int) -> dict[str, list[int]]:
    """Return the numbers of successes and of episodes of each task."""
    found = {}
    for name, task in TASKS.items():
        with tempfile.TemporaryDirectory() as folder:
            found[name] = [int(successes(device, task, range(episodes), Path(folder))), episodes]
        print(f"{device}, {name}: {found[name][0]} of {episodes}", flush=True)
    return found


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--episodes", type=int, default=20)
    parser.add_argument("--devices", default=",".join(PERSONS))
    parser.add_argument("--takeovers", type=int, default=1000, help="a multiple of 10; 0: none")
    parser.add_argument("--stretches", type=int, default=6, help="stretches of 10 s with a page; 0: no page")
    parser.add_argument("--json", type=Path, help="write the figures to this file")
    arguments = parser.parse_args()
    leader._WAIT_S = 0.2  # the emulated servos answer from a thread of this process
    figures: dict[str, Any] = {}
    for key, family in (("input_to_motion_ms_p99", "e-series"), ("input_to_motion_cb3_ms_p99", "cb3")):
        figures[key] = round(input_to_motion_ms(family), 1)
        print(f"{family}: input to motion, 99th percentile {figures[key]} ms", flush=True)
    if arguments.takeovers:
        figures |= takeovers(arguments.takeovers)
    figures["devices"] = {each: finished(each, arguments.episodes) for each in arguments.devices.split(",")}
    if arguments.stretches:
        figures |= live_page.figures_of(10.0, arguments.stretches)
        print(f"page_late_extra {figures['page_late_extra']}", flush=True)
    if arguments.json:
        arguments.json.write_text(json.dumps(figures, indent=2) + "\n")


if __name__ == "__main__":
    main()
