"""Encoding of MCAP records, by version 0 of the format's specification."""

from __future__ import annotations

import struct
import zlib
from collections.abc import Mapping, Sequence
from typing import Final, NamedTuple

MAGIC: Final = b"\x89MCAP0\r\n"

HEADER, FOOTER, SCHEMA, CHANNEL, MESSAGE, CHUNK, MESSAGE_INDEX, CHUNK_INDEX = range(1, 9)
STATISTICS, METADATA, METADATA_INDEX, SUMMARY_OFFSET, DATA_END = 0x0B, 0x0C, 0x0D, 0x0E, 0x0F


class ChunkPlace(NamedTuple):
    """Place of a chunk in its file.

    Attributes:
        first_ns, last_ns: Times of the first and the last message.
        at: Offset of the record.
        length: Length of the record.
        size: Length of the messages.
        indexes: Channel number -> offset of the index of its messages.
        indexes_length: Length of all these indexes.
    """

    first_ns: int
    last_ns: int
    at: int
    length: int
    size: int
    indexes: dict[int, int]
    indexes_length: int


def record(code: int, body: bytes) -> bytes:
    """Return a record."""
    return struct.pack("<BQ", code, len(body)) + body


def text(value: str) -> bytes:
    """Return a string with its length."""
    line = value.encode()
    return struct.pack("<I", len(line)) + line


def mapping(values: Mapping[str, str]) -> bytes:
    """Return a map of strings with its length."""
    body = b"".join(text(key) + text(value) for key, value in values.items())
    return struct.pack("<I", len(body)) + body


def header(library: str) -> bytes:
    """Return the first record of a file."""
    return record(HEADER, text("ros2") + text(library))


def schema(number: int, name: str, definition: str) -> bytes:
    """Return the definition of a message."""
    data = definition.encode()
    return record(
        SCHEMA, struct.pack("<H", number) + text(name) + text("ros2msg") + struct.pack("<I", len(data)) + data
    )


def channel(number: int, topic: str) -> bytes:
    """Return a channel whose messages have the schema of the same number."""
    return record(CHANNEL, struct.pack("<HH", number, number) + text(topic) + text("cdr") + mapping({}))


def metadata(name: str, values: Mapping[str, str]) -> bytes:
    """Return metadata: named strings."""
    return record(METADATA, text(name) + mapping(values))


def chunk(first_ns: int, last_ns: int, messages: bytes) -> bytes:
    """Return a chunk of messages, not compressed: whole messages can be read where the file was cut off."""
    head = struct.pack("<QQQIIQ", first_ns, last_ns, len(messages), zlib.crc32(messages), 0, len(messages))
    return record(CHUNK, head + messages)


def message_index(number: int, entries: bytes) -> bytes:
    """Return the index of one channel's messages: times and offsets in their chunk, eight bytes each."""
    return record(MESSAGE_INDEX, struct.pack("<HI", number, len(entries)) + entries)


def chunk_index(place: ChunkPlace) -> bytes:
    """Return the index of a chunk."""
    indexes = b"".join(struct.pack("<HQ", *each) for each in place.indexes.items())
    head = struct.pack("<QQQQI", place.first_ns, place.last_ns, place.at, place.length, len(indexes))
    tail = struct.pack("<QIQQ", place.indexes_length, 0, place.size, place.size)
    return record(CHUNK_INDEX, head + indexes + tail)


def metadata_index(at: int, length: int, name: str) -> bytes:
    """Return the index of metadata."""
    return record(METADATA_INDEX, struct.pack("<QQ", at, length) + text(name))


def statistics(counts: Mapping[int, int], chunks: int, first_ns: int, last_ns: int, channels: int) -> bytes:
    """Return the numbers of records; one of metadata, none of attachments."""
    counted = b"".join(struct.pack("<HQ", *each) for each in counts.items())
    total = sum(counts.values())
    head = struct.pack("<QHIIIIQQ", total, channels, channels, 0, 1, chunks, first_ns, last_ns)
    return record(STATISTICS, head + struct.pack("<I", len(counted)) + counted)


def data_end(crc: int) -> bytes:
    """Return the end of the data, with the checksum of all that precedes it."""
    return record(DATA_END, struct.pack("<I", crc))


def ending(at: int, groups: Sequence[tuple[int, bytes]]) -> bytes:
    """Return summary, footer and magic of a file whose summary of groups of records begins at offset `at`."""
    summary, offsets, place = b"", b"", at
    for code, records in groups:
        if records:
            offsets += record(SUMMARY_OFFSET, struct.pack("<BQQ", code, place, len(records)))
            summary += records
            place += len(records)
    body = summary + offsets
    foot = struct.pack("<BQQQ", FOOTER, 20, at, place)
    return body + foot + struct.pack("<I", zlib.crc32(body + foot)) + MAGIC
