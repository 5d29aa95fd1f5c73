"""Schedules of the fault simulator: a cell, a policy and faults, random from a seed or from a file."""

from __future__ import annotations

import json
import re
import tomllib
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
from pydantic import BaseModel, ConfigDict, Field, ValidationError

from dual_ur10.errors import SettingsError

Arm = Literal["left", "right"]
Port = Literal["dashboard", "primary", "secondary", "realtime", "rtde", "gripper"]
When = Literal["start", "approach", "motion", "stop", "end"]

_STOPS = (3, 4, 5, 6, 7, 8, 9, 10, 11, 12, 13, 14, 15, 16, 17, 21, 22, 99, 255)
_LONGEST_S = 2.0


class Model(BaseModel):
    """Part of a schedule; unknown keys and other types are refused."""

    model_config = ConfigDict(strict=True, extra="forbid", frozen=True, allow_inf_nan=False)


class Timed(Model):
    """Fault.

    Attributes:
        when: Phase of the program that the instant is counted from; "stop" begins when the first process stops.
        at_s: Delay after that.
        duration_s: Time until the cause is removed; 0: it stays.
    """

    when: When = "motion"
    at_s: Annotated[float, Field(ge=0.0, le=5.0)] = 0.3
    duration_s: Annotated[float, Field(ge=0.0, le=_LONGEST_S)] = 0.0


class Safety(Timed):
    """Rows 29 to 31: stop condition of a controller, any code."""

    kind: Literal["safety"] = "safety"
    arm: Arm
    mode: Annotated[int, Field(ge=0, le=255)]


class Press(Timed):
    """Rows 32, 33 and 38: operator at the pendant; with a duration, `then` follows."""

    kind: Literal["press"] = "press"
    arm: Arm
    button: Literal["stop", "pause", "power_off"]
    then: Literal["", "resume", "play"] = ""


class Slider(Timed):
    """Row 34: speed slider."""

    kind: Literal["slider"] = "slider"
    arm: Arm
    fraction: Annotated[float, Field(ge=0.0, le=1.0)]


class Reduced(Timed):
    """Row 35: reduced mode."""

    kind: Literal["reduced"] = "reduced"
    arm: Arm


class Local(Timed):
    """Row 36: local control of an e-Series."""

    kind: Literal["local"] = "local"
    arm: Arm


class Override(Timed):
    """Rows 38, 41 to 43 and 45: a controller reports other values than the true ones."""

    kind: Literal["override"] = "override"
    arm: Arm
    what: Literal["tracking", "hot", "moving", "clock stands", "clock back", "robot mode", "program", "payload", "nan"]


class Pretend(Timed):
    """Rows 25, 26, 39 and 40: another controller than the expected one."""

    kind: Literal["pretend"] = "pretend"
    arm: Arm
    what: Literal["version", "type", "calibration", "serial number"]


class Link(Timed):
    """Rows 18 and 20 to 24: fault of a port's connections."""

    kind: Literal["link"] = "link"
    arm: Arm
    port: Port
    effect: Literal["mute", "frozen", "half_open", "delay_s", "jitter_s", "lose", "corrupt", "short", "long", "foreign"]
    amount: Annotated[float, Field(ge=0.0, le=20.0)] = 0.0


class Drop(Timed):
    """Row 19: connections of a port are closed."""

    kind: Literal["drop"] = "drop"
    arm: Arm
    port: Port
    reset: bool = False
    writers: bool = False


class Refuse(Timed):
    """Row 17: new connections are refused."""

    kind: Literal["refuse"] = "refuse"
    arm: Arm
    port: Port


class ScriptDelay(Timed):
    """Row 18: the control script starts late."""

    kind: Literal["script_delay"] = "script_delay"
    arm: Arm
    seconds: Annotated[float, Field(ge=0.0, le=20.0)]


class Stall(Timed):
    """Rows 54 to 56: a process does not run for `duration_s`."""

    kind: Literal["stall"] = "stall"
    process: Literal["left", "right", "supervisor", "recorder", "controllers", "left controller", "right controller"]


class Death(Timed):
    """Rows 11 and 56: a process ends at once."""

    kind: Literal["death"] = "death"
    process: Literal["left", "right", "supervisor", "recorder", "controllers", "left controller", "right controller"]


