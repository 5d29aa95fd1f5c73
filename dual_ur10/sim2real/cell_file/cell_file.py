"""Cell files: the description of a cell of two controllers in TOML, checked before anything is connected to.

The reference page of `reference` lists every key.
"""

from __future__ import annotations

import hashlib
import math
import tomllib
from collections.abc import Iterator, Mapping
from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Any, Final, NamedTuple, Self, cast

from pydantic import Field, PrivateAttr, ValidationError, model_validator

from dual_ur10.assets.obstacles import Obstacle
from dual_ur10.assets.settings import default_mount
from dual_ur10.errors import CellFileError, SettingsError
from dual_ur10.sim2real.cell.cell_config import CellConfig
from dual_ur10.sim2real.cell.perturbation import Perturbation
from dual_ur10.sim2real.cell_file.rules import inconsistencies
from dual_ur10.sim2real.cell_file.tables import (
    MAX_CAMERAS,
    MAX_OBSTACLES,
    MAX_TRACKERS,
    ZERO,
    ArmEntry,
    ArmLimits,
    BaseToBase,
    CameraEntry,
    EmulatorEntry,
    GainsEntry,
    Kind,
    Measured,
    Name,
    NoGripper,
    ObstacleEntry,
    Table,
    Task,
    Tracker,
    key,
    read_keywords,
)
from dual_ur10.sim2real.cell_file.text import KeyList, missing, toml_text
from ur_core.files import read_named
from ur_core.kinematics.robots import MODEL_OF_FAMILY, ROBOTS
from ur_core.kinematics.ur10 import ARMS
from ur_core.mjcf.gains import Gains
from ur_core.tools.tool import Tool, tool_named

MAX_BYTES: Final = 64 * 1024
MAX_DOTS: Final = 100  # in one line

VIRTUAL: Final = "the virtual cell"
"""Source of a cell that has no file, because it is virtual."""

# For first runs. 0.25 m/s is what ISO 10218-1 calls reduced speed.
FIRST_SPEED_FACTOR: Final = 0.25
FIRST_SPEED_RAD_S: Final = 0.5
FIRST_TCP_SPEED_M_S: Final = 0.25
_FIRST: Final = {"speed_rad_s": (FIRST_SPEED_RAD_S, "rad/s"), "tcp_speed_m_s": (FIRST_TCP_SPEED_M_S, "m/s")}


class _UnfitError(ValueError):
    """Values that are legal each and do not fit together."""

    def __init__(self, findings: list[str]) -> None:
        super().__init__("; ".join(findings))
        self.findings = findings


