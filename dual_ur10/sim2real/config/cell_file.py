"""Cell files: what a cell of two controllers is, in TOML, checked before anything is connected to.

`docs/reference/cell-file.md` lists every key.
"""

from __future__ import annotations

import hashlib
import math
import os
import tomllib
from collections.abc import Mapping
from dataclasses import dataclass, field, fields, replace
from pathlib import Path
from typing import Any, Final, NamedTuple, cast

from dual_ur10.assets.obstacles import Obstacle
from dual_ur10.assets.settings import SceneSettings
from dual_ur10.errors import CellFileError, SettingsError, UnknownNameError
from dual_ur10.kinematics.ur10 import ARMS
from dual_ur10.sim2real.config.cell import CellConfig, Perturbation
from dual_ur10.sim2real.config.cell_file_entries import (
    GRIPPERS,
    OBSTACLES,
    PLAIN,
    TRACKERS,
    ZERO,
    ArmEntry,
    ArmLimits,
    EmulatorEntry,
    Measured,
    NoGripper,
    Tracker,
    of_kind,
    plain,
    said,
    with_kind,
)
from dual_ur10.sim2real.config.cell_file_reader import mount_of, read
from dual_ur10.sim2real.config.cell_file_schema import Kind
from dual_ur10.sim2real.config.cell_file_text import commented, toml_text
from dual_ur10.sim2real.control.servoj import ServojProfile

MOST_BYTES: Final = 64 * 1024
MOST_DOTS: Final = 100  # in one line

# For first runs. 0.25 m/s is what ISO 10218-1 calls reduced speed.
FIRST_SPEED_FACTOR: Final = 0.25
FIRST_SPEED_RAD_S: Final = 0.5
FIRST_TCP_SPEED_M_S: Final = 0.25
_FIRST: Final = {"speed_rad_s": (FIRST_SPEED_RAD_S, "rad/s"), "tcp_speed_m_s": (FIRST_TCP_SPEED_M_S, "m/s")}

_PLAIN: Final = ("kind", "name", "task", "speed_factor", "commissioned", "allow_reduced_mode", "rt_priority")


