"""Files of joint trajectories: JSON and YAML of ROS `trajectory_msgs/JointTrajectory`, and CSV.

A CSV file has a header and a row per point: `time_s`, then each joint's position, and optionally its speed and its
acceleration, as in `left/elbow_joint`, `left/elbow_joint.speed` and `left/elbow_joint.acceleration`; rad and s.

A path has points without times: a message with all times 0, or a CSV file without `time_s`.
"""

from __future__ import annotations

import csv
import difflib
import io
import json
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Any, Final, Literal, get_args

import numpy as np
from pydantic import BaseModel, ConfigDict, Field, ValidationError

from dual_ur10.errors import TrajectoryError, UnknownNameError
from dual_ur10.sim2real.trajectory.joint_trajectory import JointTrajectory, ResultCode, too_long
from dual_ur10.yaml_documents import documents
from ur_core.files import check_target, read_named
from ur_core.findings import path_of
from ur_core.kinematics.ur10 import ARMS, JOINTS
from ur_core.types import Array

MOST_BYTES: Final = 64 << 20
"""Size above which a file is not read."""

MOST_YAML_BYTES: Final = 4 << 20
"""The same for YAML, which takes a hundred times as long to read as JSON."""

MOST_POINTS: Final = 200_000
"""Largest number of points: half an hour at 125 Hz."""

Format = Literal["json", "yaml", "csv"]

FORMATS: Final[dict[str, Format]] = {".json": "json", ".yaml": "yaml", ".yml": "yaml", ".csv": "csv"}
"""Formats by the suffix of a file."""

_NAMES: Final = tuple(f"{arm}/{joint}" for arm in ARMS for joint in JOINTS)
_ORDERS: Final = ("", ".speed", ".acceleration")
_FIELDS: Final = ("q_rad", "qd_rad_s", "qdd_rad_s2")
_NS: Final = 1_000_000_000


class _Strict(BaseModel):
    model_config = ConfigDict(strict=True, extra="forbid")


Seconds = Annotated[int, Field(ge=-(2**31), lt=2**31)]
Nanoseconds = Annotated[int, Field(ge=0, lt=_NS)]
Values = Annotated[list[float], Field(max_length=len(_NAMES))]


class _Time(_Strict):
    sec: Seconds = 0
    nanosec: Nanoseconds = 0


class _Header(_Strict):
    stamp: _Time = _Time()
    frame_id: str = ""


class _Point(_Strict):
    positions: Values
    velocities: Values = Field(default_factory=list)
    accelerations: Values = Field(default_factory=list)
    effort: Annotated[list[float], Field(max_length=0)] = Field(default_factory=list)
    time_from_start: _Time


class _Message(_Strict):
    header: _Header = _Header()
    joint_names: Annotated[list[str], Field(min_length=1, max_length=len(_NAMES))]
    points: Annotated[list[_Point], Field(min_length=1, max_length=MOST_POINTS)]


def read_trajectory(path: str | Path, *, number_points: bool = False, allow_partial: bool = False) -> JointTrajectory:
    """Return the trajectory of a file, whose suffix names its format: .json, .yaml, .yml or .csv.

    Args:
        path: The file.
        number_points: Accept points without times; their numbers stand for times.
        allow_partial: Leave out the last row of a CSV file if it has no line end: it was cut off.

    Raises:
        TrajectoryError: The file cannot be read, or holds no legal trajectory.
    """
    path = Path(path)
    kind = FORMATS.get(path.suffix.lower())
    if kind is None:
        raise TrajectoryError(f"{path} has the suffix {path.suffix!r}: it must be one of {', '.join(FORMATS)}")
    data = read_named(path, MOST_BYTES, TrajectoryError, absent=f"there is no file {path}: correct the name")
    return parse_trajectory(data, kind, str(path), number_points=number_points, allow_partial=allow_partial)


