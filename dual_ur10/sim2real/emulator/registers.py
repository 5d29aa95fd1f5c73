"""The general purpose registers by which programs and RTDE clients exchange numbers."""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any, Final

NUMBERS: Final = 48
"""Integer registers and double registers, each way: UR's RTDE guide."""

BITS: Final = 128
"""Bit registers, each way."""

_REGISTER: Final = re.compile(r"(input|output)_(bit|int|double)_register_(0|[1-9]\d{0,2})")
_BIT_GROUP: Final = re.compile(r"(input|output)_bit_registers(0_to_31|32_to_63)")


@dataclass(slots=True)
class Registers:
    """All registers of one controller.

    Recipes of RTDE hold on to the lists: change what is in them, do not replace them.

    Attributes:
        input_int, input_double: 48 numbers that clients write and programs read.
        input_bits: 128 of them.
        output_int, output_double: 48 numbers that programs write and clients read.
        output_bits: 128 of them.
        writes: How often clients wrote each RTDE input variable, by its name; what was never written counts 0. Inputs
            that are no registers are counted, too, as a program can watch over any of them.
    """

    input_int: list[int] = field(default_factory=lambda: [0] * NUMBERS)
    input_double: list[float] = field(default_factory=lambda: [0.0] * NUMBERS)
    input_bits: list[bool] = field(default_factory=lambda: [False] * BITS)
    output_int: list[int] = field(default_factory=lambda: [0] * NUMBERS)
    output_double: list[float] = field(default_factory=lambda: [0.0] * NUMBERS)
    output_bits: list[bool] = field(default_factory=lambda: [False] * BITS)
    writes: Counter[str] = field(default_factory=Counter)

    def find(self, name: str) -> tuple[list[Any], int | slice] | None:
        """Where the register with an RTDE variable's name is kept.

        Returns:
            The list and the index in it, or for the variables that hold 32 bits the slice of them; None if the
            variable is no register.
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
    """A program's demand that a client keeps writing a register.

    Attributes:
        name: The register's, as RTDE names it.
        period_s: Longest time between two writes.
        action: "pause" or "stop".
        writes: How often it had been written when it was looked at last.
        machine: The program.
        value: Gives what is in the register.
        since_s: Time since it was last fed.
    """

    name: str
    period_s: float
    action: str
    writes: int
    machine: object
    value: Callable[[], Any]
    since_s: float = 0.0
    last: Any = None

    def is_fed(self, registers: Registers, counts_unchanged: bool) -> bool:
        """Whether the register was written since this was asked last."""
        writes, value = registers.writes.get(self.name, 0), self.value()
        fed = writes != self.writes and (counts_unchanged or value != self.last)
        self.writes, self.last = writes, value
        if fed:
            self.since_s = 0.0
        return fed
