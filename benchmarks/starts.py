"""Starts of a rollout on an emulated cell while other programs fill the machine.

    python benchmarks/starts.py [--starts 50] [--busy CORES] [--family cb3] [--json FILE]

Each start is the command `rollout`, as a user types it: a process of its own, the check of both controllers, the way to
the start of the task, and a second of SineTracking. It counts as good if it ends without a latched stop. All others are
listed by their text. `--busy` simulations like those of a training run beside it; the load of the machine is printed.
"""

import argparse
import collections
import contextlib
import json
import os
import pathlib
import re
import subprocess
import sys
import tempfile
import time

from runner import ready, training

from dual_ur10.kinematics.ur10 import TICK_S
from dual_ur10.sim2real.config.cell_file import load_cell_file
from dual_ur10.sim2real.runtime.latch import Latch
from ur_emulator.emulated_cell import EmulatedCell

COMMAND = (sys.executable, "-m", "dual_ur10", "rollout", "SineTracking", "-n", "1", "--no-record")
SECONDS = 1.0  # of the task
LIMIT_S = 180.0
NUMBER = re.compile(r"\d+(\.\d+)?")


def start(path, seed):
    """Start one rollout, and return its exit code, its text and its seconds."""
    begin = time.monotonic()
    arguments = ("--cell", str(path), "--seed", str(seed), "--set", f"duration_s={SECONDS}")
    found = subprocess.run([*COMMAND, *arguments], capture_output=True, text=True, timeout=LIMIT_S, check=False)
    error = next((line for line in found.stderr.splitlines() if line.startswith("error: ")), "")
    late = re.search(r"(\d+) late action", found.stdout)
    return {
        "code": found.returncode,
        "text": error.removeprefix("error: "),
        "late_actions": int(late.group(1)) if late else 0,
        "printed": [line for line in found.stderr.splitlines() if "RTDEControlInterface" in line],
        "seconds": time.monotonic() - begin,
    }


def starts(path, cell, count):
    """Start `count` rollouts."""
    rows, latch = [], Latch(load_cell_file(path))
    for number in range(count):
        ready(cell)
        lost_s, load = cell.ask("info")["lost_s"], os.getloadavg()[0]
        row = start(path, number)
        fault = latch.read()
        row |= {
            "latched": "" if fault is None else fault.text,
            "emulator_stalled_s": cell.ask("info")["lost_s"] - lost_s,
            "load": load,
        }
        latch.clear()
        rows.append(row)
        print(f"{number + 1:3} code {row['code']} {row['seconds']:5.1f} s, load {load:.1f} {row['text']}", flush=True)
    return rows


def figures_of(rows):
    """Return the figures of all starts, and how often each text came, numbers aside."""
    texts = collections.Counter(NUMBER.sub("N", row["latched"] or row["text"]) for row in rows if row["code"])
    return {
        "starts": len(rows),
        "without_latched_stop": sum(not row["latched"] for row in rows),
        "begun": sum(row["code"] == 0 for row in rows),
        "late_actions": sum(row["late_actions"] for row in rows),
        "printed_by_ur_rtde": sum(len(row["printed"]) for row in rows),
        "load_mean": sum(row["load"] for row in rows) / len(rows),
        "load_max": max(row["load"] for row in rows),
        "emulator_stalled_s": sum(row["emulator_stalled_s"] for row in rows),
        "texts": dict(texts.most_common()),
    }


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--starts", type=int, default=50)
    parser.add_argument("--busy", type=int, default=os.cpu_count() or 1, help="simulations that run beside it")
    parser.add_argument("--family", choices=tuple(TICK_S), default="cb3", help="of both controllers")
    parser.add_argument("--json", type=pathlib.Path)
    args = parser.parse_args()
    with tempfile.TemporaryDirectory() as name, contextlib.ExitStack() as stack:
        os.environ["XDG_STATE_HOME"] = name
        path = pathlib.Path(name) / "starts.toml"
        cell = stack.enter_context(EmulatedCell(task="SineTracking", cell=str(path), family=args.family))
        for arm in ("left", "right"):
            cell.wait_until(arm, "robot_mode", 7)
        stack.enter_context(training(args.busy))
        rows = starts(path, cell, args.starts)
    figures = figures_of(rows)
    for key, value in figures.items():
        print(f"{key:22} {value:.4g}" if isinstance(value, float) else f"{key:22} {value}")
    if args.json:
        args.json.parent.mkdir(parents=True, exist_ok=True)
        args.json.write_text(json.dumps({**figures, "busy": args.busy, "family": args.family, "rows": rows}, indent=1))


if __name__ == "__main__":
    main()