def parse_trajectory(
    data: bytes,
    kind: Format,
    where: str = "the trajectory",
    *,
    number_points: bool = False,
    allow_partial: bool = False,
) -> JointTrajectory:
    """Return the trajectory of a file's content.

    Args:
        data: The content.
        kind: "json", "yaml" or "csv".
        where: Name of the file, for messages.
        number_points: See `read_trajectory`.
        allow_partial: See `read_trajectory`.

    Raises:
        TrajectoryError: It holds no legal trajectory; with INVALID_JOINTS where joints are unknown or missing.
    """
    if kind not in get_args(Format):
        raise UnknownNameError("format of a trajectory", str(kind), get_args(Format))
    most = MOST_YAML_BYTES if kind == "yaml" else MOST_BYTES
    if len(data) > most:
        other = ": convert it to JSON" if kind == "yaml" else ": send it in parts"
        raise TrajectoryError(f"{where} is longer than {most} bytes, the most that is read{other}")
    try:
        text = data.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        raise TrajectoryError(f"{where} is no text in UTF-8: {error}") from None
    try:
        if kind == "csv":
            found = _from_csv(_whole_rows(text, allow_partial), number_points)
        else:
            found = _from_message(_loaded(text, kind), number_points)
        if not number_points and (text := too_long(found.duration_s)):
            raise TrajectoryError(text)
    except TrajectoryError as error:
        raise TrajectoryError(f"{where}: {error}", error.code) from None
    return found


def write_trajectory(path: str | Path, trajectory: JointTrajectory) -> Path:
    """Write a new file in the format that its suffix names, .json or .csv, and return its path.

    Raises:
        TrajectoryError: The suffix is another, or the file exists.
        DualUR10Error: It cannot be written.
    """
    path = check_target(path)
    kind = FORMATS.get(path.suffix.lower())
    if kind not in ("json", "csv"):
        raise TrajectoryError(f"cannot write {path}: the suffix must be .json or .csv")
    text = _csv_of(trajectory) if kind == "csv" else _json_of(trajectory)
    try:
        file = path.open("x", encoding="utf-8", newline="")
    except FileExistsError:
        raise TrajectoryError(f"{path} exists: choose another name, or remove it") from None
    except OSError as error:
        raise TrajectoryError(f"cannot write {path}: {error}") from error
    try:
        with file:
            file.write(text)
    except BaseException as error:  # a part of a CSV file reads as a shorter trajectory
        path.unlink(missing_ok=True)
        if isinstance(error, OSError):
            raise TrajectoryError(f"cannot write {path}: {error}") from error
        raise
    return path


# Messages.


def _loaded(text: str, kind: Format) -> object:
    try:
        if kind == "json":
            return json.loads(text)
        found = [each for each in documents(text, "real", "a trajectory in YAML") if each is not None]
    except (ValueError, RecursionError) as error:
        reason = " ".join(str(error).split())
        if "set_int_max_str_digits" in reason:  # Python's own remedy is none here
            reason = "a value has too many digits to be a number here"
        raise TrajectoryError(f"this is no {kind.upper()}: {reason:.200}") from None
    if len(found) != 1:
        raise TrajectoryError(f"there are {len(found)} documents: one message must be there, of JointTrajectory")
    return found[0]


