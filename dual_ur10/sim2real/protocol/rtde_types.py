"""The data types of RTDE variables: UR's RTDE guide. On the wire they are big-endian, and vectors have no length."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any, Final

from dual_ur10.errors import SettingsError

Value = float | int | tuple[float, ...] | tuple[int, ...]
"""What a variable is in this program."""


@dataclass(frozen=True)
class DataType:
    """One data type.

    Attributes:
        name: As RTDE names it in replies.
        code: Format of one element, as of the module struct.
        count: Elements: 1, or 3 or 6 in vectors.
    """

    name: str
    code: str
    count: int = 1

    @property
    def zero(self) -> Value:
        """A zero of this type."""
        one: Value = 0.0 if self.code == "d" else False if self.code == "?" else 0
        return one if self.count == 1 else (one,) * self.count  # type: ignore[return-value]

    def fit(self, name: str, value: Any) -> list[float | int]:
        """Make a value fit: integers lose the bits that are too many, and are 0 where there is no number.

        Args:
            name: Of the variable, for the message.
            value: A number, or `count` of them.

        Raises:
            SettingsError: It is no number, or not `count` of them.
        """
        try:
            elements = list(value) if self.count > 1 else [value]
            if len(elements) == self.count:
                return [_fit(self.code, element) for element in elements]
        except (TypeError, ValueError):
            pass
        raise SettingsError(
            f"value of {name} is {value!r}: it must be {self.count} number(s), to be sent as {self.name}"
        )


def _fit(code: str, value: Any) -> float | int:
    if code == "?":
        return bool(value)
    if code == "d":
        try:
            return float(value)
        except OverflowError:
            return math.inf if value > 0 else -math.inf
    if isinstance(value, float) and not math.isfinite(value):
        return 0
    bits = {"B": 8, "I": 32, "i": 32, "Q": 64}[code]
    masked = int(value) & ((1 << bits) - 1)
    return masked - (1 << bits) if code == "i" and masked >> (bits - 1) else masked


TYPES: Final = {
    kind.name: kind
    for kind in (
        DataType("BOOL", "?"),
        DataType("UINT8", "B"),
        DataType("UINT32", "I"),
        DataType("UINT64", "Q"),
        DataType("INT32", "i"),
        DataType("DOUBLE", "d"),
        DataType("VECTOR3D", "d", 3),
        DataType("VECTOR6D", "d", 6),
        DataType("VECTOR6INT32", "i", 6),
        DataType("VECTOR6UINT32", "I", 6),
    )
}
"""All data types, by name."""
