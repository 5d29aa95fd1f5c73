"""Measure the accuracy of followers of one path: targets at 125 Hz, points at 10 and 5 Hz, and fixed-time `movej`.

125 Hz: the runner sends each target. 10 and 5 Hz: points with speeds, between which each controller interpolates
cubics. `movej`: at 2 Hz each controller moves to a point and rests there. Each follows four paths from rest to rest:
`dual`, both flanges swing along y of their bases by 0.1 m at 0.5 Hz; `single`, only the left one does; `grasp`, both
are lowered by 0.1 m to a bar, and both grippers close; `carry`, both carry it along the path of SyncCarry, 30 s. Each
controller knows of half its 4 kg.

Errors are distances and angles of each flange, by its measured joints and the controller's own kinematics, from the
path at the sender's time; one delay, the same for both arms and the whole run, is fitted. `relative` is the same of the
right flange in the left one's frame. `skew` is the difference of both arms' times on the path at one instant. The
default is a virtual cell with the nominal plant: its figures are exact, and an artefact of an exact model. No real arm
is in this.

    python benchmarks/followers.py --json followers.json
    python benchmarks/followers.py --cell emulated --plant mild
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from follower_paths import ArmsPath, Mounts, carried, flanges_in_cell, lowered, swing
from scipy.optimize import minimize_scalar
from scipy.spatial.transform import Rotation

from dual_ur10.assets.props import BAR_MASS_KG
from dual_ur10.sim2real.control.link_profiles import profile_for
from dual_ur10.sim2real.peripherals.grippers import Grippers
from dual_ur10.sim2real.programs.point_stream import PointStream
from dual_ur10.sim2real.runtime.runner import Runner
from dual_ur10.sim2real.trajectory.point_path import PointPath
from ur_core.kinematics.forward import flange_pose
from ur_core.kinematics.poses import Poses
from ur_core.kinematics.ur10 import ARMS, NOMINAL_DH
from ur_core.links.link_socket import LinkSocket
from ur_core.links.rtde_link import RtdeLink
from ur_core.tools.robotiq_2f85 import ROBOTIQ_2F85 as TOOL

REST_S = 1.0  # of the observation, before and after
GRIP_S = 1.5  # for closing
SCRIPT_PORT = 30002
MOVES_RAD_S = 1e-3
ROWS = {"125hz": 125.0, "10hz": 10.0, "5hz": 5.0, "movej": 2.0}
PATHS = ("single", "dual", "carry", "grasp")

Figures = dict[str, float]


class Rig(NamedTuple):
    """A cell: its file, the system on which it runs, and itself."""

    file: Any
    system: Any
    cell: Any

    @property
    def mounts(self) -> Mounts:
        """Bases of both arms."""
        config = self.file.config()
        return (config.left, config.right)

    def bar(self) -> Poses:
        """Return the pose of the bar in the cell frame."""
        found = self.cell.ask("pose", body="bar")
        return Poses(np.array(found["position_m"]), np.array(found["quat"]))

    def grasp(self) -> None:
        """Close both grippers, and let the controllers know of half the bar in each."""
        with Grippers(self.file, system=self.system) as grippers:
            grippers.activate(lambda question: True)
            grippers.command((0.0, 0.0), self.system.clock.now_s())
            self.system.clock.sleep(GRIP_S)
        for name, arm in zip(ARMS, self.file.arms, strict=True):
            kg = self.cell.ask("state", arm=name, names=["payload"])["payload"] + BAR_MASS_KG / 2
            text = f"sec load():\n  set_payload({kg}, [0.0, 0.0, {TOOL.tcp_m}])\nend\n"
            deadline_s = self.system.clock.now_s() + GRIP_S
            with LinkSocket(name, "script", arm.host, SCRIPT_PORT, deadline_s, system=self.system) as script:
                script.send(text.encode("ascii"), deadline_s)
                self.cell.wait_until(name, "payload", kg)
        self.system.clock.sleep(REST_S)


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


def figures(seen: list[tuple[Any, Any]], path: ArmsPath, rate: float, mounts: Mounts) -> Figures:
    """Return the errors of both flanges, and the skew of both arms.

    Args:
        seen: Times and joints of each arm.
        path: The path.
        rate: Rate of the path's time on this program's clock.
        mounts: Bases of the arms.
    """

    def errors(begin_s: float) -> Any:
        away = []
        for arm, (time_s, q) in enumerate(seen):
            wanted = path(rate * (time_s - begin_s))[:, arm]
            away.append(np.linalg.norm(flange_pose(q, NOMINAL_DH)[0] - flange_pose(wanted, NOMINAL_DH)[0], axis=-1))
        return np.concatenate(away)

    moved = np.abs(seen[0][1] - seen[0][1][0]).max(axis=1) > 1e-3
    about_s = float(seen[0][0][moved.argmax()]) - 0.3
    coarse = min(np.arange(about_s - 1.5, about_s + 1.5, 0.02), key=lambda each: float((errors(each) ** 2).mean()))
    squares, near = (lambda each: float((1e3 * errors(each) ** 2).sum())), (coarse - 0.03, coarse + 0.03)
    begin_s = float(minimize_scalar(squares, bounds=near, method="bounded", options={"xatol": 1e-8}).x)
    away = errors(begin_s)
    return {
        "flange_max_mm": 1e3 * float(away.max()),
        "flange_rms_mm": 1e3 * float(np.sqrt((away**2).mean())),
        "skew_p99_ms": 1e3 * skew_s(seen, path, rate, begin_s),
        **angles(seen, path, rate, begin_s, mounts),
    }


def skew_s(seen: list[tuple[Any, Any]], path: ArmsPath, rate: float, begin_s: float) -> float:
    """Return 99 % of the differences of both arms' times on the path; 0 if an arm rests."""
    late = []
    common = np.arange(begin_s + path.ramp_s / rate, begin_s + (path.duration_s - path.ramp_s) / rate, 0.008)
    for arm, (time_s, q) in enumerate(seen):
        p = rate * (time_s - begin_s)
        wanted, speed = path(p)[:, arm], path(p, 1)[:, arm]
        fast = (speed**2).sum(axis=1)
        passed = ((q - wanted) * speed).sum(axis=1) / np.maximum(fast, 1e-12)
        good = fast > max(0.1 * fast.max(), MOVES_RAD_S**2)
        if not good.any():
            return 0.0
        late.append(np.interp(common, time_s[good], passed[good]))
    return float(np.quantile(np.abs(late[0] - late[1]), 0.99))


