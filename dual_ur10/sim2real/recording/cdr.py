"""Messages as ROS 2 writes them: CDR, little endian, after a header of four bytes; and their definitions as text."""

from __future__ import annotations

import struct
from collections.abc import Mapping
from typing import Any, Final, NamedTuple

import numpy as np

from dual_ur10.errors import RecordingError

HEAD: Final = b"\x00\x01\x00\x00"
"""Encapsulation of plain CDR, little endian: OMG's DDS interoperability protocol, section 10.2."""

_NUMBERS: Final = {"float64": ("<d", 8), "int64": ("<q", 8), "bool": ("<?", 1), "int8": ("<b", 1)}


class Field(NamedTuple):
    """A field of a message.

    Attributes:
        name: In lower case, as ROS wants it.
        kind: "float64", "int64", "int8", "bool", "string", "float64[N]", "float64[]" or "uint8[]".
    """

    name: str
    kind: str

    @property
    def size(self) -> int | None:
        """Numbers of a fixed array, else None."""
        inside = self.kind.partition("[")[2].rstrip("]")
        return int(inside) if inside else None


class Schema(NamedTuple):
    """A message without parts that are messages themselves.

    Attributes:
        name: Such as "dual_ur10_msgs/msg/Event".
        fields: In order.
    """

    name: str
    fields: tuple[Field, ...]

    @property
    def text(self) -> str:
        """The definition, as a file `.msg` has it."""
        return "".join(f"{field.kind} {field.name}\n" for field in self.fields)

    def encode(self, values: Mapping[str, Any]) -> bytes:
        """The bytes of a message; arrays are flattened."""
        out = bytearray()
        for field in self.fields:
            value = values[field.name]
            if field.kind in _NUMBERS:
                code, size = _NUMBERS[field.kind]
                _align(out, size)
                out += struct.pack(code, value)
            elif field.kind == "string":
                line = value.encode()
                _align(out, 4)
                out += struct.pack("<I", len(line) + 1) + line + b"\0"
            elif field.kind == "uint8[]":
                _align(out, 4)
                out += struct.pack("<I", len(value)) + bytes(value)
            else:
                array = np.ascontiguousarray(value, dtype="<f8")
                if field.size is None:
                    _align(out, 4)
                    out += struct.pack("<I", array.size)
                elif array.size != field.size:
                    raise RecordingError(f"{field.name} needs {field.size} numbers, found an array of {array.shape}")
                if array.size:
                    _align(out, 8)
                out += array.tobytes()
        return HEAD + bytes(out)

    def decode(self, data: bytes) -> dict[str, Any]:
        """The values of a message; arrays are flat.

        Raises:
            RecordingError: These bytes are no such message.
        """
        if data[:4] != HEAD:
            raise RecordingError(f"{self.name}: a message begins with {data[:4].hex()}, expected {HEAD.hex()}")
        body, at = memoryview(data)[4:], 0
        values: dict[str, Any] = {}
        try:
            for field in self.fields:
                if field.kind in _NUMBERS:
                    code, size = _NUMBERS[field.kind]
                    at += -at % size
                    values[field.name] = struct.unpack_from(code, body, at)[0]
                    at += size
                    continue
                if field.size is None:
                    at += -at % 4
                    count = struct.unpack_from("<I", body, at)[0]
                    at += 4
                else:
                    count = field.size
                if field.kind.startswith("float64"):
                    at += -at % 8 if count else 0
                    end = at + 8 * count
                    _within(end, body)
                    values[field.name] = np.frombuffer(body[at:end], "<f8").copy()
                else:
                    end = at + count
                    _within(end, body)
                    piece = bytes(body[at:end])
                    values[field.name] = piece if field.kind == "uint8[]" else _string(piece)
                at = end
        except (struct.error, UnicodeDecodeError, ValueError) as error:
            raise RecordingError(f"{self.name}: a message of {len(data)} bytes is malformed: {error}") from None
        if at != len(body):
            raise RecordingError(f"{self.name}: a message has {len(body) - at} bytes too many")
        return values


def _within(end: int, body: memoryview) -> None:
    if end > len(body):
        raise ValueError(f"it ends after {len(body)} bytes where {end} are needed")


def _string(piece: bytes) -> str:
    if piece[-1:] != b"\0":
        raise ValueError("a string without its end")
    return piece[:-1].decode()


def _align(out: bytearray, size: int) -> None:
    out.extend(bytes(-len(out) % size))
