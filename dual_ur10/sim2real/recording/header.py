"""Header of a record: description of a run that begins, and its JSON in the metadata of the file."""

from __future__ import annotations

import hashlib
import json
import reprlib
import zlib
from collections.abc import Mapping
from dataclasses import asdict, fields, is_dataclass
from datetime import UTC, datetime
from functools import cache
from importlib.metadata import PackageNotFoundError, version
from types import UnionType
from typing import Any, Final, Union, get_args, get_origin, get_type_hints

import numpy as np
from pydantic import TypeAdapter, ValidationError

from dual_ur10.errors import RecordingError, SettingsError, UnknownNameError
from dual_ur10.ids import __version__
from dual_ur10.sim2real.cell.cell_config import CellConfig
from dual_ur10.sim2real.recording.run import Header, Mount, ServojSettings, Source
from ur_core.findings import listed
from ur_core.kinematics.frames import ArmMount
from ur_core.kinematics.ur10 import DHParameters, nominal_dh

FORMAT: Final = "1"
METADATA_NAME: Final = "dual_ur10"

_PACKAGES: Final = ("numpy", "mujoco", "gymnasium", "ur-rtde")
_MOST_TEXT: Final = 2**20  # a wrong value takes about 1.5 KB for its finding, and three characters in the text
_MOST_FINDINGS: Final = 10


def describe(
    env_id: str,
    kwargs: Mapping[str, Any],
    config: CellConfig,
    *,
    period_ticks: int,
    latency_ticks: int,
    source: Source = "mujoco",
    seed: int | None = None,
    speed_factor: float = 1.0,
    policy: str = "",
    policy_sha256: str | None = None,
    cell_file: str | None = None,
    extra: Mapping[str, Any] | None = None,
    started: datetime | None = None,
) -> Header:
    """Return the header of a run that begins now; see `Header` for the arguments; `started` None: now.

    Of the dataclasses in `kwargs`, fields that differ from their defaults are kept; functions are left out.

    Raises:
        RecordingError: A keyword cannot be described in JSON.
    """
    servoj = ServojSettings(lookahead_s=config.servoj.lookahead_s, gain=config.servoj.gain)
    return Header(
        env_id=env_id,
        kwargs=plain({name: value for name, value in kwargs.items() if not callable(value)}),
        seed=None if seed is None else int(seed),
        source=source,
        family=config.servoj.family,
        tick_s=config.servoj.tick_s,
        period_ticks=period_ticks,
        latency_ticks=latency_ticks,
        speed_factor=float(speed_factor),
        mounts=[_plain_mount(mount) for mount in (config.left, config.right)],
        servoj=[servoj, servoj.copy()],
        versions=versions(*_PACKAGES),
        started_utc=(started or datetime.now(UTC)).isoformat(timespec="microseconds").replace("+00:00", "Z"),
        policy=policy,
        policy_sha256=policy_sha256,
        cell_file=cell_file,
        cell_sha256=None if cell_file is None else hashlib.sha256(cell_file.encode()).hexdigest(),
        extra=plain(dict(extra or {})),
    )


def mounts_of(header: Header) -> tuple[ArmMount, ArmMount]:
    """Return the base poses and the kinematics of both arms; nominal kinematics where the header holds none.

    Raises:
        RecordingError: They are not those of two arms of known models.
    """
    try:
        left, right = (_mount(each) for each in header.mounts)
    except (SettingsError, AttributeError, KeyError, TypeError, ValueError) as error:
        raise RecordingError(
            f"the recording's mounts are not those of two arms: {error}. It is of another robot, or damaged"
        ) from error
    return left, right


def _mount(values: Mount) -> ArmMount:
    x, y, z = values["position_m"]
    robot = values.get("robot", "ur10")
    dh: dict[str, Any] = {name: tuple(each) for name, each in values.get("dh", {}).items()}
    kinematics = DHParameters(**dh, robot=robot) if dh else nominal_dh(robot)
    tilt_x, tilt_y = values.get("tilt_rad", (0.0, 0.0))
    return ArmMount((x, y, z), values.get("yaw_rad", 0.0), kinematics, robot, (tilt_x, tilt_y))


def _plain_mount(mount: ArmMount) -> Mount:
    dh = mount.dh
    rows = {"a_m": dh.a_m, "d_m": dh.d_m, "alpha_rad": dh.alpha_rad, "theta_rad": dh.theta_rad}
    found: Mount = plain(
        {
            "position_m": mount.position_m,
            "yaw_rad": mount.yaw_rad,
            "tilt_rad": mount.tilt_rad,
            "robot": mount.robot,
            "dh": rows,
        }
    )
    return found


def plain(value: Any) -> Any:
    """Return a value as JSON can hold it; a dataclass as a map of the fields that differ from their defaults.

    Raises:
        RecordingError: JSON cannot hold it.
    """
    if value is None or isinstance(value, str | bool | int):
        return value
    if isinstance(value, float | np.floating):
        return float(value)
    if isinstance(value, np.ndarray | np.generic):
        return plain(value.tolist())
    if isinstance(value, Mapping):
        return {str(key): plain(each) for key, each in value.items()}
    if isinstance(value, tuple | list):
        return [plain(each) for each in value]
    if is_dataclass(value) and not isinstance(value, type):
        default = _default(type(value))
        pairs = ((field.name, getattr(value, field.name)) for field in fields(value) if field.init)
        return {name: plain(each) for name, each in pairs if default is None or each != getattr(default, name)}
    raise RecordingError(f"{value!r:.200} of type {type(value).__name__} cannot be recorded: use plain values")