def angles(seen: list[tuple[Any, Any]], path: ArmsPath, rate: float, begin_s: float, mounts: Mounts) -> Figures:
    """Return the largest angle of a flange off its path, and the errors of the right flange in the left one's frame."""
    times = seen[0][0]
    inside = (times >= seen[1][0][0]) & (times <= seen[1][0][-1])
    times = times[inside]
    right = np.stack([np.interp(times, seen[1][0], each) for each in seen[1][1].T], axis=1)
    found = flanges_in_cell(np.stack([seen[0][1][inside], right], axis=1), mounts)
    wanted = flanges_in_cell(path(rate * (times - begin_s)), mounts)
    relative = [_relative(*each) for each in (found, wanted)]
    return {
        "angle_max_deg": max(_angle_deg(wanted[1][:, arm], found[1][:, arm]) for arm in range(2)),
        "relative_max_mm": 1e3 * float(np.linalg.norm(relative[0][0] - relative[1][0], axis=-1).max()),
        "relative_max_deg": _angle_deg(relative[1][1], relative[0][1]),
    }


def _relative(position: Any, rotation: Any) -> tuple[Any, Any]:
    back = np.swapaxes(rotation[:, 0], -1, -2)
    return np.einsum("nij,nj->ni", back, position[:, 1] - position[:, 0]), back @ rotation[:, 1]


def _angle_deg(first: Any, second: Any) -> float:
    return float(np.degrees((Rotation.from_matrix(first).inv() * Rotation.from_matrix(second)).magnitude().max()))


