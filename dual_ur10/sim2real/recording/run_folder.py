"""Folder of a run: its name, the room on its disk, and the log of events beside the record."""

from __future__ import annotations

import contextlib
import logging
import os
import re
import shutil
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Final

from dual_ur10.errors import RecordingError
from dual_ur10.sim2real.recording.run import Header, RunEvent

_LOG: Final = logging.getLogger(__name__)

RUN_FILE: Final = "run.mcap"
LOG_FILE: Final = "run.log"

LEAST_FREE_BYTES: Final = 256 * 2**20
"""Free space required at the start of a run: four minutes of two arms at 500 Hz, fifteen at 125 Hz."""

_NAME: Final = re.compile(r"[A-Za-z0-9_.-]{1,128}\Z")
_MOST_FOLDERS: Final = 99


def check_name(name: str) -> str:
    """Return the name of a file or folder of a record, if it is legal.

    Raises:
        RecordingError: It has other characters than letters, digits, "_", "." and "-", or begins with a dot.
    """
    if not _NAME.match(name) or name.startswith("."):
        raise RecordingError(f"the name {name[:140]!r} cannot be used: letters, digits, '_', '.' and '-' are allowed")
    return name


def check_room(folder: Path, least_free_bytes: int) -> None:
    """Make sure that there is room on the disk of a folder.

    Raises:
        RecordingError: There is too little.
        OSError: The system does not report it.
    """
    free = shutil.disk_usage(folder).free
    if free < least_free_bytes:
        raise RecordingError(
            f"cannot record in {folder}: {free / 2**20:.0f} MiB are free, {least_free_bytes / 2**20:.0f} MiB "
            "are needed: make room, or record elsewhere"
        )


def prepare(root: Path, *, least_free_bytes: int = LEAST_FREE_BYTES) -> None:
    """Make sure that runs can be recorded in a folder, and create it if it does not exist.

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
    """Create the folder of a new run, `<UTC time>-<task>-<source>`.

    Args:
        root: Folder to create it in; created if it does not exist.
        header: Header of the run.
        least_free_bytes: Free space required on the disk.

    Raises:
        RecordingError: It cannot be created, or there is too little room.
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
                _LOG.info("recording in %s", folder)
                return folder
    except OSError as error:
        raise RecordingError(f"cannot make a folder for the run in {root}: {error}") from error
    raise RecordingError(f"cannot make a folder for the run in {root}: {name} and {_MOST_FOLDERS - 1} others exist")


class RunLog:
    """Log of a run: one line of text per event.

    Args:
        folder: Folder of the run.
        header: Header of the run.

    Raises:
        RecordingError: The file exists, or cannot be created.
    """

    def __init__(self, folder: Path, header: Header) -> None:
        self.path = folder / LOG_FILE
        self._began = datetime.fromisoformat(header.started_utc).astimezone(UTC)
        try:
            flags = os.O_WRONLY | os.O_CREAT | os.O_EXCL | os.O_NOFOLLOW | os.O_APPEND | os.O_CLOEXEC
            self._file = os.open(self.path, flags, 0o644)
        except OSError as error:
            raise RecordingError(f"cannot write the log {self.path}: {error}") from error
        policy = header.policy or "no policy named"
        self(RunEvent(0.0, "begin", f"{header.env_id} on {header.source}, {header.family}, {policy}"))

    def __call__(self, event: RunEvent) -> None:
        """Write an event.

        Raises:
            RecordingError: It cannot be written.
        """
        try:
            moment = self._began + timedelta(seconds=event.time_s)
        except (OverflowError, ValueError):  # NaN, or beyond the calendar
            moment = self._began
        who = f" {event.arm}" if event.arm else ""
        text = " ".join(event.text.split())
        line = f"{moment:%Y-%m-%dT%H:%M:%S.%f}Z {event.time_s:+.3f} s{who} {event.kind}: {text}\n"
        try:
            os.write(self._file, line.encode())
        except OSError as error:
            raise RecordingError(f"cannot write the log {self.path}: {error}") from error

    def close(self) -> None:
        """Close the file. May be called twice."""
        if self._file >= 0:
            os.close(self._file)
        self._file = -1
