"""Structure of a record's file: metadata, schemas and the messages of each channel.

`mcap` parses all records but messages, of which there are millions. This module frames them, because the stream reader
of `mcap` skips unknown records, believes lengths within a record and drops the last chunk of a file that was cut off.
Nothing in a file is trusted: lengths are checked against the size of the file before memory is taken, and nothing in it
is ever executed.
"""

from __future__ import annotations

import os
import stat
import struct
import zlib
from collections.abc import Callable
from dataclasses import dataclass, field
from io import BytesIO
from pathlib import Path
from typing import BinaryIO, Final, TypeVar

from dual_ur10.errors import MissingExtraError, RecordingError
from dual_ur10.sim2real.recording.mcap_records import MAGIC

try:
    from mcap.data_stream import ReadDataStream
    from mcap.exceptions import McapError
    from mcap.opcode import Opcode
    from mcap.records import Channel, Chunk, DataEnd, Footer, Metadata, Schema
except ImportError as error:
    raise MissingExtraError("mcap", "records", "reading a record") from error

MOST_BYTES: Final = 8 * 2**30
"""Largest file that is read: two hours of two arms at 500 Hz, seven at 125 Hz."""

_MOST_RECORD: Final = 64 * 2**20
_MOST_CHANNELS: Final = 64
_HEAD: Final = struct.Struct("<BQ")
_CHUNK_HEAD: Final = 40  # bytes before the messages of a chunk that is not compressed
_MESSAGE_HEAD: Final = 22
_MESSAGE: Final = struct.Struct("<BQHIQQ")  # code, length, channel, sequence, and both times
_FOOTER: Final = 20
_KNOWN: Final = frozenset(map(int, Opcode))
_SKIPPED: Final = frozenset({Opcode.HEADER, Opcode.MESSAGE_INDEX})
_SUMMARY: Final = frozenset(
    {
        Opcode.SCHEMA,
        Opcode.CHANNEL,
        Opcode.STATISTICS,
        Opcode.CHUNK_INDEX,
        Opcode.ATTACHMENT_INDEX,
        Opcode.METADATA_INDEX,
        Opcode.SUMMARY_OFFSET,
    }
)
_Record = TypeVar("_Record")


@dataclass
class Scanned:
    """Content of a file.

    Attributes:
        metadata: Metadata by name.
        schemas: Name and text of the schema of each topic.
        messages: Data of all messages by topic, in the order of the file.
        complete: True if the file has its end.
        reason: Reason why it has not.
    """

    metadata: dict[str, dict[str, str]] = field(default_factory=dict)
    schemas: dict[str, tuple[str, str]] = field(default_factory=dict)
    messages: dict[str, list[bytes]] = field(default_factory=dict)
    complete: bool = False
    reason: str = ""


class _CutOffError(Exception):
    """The file ends here. It does not leave this module."""


def open_regular(path: Path) -> tuple[BinaryIO, int]:
    """Open a file for reading, and return it with its size. Links are not followed.

    Raises:
        RecordingError: There is none, or it is not a regular file.
    """
    try:
        number = os.open(path, os.O_RDONLY | os.O_NOFOLLOW | os.O_NONBLOCK | os.O_CLOEXEC)
    except (OSError, ValueError) as error:
        hint = ": links are not followed" if path.is_symlink() else ""
        raise RecordingError(f"cannot read {path}: {error}{hint}") from error
    status = os.fstat(number)
    if not stat.S_ISREG(status.st_mode):
        os.close(number)
        raise RecordingError(f"cannot read {path}: it is no regular file")
    return os.fdopen(number, "rb"), status.st_size


def scan(path: Path, *, wanted: frozenset[str], most_bytes: int = MOST_BYTES) -> Scanned:
    """Read a file to its end, or to the byte at which it was cut off.

    Args:
        path: The file.
        wanted: Topics whose messages are kept.
        most_bytes: Largest size of the file.

    Raises:
        RecordingError: It is no such file, it is too large, or something in it is not as it was written.
    """
    file, size = open_regular(path)
    with file:
        if size > most_bytes:
            raise RecordingError(
                f"{path} has {size} bytes: allowed are {most_bytes}, as all of it is held in memory. It is whole, and "
                "other programs read it; record fewer episodes in one run"
            )
        try:
            return _Scan(file, size, wanted).run()
        except RecordingError as error:
            raise RecordingError(f"{path}: {error}") from None
        except OSError as error:
            raise RecordingError(f"cannot read {path}: {error}") from error


