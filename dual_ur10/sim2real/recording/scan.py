"""What is in a file of a record, message by message, whatever somebody may have put there.

Nothing of a file is believed: lengths are held against what is there before memory is taken, and nothing in it is ever
carried out.
"""

from __future__ import annotations

import os
import stat
import struct
import zlib
from dataclasses import dataclass, field
from pathlib import Path
from typing import BinaryIO, Final

from dual_ur10.errors import RecordingError
from dual_ur10.sim2real.recording import mcap_records as mcap

MOST_BYTES: Final = 8 * 2**30
"""Largest file that is read: two hours of two arms at 500 Hz, seven at 125 Hz."""

_MOST_RECORD: Final = 64 * 2**20
_MOST_CHANNELS: Final = 64
_HEAD: Final = struct.Struct("<BQ")
_MESSAGE_HEAD: Final = struct.Struct("<BQHIQQ")
_CHUNK_HEAD: Final = struct.Struct("<QQQII")
_KNOWN: Final = frozenset({*range(0x01, 0x10)})
_SUMMARY: Final = frozenset(
    {mcap.SCHEMA, mcap.CHANNEL, mcap.STATISTICS, mcap.CHUNK_INDEX, mcap.METADATA_INDEX, mcap.SUMMARY_OFFSET, 0x0A}
)


@dataclass
class Scanned:
    """What was found.

    Attributes:
        metadata: By name.
        schemas: Name and text, by channel's topic.
        messages: Data of all messages, by topic, in the order of the file.
        complete: Whether the file has its end.
        reason: Why not.
    """

    metadata: dict[str, dict[str, str]] = field(default_factory=dict)
    schemas: dict[str, tuple[str, str]] = field(default_factory=dict)
    messages: dict[str, list[bytes]] = field(default_factory=dict)
    complete: bool = False
    reason: str = ""


class _CutOffError(Exception):
    """The file ends here. It does not leave this module."""