class Policy(Timed):
    """Rows 1 to 5, 8 to 10, 12, 13 and 57: wrong, late or absent action; an interrupt."""

    kind: Literal["policy"] = "policy"
    how: Literal["nan", "inf", "shape", "text", "huge", "late", "raise", "interrupt"]


class Disk(Timed):
    """Row 59: nothing can be written any more."""

    kind: Literal["disk"] = "disk"


class Second(Timed):
    """Row 58: a second program on the same arms."""

    kind: Literal["second"] = "second"


class WallClock(Timed):
    """Row 53: the wall clock jumps by an hour."""

    kind: Literal["wall_clock"] = "wall_clock"


Fault = Annotated[
    Safety
    | Press
    | Slider
    | Reduced
    | Local
    | Override
    | Pretend
    | Link
    | Drop
    | Refuse
    | ScriptDelay
    | Stall
    | Death
    | Policy
    | Disk
    | Second
    | WallClock,
    Field(discriminator="kind"),
]


class Cell(Model):
    """Cell and policy.

    Attributes:
        right_phase_s: Phase of the right controller, which then has a clock of its own; -1: both share one.
        start: Seed of the episode differs from that of the cell, so that the arms move to the start.
        rows: Action of the policy: a name.
    """

    task: Literal["SineTracking", "SyncCarry", "Handover"] = "SineTracking"
    family: Literal["cb3", "e-series"] = "cb3"
    plant: Literal["nominal", "mild"] = "nominal"
    seed: Annotated[int, Field(ge=0, le=1000)] = 0
    speed_factor: Annotated[float, Field(ge=0.1, le=1.0)] = 1.0
    drift_ppm: Annotated[float, Field(ge=-200.0, le=200.0)] = 0.0
    right_phase_s: Annotated[float, Field(ge=-1.0, le=0.01)] = -1.0
    right_drift_ppm: Annotated[float, Field(ge=-200.0, le=200.0)] = 0.0
    allow_reduced_mode: bool = False
    far: bool = False
    policy: Literal["scripted", "swing", "random", "bounds", "rest"] = "swing"
    motion_s: Annotated[float, Field(ge=0.1, le=5.0)] = 0.8
    record: Literal["", "go on", "stop"] = ""
    again: bool = False


class Schedule(Model):
    """Cell and faults.

    Attributes:
        seed: Seed that it came from, or any number: seed of the policy.
        cell: Cell and policy.
        faults: Faults, in any order.
    """

    seed: Annotated[int, Field(ge=0)] = 0
    cell: Cell = Cell()
    faults: Annotated[tuple[Fault, ...], Field(max_length=8, strict=False)] = ()


# The kinds of faults, how often they are drawn, and in which phases.
_KINDS: dict[str, tuple[float, tuple[When, ...]]] = {
    "safety": (4, ("start", "approach", "motion", "motion", "stop", "end")),
    "press": (3, ("start", "approach", "motion", "motion", "stop", "end")),
    "slider": (3, ("start", "approach", "motion", "motion", "stop", "end")),
    "reduced": (1, ("start", "approach", "motion", "stop", "end")),
    "local": (0.5, ("start", "motion")),
    "override": (2, ("start", "approach", "motion", "motion", "stop", "end")),
    "pretend": (0.7, ("start",)),
    "link": (6, ("start", "approach", "motion", "motion", "motion", "stop", "end")),
    "drop": (3, ("start", "approach", "motion", "motion", "stop", "end")),
    "refuse": (1, ("start", "motion", "stop", "end")),
    "script_delay": (0.4, ("start",)),
    "stall": (5, ("start", "approach", "motion", "motion", "motion", "stop", "end")),
    "death": (3, ("start", "approach", "motion", "motion", "stop", "end")),
    "policy": (4, ("motion",)),
    "disk": (1, ("start", "motion", "stop", "end")),
    "second": (0.5, ("motion",)),
    "wall_clock": (0.5, ("start", "motion")),
}


