"""Writing a record, so that nothing that was flushed is lost when the process is killed."""

from __future__ import annotations

import contextlib
import errno
import os
import re
import shutil
import zlib
from collections import Counter
from collections.abc import Iterable
from pathlib import Path
from typing import Final

import numpy as np

from dual_ur10.errors import ClosedError, RecordingError
from dual_ur10.sim2real.recording import mcap_records as mcap
from dual_ur10.sim2real.recording.encoding import METADATA_NAME, NUMBERS, Encoder, Messages
from dual_ur10.sim2real.recording.run import Event, Header
from dual_ur10.sim2real.recording.schemas import STATE_COLUMNS, Columns
from dual_ur10.types import Array, Closing

RUN_FILE: Final = "run.mcap"
LOG_FILE: Final = "run.log"

LEAST_FREE_BYTES: Final = 256 * 2**20
"""Room on the disk that a run wants when it begins: four minutes of two arms at 500 Hz, fifteen at 125 Hz."""

_NAME: Final = re.compile(r"[A-Za-z0-9_.-]{1,128}\Z")
_MOST_FOLDERS: Final = 99


def check_name(name: str) -> str:
    """A name of a file or folder of a record, as it is.

    Raises:
        RecordingError: It has other characters than letters, digits, "_", "." and "-", or begins with a dot.
    """
    if not _NAME.match(name) or name.startswith("."):
        raise RecordingError(f"the name {name[:140]!r} cannot be used: letters, digits, '_', '.' and '-' are allowed")
    return name


def check_room(folder: Path, least_free_bytes: int) -> None:
    """Make sure that there is room on the disk of a folder.

    Raises:
        RecordingError: There is not.
        OSError: Nobody knows.
    """
    free = shutil.disk_usage(folder).free
    if free < least_free_bytes:
        raise RecordingError(
            f"cannot record in {folder}: {free / 2**20:.0f} MiB are free, {least_free_bytes / 2**20:.0f} MiB "
            "are needed: make room, or record elsewhere"
        )


def prepare(root: Path, *, least_free_bytes: int = LEAST_FREE_BYTES) -> None:
    """See that runs can be recorded in a folder, which is made if it does not exist.

    Raises:
        RecordingError: They cannot, or there is too little room.
    """
    if root.exists() and not root.is_dir():
        raise RecordingError(f"cannot make a folder for the run in {root}: it is no folder. Name one to record in")
    try:
        root.mkdir(parents=True, exist_ok=True)
        check_room(root, least_free_bytes)
    except OSError as error:
        raise RecordingError(f"cannot make a folder for the run in {root}: {error}") from error


def new_folder(root: Path, header: Header, *, least_free_bytes: int = LEAST_FREE_BYTES) -> Path:
    """Make the folder of a new run, `<UTC time>-<task>-<source>`, within a folder that exists or is made.

    Args:
        root: That folder.
        header: Of the run.
        least_free_bytes: Room that there must be on the disk.

    Raises:
        RecordingError: It cannot be made, or there is too little room.
    """
    prepare(root, least_free_bytes=least_free_bytes)
    time = re.sub(r"[^0-9T]", "", header.started_utc.split(".")[0].split("+")[0])
    task = header.env_id.split("/")[-1]
    name = check_name(f"{time}-{task}-{header.source}")
    try:
        for number in range(1, _MOST_FOLDERS + 1):
            folder = root / (name if number == 1 else f"{name}-{number}")
            with contextlib.suppress(FileExistsError):
                folder.mkdir()
                return folder
    except OSError as error:
        raise RecordingError(f"cannot make a folder for the run in {root}: {error}") from error
    raise RecordingError(f"cannot make a folder for the run in {root}: {name} and {_MOST_FOLDERS - 1} others exist")


class RunWriter(Closing):
    """Writes a record. What it is given is in the file, as far as the system is concerned, after the next `flush`.

    The file ends with an index after `close`; without it, as after a kill, everything can be read all the same.

    Args:
        folder: Of the run; it exists.
        header: Of the run.
        name: Of the file, which must not exist.
        columns: Of the states that come.
        least_free_bytes: Room that there must be on the disk.

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
        """States of an arm, (k, numbers) in the writer's columns; the first is the time of the run."""
        self.add(self.encoder.states(arm, rows))

    def sent(self, arm: int, rows: Array) -> None:
        """Targets that were sent, (k, 10) in `SENT_COLUMNS`, with times of the run."""
        self.add(self.encoder.sent(arm, rows))

    def single(self, topic: str, time_s: float, data: bytes) -> None:
        """One message of a channel, encoded."""
        self.add(self.encoder.single(topic, time_s, data))

    def event(self, event: Event) -> None:
        """An event."""
        self.add(self.encoder.event(event))

    def add(self, messages: Iterable[Messages]) -> None:
        """Messages, which `flush` will write."""
        self._pending.extend(messages)

    def flush(self) -> None:
        """Hand everything over to the system.

        Raises:
            RecordingError: It does not take it. The file can be read up to the last flush, and no more is written.
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
        """Wait until the disk has everything that was flushed. This may take long: not where others wait.

        Raises:
            RecordingError: The disk refuses.
        """
        try:
            os.fsync(self._file)
        except OSError as error:
            if error.errno not in (errno.EINVAL, errno.EBADF):
                raise RecordingError(f"cannot record in {self.path}: {error}") from error

    def close(self) -> None:
        """Write what is left, and the index. May be called twice.

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
        """Write all of it, or nothing.

        Raises:
            RecordingError: It cannot be written, or something could not be before.
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
    """The index of one channel's messages within their chunk."""
    body = []
    for part, start in zip(parts, starts, strict=True):
        count = len(part.log_ns)
        entries = np.empty((count, 2), np.uint64)
        entries[:, 0] = part.log_ns
        entries[:, 1] = start + np.arange(count) * (len(part.records) // count)
        body.append(entries.astype("<u8").tobytes())
    return mcap.message_index(number, b"".join(body))
