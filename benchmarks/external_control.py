"""External control of both arms as UR's client library does it: counts of set-points, and share of a core.

    python benchmarks/external_control.py [--script FILE] [--family e-series] [--seconds 20] [--json FILE]

FILE is your own copy of `resources/external_control.urscript`, the program that the Universal Robots Client Library
uploads. Without it, the program of this project's tests runs. A driver in this process uploads it to both emulated
controllers, streams a target of `servoj` in every control period, receives their state by RTDE as often, and then
sends a spline of ten points.
"""

import argparse
import contextlib
import json
import math
import os
import pathlib
import socket
import sys
import time

import numpy as np
import psutil

ROOT = pathlib.Path(__file__).parents[1]
sys.path.insert(0, str(ROOT / "packages" / "ur-emulator"))  # the driver is that of its tests

from dual_ur10.emulated.emulated_cell import EmulatedCell
from tests.ur_emulator.external_control import SCALE, Driver, Mode, Result
from ur_core.kinematics.ur10 import ARMS, TICK_S
from ur_core.links.rtde_link import RtdeLink
from ur_core.processes.system import LOCAL
from ur_core.protocol.modes import RuntimeState
from ur_emulator.profile import profile_of

OWN = ROOT / "packages" / "ur-emulator" / "tests" / "ur_emulator" / "external_control.urscript"
POINTS, SEGMENT_S, STEP_RAD = 10, 0.5, -0.02  # away from the table
STATE = (
    "timestamp",
    "actual_q",
    "actual_qd",
    "actual_current",
    "actual_TCP_pose",
    "actual_TCP_speed",
    "actual_TCP_force",
)
STATE += ("target_speed_fraction", "speed_scaling", "runtime_state", "robot_mode", "safety_mode", "robot_status_bits")
PORTS = {"reverse": 50001, "trajectory": 50003, "command": 50004}


class Arm:
    """One arm with its driver.

    Args:
        cell: Emulated cell.
        name: "left" or "right".
        text: Program template.
        family: Family of the controller.
    """

    def __init__(self, cell: EmulatedCell, name: str, text: str, family: str) -> None:
        self.cell, self.name = cell, name
        host = getattr(cell, name)
        self.driver = Driver(LOCAL, host, PORTS)
        self.driver.timeout_s = 1.0
        self.sent: list[list[float]] = []
        with socket.create_connection((host, 30001)) as client:
            client.sendall(b"stop program\n" + self.driver.script(text, profile_of(family).version).encode())
            deadline = time.monotonic() + 20.0
            while not self.driver.connected:
                self.driver.serve()
                client.settimeout(0.01)
                with contextlib.suppress(TimeoutError):
                    client.recv(4096)
                if time.monotonic() > deadline:
                    raise SystemExit(f"{name}: the program did not connect; its log: {cell.log_tail()}")
        self.start = self.q()
        self.state = RtdeLink(host, STATE)

    def q(self) -> np.ndarray:
        """Return the joint positions."""
        return np.array(self.cell.ask("state", arm=self.name, names=["actual_q"])["actual_q"])


def paced(period_s: float, count: int):
    """Yield numbers in time with the control periods, and count those that came late."""
    due, late = time.monotonic(), 0
    for k in range(count):
        yield k, late
        due += period_s
        left = due - time.monotonic()
        late += left < 0
        time.sleep(max(0.0, left))