def draw(seed: int) -> Schedule:
    """Return the schedule of a seed: a single fault if it is even, else a pair."""
    rng = np.random.default_rng(seed)
    cell = _cell(rng)
    faults = tuple(_fault(rng, cell) for _ in range(1 + seed % 2))
    if any(each.kind == "disk" for each in faults) and not cell.record:
        cell = cell.model_copy(update={"record": str(rng.choice(["go on", "stop"]))})
    return Schedule(seed=seed, cell=cell, faults=faults)


def _cell(rng: np.random.Generator) -> Cell:
    task = str(rng.choice(["SineTracking", "SyncCarry", "Handover"], p=[0.8, 0.1, 0.1]))
    apart = task == "SineTracking" and rng.random() < 0.25
    family = "e-series" if rng.random() < 0.08 else "cb3"
    tick_s = 0.002 if family == "e-series" else 0.008
    drift = rng.choice([0.0, round(float(rng.uniform(-200, 200)), 1)])
    policies = ["scripted", "swing", "random", "bounds", "rest"]
    return Cell(
        task=task,
        family=family,
        plant=str(rng.choice(["nominal", "mild"])),
        seed=int(rng.integers(20)),
        speed_factor=float(rng.choice([1.0, 1.0, 0.75, 0.5])),
        drift_ppm=float(drift),
        right_phase_s=round(float(rng.uniform(0, tick_s)), 5) if apart else -1.0,
        right_drift_ppm=round(float(rng.uniform(-200, 200)), 1) if apart else 0.0,
        allow_reduced_mode=bool(rng.random() < 0.2),
        far=bool(rng.random() < 0.15),
        policy="scripted" if task != "SineTracking" else str(rng.choice(policies, p=[0.3, 0.3, 0.2, 0.15, 0.05])),
        motion_s=round(float(rng.uniform(0.4, 0.8)), 2),
        record=str(rng.choice(["", "go on", "stop"], p=[0.8, 0.1, 0.1])),
        again=bool(rng.random() < 0.05),
    )


def _duration(rng: np.random.Generator, least_s: float = 0.001, most_s: float = _LONGEST_S) -> float:
    """Return a duration, its logarithm uniform."""
    return round(float(np.exp(rng.uniform(np.log(least_s), np.log(most_s)))), 4)


def _fault(rng: np.random.Generator, cell: Cell) -> Any:
    names = list(_KINDS)
    weights = np.array([_KINDS[name][0] for name in names])
    kind = str(rng.choice(names, p=weights / weights.sum()))
    when = str(rng.choice(_KINDS[kind][1]))
    most_s = {"start": 0.65, "approach": 1.5 if cell.far else 0.2, "motion": 0.6, "stop": 0.25, "end": 0.2}[when]
    timed: dict[str, Any] = {"when": when, "at_s": round(float(rng.uniform(0.0, most_s)), 4)}
    arm = str(rng.choice(["left", "right"]))
    lasting = {"duration_s": float(rng.choice([0.0, _duration(rng)]))}
    ports = ["dashboard", "primary", "realtime", "rtde", "rtde", "rtde"] + ["gripper"] * (cell.task != "SineTracking")
    port = str(rng.choice(ports))
    own = cell.right_phase_s >= 0.0
    controllers = ["left controller", "right controller"] if own else ["controllers"]
    match kind:
        case "safety":
            return Safety(arm=arm, mode=int(rng.choice(_STOPS)), **timed, **lasting)
        case "press":
            button, then = [
                ("stop", ""),
                ("stop", "play"),
                ("pause", ""),
                ("pause", "resume"),
                ("pause", "play"),
                ("power_off", ""),
            ][int(rng.integers(6))]
            return Press(arm=arm, button=button, then=then, duration_s=_duration(rng) if then else 0.0, **timed)
        case "slider":
            fraction = float(rng.choice([0.0, 0.05, 0.3, 0.5, 0.99, round(float(rng.uniform(0, 1)), 3)]))
            return Slider(arm=arm, fraction=fraction, duration_s=_duration(rng, 0.005, 1.0), **timed)
        case "reduced":
            return Reduced(arm=arm, **timed, **lasting)
        case "local":
            return Local(arm=arm, **timed, **lasting)
        case "override":
            what = str(rng.choice(Override.model_fields["what"].annotation.__args__))  # type: ignore[union-attr]
            return Override(arm=arm, what=what, **timed, **lasting)
        case "pretend":
            what = str(rng.choice(["version", "type", "calibration", "serial number"]))
            return Pretend(arm=arm, what=what, **timed)
        case "link":
            effects = ["mute", "frozen", "delay_s", "jitter_s", "lose", "corrupt", "short", "long", "foreign"]
            effect = str(rng.choice(["half_open", *effects] if when == "start" else effects))
            amount = 0.0
            if effect in ("delay_s", "jitter_s"):
                amount = _duration(rng, 0.0005, 0.5)
            elif effect not in ("mute", "frozen", "half_open"):
                amount = float(rng.integers(1, 20))
            return Link(arm=arm, port=port, effect=effect, amount=amount, **timed, **lasting)
        case "drop":
            writers = port == "rtde" and bool(rng.random() < 0.4)
            return Drop(arm=arm, port=port, reset=bool(rng.random() < 0.5), writers=writers, **timed)
        case "refuse":
            return Refuse(arm=arm, port=port, **timed, **lasting)
        case "script_delay":
            return ScriptDelay(arm=arm, seconds=round(float(rng.choice([0.05, 0.5, 20.0])), 3), **timed)
        case "stall":
            process = str(rng.choice(["left", "right", "supervisor", "recorder", *controllers]))
            return Stall(process=process, **timed, duration_s=_duration(rng))
        case "death":
            process = str(rng.choice(["left", "right", "supervisor", "recorder", *controllers], p=None))
            return Death(process=process, **timed)
        case "policy":
            how = str(rng.choice(["nan", "inf", "shape", "text", "huge", "late", "late", "late", "raise", "interrupt"]))
            return Policy(how=how, duration_s=_duration(rng, 0.005) if how == "late" else 0.0, **timed)
        case "disk":
            return Disk(**timed, **lasting)
        case "second":
            return Second(**timed)
        case _:
            return WallClock(**timed)


