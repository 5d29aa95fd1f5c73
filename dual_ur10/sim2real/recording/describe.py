"""The header of a run that is about to begin."""

from __future__ import annotations

import hashlib
from collections.abc import Mapping
from dataclasses import asdict, fields, is_dataclass
from datetime import UTC, datetime
from importlib.metadata import PackageNotFoundError, version
from typing import Any, Final

import numpy as np

from dual_ur10.errors import RecordingError
from dual_ur10.ids import __version__
from dual_ur10.sim2real.config.cell import CellConfig
from dual_ur10.sim2real.recording.run import Header

_PACKAGES: Final = ("numpy", "mujoco", "gymnasium", "ur-rtde")


def describe(
    env_id: str,
    kwargs: Mapping[str, Any],
    config: CellConfig,
    *,
    period_ticks: int,
    latency_ticks: int,
    source: str = "mujoco",
    seed: int | None = None,
    speed_factor: float = 1.0,
    policy: str = "",
    policy_sha256: str | None = None,
    cell_file: str | None = None,
    extra: Mapping[str, Any] | None = None,
) -> Header:
    """The header of a run that begins now.

    Args:
        env_id: Of the environment.
        kwargs: Its keywords. Of dataclasses, what differs from their defaults is kept; functions are left out.
        config: The cell.
        period_ticks: Control periods of a step.
        latency_ticks: Control periods between an action's step and its first target.
        source: "mujoco", "emulated" or "real".
        seed: Of the first reset.
        speed_factor: Share of the full speed.
        policy: Its name.
        policy_sha256: Of its file.
        cell_file: Text of the cell file.
        extra: Anything else.

    Raises:
        RecordingError: A keyword cannot be described in JSON.
    """
    servoj = {"lookahead_s": config.servoj.lookahead_s, "gain": config.servoj.gain}
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
        mounts=[plain(asdict(mount)) for mount in (config.left, config.right)],
        servoj=[dict(servoj), dict(servoj)],
        versions=versions(*_PACKAGES),
        started_utc=datetime.now(UTC).isoformat(timespec="microseconds").replace("+00:00", "Z"),
        policy=policy,
        policy_sha256=policy_sha256,
        cell_file=cell_file,
        cell_sha256=None if cell_file is None else hashlib.sha256(cell_file.encode()).hexdigest(),
        extra=plain(dict(extra or {})),
    )


def plain(value: Any) -> Any:
    """A value as JSON can hold it; a dataclass as a map of the fields that differ from their defaults.

    Raises:
        RecordingError: It cannot.
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
        pairs = ((field.name, getattr(value, field.name)) for field in fields(value))
        return {name: plain(each) for name, each in pairs if default is None or each != getattr(default, name)}
    raise RecordingError(f"{value!r:.200} of type {type(value).__name__} cannot be recorded: use plain values")


def _default(kind: type[Any]) -> Any:
    try:
        return kind()
    except TypeError:  # some fields must be given
        return None


def versions(*packages: str) -> dict[str, str]:
    """That of this package, and of others as far as they are installed, by name."""
    found = {"dual_ur10": __version__}
    for name in packages:
        try:
            found[name] = version(name)
        except PackageNotFoundError:
            continue
    return found