class Follower:
    """Follower of paths on a rig, by targets at 125 Hz or by points.

    Args:
        rig: The cell.
        rate_hz: Rate; below 5 Hz by fixed-time moves.
    """

    def __init__(self, rig: Rig, rate_hz: float) -> None:
        self._rig, self._config, self._rate_hz = rig, rig.file.config(), rate_hz
        self._made: Any = None

    def __enter__(self) -> Follower:
        file, system = self._rig.file, self._rig.system
        if self._rate_hz == 125.0:
            self._made = Runner(file, self._config, system=system)
            self._made.begin(np.array([each.q_rad for each in self._made.statuses()]))
        else:
            self._made = PointStream(file, profile_for(self._rate_hz, self._config.servoj), system=system)
        return self

    def __exit__(self, *_: object) -> None:
        self._made.close()

    def joints(self) -> Any:
        """Return joint positions, (2, 6), where a path can begin."""
        if isinstance(self._made, Runner):
            return np.array([each.q_rad for each in self._made.statuses()])
        return self._made.measured()

    def follow(self, path: ArmsPath) -> tuple[list[tuple[Any, Any]], ArmsPath, float]:
        """Follow a path, and return what was seen."""
        clock, made = self._rig.system.clock, self._made
        observer = Observer(self._rig.file, self._rig.system)
        clock.sleep(REST_S)
        if isinstance(made, Runner):
            targets, rate = path.targets(self._config.servoj), 1.0
            first, done, ahead = made.next + 10, 0, 100
            while done < len(targets):
                made.write(first + done, targets[done : done + ahead])
                done += ahead
                made.wait_for(first + done - ahead // 2)
            made.wait_for(first + len(targets))
        else:
            interval_s, rate = made.profile.interval_s, made.rate
            if made.profile.mode == "movej":
                sent = path(np.arange(round(path.duration_s / interval_s) + 1) * interval_s)
                points = PointPath(interval_s, sent, np.zeros_like(sent))
            else:
                points = made.thin(path.targets(made.profile.servoj))
            made.run(points)
        clock.sleep(REST_S)
        return observer.end(), path, rate


@contextmanager
def virtual(task: str, plant: str) -> Iterator[Rig]:
    """Yield a virtual cell."""
    from dual_ur10.testing import VirtualCell

    with VirtualCell(task=task, plant=plant) as cell:
        yield Rig(cell.file, cell.system, cell)


@contextmanager
def emulated(task: str, plant: str) -> Iterator[Rig]:
    """Yield an emulated cell, in real time."""
    import tempfile

    from dual_ur10.sim2real.cell_file.cell_file import load_cell_file
    from dual_ur10.testing import EmulatedCell
    from ur_core.processes.system import LOCAL

    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "cell.toml"
        with EmulatedCell(task=task, plant=plant, cell=str(path)) as cell:
            yield Rig(load_cell_file(path), LOCAL, cell)


def measured(make: Callable[[str, str], Any], plant: str, rate_hz: float, names: Sequence[str]) -> dict[str, Figures]:
    """Return the figures of some paths at one rate."""
    found = {}
    for name in ("single", "dual"):
        if name in names:
            with make("SineTracking", plant) as rig, Follower(rig, rate_hz) as follower:
                path = swing(follower.joints(), (0,) if name == "single" else (0, 1))
                found[name] = figures(*follower.follow(path), rig.mounts)
    if not {"grasp", "carry"} & set(names):
        return found
    with make("SyncCarry", plant) as rig, Follower(rig, rate_hz) as follower:
        seen = follower.follow(lowered(follower.joints(), rig.bar(), rig.mounts))
        found["grasp"] = figures(*seen, rig.mounts)
        rig.grasp()
        if "carry" in names:
            bar = rig.bar()
            found["carry"] = figures(*follower.follow(carried(follower.joints(), bar, rig.mounts)), rig.mounts)
            found["carry"]["bar_moved_mm"] = 1e3 * float(np.linalg.norm(rig.bar().position_m - bar.position_m))
    return found


def run(
    make: Callable[[str, str], Any], plant: str, rows: dict[str, float] = ROWS, names: Sequence[str] = PATHS
) -> dict[str, Any]:
    """Measure all rows, and print each when it is done; those of `dual` are on the top level, too."""
    found: dict[str, Any] = {}
    table: dict[str, dict[str, Figures]] = {}
    for row, rate_hz in rows.items():
        for name, values in measured(make, plant, rate_hz, names).items():
            table.setdefault(name, {})[row] = {**values, "period_ms": 1e3 / rate_hz}
            print(f"{name:7}{row:6}", "  ".join(f"{key} {value:.4f}" for key, value in values.items()), flush=True)
        if "dual" in table:
            found[row] = {key: table["dual"][row][key] for key in ("flange_max_mm", "flange_rms_mm", "skew_p99_ms")}
    return found | {"paths": table}


def main() -> None:
    """Measure, print and write the table."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--cell", choices=("virtual", "emulated"), default="virtual")
    parser.add_argument("--plant", default="nominal", help="deviation of the plant from its model, such as mild")
    parser.add_argument("--json", type=Path, help="file to write")
    arguments = parser.parse_args()
    make = emulated if arguments.cell == "emulated" else virtual
    found = run(make, arguments.plant)
    if arguments.json is not None:
        arguments.json.write_text(json.dumps(found, indent=1) + "\n")


if __name__ == "__main__":
    main()
