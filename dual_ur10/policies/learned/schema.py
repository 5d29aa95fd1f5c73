"""Strict reading of JSON that others may have written, into dataclasses.

Nothing in a file names a class or a function: the dataclass alone determines what a value becomes.
"""

from __future__ import annotations

import dataclasses
import json
import math
import re
from collections.abc import Callable, Iterator
from functools import lru_cache
from typing import Annotated, Any, ClassVar, Final, TypeVar

from pydantic import AfterValidator, ConfigDict, Field, TypeAdapter, ValidationError

from dual_ur10.errors import CheckpointError, DualUR10Error
from ur_core.findings import listed, path_of

MOST_BYTES: Final = 1 << 20
"""Size of a text above which it is not read."""

_MOST_TEXT, _MOST_ITEMS, _DEEPEST, _MOST_FINDINGS = 2000, 8192, 8, 8
_KEY: Final = re.compile(r"[A-Za-z0-9_][A-Za-z0-9_ ./+-]{0,63}", re.ASCII)

T = TypeVar("T")


class StrictJson:
    """Base of dataclasses that are read from JSON: exactly their fields, of exactly their types."""

    __pydantic_config__: ClassVar[ConfigDict] = ConfigDict(
        strict=True, extra="forbid", allow_inf_nan=False, revalidate_instances="always"
    )


def _bounded(value: dict[str, object]) -> dict[str, object]:
    if found := list(_beyond(value, "", 0)):
        raise ValueError("\n".join(found[:_MOST_FINDINGS]))
    return value


def _beyond(value: object, path: str, depth: int) -> Iterator[str]:
    if depth > _DEEPEST:
        yield f"{path} is nested deeper than {_DEEPEST}: use plain values"
    elif isinstance(value, dict | list):
        if len(value) > _MOST_ITEMS:
            yield f"{path} has {len(value)} values: at most {_MOST_ITEMS} are allowed"
            return
        for key, each in value.items() if isinstance(value, dict) else enumerate(value):
            if isinstance(key, str) and not _KEY.fullmatch(key):
                yield f"{path} has the key {key!r:.80}: keys are letters, digits and _ ./+-, at most 64"
            yield from _beyond(each, f"{path}.{key}" if isinstance(key, str) else f"{path}[{key}]", depth + 1)
    elif isinstance(value, str) and len(value) > _MOST_TEXT:
        yield f"{path} has {len(value)} characters: at most {_MOST_TEXT} are allowed"
    elif isinstance(value, int) and abs(value) > 2**63:
        yield f"{path} is {value!r:.80}: it must be a whole number of 64 bits"
    elif isinstance(value, float) and not math.isfinite(value):
        yield f"{path} is {value!r}: it must be a finite number"
    elif value is not None and not isinstance(value, str | int | float):
        yield f"{path} is {value!r:.80}: it must be a value of JSON"


Text = Annotated[str, Field(max_length=_MOST_TEXT)]
Whole = Annotated[int, Field(ge=-(2**63), le=2**63)]
JsonList = Field(max_length=_MOST_ITEMS)
Numbers = Annotated[tuple[float, ...], JsonList]
Wholes = Annotated[tuple[Whole, ...], JsonList]
Object = Annotated[dict[str, Any], AfterValidator(_bounded)]
"""Any JSON object whose sizes are within the bounds of this module."""


def loads(text: bytes, where: str, error: type[DualUR10Error] = CheckpointError) -> Any:
    """Return the value of a JSON text.

    Raises:
        DualUR10Error: As `error`: it is too long or no JSON, or holds NaN, infinity or the same key twice.
    """
    if len(text) > MOST_BYTES:
        raise error(f"{where} has {len(text)} bytes: at most {MOST_BYTES} are read")

    def once(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
        result = dict(pairs)
        if len(result) < len(pairs):
            raise error(f"{where} holds a key twice, of {sorted(result)[:8]}: which one counts is unclear")
        return result

    def refuse(constant: str) -> Any:
        raise error(f"{where} holds {constant}: numbers must be finite")

    try:
        return json.loads(text.decode("utf-8"), object_pairs_hook=once, parse_constant=refuse)
    except error:
        raise
    except (ValueError, RecursionError) as reason:  # the latter: brackets within brackets
        raise error(f"{where} cannot be read as JSON: {reason!s:.200}") from None


_adapter: Callable[[Any], TypeAdapter[Any]] = lru_cache(maxsize=64)(TypeAdapter)
"""Return Pydantic's schema of a dataclass, which takes longer to make than a file to read."""


def read(kind: type[T], value: Any, where: str, error: type[DualUR10Error] = CheckpointError) -> T:
    """Return a dataclass from the JSON object that holds its fields.

    Raises:
        DualUR10Error: As `error`, with all findings and their paths: a field is missing, unknown or of another type,
            or the dataclass refuses it.
    """
    try:
        # As text again: only there does strictness take a list for a tuple and an object for a dataclass.
        result: T = _adapter(kind).validate_json(json.dumps(value))
    except ValidationError as reason:
        raise error(_findings(reason, where, value)) from None
    if found := list(_absent(dataclasses.asdict(result), value, where)):  # type: ignore[call-overload]  # a dataclass
        raise error(listed(found, str, _MOST_FINDINGS))
    return result


def check(value: object, where: str, error: type[DualUR10Error]) -> None:
    """Check the fields of a dataclass that a program made as `read` checks those of a file.

    Raises:
        DualUR10Error: As `error`, with all findings and their paths.
    """
    try:
        _adapter(type(value)).validate_python(value)
    except ValidationError as reason:
        raise error(_findings(reason, where, value)) from None


def _absent(filled: Any, value: Any, path: str) -> Iterator[str]:
    """Yield the fields that took a default because the JSON has none."""
    if isinstance(filled, dict):
        for key, each in filled.items():
            if key in value:
                yield from _absent(each, value[key], f"{path}.{key}")
            else:
                yield f"{path}.{key} is missing: write it down"
    elif isinstance(filled, tuple):
        for k, each in enumerate(filled):
            yield from _absent(each, value[k], f"{path}[{k}]")


def _findings(error: ValidationError, where: str, value: Any) -> str:
    found = error.errors(include_url=False)
    parents = {each["loc"][:-1] for each in found}
    # pydantic counts only valid items: a list with a wrong one would be too short as well.
    kept = [each for each in found if each["type"] != "too_short" or each["loc"] not in parents]
    return listed(kept, lambda each: _finding(each, where + _path(each["loc"], value)), _MOST_FINDINGS)


def _path(keys: tuple[int | str, ...], value: Any) -> str:
    path = []
    for k, key in enumerate(keys):
        if isinstance(value, dict) and key not in value and k < len(keys) - 1:
            continue  # the tag of a union is no key of the JSON
        path.append(key)
        if isinstance(value, dict):
            value = value.get(key)
        elif isinstance(value, list) and isinstance(key, int):
            value = value[key] if key < len(value) else None  # an item that is missing
    return path_of(path)


def _finding(finding: Any, path: str) -> str:
    text, value = str(finding["msg"]), finding["input"]
    if finding["type"] == "value_error":
        lines = text.removeprefix("Value error, ").split("\n")
        return "; ".join(f"{path}{line}" if line.startswith((".", "[", " ")) else f"{path}: {line}" for line in lines)
    if finding["type"] in ("unexpected_keyword_argument", "missing"):
        return f"{path} is {'missing: write it down' if finding['type'] == 'missing' else 'unknown: remove it'}"
    allowed = text.replace("Input should be", "it must be").replace("String should have", "it must have")
    return f"{path} is {value!r:.80}: {allowed}"