def servo(arms: list[Arm], tick_s: float, seconds: float) -> dict[str, float]:
    """Stream to both arms, and count what was executed."""
    processes = [psutil.Process(arms[0].cell.process.pid), psutil.Process()]
    before, begin, late = [sum(each.cpu_times()[:2]) for each in processes], time.monotonic(), 0
    for k, late in paced(tick_s, round(seconds / tick_s)):  # noqa: B007  # the last one counts
        swing = 0.02 * (1 - math.cos(0.5 * math.pi * k * tick_s))
        for arm in arms:
            q = arm.start + swing
            q[5] += 1e-6 * k  # tells the set-points apart
            arm.sent.append(np.round(q * SCALE).astype(int).tolist())
            arm.driver.write(Mode.SERVOJ, q)
            arm.state.poll()
    end = time.monotonic()
    for arm in arms:
        arm.driver.timeout_s = 20.0  # counting takes a while
        arm.driver.write(Mode.IDLE)
        if arm.cell.ask("state", arm=arm.name, names=["runtime_state"])["runtime_state"] != RuntimeState.PLAYING:
            raise SystemExit(f"{arm.name}: the program does not play any more; log: {arm.cell.log_tail()}")
    used = [sum(each.cpu_times()[:2]) - first for each, first in zip(processes, before, strict=True)]
    counts = {"sent": 0, "executed": 0, "extrapolated": 0, "out_of_order": 0}
    for arm in arms:
        number = {tuple(q): k for k, q in enumerate(arm.sent)}
        executed = [
            number.get(tuple(np.round(np.array(each[1]) * SCALE).astype(int))) for each in arm.cell.setpoints(arm.name)
        ]
        known = [each for each in executed if each is not None]
        counts["sent"] += len(arm.sent)
        counts["executed"] += len(set(known))
        counts["extrapolated"] += len(executed) - len(known)
        counts["out_of_order"] += int((np.diff(known) < 0).sum())
    return {
        **counts,
        "late_sends": late,
        "emulator_cpu": used[0] / (end - begin),
        "driver_cpu": used[1] / (end - begin),
    }


def spline(arms: list[Arm], tick_s: float) -> dict[str, float | str]:
    """Run a spline on both arms."""
    time.sleep(0.5)
    starts = [arm.q() for arm in arms]
    results: list[Result | None] = [None] * len(arms)
    for arm, start in zip(arms, starts, strict=True):
        arm.driver.start(POINTS)
        for k in range(1, POINTS + 1):
            arm.driver.spline(start + STEP_RAD * k, [STEP_RAD / SEGMENT_S * (k < POINTS)] * 6, SEGMENT_S)
    begin, used = time.monotonic(), psutil.Process(arms[0].cell.process.pid)
    before = sum(used.cpu_times()[:2])
    for _ in paced(0.02, 2000):
        for number, arm in enumerate(arms):
            if results[number] is None:
                arm.driver.keep_alive()
                arm.state.poll()
                results[number] = arm.driver.result()
        if None not in results:
            break
    lasted, cpu = time.monotonic() - begin, sum(used.cpu_times()[:2]) - before
    time.sleep(0.3)
    away = max(
        float(np.abs(arm.q() - start - STEP_RAD * POINTS).max()) for arm, start in zip(arms, starts, strict=True)
    )
    return {
        "spline_results": " ".join("none" if each is None else each.name for each in results),
        "spline_s": lasted,
        "spline_end_error_rad": away,
        "spline_cpu": cpu / lasted,
    }


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--script", type=pathlib.Path, default=OWN)
    parser.add_argument("--family", default="e-series", choices=sorted(TICK_S))
    parser.add_argument("--seconds", type=float, default=20.0)
    parser.add_argument("--json", type=pathlib.Path)
    args = parser.parse_args()
    tick_s, load = TICK_S[args.family], os.getloadavg()[0]
    with EmulatedCell(family=args.family, plant="nominal") as cell:
        for arm in ARMS:
            cell.wait_until(arm, "robot_mode", 7)
        arms = [Arm(cell, name, args.script.read_text(), args.family) for name in ARMS]
        LOCAL.dedicate(sends=True)
        figures = {"family": args.family, **servo(arms, tick_s, args.seconds), **spline(arms, tick_s)}
        for each in arms:
            each.driver.write(Mode.STOPPED)
            each.driver.close()
        info = cell.ask("info")
        log = cell.log_tail()
    figures |= {f"lateness_{name}_ms": 1e3 * info[f"lateness_{name}_s"] for name in ("p50", "p99", "max")}
    figures["load"] = load
    for name, value in figures.items():
        print(f"{name:22} {value:.4g}" if isinstance(value, float) else f"{name:22} {value}")
    print(log, end="")
    if args.json:
        args.json.parent.mkdir(parents=True, exist_ok=True)
        args.json.write_text(json.dumps(figures, indent=1))


if __name__ == "__main__":
    main()