class CellFile(Table):
    """The content of a cell file. Files with the same content are equal, wherever they are."""

    kind: Kind = key("real or emulated arms")
    name: Name = key("name of the cell", "cell")
    task: Task | None = key(
        "id of the environment that the cell is set up for", None, example="DualUR10/SineTracking-v0"
    )
    speed_factor: float = key(
        "speed of a task's clock relative to real time", 1.0, low=0.05, high=1, if_real=True, example=0.25
    )
    commissioned: bool = key(
        "whether the checklist of a real cell was signed; until then, its arms are as slow as in first runs", False
    )
    allow_reduced_mode: bool = key(
        "whether both arms go on, at half their speed, when a controller is in reduced mode", False
    )
    rt_priority: int = key("real-time priority of the senders; 0 is off", 0, low=0, high=90)
    left: ArmEntry
    right: ArmEntry
    base_to_base: BaseToBase | None = None
    gains: GainsEntry | None = None
    emulator: EmulatorEntry | None = None
    tracker: tuple[Tracker, ...] = Field((), max_length=MAX_TRACKERS, description="source of an object's pose")
    camera: tuple[CameraEntry, ...] = Field((), max_length=MAX_CAMERAS, description="source of a camera's images")
    obstacle: tuple[ObstacleEntry, ...] = Field((), max_length=MAX_OBSTACLES, description="shape of the obstacle")

    _source: str = PrivateAttr("the cell file")

    @classmethod
    def read(cls, values: Mapping[str, Any], source: str = "the cell file") -> CellFile:
        """Return the cell file of plain values, as TOML has them.

        Args:
            values: Content of the file.
            source: The file, for messages.

        Raises:
            CellFileError: A value is not legal, or two do not fit together.
        """
        cell, findings = _examined(values, source)
        if cell is None:
            raise _error(source, findings)
        return cell

    def replace(self, **changes: Any) -> Self:
        """Return this cell with some keys changed, checked again.

        Raises:
            CellFileError: As for `read`.
        """
        return cast(Self, self.read(super().replace(**changes).mapping(), self.source))

    @model_validator(mode="before")
    @classmethod
    def _default_positions(cls, values: Any) -> Any:
        """Bases of an emulated cell stand where those of the simulated cell do."""
        if not isinstance(values, Mapping) or values.get("kind") == "real":
            return values
        filled = dict(values)
        for arm, name in enumerate(ARMS):
            entry = values.get(name)
            entry = entry.model_dump(exclude_unset=True) if isinstance(entry, ArmEntry) else entry
            if isinstance(entry, Mapping):
                robot = entry.get("model") or MODEL_OF_FAMILY.get(str(entry.get("family")))
                mount = default_mount(arm, robot if isinstance(robot, str) and robot in ROBOTS else "ur10")
                filled[name] = {"base_position_m": mount.position_m, **entry}
        return filled

    @model_validator(mode="after")
    def _fits_together(self) -> CellFile:
        findings = [*_missing_of_real(self.model_dump(exclude_unset=True, exclude_none=True)), *inconsistencies(self)]
        if findings:
            raise _UnfitError(findings)
        return self

    def __eq__(self, other: object) -> bool:
        return isinstance(other, CellFile) and dict(self) == dict(other)

    def __hash__(self) -> int:
        return hash(self.sha256)

    @property
    def source(self) -> str:
        """The file, for messages."""
        return self._source

    @property
    def arms(self) -> tuple[ArmEntry, ArmEntry]:
        """Both arms in the order of `ARMS`."""
        return self.left, self.right

    @property
    def emulated_scene(self) -> tuple[str, dict[str, Any]] | None:
        """Id of the environment whose scene emulated controllers simulate, and keywords of its task; None: of none."""
        if self.emulator is None or self.emulator.task is None:
            return None
        return self.emulator.task, read_keywords(self.emulator.settings or "{}")

    @property
    def obstacles(self) -> tuple[Obstacle, ...]:
        """Obstacles in the workspace, as scenes take them."""
        return tuple(each.obstacle for each in self.obstacle)

    @property
    def clearing(self) -> str:
        """Step that clears a latched stop, for messages."""
        if self.source == VIRTUAL:
            return f"call `.clear()` of {VIRTUAL}"
        return f"run `python -m dual_ur10 cell clear {self.source}`"

    def text(self) -> str:
        """Return the file with all defaults. Read again, it is equal to this."""
        return toml_text(self.mapping())

    @property
    def sha256(self) -> str:
        """SHA-256 of `text()` in hexadecimal digits: of the content of the file, not of its comments."""
        return hashlib.sha256(self.text().encode()).hexdigest()

    @property
    def relative_uncertainty(self) -> tuple[float, float] | None:
        """Uncertainty of the right base relative to the left one, m and rad; None: the file states none."""
        if self.base_to_base is not None:
            return self.base_to_base.uncertainty_m, self.base_to_base.uncertainty_rad
        (left_m, left_rad), (right_m, right_rad) = (
            (arm.base_uncertainty_m, arm.base_uncertainty_rad) for arm in self.arms
        )
        if not any((left_m, left_rad, right_m, right_rad)):
            return None
        apart_m = math.dist(self.left.base_position_m or ZERO, self.right.base_position_m or ZERO)
        return left_m + left_rad * apart_m + right_m, left_rad + right_rad

    def config(self) -> CellConfig:
        """Return the configuration for adapter, gate and simulation: mounts, servoj settings, speed caps.

        Raises:
            CellFileError: The arms' families or servoj settings differ.
        """
        for name in ("family", "lookahead_s", "gain"):
            left, right = (getattr(each.profile, name) for each in self.arms)
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
                servoj=self.left.profile,
                speed_factor=self.speed_factor,
                obstacles=self.obstacles,
                uncertainty=(
                    (self.left.base_uncertainty_m, self.left.base_uncertainty_rad),
                    (self.right.base_uncertainty_m, self.right.base_uncertainty_rad),
                ),
                grippers_mounted=any(not isinstance(arm.gripper, NoGripper) for arm in self.arms),
                file=self,
                cameras=tuple((each.name, mounted) for each in self.camera if (mounted := each.mounted) is not None),
                measured_lookahead_s=self._lookahead_s(),
                tools=self._tools(),
                gains=None if self.gains is None else Gains(self.gains.kp_nm_rad, self.gains.kv_nms_rad),
                tcp_m=(self.left.tcp_position_m or ZERO, self.right.tcp_position_m or ZERO),
                **{name: self._tighter(name) for name in ArmLimits.model_fields},  # type: ignore[arg-type]  # floats
            )
        except SettingsError as error:
            raise _error(self.source, [str(error)]) from error

    def _tools(self) -> tuple[Tool, Tool] | None:
        """Return the tools of both arms; None: neither has a gripper. An arm without one counts as its fellow."""
        names = [None if isinstance(arm.gripper, NoGripper) else arm.gripper.tool for arm in self.arms]
        left, right = names[0] or names[1], names[1] or names[0]
        return None if left is None or right is None else (tool_named(left), tool_named(right))

    def simulated(self) -> CellConfig:
        """Return the simulated cell of the same configuration, with the measured lookahead and latency of its arms.

        Raises:
            CellFileError: As for `config`.
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
        """Mean of both arms, as one adapter serves both; None: nothing was measured."""
        if all(arm.measured.lookahead_s is None for arm in self.arms):
            return None
        return math.fsum(arm.measured.lookahead_s or arm.servoj.lookahead_s for arm in self.arms) / len(self.arms)

    def _tighter(self, name: str) -> float | None:
        said = [each for arm in self.arms if (each := getattr(arm.limits, name)) is not None]
        if self.kind == "real" and not self.commissioned and name in _FIRST:
            said.append(_FIRST[name][0])
        return min(said, default=None)

    def notes(self) -> list[str]:
        """Return what is legal and deserves attention before real arms move, a line each."""
        if self.kind == "emulated":
            return []
        notes = []
        for name, arm in zip(ARMS, self.arms, strict=True):
            exact = not (arm.base_uncertainty_m and arm.base_uncertainty_rad)
            tool = isinstance(arm.gripper, NoGripper) and any(arm.tcp_position_m or ZERO)
            for noted, note in (
                (
                    arm.mount.dh.is_nominal,
                    f"calibration is the nominal {arm.mount.model.title}'s: flange poses may be off by millimetres",
                ),
                (
                    arm.model is None,
                    f'model is missing: the arm counts as a {arm.mount.model.title}. Write "{arm.robot}"',
                ),
                (arm.calibration.checksum is None, "calibration.checksum is missing: others would not be noticed"),
                (arm.serial_number is None, "serial_number is missing: swapped arms may not be noticed"),
                (arm.safety_checksum is None, "safety_checksum is missing: other settings would not be noticed"),
                (
                    any(arm.mount.tilt_rad),
                    "base_tilt_rad is not 0: set the same mounting in the installation on the pendant, by which the "
                    "controller compensates gravity. It cannot be read from here",
                ),
                (exact, "base_uncertainty_m or _rad is 0: no base stands exactly at its nominal pose"),
                (tool, "tcp_position_m is not at the flange and gripper is none: the safety gate knows no tool there"),
            ):
                notes += [f"{name}.{note}"] if noted else []
            for limited, (first, unit) in _FIRST.items():
                limit = getattr(arm.limits, limited)
                if limit is None:
                    notes.append(f"{name}.limits.{limited} is missing: first runs are made at {first:g} {unit}")
                elif limit > first:
                    notes.append(f"{name}.limits.{limited} is {limit:g}: first runs are made at {first:g} {unit}")
        if not self.commissioned:
            speeds = " and ".join(f"{first:g} {unit}" for first, unit in _FIRST.values())
            notes.append(
                f"commissioned is false: no arm exceeds {speeds}, whatever its limits are, until the checklist of "
                "docs/how-to/commissioning-checklist.md is signed and it is true"
            )
        if self.speed_factor > FIRST_SPEED_FACTOR:
            notes.append(f"speed_factor is {self.speed_factor:g}: first runs are made at {FIRST_SPEED_FACTOR:g}")
        return notes


class Examination(NamedTuple):
    """Result of the examination of a file.

    Attributes:
        cell: Content of the file; None if anything is wrong.
        findings: Errors, a line each.
    """

    cell: CellFile | None
    findings: list[str]


def examine(path: str | Path) -> Examination:
    """Read a cell file and collect all its errors.

    Raises:
        CellFileError: The file cannot be read at all.
    """
    return examine_text(_text_of(path), str(path))


def examine_text(text: str, source: str = "the cell file") -> Examination:
    """Examine the text of a cell file.

    Raises:
        CellFileError: The text is no TOML.
    """
    for row, line in enumerate(text.split("\n"), start=1):
        # Python's reader takes half a minute for a key of thirty thousand parts.
        if line.count(".") > MAX_DOTS and not line.startswith("#"):
            raise CellFileError(f"{source}: line {row} has {line.count('.')} dots: allowed are {MAX_DOTS}. Shorten it")
    try:
        mapping = tomllib.loads(text)
    except RecursionError:
        raise CellFileError(f"{source} is no TOML: brackets inside brackets, too many. Correct it") from None
    except ValueError as error:
        raise CellFileError(f"{source} is no TOML: {str(error)[:200]}. Correct that place") from None
    return _examined(mapping, source)


def load_cell_file(path: str | Path) -> CellFile:
    """Read a cell file.

    Raises:
        CellFileError: The file cannot be read or is not legal. The message names the file, the key, what was found,
            what is allowed and what to do.
    """
    cell, findings = examine(path)
    if cell is None:
        raise _error(str(path), findings)
    return cell


def _text_of(path: str | Path) -> str:
    path = Path(path)
    content = read_named(
        path,
        MAX_BYTES,
        CellFileError,
        absent=f"there is no cell file {path}: write one with `python -m dual_ur10 cell new {path}`, or "
        "correct the name",
        remedy="Correct the name, or the rights of the file",
    )
    if len(content) > MAX_BYTES:
        raise CellFileError(
            f"{path} is longer than {MAX_BYTES} bytes, the most that a cell file may be: name another, or shorten it"
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


@cache
def keys() -> KeyList:
    """Return the keys of a cell file in words."""
    return KeyList(CellFile.model_json_schema())


def _examined(values: Mapping[str, Any], source: str) -> Examination:
    try:
        cell = CellFile.model_validate(_normal(values))
    except ValidationError as error:
        errors = error.errors(include_url=False)
        unfit = errors[0].get("ctx", {}).get("error")
        if isinstance(unfit, _UnfitError):
            return Examination(None, unfit.findings)
        errors.sort(key=lambda each: each["type"] == "missing")  # last: a misspelt key may be the one that is missing
        findings = []
        for each in errors:
            findings.append(keys().finding(each["type"], each["loc"], each["input"]))
            if each["type"].startswith("union_tag"):
                findings += keys().strays(each["loc"], each["input"])
        # A vector that is too short gives an error for each missing number.
        return Examination(None, [*dict.fromkeys(findings), *_missing_of_real(values)])
    cell._source = source
    return Examination(cell, [])


def _normal(value: Any) -> Any:
    """Arrays as tuples, and zeros without a sign: equal files have equal texts."""
    if isinstance(value, Mapping):
        return {name: _normal(each) for name, each in value.items()}
    if isinstance(value, list | tuple):
        return tuple(map(_normal, value))
    return value + 0.0 if isinstance(value, float) else value


def _missing_of_real(values: Mapping[str, Any]) -> Iterator[str]:
    """Yield what the file of a real cell has to name and does not."""
    if values.get("kind") != "real":
        return
    for each in keys().keys:
        if not each.schema.get("if_real"):
            continue
        for arm in ARMS if each.path.startswith("ARM.") else ("",):
            table = values.get(arm) if arm else values
            if isinstance(table, Mapping) and each.name not in table:
                yield missing(each.path.replace("ARM", arm), each, "the file of a real cell has to name it")