@dataclass(frozen=True, kw_only=True)
class CellFile:
    """What a cell file says, checked; also when made by hand or by `dataclasses.replace`.

    Attributes:
        kind: "real" or "emulated".
        left, right: The arms.
        name: What the cell is called.
        task: Id of the environment that it is set up for; None: any.
        speed_factor: How fast the clock of a task runs, above 0 and at most 1.
        commissioned: Whether a person has signed for a real cell. Until then no target exceeds what first runs are
            made at, whatever the limits are.
        allow_reduced_mode: Whether both arms go on, slower, where a controller is in reduced mode.
        rt_priority: Real-time priority of the senders; 0: none.
        emulator: The process that emulates the cell, if one does.
        tracker: Where the poses of objects come from; None: there are none.
        obstacles: What stands in the workspace.
        source: The file, for messages. Two cell files that say the same are equal, wherever they are.

    Raises:
        CellFileError: A value is not legal, or two do not fit together.
    """

    kind: Kind
    left: ArmEntry
    right: ArmEntry
    name: str = "cell"
    task: str | None = None
    speed_factor: float = 1.0
    commissioned: bool = False
    allow_reduced_mode: bool = False
    rt_priority: int = 0
    emulator: EmulatorEntry | None = None
    tracker: Tracker | None = None
    obstacles: tuple[Obstacle, ...] = ()
    source: str = field(default="the cell file", compare=False)

    def __post_init__(self) -> None:
        _, findings = read(self.mapping())
        if findings:
            raise _error(self.source, findings)

    @property
    def arms(self) -> tuple[ArmEntry, ArmEntry]:
        """Both arms in the order of `ARMS`."""
        return self.left, self.right

    def mapping(self) -> dict[str, Any]:
        """The content of the file, with all that it leaves to defaults."""
        return said(
            {
                "kind": self.kind,
                "name": self.name,
                "task": self.task,
                "speed_factor": self.speed_factor,
                "commissioned": self.commissioned,
                "allow_reduced_mode": self.allow_reduced_mode,
                "rt_priority": self.rt_priority,
                **{name: arm.mapping() for name, arm in zip(ARMS, self.arms, strict=True)},
                "emulator": None if self.emulator is None else plain(self.emulator),
                "tracker": None if self.tracker is None else with_kind(self.tracker),
                "obstacle": tuple(map(with_kind, self.obstacles)) or None,
            }
        )

    def text(self) -> str:
        """The file. Read again, it is equal to this."""
        return toml_text(self.mapping())

    @property
    def sha256(self) -> str:
        """Of `text()`, in hexadecimal digits: of what the file means, not of its comments."""
        return hashlib.sha256(self.text().encode()).hexdigest()

    def config(self) -> CellConfig:
        """The cell as adapter, gate and simulation know it: mounts, servoj settings, caps on speeds.

        Raises:
            CellFileError: The arms' families or servoj settings differ.
        """
        for name in ("family", "lookahead_s", "gain"):
            left, right = (getattr(each.servoj, name) for each in self.arms)
            if left != right:
                key = name if name == "family" else f"servoj.{name}"
                finding = (
                    f"right.{key} is {right!r} and left.{key} is {left!r}: both arms need the same, as one adapter "
                    "times the targets of both. Write the same for both"
                )
                raise _error(self.source, [finding])
        try:
            return CellConfig(
                kind=self.kind,
                left=self.left.mount,
                right=self.right.mount,
                servoj=self.left.servoj,
                speed_factor=self.speed_factor,
                obstacles=self.obstacles,
                uncertainty=(
                    (self.left.base_uncertainty_m, self.left.base_uncertainty_rad),
                    (self.right.base_uncertainty_m, self.right.base_uncertainty_rad),
                ),
                hands=any(not isinstance(arm.gripper, NoGripper) for arm in self.arms),
                file=self,
                measured_lookahead_s=self._lookahead_s(),
                tcp_m=(self.left.tcp_position_m or ZERO, self.right.tcp_position_m or ZERO),
                **{each.name: self._tighter(each.name) for each in fields(ArmLimits)},  # type: ignore[arg-type]  # floats
            )
        except SettingsError as error:
            raise _error(self.source, [str(error)]) from error

    def simulated(self) -> CellConfig:
        """The simulated cell that is like this one, with the lookahead and latency that were measured of its arms.

        Raises:
            CellFileError: As of `config`.
        """
        scales, latencies = [], []
        for arm in self.arms:
            measured, servoj = arm.measured, arm.servoj
            scales.append(1.0 if measured.lookahead_s is None else measured.lookahead_s / servoj.lookahead_s)
            latencies.append(measured.latency_s or 0.0)
        plant = Perturbation(
            lookahead_scale=tuple(min(max(each, 0.1), 10.0) for each in scales),
            latency_s=tuple(min(each, 0.2) for each in latencies),
        )
        known = plant if any(arm.measured != Measured() for arm in self.arms) else Perturbation()
        return replace(self.config(), kind="mujoco", file=None, perturbation=known)

    def _lookahead_s(self) -> float | None:
        """Mean of both arms, which one adapter leads; None: nothing was measured."""
        if all(arm.measured.lookahead_s is None for arm in self.arms):
            return None
        return math.fsum(arm.measured.lookahead_s or arm.servoj.lookahead_s for arm in self.arms) / len(self.arms)

    def _tighter(self, name: str) -> float | None:
        said = [each for arm in self.arms if (each := getattr(arm.limits, name)) is not None]
        if self.kind == "real" and not self.commissioned and name in _FIRST:
            said.append(_FIRST[name][0])
        return min(said, default=None)

    def notes(self) -> list[str]:
        """What is legal and deserves a look before real arms move, a line each."""
        if self.kind == "emulated":
            return []
        notes = []
        for name, arm in zip(ARMS, self.arms, strict=True):
            if arm.mount.dh.is_nominal:
                notes.append(f"{name}.calibration is the nominal UR10's: flange poses may be off by some millimetres")
            if arm.checksum is None:
                notes.append(f"{name}.calibration.checksum is not said: another calibration would not be noticed")
            if arm.serial_number is None:
                notes.append(f"{name}.serial_number is not said: swapped arms may not be noticed")
            if arm.safety_checksum is None:
                notes.append(f"{name}.safety_checksum is not said: other safety settings would not be noticed")
            if not (arm.base_uncertainty_m and arm.base_uncertainty_rad):
                notes.append(f"{name}.base_uncertainty_m or _rad is 0: no base is where it is believed to be")
            if isinstance(arm.gripper, NoGripper) and any(arm.tcp_position_m or ZERO):
                notes.append(
                    f"{name}.tcp_position_m is not at the flange and {name}.gripper is none: what is mounted "
                    "there does not exist for the safety gate"
                )
            for key, (first, unit) in _FIRST.items():
                limit = getattr(arm.limits, key)
                if limit is None:
                    notes.append(f"{name}.limits.{key} is not said: first runs are made at {first:g} {unit}")
                elif limit > first:
                    notes.append(f"{name}.limits.{key} is {limit:g}: first runs are made at {first:g} {unit}")
        if not self.commissioned:
            speeds = " and ".join(f"{first:g} {unit}" for first, unit in _FIRST.values())
            notes.append(
                f"commissioned is false: no arm exceeds {speeds}, whatever its limits are, until the checklist of "
                "docs/how-to/two-arms.md is signed and it is true"
            )
        if self.speed_factor > FIRST_SPEED_FACTOR:
            notes.append(f"speed_factor is {self.speed_factor:g}: first runs are made at {FIRST_SPEED_FACTOR:g}")
        return notes


