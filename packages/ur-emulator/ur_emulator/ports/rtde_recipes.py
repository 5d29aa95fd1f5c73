"""Recipes of RTDE data packages, prepared so that packing and unpacking takes microseconds."""

from __future__ import annotations

import struct
from collections.abc import Callable, Iterable, Mapping, Sequence
from itertools import chain, groupby
from operator import itemgetter
from typing import Any, NamedTuple

from ur_core.protocol.rtde import HEADER, DataType, Kind, Value
from ur_emulator.controller.registers import Registers

Reader = Callable[[Any], Iterable[Any]]

OUTPUT_RECIPE = 1
"""Number of the only output recipe of a connection."""


class _Field(NamedTuple):
    """Variable and the place of its value: `container[key]`."""

    name: str
    kind: DataType
    container: Any
    key: Any

    @property
    def group(self) -> tuple[int, str]:
        """Group key: consecutive fields of one group are read at once."""
        shape = "bits" if isinstance(self.key, slice) else "number" if self.kind.count == 1 else "vector"
        return id(self.container), shape


class OutputRecipe:
    """Variables that a client reads.

    Args:
        variables: Names and types, in the client's order.
        values: Values of the variables that are no registers.
        registers: The registers.
        numbered: Whether packages begin with the number of the recipe: since version 2 of the protocol.
    """

    def __init__(
        self,
        variables: Sequence[tuple[str, DataType]],
        values: Mapping[str, Value],
        registers: Registers,
        *,
        numbered: bool,
    ) -> None:
        self.variables, self.numbered = tuple(variables), numbered
        self._fields = [_Field(name, kind, *(registers.find(name) or (values, name))) for name, kind in self.variables]
        self._segments: list[tuple[Reader, Any]] = []
        for (_, shape), group in groupby(self._fields, lambda field: field.group):
            fields = list(group)
            self._segments.append((_reader([field.key for field in fields], shape), fields[0].container))
        packer = struct.Struct(HEADER.format + ("B" if numbered else "") + _codes(kind for _, kind in variables))
        self._pack = packer.pack
        number = (OUTPUT_RECIPE,) if numbered else ()
        self._header = (packer.size, int(Kind.DATA_PACKAGE), *number)

    def package(self) -> bytes:
        """Return a data package with the present values.

        Raises:
            SettingsError: A value is no number, or a vector has the wrong length.
        """
        flat = list(self._header)
        try:
            for read, container in self._segments:
                flat += read(container)
            return self._pack(*flat)
        except (struct.error, TypeError, OverflowError):
            # A number does not fit its type: rare, so it may be slow.
            return self._pack(*self._header, *self._fitted())

    def _fitted(self) -> Iterable[float | int]:
        for name, kind, container, key in self._fields:
            value = _bits_to_int(container[key]) if isinstance(key, slice) else container[key]
            yield from kind.fit(name, value)


class InputRecipe:
    """Variables that a client writes.

    Args:
        variables: Names and types, in the client's order.
        registers: The registers.
    """

    def __init__(self, variables: Sequence[tuple[str, DataType]], registers: Registers) -> None:
        self.names, self.count = frozenset(name for name, _ in variables), len(variables)
        self._writes = registers.writes
        self._kinds = [kind for _, kind in variables]
        self._struct = struct.Struct(">" + _codes(self._kinds))
        # Grouped by kind of write, each with the place of its value in a package.
        self._cells: list[tuple[list[Any], int, str, int]] = []
        self._groups: list[tuple[list[Any], slice, str, int]] = []
        self._others: list[tuple[str, int, int]] = []
        place = 0
        for name, kind in variables:
            found = registers.find(name)
            if found is None:
                self._others.append((name, place, place + kind.count))
            elif isinstance(found[1], slice):
                self._groups.append((found[0], found[1], name, place))
            else:
                self._cells.append((found[0], found[1], name, place))
            place += kind.count

    @property
    def size(self) -> int:
        """Bytes of the values of a package."""
        return self._struct.size

    def apply(self, data: bytes) -> dict[str, Value]:
        """Write a package's values into the registers.

        Args:
            data: Package without header and recipe number. Of a short package only complete variables are written;
                excess bytes are ignored.

        Returns:
            Values that are no registers, by name.
        """
        flat = self._struct.unpack_from(data) if len(data) >= self._struct.size else self._prefix(data)
        available, writes = len(flat), self._writes
        for cells, index, name, place in self._cells:
            if place >= available:
                break
            cells[index] = flat[place]
            writes[name] += 1
        for bits, where, name, place in self._groups:
            if place >= available:
                break
            bits[where] = _int_to_bits(flat[place])
            writes[name] += 1
        others: dict[str, Value] = {}
        for name, start, end in self._others:
            if end > available:
                break
            others[name] = flat[start] if end - start == 1 else flat[start:end]
            writes[name] += 1
        return others

    def _prefix(self, data: bytes) -> tuple[Any, ...]:
        """Unpack the complete variables of a short package."""
        codes, size = "", 0
        for kind in self._kinds:
            size += struct.calcsize(f">{kind.count}{kind.code}")
            if size > len(data):
                break
            codes += f"{kind.count}{kind.code}"
        return struct.unpack_from(">" + codes, data)


def _codes(kinds: Iterable[DataType]) -> str:
    return "".join(f"{kind.count}{kind.code}" for kind in kinds)


def _reader(keys: list[Any], shape: str) -> Reader:
    """Return a function that returns all elements at `keys` of a container in a row."""
    if shape == "bits":
        return lambda bits: [_bits_to_int(bits[key]) for key in keys]
    if len(keys) == 1:
        key = keys[0]
        return itemgetter(key) if shape == "vector" else lambda container: (container[key],)
    several = itemgetter(*keys)
    if shape == "number":
        return several
    return lambda container: chain.from_iterable(several(container))


def _bits_to_int(bits: Sequence[Any]) -> int:
    return sum(1 << place for place, bit in enumerate(bits) if bit)


def _int_to_bits(number: int) -> list[bool]:
    return [bool(number >> place & 1) for place in range(32)]
