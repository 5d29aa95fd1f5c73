"""Reads JSON that somebody else may have written into dataclasses, and refuses whatever they do not provide for.

Nothing in it names a class or a function: what a value becomes is said by the dataclass alone.
"""

from __future__ import annotations

import dataclasses
import json
import math
import re
import types
import typing
from collections.abc import Mapping
from typing import Any, Final, TypeVar

from dual_ur10.errors import CheckpointError

MOST_BYTES: Final = 1 << 20
"""Size of a text beyond which it is not read."""

_MOST_TEXT, _MOST_ITEMS, _DEEPEST = 2000, 8192, 8
_KEY: Final = re.compile(r"[A-Za-z0-9_][A-Za-z0-9_ ./+-]{0,63}", re.ASCII)

T = TypeVar("T")


def parsed(text: bytes, where: str) -> Any:
    """The value of a JSON text.

    Raises:
        CheckpointError: It is too long or no JSON, holds NaN or infinity, or a key twice.
    """
    if len(text) > MOST_BYTES:
        raise CheckpointError(f"{where} has {len(text)} bytes: at most {MOST_BYTES} are read")

    def once(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
        result = dict(pairs)
        if len(result) < len(pairs):
            raise CheckpointError(f"{where} holds a key twice, of {sorted(result)[:8]}: which one counts is unclear")
        return result

    def refuse(constant: str) -> Any:
        raise CheckpointError(f"{where} holds {constant}: numbers must be finite")

    try:
        return json.loads(text.decode("utf-8"), object_pairs_hook=once, parse_constant=refuse)
    except CheckpointError:
        raise
    except (ValueError, RecursionError) as error:  # the latter: brackets within brackets
        raise CheckpointError(f"{where} cannot be read as JSON: {error!s:.200}") from None


def read(kind: type[T], value: Any, where: str) -> T:
    """A dataclass from a JSON object with exactly its fields.

    Raises:
        CheckpointError: A field is missing, unknown, or of another type; or the dataclass refuses it.
    """
    result: T = _read(kind, value, where)
    return result


def _read(kind: Any, value: Any, where: str) -> Any:
    if dataclasses.is_dataclass(kind) and isinstance(kind, type):
        return _fields(kind, value, where)
    origin, parts = typing.get_origin(kind), typing.get_args(kind)
    if origin is types.UnionType:
        return None if value is None and type(None) in parts else _read(parts[0], value, where)
    if origin is tuple:
        return _items(parts, value, where)
    if origin is typing.Literal:
        if not isinstance(value, str) or value not in parts:
            raise _wrong(value, where, f"one of {', '.join(map(repr, parts))}")
        return value
    if kind is float:
        return number(value, where)
    if kind is int or kind is bool:
        # What is True is an int for Python.
        if type(value) is not kind or (kind is int and abs(value) > 2**63):
            raise _wrong(value, where, "a whole number of 64 bits" if kind is int else "true or false")
        return value
    if kind is str:
        if not isinstance(value, str) or len(value) > _MOST_TEXT:
            raise _wrong(value, where, f"a text of at most {_MOST_TEXT} characters")
        return value
    if origin is dict:
        if not isinstance(value, dict):
            raise _wrong(value, where, "an object")
        return {_key(name, where): _read(parts[1], each, f"{where}.{name}") for name, each in value.items()}
    return plain(value, where)


def _fields(kind: Any, value: Any, where: str) -> Any:
    if not isinstance(value, dict):
        raise _wrong(value, where, "an object")
    hints = typing.get_type_hints(kind)
    for what, names in (("no", hints.keys() - value.keys()), ("an unknown", value.keys() - hints.keys())):
        if names:
            allowed = ", ".join(hints)
            raise CheckpointError(f"{where} has {what} {min(names)!r:.80}: it must have exactly {allowed}")
    return kind(**{name: _read(hint, value[name], f"{where}.{name}") for name, hint in hints.items()})


def _items(parts: tuple[Any, ...], value: Any, where: str) -> tuple[Any, ...]:
    if not isinstance(value, list | tuple) or len(value) > _MOST_ITEMS:
        raise _wrong(value, where, f"a list of at most {_MOST_ITEMS} values")
    if parts[-1] is Ellipsis:
        parts = (parts[0],) * len(value)
    if len(value) != len(parts):
        raise _wrong(value, where, f"a list of {len(parts)} values")
    return tuple(_read(kind, each, f"{where}[{k}]") for k, (kind, each) in enumerate(zip(parts, value, strict=True)))


def number(value: Any, where: str) -> float:
    """A finite number.

    Raises:
        CheckpointError: It is none.
    """
    if isinstance(value, bool) or not isinstance(value, int | float):
        raise _wrong(value, where, "a number")
    try:
        result = float(value)
    except OverflowError:
        result = math.inf
    if not math.isfinite(result):
        raise _wrong(value, where, "a finite number")
    return result


def plain(value: Any, where: str, depth: int = 0) -> Any:
    """A copy of a value of which the schema says no more than that it is JSON: lists, and objects with names as keys.

    Raises:
        CheckpointError: It holds something else, is too deep, or holds too much.
    """
    if depth > _DEEPEST:
        raise CheckpointError(f"{where} is nested deeper than {_DEEPEST}: use plain values")
    if value is None or isinstance(value, bool):
        return value
    if isinstance(value, str):
        return _read(str, value, where)
    if isinstance(value, int) and not isinstance(value, bool):
        return _read(int, int(value), where)
    if isinstance(value, float):
        return number(value, where)
    if isinstance(value, list | tuple) and len(value) <= _MOST_ITEMS:
        return [plain(each, f"{where}[{k}]", depth + 1) for k, each in enumerate(value)]
    if isinstance(value, Mapping) and len(value) <= _MOST_ITEMS:
        return {_key(name, where): plain(each, f"{where}.{name}", depth + 1) for name, each in value.items()}
    raise _wrong(value, where, "a text, a number, true, false, null, or a list or object of at most 8192 of them")


def _key(name: Any, where: str) -> str:
    if not isinstance(name, str) or not _KEY.fullmatch(name):
        raise CheckpointError(f"{where} has the key {name!r:.80}: keys are letters, digits and _ ./+-, at most 64")
    return name


def _wrong(value: Any, where: str, allowed: str) -> CheckpointError:
    return CheckpointError(f"{where} is {value!r:.80}: it must be {allowed}")