class Examination(NamedTuple):
    """What was found of a file.

    Attributes:
        cell: What it says; None if anything is wrong.
        findings: What is wrong, a line each.
    """

    cell: CellFile | None
    findings: list[str]


def starting_text(
    kind: Kind = "real",
    left: str | None = None,
    right: str | None = None,
    family: str = "cb3",
    task: str | None = None,
    source: str = "the cell file",
) -> str:
    """A commented file to begin with: slow, and with all that the file of such a cell has to say.

    Args:
        kind: "real" or "emulated".
        left: Address of the left controller; an emulated cell has one by default.
        right: Address of the right controller, likewise.
        family: Of both controllers.
        task: Id of the environment that it is set up for; None: any.
        source: The file, for messages.

    Raises:
        CellFileError: A value is not legal, or the address of a real arm is missing.
    """
    real = kind == "real"
    hosts = [left, right] if real else [left or "127.0.0.2", right or "127.0.0.3"]
    for arm, host in zip(ARMS, hosts, strict=True):
        if host is None:
            raise CellFileError(
                f"the address of the {arm} arm is missing: it is on the controller's screen, under network. Give "
                f"it as --{arm}, or write the file of an emulated cell with --kind emulated"
            )
    on_controller = {"tcp_position_m": ZERO, "tcp_rotation_rad": ZERO, "payload_kg": 0.0, "payload_cog_m": ZERO}
    arms = {
        arm: {
            "host": host,
            "family": family,
            "base_position_m": mount.position_m,
            "base_yaw_rad": mount.yaw_rad,
            **({"base_uncertainty_m": 0.005, "base_uncertainty_rad": 0.01, **on_controller} if real else {}),
            "gripper": {"kind": "none"},
            "servoj": {"lookahead_s": ServojProfile().lookahead_s, "gain": ServojProfile().gain},
            "limits": {"speed_rad_s": FIRST_SPEED_RAD_S, "tcp_speed_m_s": FIRST_TCP_SPEED_M_S},
        }
        for arm, host, mount in zip(ARMS, hosts, SceneSettings().mounts, strict=True)
    }
    signed = {"commissioned": False} if real else {}
    values: dict[str, Any] = {"kind": kind, "name": "cell", "task": task, "speed_factor": FIRST_SPEED_FACTOR, **signed}
    values |= {"rt_priority": 0, **arms}
    text = commented(said(values))
    _, findings = examine_text(text, source)
    if findings:
        raise _error(source, findings[:1])
    return text


def examine(path: str | Path) -> Examination:
    """Read a cell file and find all that is wrong with it.

    Raises:
        CellFileError: It cannot be read at all.
    """
    return examine_text(_text_of(path), str(path))


