"""Processor time of an emulated cell, lateness of its control periods, and lost or repeated servoj targets.

    python benchmarks/emulator.py [--family cb3] [--seconds 20] [--json FILE]

Two controllers, one `ur_rtde` client each (control and receive interface) in one process, which streams servoJ to both.
"""

import argparse
import json
import os
import pathlib
import subprocess
import sys
import time

import numpy as np
import psutil

from dual_ur10.emulated.emulated_cell import EmulatedCell
from ur_core.kinematics.ur10 import TICK_S

ROOT = pathlib.Path(__file__).parents[1]

CLIENT = """
import gc, json, math, sys, time
from rtde_control import RTDEControlInterface
from rtde_receive import RTDEReceiveInterface
hosts, period, seconds = json.loads(sys.argv[1])
receive = [RTDEReceiveInterface(host) for host in hosts]
control = [RTDEControlInterface(host) for host in hosts]
home = [each.getActualQ() for each in receive]
gc.disable()
sent = [[], []]
due = time.monotonic()
late = 0
for k in range(round(seconds / period)):
    swing = 0.05 * (1 - math.cos(2 * math.pi * k * period / 2.0))
    for arm in range(2):
        q = [value + swing for value in home[arm]]
        q[5] += 1e-9 * k
        control[arm].servoJ(q, 0.0, 0.0, period, 0.05, 800)
        sent[arm].append(q)
    due += period
    left = due - time.monotonic()
    late += left < 0
    time.sleep(max(0.0, left))
time.sleep(0.5)
for each in control:
    each.servoStop()
    each.stopScript()
print("RESULT " + json.dumps({"sent": sent, "late": late}), flush=True)
import os
os._exit(0)
"""


def stream(cell: EmulatedCell, tick_s: float, seconds: float) -> dict[str, float]:
    """Stream to both arms and count the executed targets."""
    emulator = psutil.Process(cell.process.pid)
    arguments = json.dumps([[cell.left, cell.right], tick_s, seconds])
    client = subprocess.Popen([sys.executable, "-c", CLIENT, arguments], stdout=subprocess.PIPE, text=True)
    time.sleep(1.5)  # connected, and streaming
    before, begin = emulator.cpu_times(), time.monotonic()
    time.sleep(max(1.0, seconds - 2.0))
    after, end = emulator.cpu_times(), time.monotonic()
    output, _ = client.communicate(timeout=60)
    result = json.loads(output.strip().splitlines()[-1].removeprefix("RESULT "))
    counts = {"sent": 0, "overwritten": 0, "repeated": 0, "out_of_order": 0}
    for arm, sent in zip(("left", "right"), result["sent"], strict=True):
        number = {tuple(q): k for k, q in enumerate(sent)}
        executed = [number[tuple(each[1])] for each in cell.setpoints(arm)]
        counts["sent"] += len(sent)
        counts["overwritten"] += len(sent) - len(set(executed))
        steps = np.diff(executed[: executed.index(len(sent) - 1) + 1] if len(sent) - 1 in executed else executed)
        counts["repeated"] += int((steps == 0).sum())
        counts["out_of_order"] += int((steps < 0).sum())
    used = after.user + after.system - before.user - before.system
    return {"cpu": used / (end - begin), "client_late": result["late"], **counts}


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--family", default="cb3", choices=sorted(TICK_S))
    parser.add_argument("--task", default="SineTracking")
    parser.add_argument("--seconds", type=float, default=20.0)
    parser.add_argument("--json", type=pathlib.Path)
    args = parser.parse_args()
    tick_s = TICK_S[args.family]
    load = os.getloadavg()[0]
    begin = time.monotonic()
    with EmulatedCell(family=args.family, task=args.task, plant="nominal") as cell:
        for arm in ("left", "right"):
            cell.wait_until(arm, "robot_mode", 7)
        start_s = time.monotonic() - begin
        idle = psutil.Process(cell.process.pid)
        used, since = sum(idle.cpu_times()[:2]), time.monotonic()
        time.sleep(2.0)
        idle_cpu = (sum(idle.cpu_times()[:2]) - used) / (time.monotonic() - since)
        figures = stream(cell, tick_s, args.seconds)
        info = cell.ask("info")
    figures = {
        "family": args.family,
        "task": args.task,
        "start_s": start_s,
        "idle_cpu": idle_cpu,
        **figures,
        "lost": (figures["overwritten"] + figures["repeated"]) / figures["sent"],
        "lateness_p50_ms": 1e3 * info["lateness_p50_s"],
        "lateness_p99_ms": 1e3 * info["lateness_p99_s"],
        "lateness_max_ms": 1e3 * info["lateness_max_s"],
        "load": load,
    }
    for name, value in figures.items():
        print(f"{name:18} {value:.4g}" if isinstance(value, float) else f"{name:18} {value}")
    if args.json:
        args.json.parent.mkdir(parents=True, exist_ok=True)
        args.json.write_text(json.dumps(figures, indent=1))


if __name__ == "__main__":
    main()
