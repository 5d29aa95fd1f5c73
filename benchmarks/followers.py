"""Measure the accuracy of followers of one path: targets at 125 Hz, points at 10 and 5 Hz, and fixed-time `movej`.

Both flanges swing along y of their bases by 0.1 m at 0.5 Hz, from rest to rest. 125 Hz: the runner sends each target.
10 and 5 Hz: points with speeds, between which each controller interpolates cubics. `movej`: at 2 Hz each controller
moves to a point and rests there. Errors are distances of each flange, by its measured joints and the controller's own
kinematics, from the path at the sender's time; one delay, the same for both arms and the whole run, is fitted. `skew`
is the difference of both arms' times on the path at one instant. The default is a virtual cell with the nominal plant:
its figures are exact, and an artefact of an exact model. No real arm is in this.

    python benchmarks/followers.py --json followers.json
    python benchmarks/followers.py --cell emulated --plant mild
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
from scipy.interpolate import make_interp_spline
from scipy.optimize import minimize_scalar

from dual_ur10.kinematics.forward import flange_pose
from dual_ur10.kinematics.inverse import nearest
from dual_ur10.sim2real.control.link_profiles import profile_for
from dual_ur10.sim2real.links.rtde_link import RtdeLink
from dual_ur10.sim2real.runtime.point_stream import PointStream
from dual_ur10.sim2real.runtime.runner import Runner
from dual_ur10.sim2real.trajectory.point_path import PointPath

AMPLITUDE_M, FREQUENCY_HZ, DURATION_S, RAMP_S = 0.1, 0.5, 12.0, 2.0
REST_S = 1.0  # of the observation, before and after
ROWS = {"125hz": 125.0, "10hz": 10.0, "5hz": 5.0, "movej": 2.0}
OF_OTHERS = ("calibrated_squeeze_n", "base_error_mm", "base_error_deg", "coverage_95", "repeatability_mm")
"""Figures that other benchmarks measure: `merged` adds them."""


class Sine:
    """The path: joint positions, speeds and accelerations at any time.

    Args:
        q_rad: (2, 6) joint positions at its begin and end.
    """

    def __init__(self, q_rad: Any) -> None:
        times = np.arange(round(DURATION_S / 0.004) + 1) * 0.004
        s = np.clip(np.minimum(times, DURATION_S - times) / RAMP_S, 0.0, 1.0)
        swing = AMPLITUDE_M * s**3 * (10 + s * (6 * s - 15)) * np.sin(2 * np.pi * FREQUENCY_HZ * times)
        joints = []
        for q in q_rad:
            position, rotation = flange_pose(q)
            wanted = position + swing[:, None] * np.array([0.0, 1.0, 0.0])
            joints.append(nearest(wanted, np.broadcast_to(rotation, (len(times), 3, 3)), np.tile(q, (len(times), 1))))
        self._curve = make_interp_spline(times, np.stack(joints, axis=1), k=5)

    def __call__(self, time_s: Any, derivative: int = 0) -> Any:
        """Return values (n, 2, 6) at times; the path rests before and after."""
        time_s = np.asarray(time_s)
        inside = np.clip(time_s, 0.0, DURATION_S)
        rests = (time_s != inside)[:, None, None]
        return np.where(rests & (derivative > 0), 0.0, self._curve(inside, derivative))

    def targets(self, servoj: Any) -> Any:
        """Return the targets of each control period, which lead by the lag of the law."""
        ticks = round((DURATION_S + 0.2) / servoj.tick_s)
        times = (np.arange(-1, ticks) + 0.5) * servoj.tick_s
        return self(times) + servoj.lookahead_s * self(times, 1) + self(times, 2) / servoj.gain


class Observer:
    """Reader of the measured joints of both arms, in a thread."""

    def __init__(self, file: Any, system: Any) -> None:
        self._clock, self._ended = system.clock, False
        self._links = [RtdeLink(arm.host, ("actual_q",), system=system) for arm in file.arms]
        self.samples: list[list[tuple[float, Any]]] = [[], []]
        self._offset = [0.0, 0.0]
        self._thread = system.thread(self._read, "observer")

    def _read(self) -> None:
        while not self._ended:
            for link, samples in zip(self._links, self.samples, strict=True):
                samples += [(each.arrival_s, each.timestamp_s, each.values["actual_q"]) for each in link.poll()]
            self._clock.wait([link.fileno() for link in self._links], self._clock.now_s() + 0.05)

    def end(self) -> list[tuple[Any, Any]]:
        """Return times on this program's clock and joints, (n,) and (n, 6), of each arm.

        A controller's own time is put on the clock by its earliest arrival: late arrivals are this machine's.
        """
        self._ended = True
        self._thread.join(1.0)
        found = []
        for link, samples in zip(self._links, self.samples, strict=True):
            link.close()
            arrival, own = (np.array([each[k] for each in samples]) for k in (0, 1))
            found.append((own + (arrival - own).min(), np.array([each[2] for each in samples])))
        return found


def figures(seen: list[tuple[Any, Any]], path: Sine, rate: float) -> dict[str, float]:
    """Return the errors of both flanges, and the skew of both arms.

    Args:
        seen: Times and joints of each arm.
        path: The path.
        rate: Rate of the path's time on this program's clock.
    """

    def errors(begin_s: float) -> Any:
        away = []
        for arm, (time_s, q) in enumerate(seen):
            wanted = path(rate * (time_s - begin_s))[:, arm]
            away.append(np.linalg.norm(flange_pose(q)[0] - flange_pose(wanted)[0], axis=-1))
        return np.concatenate(away)

    moved = np.abs(seen[0][1] - seen[0][1][0]).max(axis=1) > 1e-3
    about_s = float(seen[0][0][moved.argmax()]) - 0.3
    coarse = min(np.arange(about_s - 1.5, about_s + 1.5, 0.02), key=lambda each: float((errors(each) ** 2).mean()))
    squares, near = (lambda each: float((1e3 * errors(each) ** 2).sum())), (coarse - 0.03, coarse + 0.03)
    begin_s = float(minimize_scalar(squares, bounds=near, method="bounded", options={"xatol": 1e-8}).x)
    late = []
    common = np.arange(begin_s + RAMP_S / rate, begin_s + (DURATION_S - RAMP_S) / rate, 0.008)
    for arm, (time_s, q) in enumerate(seen):
        p = rate * (time_s - begin_s)
        wanted, speed = path(p)[:, arm], path(p, 1)[:, arm]
        fast = (speed**2).sum(axis=1)
        passed = ((q - wanted) * speed).sum(axis=1) / np.maximum(fast, 1e-12)
        good = fast > 0.1 * fast.max()
        late.append(np.interp(common, time_s[good], passed[good]))
    away = errors(begin_s)
    return {
        "flange_max_mm": 1e3 * float(away.max()),
        "flange_rms_mm": 1e3 * float(np.sqrt((away**2).mean())),
        "skew_p99_ms": 1e3 * float(np.quantile(np.abs(late[0] - late[1]), 0.99)),
    }


def at_125_hz(file: Any, system: Any) -> tuple[list[tuple[Any, Any]], Sine, float]:
    """Follow the path by targets, and return what was seen."""
    config = file.config()
    runner = Runner(file, config, coupled=False, system=system)
    try:
        home = np.array([each.q_rad for each in runner.statuses()])
        path, observer = Sine(home), Observer(file, system)
        targets = path.targets(config.servoj)
        runner.begin(home)
        system.clock.sleep(REST_S)
        first, done, ahead = runner.next + 10, 0, 100
        while done < len(targets):
            runner.write(first + done, targets[done : done + ahead])
            done += ahead
            runner.wait_for(first + done - ahead // 2)
        runner.wait_for(first + len(targets))
        system.clock.sleep(REST_S)
        return observer.end(), path, 1.0
    finally:
        runner.close()


def at_rate(file: Any, system: Any, rate_hz: float) -> tuple[list[tuple[Any, Any]], Sine, float]:
    """Follow the path by points, or below 5 Hz by fixed-time moves, and return what was seen."""
    profile = profile_for(rate_hz, file.config().servoj)
    with PointStream(file, profile, system=system) as stream:
        home = stream.measured()
        path, observer = Sine(home), Observer(file, system)
        if profile.mode == "movej":
            sent = path(np.arange(round(DURATION_S / profile.interval_s) + 1) * profile.interval_s)
            points = PointPath(profile.interval_s, sent, np.zeros_like(sent))
        else:
            points = stream.thin(path.targets(profile.servoj))
        stream.run(points)
        system.clock.sleep(REST_S)
        return observer.end(), path, stream.rate


@contextmanager
def virtual(plant: str) -> Iterator[tuple[Any, Any]]:
    """Yield the cell file and the system of a virtual cell."""
    from dual_ur10.testing import VirtualCell

    with VirtualCell(task="SineTracking", plant=plant) as cell:
        yield cell.file, cell.system


@contextmanager
def emulated(plant: str) -> Iterator[tuple[Any, Any]]:
    """Yield the cell file and the system of an emulated cell, in real time."""
    import tempfile

    from dual_ur10.sim2real.config.cell_file import load_cell_file
    from dual_ur10.sim2real.processes.system import LOCAL
    from dual_ur10.testing import EmulatedCell

    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "cell.toml"
        with EmulatedCell(task="SineTracking", plant=plant, cell=str(path)):
            yield load_cell_file(path), LOCAL


def run(make: Callable[[str], Any], plant: str, rows: dict[str, float] = ROWS) -> dict[str, dict[str, float]]:
    """Measure all rows, and print each when it is done."""
    found = {}
    for name, rate_hz in rows.items():
        with make(plant) as (file, system):
            seen = at_125_hz(file, system) if rate_hz == 125.0 else at_rate(file, system, rate_hz)
        found[name] = figures(*seen)
        print(f"{name:6}", "  ".join(f"{key} {value:.4f}" for key, value in found[name].items()), flush=True)
    return found


def merged(rows: dict[str, dict[str, float]], others: list[Path]) -> dict[str, Any]:
    """Return the table: these rows, and the figures of other benchmarks from their files."""
    table: dict[str, Any] = dict(rows)
    for path in others:
        values = json.loads(path.read_text())
        table |= {name: values[name] for name in OF_OTHERS if name in values}
    return table


def main() -> None:
    """Measure, print and write the table."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--cell", choices=("virtual", "emulated"), default="virtual")
    parser.add_argument("--plant", default="nominal", help="deviation of the plant from its model, such as mild")
    parser.add_argument("--with", dest="others", type=Path, action="append", default=[], help="JSON with more figures")
    parser.add_argument("--json", type=Path, help="file to write")
    arguments = parser.parse_args()
    found = merged(run(emulated if arguments.cell == "emulated" else virtual, arguments.plant), arguments.others)
    if arguments.json is not None:
        arguments.json.write_text(json.dumps(found, indent=1) + "\n")


if __name__ == "__main__":
    main()