def examine_text(text: str, source: str = "the cell file") -> Examination:
    """The same of a text.

    Raises:
        CellFileError: It is no TOML.
    """
    for row, line in enumerate(text.split("\n"), start=1):
        # Python's reader takes half a minute for a key of thirty thousand parts.
        if line.count(".") > MOST_DOTS and not line.startswith("#"):
            raise CellFileError(f"{source}: line {row} has {line.count('.')} dots: allowed are {MOST_DOTS}. Shorten it")
    try:
        mapping = tomllib.loads(text)
    except RecursionError:
        raise CellFileError(f"{source} is no TOML: brackets inside brackets, too many. Correct it") from None
    except ValueError as error:
        raise CellFileError(f"{source} is no TOML: {str(error)[:200]}. Correct that place") from None
    values, findings = read(mapping)
    return Examination(None if findings else _built(values, source), findings)


def load_cell_file(path: str | Path) -> CellFile:
    """Read a cell file.

    Raises:
        CellFileError: It cannot be read, or says something that is not legal. The message names the file, the key,
            what was found, what is allowed and what to do.
    """
    cell, findings = examine(path)
    if cell is None:
        raise _error(str(path), findings)
    return cell


def resolve_cell(cell: object) -> CellConfig:
    """Return the configuration that the keyword `cell` of an environment stands for.

    Args:
        cell: "mujoco", a `CellConfig`, or the path of a cell file.

    Raises:
        UnknownNameError: None of them.
        CellFileError: The cell file cannot be read or is not legal.
    """
    if isinstance(cell, CellConfig):
        return cell
    if isinstance(cell, str) and cell == "mujoco":
        return CellConfig()
    if isinstance(cell, os.PathLike) or (isinstance(cell, str) and ("/" in cell or cell.endswith(".toml"))):
        return load_cell_file(os.fspath(cell)).config()
    raise UnknownNameError("cell", str(cell), ("mujoco", "a path such as lab.toml", "a dual_ur10.CellConfig"))


def _text_of(path: str | Path) -> str:
    path = Path(path)
    try:
        if not path.exists():
            raise CellFileError(
                f"there is no cell file {path}: write one with `python -m dual_ur10 cell new {path}`, or correct "
                "the name"
            )
        if not path.is_file():  # a pipe would keep us waiting
            raise CellFileError(f"{path} is no regular file: name a cell file")
        with path.open("rb") as file:
            content = file.read(MOST_BYTES + 1)
    except (OSError, ValueError, RuntimeError) as error:
        if isinstance(error, CellFileError):
            raise
        raise CellFileError(f"cannot read {path}: {error}. Correct the name, or the rights of the file") from error
    if len(content) > MOST_BYTES:
        raise CellFileError(
            f"{path} is longer than {MOST_BYTES} bytes, the most that a cell file may be: name another, or shorten it"
        )
    try:
        return content.decode("utf-8")
    except UnicodeDecodeError as error:
        raise CellFileError(
            f"{path} is no text in UTF-8 ({error.reason} at byte {error.start}): save it as such"
        ) from None


def _error(source: str, findings: list[str]) -> CellFileError:
    more = len(findings) - 1
    rest = f" ({more} more: `python -m dual_ur10 cell check {source}` shows all)" if more else ""
    return CellFileError(f"{source}: {findings[0]}{rest}")


def _built(values: Mapping[str, Any], source: str) -> CellFile:
    """The cell of checked values."""
    arms = [_arm(row, values[name]) for row, name in enumerate(ARMS)]
    emulator, tracker = values["emulator"], values["tracker"]
    return CellFile(
        left=arms[0],
        right=arms[1],
        emulator=None if emulator is None else EmulatorEntry(**emulator),
        tracker=None if tracker is None else cast(Tracker, of_kind(TRACKERS, tracker)),
        obstacles=tuple(of_kind(OBSTACLES, each) for each in values["obstacle"]),
        source=source,
        **{name: values[name] for name in _PLAIN},
    )


def _arm(row: int, values: Mapping[str, Any]) -> ArmEntry:
    return ArmEntry(
        host=values["host"],
        servoj=ServojProfile(values["family"], **values["servoj"]),
        mount=mount_of(row, values),
        checksum=values["calibration"]["checksum"],
        gripper=of_kind(GRIPPERS, values["gripper"]),
        limits=ArmLimits(**values["limits"]),
        measured=Measured(**values["measured"]),
        **{name: values[name] for name in PLAIN},
    )