def _default(kind: type[Any]) -> Any:
    try:
        return kind()
    except TypeError:  # some fields have no default
        return None


def built(kind: Any, value: Any) -> Any:
    """Return a value of a type from what `plain` returns of it; lists become tuples.

    Args:
        kind: Type, as an annotation states it. Nothing but the dataclasses in it is made.
        value: What JSON holds.

    Raises:
        UnknownNameError: No dataclass of the type has fields of these names.
        TypeError: A field without default is missing.
    """
    if get_origin(kind) in (Union, UnionType):
        return built(_member(get_args(kind), value), value)
    inner = get_args(kind)
    if isinstance(value, list):
        each = inner if inner and len(inner) == len(value) and ... not in inner else inner[:1] * len(value)
        return tuple(built(one, item) for one, item in zip(each or [None] * len(value), value, strict=True))
    if not isinstance(value, Mapping):
        return value
    if not (isinstance(kind, type) and is_dataclass(kind)):
        return {name: built(inner[-1] if inner else None, each) for name, each in value.items()}
    known, types = _arguments(kind), field_types(kind)
    unknown = next((name for name in value if name not in known), None)
    if unknown is not None:
        raise UnknownNameError(kind.__name__, str(unknown), known)
    make = getattr(kind, "received", kind)  # of what a record may not state
    return make(**{name: built(types.get(name), each) for name, each in value.items()})


def field_types(kind: type[Any]) -> dict[str, Any]:
    """Return the types of a dataclass's fields; none if an annotation names what its module does not have."""
    try:
        return get_type_hints(kind)
    except NameError:
        return {}


def _arguments(kind: Any) -> list[str]:
    return [each.name for each in fields(kind) if each.init]


def _member(kinds: tuple[Any, ...], value: Any) -> Any:
    """Return the member of a union that a value of JSON is of; None: the value stays as it is."""
    if not isinstance(value, Mapping):
        return next((each for each in kinds if isinstance(value, list) and get_args(each)), None)
    classes: list[Any] = [each for each in kinds if is_dataclass(each)]
    fitting = [each for each in classes if {*value} <= {*_arguments(each)}]
    other = [each for each in kinds if get_origin(each) is not None]
    if classes and not fitting + other:
        allowed = f"those of {' or '.join(each.__name__ for each in classes)}"
        raise UnknownNameError("value with the fields", ", ".join(map(str, value)), [], allowed)
    return next(iter(fitting + other), None)


def versions(*packages: str) -> dict[str, str]:
    """Return the versions of this package and of others, as far as they are installed, by name."""
    found = {name: _installed(name) for name in packages}
    return {"dual_ur10": __version__, **{name: each for name, each in found.items() if each is not None}}


@cache
def _installed(package: str) -> str | None:
    """Return the version of an installed package; None: it is not installed."""
    try:
        return version(package)
    except PackageNotFoundError:
        return None


def to_metadata(header: Header) -> dict[str, str]:
    """Return the metadata of a file that hold a header.

    Raises:
        RecordingError: The header holds values that JSON cannot hold, or is too long.
    """
    try:
        line = json.dumps(asdict(header), allow_nan=False, sort_keys=True)
    except (TypeError, ValueError) as error:
        raise RecordingError(f"the run cannot be described in JSON: {error}") from error
    if len(line) > _MOST_TEXT:
        raise RecordingError(
            f"the run's header has {len(line)} characters: allowed are {_MOST_TEXT}. Record fewer keywords, or less "
            "in `extra`"
        )
    return {"format": FORMAT, "header": line, "crc32": str(zlib.crc32(line.encode()))}


def from_metadata(metadata: Mapping[str, str]) -> Header:
    """Return the header that the metadata of a file hold.

    Raises:
        RecordingError: They hold none, one of another version, or an illegal one.
    """
    if metadata.get("format") != FORMAT:
        raise RecordingError(f"its format is {metadata.get('format')!r:.80}: this version reads {FORMAT!r}")
    line = metadata.get("header", "")
    if str(zlib.crc32(line.encode())) != metadata.get("crc32"):
        raise RecordingError("its header is not as it was written: the checksum is wrong")
    if len(line) > _MOST_TEXT:
        raise RecordingError(f"its header has {len(line)} characters: allowed are {_MOST_TEXT}")
    try:
        return _adapter().validate_json(line)
    except ValidationError as error:
        raise RecordingError(f"its header is not legal: {findings(error)}") from None


@cache
def _adapter() -> TypeAdapter[Header]:
    return TypeAdapter(Header)


def findings(error: ValidationError) -> str:
    """Return all that was found wrong, each with its path."""
    return listed(error.errors(include_url=False, include_context=False), _phrase, _MOST_FINDINGS)


def _phrase(finding: Any) -> str:
    path = ".".join(map(str, finding["loc"]))
    value = f" is {reprlib.repr(finding['input'])}" if path and finding["type"] != "missing" else ""
    text = finding["msg"].replace("Input should", "it should").replace("Field required", "it is missing")
    return f"{path}{value}: {text}".removeprefix(": ")