class _Scan:
    """One pass through one file."""

    def __init__(self, file: BinaryIO, size: int, wanted: frozenset[str]) -> None:
        self._file, self._size, self._wanted = file, size, wanted
        self._at = self._crc = 0
        self._found = Scanned()
        self._schemas: dict[int, tuple[str, str]] = {}
        self._channels: dict[int, str] = {}
        self._next: dict[int, int] = {}

    def run(self) -> Scanned:
        if self._take(len(MAGIC), partly=True) != MAGIC:
            raise RecordingError("this is no MCAP file")
        try:
            while self._data_record():
                pass
            self._summary()
            self._found.complete = True
        except _CutOffError as cut:
            self._found.reason = str(cut)
        return self._found

    def _take(self, count: int, *, partly: bool = False) -> bytes:
        if count > self._size - self._at and not partly:
            raise _CutOffError(f"it is cut off at byte {self._size}, within the data that begin at byte {self._at}")
        data = self._file.read(count)
        if len(data) < count and not partly:
            raise _CutOffError(f"it became shorter while it was read, at byte {self._at + len(data)}")
        self._at += len(data)
        self._crc = zlib.crc32(data, self._crc)
        return data

    def _head(self) -> tuple[int, int]:
        start = self._at
        code, length = _HEAD.unpack(self._take(_HEAD.size))
        if code not in _KNOWN:
            if not code and not length and self._only_zeros():
                raise _CutOffError(f"there are only zeros from byte {start} on")
            raise RecordingError(f"the record at byte {start} has the unknown code {code}")
        if length > _MOST_RECORD:
            raise RecordingError(f"the record at byte {start} has {length} bytes: allowed are {_MOST_RECORD}")
        return code, length

    def _only_zeros(self) -> bool:
        while piece := self._file.read(2**20):
            if piece.strip(b"\0"):
                return False
        return True

    def _data_record(self) -> bool:
        """Read one record. Return False at the end of the data."""
        before, start = self._crc, self._at
        code, length = self._head()
        if code == Opcode.CHUNK:
            self._chunk(length, start)
            return True
        body = self._take(length)
        if code == Opcode.DATA_END:
            if _parsed(DataEnd.read, body, start).data_section_crc != before:
                raise RecordingError("the data are not as they were written: their checksum is wrong")
            return False
        if code == Opcode.METADATA:
            self._metadata(_parsed(Metadata.read, body, start))
        elif code == Opcode.SCHEMA:
            self._schema(_parsed(Schema.read, body, start))
        elif code == Opcode.CHANNEL:
            self._channel(_parsed(Channel.read, body, start))
        elif code not in _SKIPPED:
            raise RecordingError(f"the record at byte {start} has code {code}, which is not allowed there")
        return True

    def _metadata(self, record: Metadata) -> None:
        if record.name in self._found.metadata or len(self._found.metadata) >= _MOST_CHANNELS:
            raise RecordingError(f"metadata {record.name[:80]!r} come twice, or too many")
        self._found.metadata[record.name] = record.metadata

    def _schema(self, record: Schema) -> None:
        if record.encoding != "ros2msg" or record.id in self._schemas or len(self._schemas) >= _MOST_CHANNELS:
            raise RecordingError(
                f"the schema {record.name[:80]!r} is of kind {record.encoding[:80]!r}, comes twice, or is one too many"
            )
        try:
            self._schemas[record.id] = record.name, record.data.decode()
        except UnicodeDecodeError:
            raise RecordingError(f"the schema {record.name[:80]!r} is no text") from None

    def _channel(self, record: Channel) -> None:
        topic = record.topic
        if record.schema_id not in self._schemas or record.message_encoding != "cdr":
            raise RecordingError(
                f"the channel {topic[:80]!r} is of kind {record.message_encoding[:80]!r} or has no schema"
            )
        if record.id in self._channels or topic in self._found.schemas:
            raise RecordingError(f"the channel {topic[:80]!r} comes twice")
        self._channels[record.id] = topic
        self._next[record.id] = 0
        self._found.schemas[topic] = self._schemas[record.schema_id]
        self._found.messages[topic] = []

    def _chunk(self, length: int, start: int) -> None:
        there = min(length, self._size - self._at)
        body = self._take(there, partly=there < length)
        cut = f"it is cut off at byte {self._size}, within the chunk at byte {start}"
        if there < length and len(body) < _CHUNK_HEAD + 1:
            raise _CutOffError(cut)
        if length < _CHUNK_HEAD:
            raise RecordingError(f"the chunk at byte {start} is malformed")
        chunk = _parsed(Chunk.read, body, start)
        if chunk.compression:
            raise RecordingError(f"the chunk at byte {start} is compressed: decompress the file with the mcap tool")
        if chunk.uncompressed_size != length - _CHUNK_HEAD:
            raise RecordingError(f"the chunk at byte {start} is malformed: its lengths differ")
        if there < length:
            self._messages(chunk.data, start)
            raise _CutOffError(cut)
        if zlib.crc32(chunk.data) != chunk.uncompressed_crc:
            if self._at == self._size:  # a power cut leaves lengths without their content
                raise _CutOffError(f"the last chunk, at byte {start}, is not as it was written")
            raise RecordingError(f"the chunk at byte {start} is not as it was written: its checksum is wrong")
        if not self._messages(chunk.data, start):
            raise RecordingError(f"the chunk at byte {start} ends within a message")

    def _messages(self, data: bytes, start: int) -> bool:
        """Keep every whole message. Return True if the data end with the last of them."""
        at, size = 0, len(data)
        while size - at >= _MESSAGE.size:
            code, length, number, sequence, _, _ = _MESSAGE.unpack_from(data, at)
            end = at + _HEAD.size + length
            if code != Opcode.MESSAGE or length < _MESSAGE_HEAD:
                raise RecordingError(f"there is something else than messages in the chunk at byte {start}")
            if end > size:
                return False
            topic = self._channels.get(number)
            if topic is None:
                raise RecordingError(f"a message in the chunk at byte {start} is of channel {number}: there is none")
            if sequence != self._next[number]:
                raise RecordingError(f"{topic}: message {sequence} follows where {self._next[number]} is expected")
            self._next[number] += 1
            if topic in self._wanted:
                self._found.messages[topic].append(data[at + _MESSAGE.size : end])
            at = end
        return at == size

    def _summary(self) -> None:
        """Check that the summary is whole. Its content repeats that of the data."""
        start = self._at
        self._crc = 0
        while True:
            code, length = self._head()
            if code == Opcode.FOOTER:
                break
            if code not in _SUMMARY:
                raise RecordingError(f"a record of code {code} has no place in the summary")
            self._take(length)
        if length != _FOOTER:
            raise RecordingError("the footer is malformed")
        body = self._take(length - 4)
        crc = self._crc
        footer = _parsed(Footer.read, body + self._take(4), start)
        if footer.summary_start != start or footer.summary_crc != crc:
            raise RecordingError("the summary is not as it was written")
        if self._take(len(MAGIC)) != MAGIC or self._at != self._size:
            raise RecordingError("the file does not end where it should")


def _parsed(read: Callable[[ReadDataStream], _Record], body: bytes, start: int) -> _Record:
    """Return the record that a body holds, and nothing else."""
    stream = ReadDataStream(BytesIO(body))
    try:
        record = read(stream)
    except (McapError, struct.error, ValueError, OverflowError):  # the last: lengths of 64 bits
        raise RecordingError(f"the record at byte {start} is malformed") from None
    if stream.count != len(body):
        raise RecordingError(f"the record at byte {start} is malformed")
    return record