def _from_message(value: object, number_points: bool) -> JointTrajectory:
    try:
        message = _Message.model_validate(value)
    except (ValidationError, RecursionError) as error:
        raise TrajectoryError(_finding(error)) from None
    if message.header.stamp.sec or message.header.stamp.nanosec:
        raise TrajectoryError(
            "header.stamp is not 0: a time of another clock means nothing here. Set it to 0, and the start in the goal",
            ResultCode.OLD_HEADER_TIMESTAMP,
        )
    points, count = message.points, len(message.joint_names)
    lists: list[tuple[str, list[list[float]]]] = [
        ("positions", [each.positions for each in points]),
        ("velocities", [each.velocities for each in points]),
        ("accelerations", [each.accelerations for each in points]),
    ]
    values: list[Array | None] = []
    for name, rows in lists:
        given = [k for k, row in enumerate(rows) if row]
        if not given and name != "positions":
            values.append(None)
            continue
        for k, row in enumerate(rows):
            if len(row) != count:
                raise TrajectoryError(
                    f"points[{k}].{name} has {len(row)} numbers, and there are {count} joints: all points must have as "
                    f"many{'' if name == 'positions' else ', or none'}"
                )
        values.append(np.array(rows))
    times = np.array([each.time_from_start.sec + each.time_from_start.nanosec / _NS for each in points])
    if number_points and not times.any():
        times = np.arange(len(points), dtype=np.float64)
    return _of_joints(message.joint_names, times, values)


def _finding(error: ValidationError | RecursionError) -> str:
    if isinstance(error, RecursionError):
        return "it is nested too deeply: it must be a JointTrajectory"
    found = error.errors(include_url=False)[0]
    path = path_of(found["loc"]).removeprefix(".")
    if found["type"] == "extra_forbidden":
        known = {name for model in (_Message, _Header, _Point, _Time) for name in model.model_fields}
        near = difflib.get_close_matches(str(found["loc"][-1])[:60], sorted(known), 1)
        return f"{path} is unknown: remove it" + (f", or did you mean {near[0]}?" if near else "")
    if found["type"] == "missing":
        return f"{path} is missing: write it"
    if "effort" in found["loc"]:
        return f"{path} is given: efforts cannot be commanded, leave them out"
    return f"{path or 'the content'} is {found['input']!r:.80}: {found['msg']}"


def _of_joints(names: Sequence[str], times: Array, values: Sequence[Array | None]) -> JointTrajectory:
    """Return a trajectory from columns of joints in any order, (points, joints) each.

    Raises:
        TrajectoryError: A joint is unknown, missing or there twice.
    """
    columns: dict[str, int] = {}
    for column, given in enumerate(names):
        name = given.replace("_", "/", 1) if given.startswith(tuple(f"{arm}_" for arm in ARMS)) else given
        if name not in _NAMES:
            near = difflib.get_close_matches(given[:60], _NAMES, 1, 0.5)
            hint = f"did you mean {near[0]}?" if near else f"joints are named like {_NAMES[0]}"
            raise TrajectoryError(f"joint {given!r:.80} is unknown: {hint}", ResultCode.INVALID_JOINTS)
        if name in columns:
            raise TrajectoryError(f"joint {name} is there twice: remove one", ResultCode.INVALID_JOINTS)
        columns[name] = column
    arms = tuple(arm for arm in ARMS if any(f"{arm}/{joint}" in columns for joint in JOINTS))
    wanted = [f"{arm}/{joint}" for arm in arms for joint in JOINTS]
    for name in wanted:
        if name not in columns:
            raise TrajectoryError(
                f"joint {name} is missing: all six joints of an arm must be there", ResultCode.INVALID_JOINTS
            )
    order = [columns[name] for name in wanted]
    shape = (len(times), len(arms), 6)
    given_values: dict[str, Any] = {
        name: None if each is None else each[:, order].reshape(shape)
        for name, each in zip(_FIELDS, values, strict=True)
    }
    return JointTrajectory(arms, times, **given_values)


def _json_of(trajectory: JointTrajectory) -> str:
    names = [f"{arm}/{joint}" for arm in trajectory.arms for joint in JOINTS]
    given = [("positions", trajectory.q_rad), ("velocities", trajectory.qd_rad_s)]
    given.append(("accelerations", trajectory.qdd_rad_s2))
    points = []
    for k, time_s in enumerate(trajectory.time_s.tolist()):
        sec, nanosec = divmod(round(time_s * _NS), _NS)
        point: dict[str, Any] = {name: each[k].ravel().tolist() for name, each in given if each is not None}
        points.append({**point, "time_from_start": {"sec": sec, "nanosec": nanosec}})
    lines = ",\n".join(f"    {json.dumps(point)}" for point in points)
    return f'{{\n  "joint_names": {json.dumps(names)},\n  "points": [\n{lines}\n  ]\n}}\n'


