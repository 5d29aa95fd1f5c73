"""The log of a run: its events as lines of text, beside the record."""

from __future__ import annotations

import os
from datetime import UTC, datetime, timedelta
from pathlib import Path

from dual_ur10.errors import RecordingError
from dual_ur10.sim2real.recording.run import Event, Header
from dual_ur10.sim2real.recording.writer import LOG_FILE


class RunLog:
    """Writes one line per event.

    Args:
        folder: Of the run.
        header: Of the run.

    Raises:
        RecordingError: The file exists, or cannot be made.
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
        self(Event(0.0, "begin", f"{header.env_id} on {header.source}, {header.family}, {policy}"))

    def __call__(self, event: Event) -> None:
        """Write an event.

        Raises:
            RecordingError: It cannot be written.
        """
        try:
            moment = self._began + timedelta(seconds=event.time_s)
        except (OverflowError, ValueError):  # a time that is none
            moment = self._began
        who = f" {event.arm}" if event.arm else ""
        text = " ".join(event.text.split())
        line = f"{moment:%Y-%m-%dT%H:%M:%S.%f}Z {event.time_s:+.3f} s{who} {event.kind}: {text}\n"
        try:
            os.write(self._file, line.encode())
        except OSError as error:
            raise RecordingError(f"cannot write the log {self.path}: {error}") from error

    def close(self) -> None:
        """No more events. May be called twice."""
        if self._file >= 0:
            os.close(self._file)
        self._file = -1
