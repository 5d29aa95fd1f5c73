"""General purpose registers, by which programs and RTDE clients exchange numbers, and watchdogs on them."""

from __future__ import annotations

import re
from collections import Counter
from dataclasses import dataclass, field
from typing import Any, Final

NUMBERS: Final = 48
"""Number of integer registers and of double registers per direction: UR's RTDE guide."""

BITS: Final = 128
"""Number of bit registers per direction."""

_REGISTER: Final = re.compile(r"(input|output)_(bit|int|double)_register_(0|[1-9]\d{0,2})")
_BIT_GROUP: Final = re.compile(r"(input|output)_bit_registers(0_to_31|32_to_63)")


@dataclass(slots=True)
class Registers:
    """All registers of one controller.

    Change the lists only in place: recipes of RTDE refer to them.

    Attributes:
        input_int, input_double: 48 numbers that clients write and programs read.
        input_bits: 128 bits of the same direction.
        output_int, output_double: 48 numbers that programs write and clients read.
        output_bits: 128 bits of the same direction.
        writes: Number of writes by clients of each RTDE input variable, by name. Inputs that are no registers count
            too, since a program can watch any of them.
    """

    input_int: list[int] = field(default_factory=lambda: [0] * NUMBERS)
    input_double: list[float] = field(default_factory=lambda: [0.0] * NUMBERS)
    input_bits: list[bool] = field(default_factory=lambda: [False] * BITS)
    output_int: list[int] = field(default_factory=lambda: [0] * NUMBERS)
    output_double: list[float] = field(default_factory=lambda: [0.0] * NUMBERS)
    output_bits: list[bool] = field(default_factory=lambda: [False] * BITS)
    writes: Counter[str] = field(default_factory=Counter)

    def find(self, name: str) -> tuple[list[Any], int | slice] | None:
        """Find the register with an RTDE variable's name.

        Returns:
            The list and the index in it, or a slice for variables of 32 bits; None if the variable is no register.
        """
        if match := _BIT_GROUP.fullmatch(name):
            direction, group = match.groups()
            first = 0 if group == "0_to_31" else 32
            return self._list(direction, "bits"), slice(first, first + 32)
        if match := _REGISTER.fullmatch(name):
            direction, kind, number = match.groups()
            registers = self._list(direction, "bits" if kind == "bit" else kind)
            return (registers, int(number)) if int(number) < len(registers) else None
        return None

    def clear_outputs(self) -> None:
        """Set every output register to zero."""
        self.output_int[:] = [0] * NUMBERS
        self.output_double[:] = [0.0] * NUMBERS
        self.output_bits[:] = [False] * BITS

    def _list(self, direction: str, kind: str) -> list[Any]:
        found: list[Any] = getattr(self, f"{direction}_{kind}")
        return found


@dataclass
class Watchdog:
    """Demand of a program that a client keeps writing a variable.

    Attributes:
        name: RTDE name of the variable.
        period_s: Longest time between two writes.
        action: "pause" or "stop".
        writes: Number of writes at the last check.
        machine: Program that set it.
        since_s: Time since the last write.
        last: Value at the last check.
    """

    name: str
    period_s: float
    action: str
    writes: int
    machine: object
    since_s: float = 0.0
    last: Any = None

    def is_fed(self, registers: Registers, counts_unchanged: bool) -> bool:
        """Return True if the variable was written since the last check. One that is no register counts as changed."""
        writes, register = registers.writes.get(self.name, 0), registers.find(self.name)
        value = writes if register is None else register[0][register[1]]
        fed = writes != self.writes and (counts_unchanged or value != self.last)
        self.writes, self.last = writes, value
        if fed:
            self.since_s = 0.0
        return fed
