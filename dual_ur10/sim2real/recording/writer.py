"""Writer of a record. Flushed data survive a kill of the process at any instant.

MCAP's own writer is not used: it holds messages back until a chunk is full, and encodes them one by one.
"""

from __future__ import annotations

import contextlib
import errno
import os
import zlib
from collections import Counter
from collections.abc import Iterable
from pathlib import Path

import numpy as np

from dual_ur10.errors import ClosedError, RecordingError
from dual_ur10.sim2real.recording import mcap_records as mcap
from dual_ur10.sim2real.recording.encoding import NUMBERS, Encoder, Messages
from dual_ur10.sim2real.recording.header import METADATA_NAME
from dual_ur10.sim2real.recording.run import Header, RunEvent
from dual_ur10.sim2real.recording.run_folder import LEAST_FREE_BYTES, RUN_FILE, check_name, check_room
from dual_ur10.sim2real.recording.schemas import STATE_COLUMNS, Columns
from ur_core.types import Array, Closing


class RunWriter(Closing):
    """Writer of one file. All that was added is handed to the system by the next `flush`.

    `close` writes an index at the end. A file without it, as after a kill, can be read all the same.

    Args:
        folder: Existing folder of the run.
        header: Header of the run.
        name: Name of the file, which must not exist.
        columns: Columns of the states.
        least_free_bytes: Free space required on the disk.

    Attributes:
        path: The file.
        size: Bytes written so far.

    Raises:
        RecordingError: The file exists or cannot be made, there is too little room, or the header is not legal.
    """

    def __init__(
        self,
        folder: Path,
        header: Header,
        *,
        name: str = RUN_FILE,
        columns: Columns = STATE_COLUMNS,
        least_free_bytes: int = LEAST_FREE_BYTES,
    ) -> None:
        self.path = folder / check_name(name)
        self.encoder = Encoder(header, columns)
        self._closed = False
        self._pending: list[Messages] = []
        self._written: Counter[int] = Counter()
        self._places: list[mcap.ChunkPlace] = []
        self._crc = self.size = 0
        self._failure = ""
        try:
            check_room(folder, least_free_bytes)
            flags = os.O_WRONLY | os.O_CREAT | os.O_EXCL | os.O_NOFOLLOW | os.O_CLOEXEC
            self._file = os.open(self.path, flags, 0o644)
        except OSError as error:
            raise RecordingError(f"cannot record in {self.path}: {error}") from error
        try:
            self._write(self.encoder.preamble)
        except RecordingError:
            self.close()
            raise

    def states(self, arm: int, rows: Array) -> None:
        """Add states of an arm, (k, numbers) in the writer's columns; the first is the time of the run."""
        self.add(self.encoder.states(arm, rows))

    def sent(self, arm: int, rows: Array) -> None:
        """Add targets that were sent, (k, 10) in `SENT_COLUMNS`, with times of the run."""
        self.add(self.encoder.sent(arm, rows))

    def single(self, topic: str, time_s: float, data: bytes) -> None:
        """Add one encoded message."""
        self.add(self.encoder.single(topic, time_s, data))

    def event(self, event: RunEvent) -> None:
        """Add an event."""
        self.add(self.encoder.event(event))

    def add(self, messages: Iterable[Messages]) -> None:
        """Add messages, which `flush` will write."""
        self._pending.extend(messages)

    def flush(self) -> None:
        """Hand all that was added to the system.

        Raises:
            RecordingError: The system refuses. The file can be read up to the last flush, and nothing more is written.
            ClosedError: The record was closed.
        """
        if self._closed:
            raise ClosedError(f"the record {self.path} was closed")
        pending, self._pending = self._pending, []
        if not pending:
            return
        first = min(int(each.log_ns[0]) for each in pending)
        last = max(int(each.log_ns[-1]) for each in pending)
        entries: dict[int, list[Messages]] = {}
        starts: dict[int, list[int]] = {}
        at = 0
        for each in pending:
            entries.setdefault(each.channel, []).append(each)
            starts.setdefault(each.channel, []).append(at)
            at += len(each.records)
        messages = b"".join(each.records for each in pending)
        whole = mcap.chunk(first, last, messages)
        indexes, offsets = b"", {}
        for number, parts in entries.items():
            offsets[number] = self.size + len(whole) + len(indexes)
            indexes += _index(number, parts, starts[number])
        place = mcap.ChunkPlace(first, last, self.size, len(whole), len(messages), offsets, len(indexes))
        self._write(whole + indexes)
        self._places.append(place)
        for each in pending:
            self._written[each.channel] += len(each.log_ns)

    def sync(self) -> None:
        """Wait until the disk has all that was flushed. This may take long.

        Raises:
            RecordingError: The disk refuses.
        """
        try:
            os.fsync(self._file)
        except OSError as error:
            if error.errno not in (errno.EINVAL, errno.EBADF):
                raise RecordingError(f"cannot record in {self.path}: {error}") from error

    def close(self) -> None:
        """Write the rest and the index, and close the file. May be called twice.

        Raises:
            RecordingError: It cannot be written. The file is closed all the same.
        """
        if self._closed:
            return
        try:
            if not self._failure:
                self.flush()
                self._finish()
                self.sync()
        finally:
            self._closed = True
            os.close(self._file)

    def _finish(self) -> None:
        end = mcap.data_end(self._crc)
        at = self.size + len(end)
        first = min((place.first_ns for place in self._places), default=0)
        last = max((place.last_ns for place in self._places), default=0)
        groups = [
            (mcap.SCHEMA, self.encoder.schemas),
            (mcap.CHANNEL, self.encoder.channels),
            (mcap.STATISTICS, mcap.statistics(self._written, len(self._places), first, last, len(NUMBERS))),
            (mcap.CHUNK_INDEX, b"".join(map(mcap.chunk_index, self._places))),
            (mcap.METADATA_INDEX, mcap.metadata_index(*self.encoder.head, METADATA_NAME)),
        ]
        self._write(end + mcap.ending(at, groups))

    def _write(self, data: bytes) -> None:
        """Write all of the data, or nothing.

        Raises:
            RecordingError: They cannot be written, or earlier ones could not.
        """
        if self._failure:
            raise RecordingError(self._failure)
        left = memoryview(data)
        try:
            while left:
                left = left[os.write(self._file, left) :]
        except OSError as error:
            self._failure = (
                f"cannot write {self.path} any more after {self.size} bytes: {error}. Up to there it can be read"
            )
            with contextlib.suppress(OSError):
                os.ftruncate(self._file, self.size)
            raise RecordingError(self._failure) from error
        self._crc = zlib.crc32(data, self._crc)
        self.size += len(data)


def _index(number: int, parts: list[Messages], starts: list[int]) -> bytes:
    body = []
    for part, start in zip(parts, starts, strict=True):
        count = len(part.log_ns)
        entries = np.empty((count, 2), np.uint64)
        entries[:, 0] = part.log_ns
        entries[:, 1] = start + np.arange(count) * (len(part.records) // count)
        body.append(entries.astype("<u8").tobytes())
    return mcap.message_index(number, b"".join(body))