def load(path: str | Path) -> Schedule:
    """Read a schedule from a TOML or JSON file.

    Raises:
        SettingsError: It is malformed; the message names line and field.
    """
    path = Path(path)
    try:
        text = path.read_text(encoding="utf-8")
        values = json.loads(text) if path.suffix == ".json" else tomllib.loads(text)
    except (OSError, UnicodeDecodeError, json.JSONDecodeError, tomllib.TOMLDecodeError, RecursionError) as error:
        raise SettingsError(f"{path} cannot be read as a schedule: {error}") from error
    try:
        return Schedule.model_validate(values)
    except ValidationError as error:
        first = error.errors()[0]
        names = [each for each in first["loc"] if not (isinstance(each, str) and each in _KINDS)]
        field = ".".join(map(str, names)) or "the whole"
        raise SettingsError(
            f"{path}, line {_line(text, names)}: {field}: {first['msg']}, found {first['input']!r:.100}"
        ) from error


def _line(text: str, names: list[Any]) -> int:
    """Return the line of a field: of its name, after as many faults as come before it."""
    lines = text.splitlines()
    at = 0
    for place, name in enumerate(names):
        if isinstance(name, int):
            wanted = name + 1
            pattern = r"\s*\[\[\s*faults\s*\]\]|.*\"kind\"|\s*\{\s*kind|\s*kind\s*="
            starts = [n for n, line in enumerate(lines) if re.match(r"\s*\[\[\s*faults\s*\]\]", line)]
            starts = starts or [n for n, line in enumerate(lines) if re.match(pattern, line)]
            at = starts[wanted - 1] if len(starts) >= wanted else at
        else:
            found = [n for n in range(at, len(lines)) if re.search(rf"(?<!\w){re.escape(name)}(?!\w)", lines[n])]
            if found and (place or len(names) == 1 or found):
                at = found[0]
    return at + 1


def text(schedule: Schedule) -> str:
    """Return a schedule as TOML, without defaults, for a file."""
    lines = [f"seed = {schedule.seed}"]
    cell = schedule.cell.model_dump(exclude_defaults=True)
    lines += ["", "[cell]", *(f"{name} = {json.dumps(value)}" for name, value in cell.items())]
    for fault in schedule.faults:
        lines += ["", "[[faults]]", *(f"{name} = {json.dumps(value)}" for name, value in fault.model_dump().items())]
    return "\n".join(lines) + "\n"
