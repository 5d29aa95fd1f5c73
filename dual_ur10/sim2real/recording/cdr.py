"""Messages in ROS 2's CDR encoding, little endian behind a header of four bytes, and their definitions as text.

Encoding is written here, because recording needs no extra package. Decoding is that of `mcap-ros2-support`.
"""

from __future__ import annotations

import struct
from collections.abc import Callable, Mapping
from functools import cache
from typing import Any, Final, NamedTuple

import numpy as np

from dual_ur10.errors import MissingExtraError, RecordingError

HEAD: Final = b"\x00\x01\x00\x00"
"""Encapsulation of plain CDR, little endian: OMG's DDS interoperability protocol, section 10.2."""

_NUMBERS: Final = {"float64": ("<d", 8), "int64": ("<q", 8), "bool": ("<?", 1), "int8": ("<b", 1)}


class CdrField(NamedTuple):
    """A field of a message.

    Attributes:
        name: Name in lower case, as ROS requires.
        kind: "float64", "int64", "int8", "bool", "string", "float64[N]", "float64[]" or "uint8[]".
    """

    name: str
    kind: str

    @property
    def size(self) -> int | None:
        """Length of a fixed array, else None."""
        inside = self.kind.partition("[")[2].rstrip("]")
        return int(inside) if inside else None


class Schema(NamedTuple):
    """Definition of a message without nested messages.

    Attributes:
        name: Name such as "dual_ur10_msgs/msg/Event".
        fields: Fields in order.
    """

    name: str
    fields: tuple[CdrField, ...]

    @property
    def text(self) -> str:
        """Definition as a file `.msg` has it."""
        return "".join(f"{field.kind} {field.name}\n" for field in self.fields)

    def encode(self, values: Mapping[str, Any]) -> bytes:
        """Return the bytes of a message; arrays are flattened."""
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
        """Return the values of a message; arrays are flat.

        Raises:
            RecordingError: The bytes are not those of such a message, to the last one.
            MissingExtraError: `mcap-ros2-support` is not installed.
        """
        if data[:4] != HEAD:
            raise RecordingError(f"{self.name}: a message begins with {data[:4].hex()}, expected {HEAD.hex()}")
        try:
            message = _decoder(self)(data)
            values = {field.name: _value(field, getattr(message, field.name)) for field in self.fields}
            again = self.encode(values)
        except (struct.error, ValueError, OverflowError) as error:
            raise RecordingError(f"{self.name}: a message of {len(data)} bytes is malformed: {error}") from None
        # The library checks neither the ends of strings and bytes nor that nothing is left over.
        if again != data:
            raise RecordingError(
                f"{self.name}: a message of {len(data)} bytes is malformed: its values are {len(again)} bytes long, "
                "or other ones"
            )
        return values


def check_extra() -> None:
    """Make sure that messages can be decoded.

    Raises:
        MissingExtraError: `mcap-ros2-support` is not installed.
    """
    try:
        import mcap_ros2.decoder  # noqa: F401
    except ImportError as error:
        raise MissingExtraError("mcap-ros2-support", "records", "reading a record") from error


@cache
def _decoder(schema: Schema) -> Callable[[bytes], Any]:
    check_extra()
    from mcap.records import Schema as Definition
    from mcap_ros2.decoder import DecoderFactory

    definition = Definition(id=1, name=schema.name, encoding="ros2msg", data=schema.text.encode())
    decoder = DecoderFactory().decoder_for("cdr", definition)
    if decoder is None:
        raise RecordingError(f"{schema.name} cannot be decoded by this version of mcap-ros2-support")
    return decoder


def _value(field: CdrField, value: Any) -> Any:
    return np.array(value, dtype=np.float64) if field.kind.startswith("float64[") else value


def _align(out: bytearray, size: int) -> None:
    out.extend(bytes(-len(out) % size))
