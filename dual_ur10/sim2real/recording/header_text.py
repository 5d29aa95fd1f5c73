"""The header of a record, from the text that is in the file."""

from __future__ import annotations

import json
import zlib
from dataclasses import fields
from typing import Any, Final

from dual_ur10.errors import RecordingError
from dual_ur10.sim2real.recording.encoding import FORMAT
from dual_ur10.sim2real.recording.run import Header

SOURCES: Final = ("mujoco", "emulated", "real")
_FAMILIES: Final = ("cb3", "e-series")
_MOST_TEXT: Final = 16 * 2**20
_MOST_TICKS: Final = 10_000
_MOST_SERVOJ: Final = 1e6

# Types of JSON for each annotation of `Header`.
_TYPES: Final[dict[str, tuple[type, ...]]] = {
    "str": (str,),
    "int": (int,),
    "float": (float, int),
    "int | None": (int, type(None)),
    "str | None": (str, type(None)),
    "dict[str, Any]": (dict,),
    "dict[str, str]": (dict,),
    "list[dict[str, Any]]": (list,),
}


def header_of(metadata: dict[str, str]) -> Header:
    """The header that metadata of a file hold.

    Raises:
        RecordingError: They hold none, one of another version, or one that makes no sense.
    """
    if metadata.get("format") != FORMAT:
        raise RecordingError(f"its format is {metadata.get('format')!r:.80}: this version reads {FORMAT!r}")
    line = metadata.get("header", "")
    if str(zlib.crc32(line.encode())) != metadata.get("crc32"):
        raise RecordingError("its header is not as it was written: the checksum is wrong")
    if len(line) > _MOST_TEXT:
        raise RecordingError(f"its header has {len(line)} characters: allowed are {_MOST_TEXT}")
    try:
        values = json.loads(line, parse_constant=_refuse)
    except (ValueError, RecursionError) as error:
        raise RecordingError(f"its header is no JSON: {error}") from None
    known = {field.name: str(field.type) for field in fields(Header)}
    if not isinstance(values, dict) or values.keys() != known.keys():
        raise RecordingError("its header has other fields than a run's")
    for name, kind in known.items():
        _check(name, values[name], kind)
    for name, least, most in (("tick_s", 1e-4, 1.0), ("speed_factor", 0.0, 1.0)):
        if not least <= values[name] <= most:
            raise RecordingError(f"its header says {name} {values[name]!r}: allowed are {least:g} to {most:g}")
    for name, low in (("period_ticks", 1), ("latency_ticks", 0)):
        if not low <= values[name] <= _MOST_TICKS:
            raise RecordingError(f"its header says {name} {values[name]!r}: allowed are {low} to {_MOST_TICKS}")
    for name, allowed in (("source", SOURCES), ("family", _FAMILIES)):
        if values[name] not in allowed:
            raise RecordingError(f"its header says {name} {values[name]!r:.80}: allowed are {', '.join(allowed)}")
    for arm in values["servoj"]:
        for name in ("lookahead_s", "gain"):
            number = arm.get(name)
            if isinstance(number, bool) or not isinstance(number, int | float) or not 0.0 < number < _MOST_SERVOJ:
                raise RecordingError(
                    f"its header says servoj {name} {number!r:.80}: a number above 0 and below {_MOST_SERVOJ:g} is "
                    "expected"
                )
    return Header(**values)


def _check(name: str, value: Any, kind: str) -> None:
    allowed = _TYPES[kind]
    if not isinstance(value, allowed) or isinstance(value, bool):
        raise RecordingError(f"its header's {name} is {type(value).__name__}, expected {kind}")
    if isinstance(value, list) and not (len(value) == 2 and all(isinstance(each, dict) for each in value)):
        raise RecordingError(f"its header's {name} must be two maps, one of each arm")
    texts = value.values() if isinstance(value, dict) and kind == "dict[str, str]" else ()
    if not all(isinstance(each, str) for each in texts):
        raise RecordingError(f"its header's {name} must be strings")


def _refuse(constant: str) -> None:
    raise ValueError(f"{constant} is no number")