# CSV.


def _whole_rows(text: str, allow_partial: bool) -> str:
    """Return the rows that have a line end.

    Raises:
        TrajectoryError: The last one has none, and is not to be left out.
    """
    end = max(text.rfind("\n"), text.rfind("\r")) + 1
    if end == len(text):
        return text
    if not allow_partial:
        raise TrajectoryError(
            "the last row has no line end: it may be cut off, and its last number be another one. Add the line end if "
            "the row is whole, or leave the row out (`follow --allow-partial`)"
        )
    return text[:end]


def _from_csv(text: str, number_points: bool) -> JointTrajectory:
    rows = csv.reader(io.StringIO(text, newline=""))
    try:
        header = [each.strip() for each in next(rows, [])]
        body = [row for row in rows if row]
    except csv.Error as error:
        raise TrajectoryError(f"this is no CSV: {error}") from None
    if number_points and header and "time_s" not in header:
        header, body = ["time_s", *header], [[str(k), *row] for k, row in enumerate(body)]
    if not header or header[0] != "time_s":
        raise TrajectoryError(f"the first column is {(header or [''])[0]!r:.80}: it must be time_s, in a header")
    if not 0 < len(body) <= MOST_POINTS:
        raise TrajectoryError(f"there are {len(body)} rows of points: it must be 1 to {MOST_POINTS}")
    for k, row in enumerate(body):
        if len(row) != len(header):
            raise TrajectoryError(f"point {k} has {len(row)} values, and the header {len(header)}")
    try:
        table = np.array(body, dtype=np.float64)
    except ValueError as error:
        raise TrajectoryError(f"a value is no number: {error!s:.200}") from None
    columns: list[dict[str, int]] = [{}, {}, {}]
    for column, name in enumerate(header[1:], 1):
        order = next((k for k in (1, 2) if name.endswith(_ORDERS[k])), 0)
        joint = name.removesuffix(_ORDERS[order])
        if joint in columns[order]:
            raise TrajectoryError(f"the column {name!r:.80} is there twice: remove one", ResultCode.INVALID_JOINTS)
        columns[order][joint] = column
    names = list(columns[0])
    for order in (1, 2):
        if columns[order] and set(columns[order]) != set(names):
            off = sorted(set(columns[order]) ^ set(names))[0]
            raise TrajectoryError(
                f"{off!r:.80} has no column with the suffix {_ORDERS[order]!r}, or only that: all joints or none",
                ResultCode.INVALID_JOINTS,
            )
    values = [table[:, [each[name] for name in names]] if each or not k else None for k, each in enumerate(columns)]
    if not names:
        raise TrajectoryError("there is no column of a joint", ResultCode.INVALID_JOINTS)
    return _of_joints(names, table[:, 0], values)


def _csv_of(trajectory: JointTrajectory) -> str:
    names = [f"{arm}/{joint}" for arm in trajectory.arms for joint in JOINTS]
    given = [(suffix, getattr(trajectory, field)) for suffix, field in zip(_ORDERS, _FIELDS, strict=True)]
    kept = [(suffix, each) for suffix, each in given if each is not None]
    out = io.StringIO(newline="")
    writer = csv.writer(out, lineterminator="\n")
    writer.writerow(["time_s", *(f"{name}{suffix}" for suffix, _ in kept for name in names)])
    count = len(trajectory)
    table = np.concatenate([trajectory.time_s[:, None], *(each.reshape(count, -1) for _, each in kept)], axis=1)
    writer.writerows([[repr(value) for value in row] for row in table.tolist()])
    return out.getvalue()