def open_regular(path: Path) -> tuple[BinaryIO, int]:
    """Open a file to be read, and its size. Links are not followed.

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
    """Read a file to its end, or to where it was cut off.

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
    """One reading of one file."""

    def __init__(self, file: BinaryIO, size: int, wanted: frozenset[str]) -> None:
        self._file, self._size, self._wanted = file, size, wanted
        self._at = self._crc = 0
        self._found = Scanned()
        self._schemas: dict[int, tuple[str, str]] = {}
        self._channels: dict[int, tuple[int, str]] = {}
        self._next: dict[int, int] = {}

    def run(self) -> Scanned:
        """Read all of it."""
        if self._take(len(mcap.MAGIC), partly=True) != mcap.MAGIC:
            raise RecordingError("this is no MCAP file")
        try:
            while self._data_record():
                pass
            self._ending()
            self._found.complete = True
        except _CutOffError as cut:
            self._found.reason = str(cut)
        return self._found

    def _take(self, count: int, *, partly: bool = False) -> bytes:
        if count > self._size - self._at and not partly:
            raise _CutOffError(f"it is cut off at byte {self._size}, within what begins at byte {self._at}")
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
        """Read one record. Returns whether there may be more data."""
        before, start = self._crc, self._at
        code, length = self._head()
        if code == mcap.CHUNK:
            self._chunk(length, start)
            return True
        body = _Body(self._take(length), start)
        if code == mcap.DATA_END:
            crc = body.number("<I")
            body.end()
            if crc != before:
                raise RecordingError("the data are not as they were written: their checksum is wrong")
            return False
        if code == mcap.METADATA:
            self._metadata(body)
        elif code == mcap.SCHEMA:
            self._schema(body)
        elif code == mcap.CHANNEL:
            self._channel(body)
        elif code not in (mcap.HEADER, mcap.MESSAGE_INDEX):
            raise RecordingError(f"the record at byte {start} has code {code}, which has no place there")
        return True

    def _metadata(self, body: _Body) -> None:
        name, values = body.text(), body.mapping()
        body.end()
        if name in self._found.metadata or len(self._found.metadata) >= _MOST_CHANNELS:
            raise RecordingError(f"metadata {name[:80]!r} come twice, or too many")
        self._found.metadata[name] = values

    def _schema(self, body: _Body) -> None:
        number, name, kind, text = body.number("<H"), body.text(), body.text(), body.text()
        body.end()
        if kind != "ros2msg" or number in self._schemas or len(self._schemas) >= _MOST_CHANNELS:
            raise RecordingError(f"the schema {name[:80]!r} is of kind {kind[:80]!r}, comes twice, or is one too many")
        self._schemas[number] = name, text

    def _channel(self, body: _Body) -> None:
        number, schema, topic, kind = body.number("<H"), body.number("<H"), body.text(), body.text()
        body.mapping()
        body.end()
        if schema not in self._schemas or kind != "cdr":
            raise RecordingError(f"the channel {topic[:80]!r} is of kind {kind[:80]!r} or has no schema")
        if number in self._channels or topic in self._found.schemas:
            raise RecordingError(f"the channel {topic[:80]!r} comes twice")
        self._channels[number] = schema, topic
        self._next[number] = 0
        self._found.schemas[topic] = self._schemas[schema]
        self._found.messages[topic] = []

    def _chunk(self, length: int, start: int) -> None:
        there = min(length, self._size - self._at)
        data = self._take(there, partly=there < length)
        if len(data) < _CHUNK_HEAD.size + 8:
            if there == length:
                raise RecordingError(f"the chunk at byte {start} is malformed")
            raise _CutOffError(f"it is cut off at byte {self._size}, within the chunk at byte {start}")
        _, _, size, crc, name_length = _CHUNK_HEAD.unpack_from(data)
        if name_length:
            raise RecordingError(f"the chunk at byte {start} is compressed: decompress the file with the mcap tool")
        (again,) = struct.unpack_from("<Q", data, _CHUNK_HEAD.size)
        if again != size or size != length - _CHUNK_HEAD.size - 8:
            raise RecordingError(f"the chunk at byte {start} is malformed: its lengths differ")
        messages = memoryview(data)[_CHUNK_HEAD.size + 8 :]
        if len(messages) == size:
            if zlib.crc32(messages) != crc:
                if self._at == self._size:  # a power cut leaves lengths without what belongs there
                    raise _CutOffError(f"the last chunk, at byte {start}, is not as it was written")
                raise RecordingError(f"the chunk at byte {start} is not as it was written: its checksum is wrong")
            if self._messages(messages, start) != size:
                raise RecordingError(f"the chunk at byte {start} ends within a message")
            return
        self._messages(messages, start)
        raise _CutOffError(f"it is cut off at byte {self._size}, within the chunk at byte {start}")

    def _messages(self, data: memoryview, start: int) -> int:
        """Keep every whole message. Returns where the last of them ends."""
        at, size = 0, len(data)
        while size - at >= _MESSAGE_HEAD.size:
            code, length, number, sequence, _, _ = _MESSAGE_HEAD.unpack_from(data, at)
            if code != mcap.MESSAGE or length < 22:
                raise RecordingError(f"there is something else than messages in the chunk at byte {start}")
            end = at + 9 + length
            if end > size:
                break
            channel = self._channels.get(number)
            if channel is None:
                raise RecordingError(f"a message in the chunk at byte {start} is of channel {number}: there is none")
            topic = channel[1]
            if sequence != self._next[number]:
                raise RecordingError(f"{topic}: message {sequence} follows where {self._next[number]} is expected")
            self._next[number] = sequence + 1
            if topic in self._wanted:
                self._found.messages[topic].append(bytes(data[at + _MESSAGE_HEAD.size : end]))
            at = end
        return at

    def _ending(self) -> None:
        """The summary is for others: what it says is known by now. But it must be whole."""
        start = self._at
        self._crc = 0
        while True:
            code, length = self._head()
            if code == mcap.FOOTER:
                break
            if code not in _SUMMARY:
                raise RecordingError(f"a record of code {code} has no place in the summary")
            self._take(length)
        if length != 20:
            raise RecordingError("the footer is malformed")
        body = self._take(16)
        expected, summary = self._crc, struct.unpack("<QQ", body)[0]
        (crc,) = struct.unpack("<I", self._take(4))
        if summary != start or crc != expected:
            raise RecordingError("the summary is not as it was written")
        if self._take(len(mcap.MAGIC)) != mcap.MAGIC or self._at != self._size:
            raise RecordingError("the file does not end where it should")


class _Body:
    """Reads the parts of a record."""

    def __init__(self, data: bytes, start: int) -> None:
        self._data, self._start, self._at = data, start, 0

    def number(self, code: str) -> int:
        """One number."""
        try:
            (value,) = struct.unpack_from(code, self._data, self._at)
        except struct.error:
            raise self._malformed() from None
        self._at += struct.calcsize(code)
        return int(value)

    def text(self) -> str:
        """A string."""
        length = self.number("<I")
        piece = self._data[self._at : self._at + length]
        if len(piece) < length:
            raise self._malformed()
        self._at += length
        try:
            return piece.decode()
        except UnicodeDecodeError:
            raise self._malformed() from None

    def mapping(self) -> dict[str, str]:
        """A map of strings."""
        end = self.number("<I") + self._at
        values: dict[str, str] = {}
        while self._at < end:
            key = self.text()
            values[key] = self.text()
        if self._at != end:
            raise self._malformed()
        return values

    def end(self) -> None:
        """See that nothing is left."""
        if self._at != len(self._data):
            raise self._malformed()

    def _malformed(self) -> RecordingError:
        return RecordingError(f"the record at byte {self._start} is malformed")
