"""Messages of the primary interface (ports 30001 and 30011) that are sent when something happens.

Each is a packet of type 20: INT32 size, UINT8 20, UINT64 timestamp in µs, INT8 source, UINT8 kind, then its own fields;
all big-endian, texts without an end mark. Layouts: UR's client interface article, and the parsers of Universal Robots'
client library for all but the popup.
"""

from __future__ import annotations

import re
import struct
from enum import IntEnum
from typing import Final, Protocol

from dual_ur10.errors import ScriptError, SettingsError

ROBOT_MESSAGE: Final = 20
"""Type of these packets."""

SOURCE_CONTROLLER: Final = -2
SOURCE_PROGRAM: Final = -3
"""Who speaks: the controller, or the program it runs. As in packets recorded from URSim."""

_TEXT, _POPUP, _VERSION, _SAFETY_MODE, _ERROR_CODE, _KEY, _RUNTIME_EXCEPTION = 0, 2, 3, 5, 6, 7, 10


class ControllerIdentity(Protocol):
    """Facts of a controller that its packets report: software, robot and safety settings."""

    @property
    def family(self) -> str:
        """Controller family: "cb3" or "e-series"."""
        ...

    @property
    def version(self) -> tuple[int, int, int, int]:
        """Major, minor, bugfix and build of the software."""
        ...

    @property
    def released(self) -> str:
        """Release date of the software."""
        ...

    @property
    def robot_type(self) -> int:
        """UR's number of the robot: 2 is the UR10."""
        ...

    @property
    def safety_checksum(self) -> int:
        """Checksum of the safety settings, 32 bits."""
        ...


class ReportLevel(IntEnum):
    """Severity of an error code."""

    DEBUG = 0
    INFO = 1
    WARNING = 2
    VIOLATION = 3
    FAULT = 4


def version_message(identity: ControllerIdentity) -> bytes:
    """Return the first message of every connection: the controller's version."""
    name = b"URControl"
    major, minor, bugfix, build = identity.version
    body = struct.pack(f">B{len(name)}sBBii", len(name), name, major, minor, bugfix, build)
    return _message(0.0, SOURCE_CONTROLLER, _VERSION, body + _bytes(identity.released))


def text_message(timestamp_s: float, text: str) -> bytes:
    """What a program says with `textmsg`."""
    return _message(timestamp_s, SOURCE_PROGRAM, _TEXT, _bytes(text))


def key_message(timestamp_s: float, title: str, text: str, *, code: int = 0, argument: int = 0) -> bytes:
    """An event with a title, as "PROGRAM_XXX_STARTED" with the program's name."""
    body = struct.pack(">iiB", code, argument, len(_short(title))) + _short(title) + _bytes(text)
    return _message(timestamp_s, SOURCE_CONTROLLER, _KEY, body)


def runtime_exception_message(timestamp_s: float, line: int, column: int, text: str) -> bytes:
    """Why a program ended.

    Args:
        timestamp_s: Controller time, s.
        line: Line of the program, from 1.
        column: Column, from 1.
        text: What is wrong.
    """
    return _message(timestamp_s, SOURCE_PROGRAM, _RUNTIME_EXCEPTION, struct.pack(">ii", line, column) + _bytes(text))


def script_error_message(timestamp_s: float, error: ScriptError) -> bytes:
    """The same of an error of the script interpreter, which knows no column."""
    return runtime_exception_message(timestamp_s, error.line, 1, f"{error.reason}: {error.word}")


def error_code_message(
    timestamp_s: float, code: str, text: str = "", *, level: ReportLevel = ReportLevel.VIOLATION
) -> bytes:
    """An error code, as the log on the pendant shows it.

    Args:
        timestamp_s: Controller time, s.
        code: As UR writes it: "C153A0".
        text: Its explanation.
        level: How grave it is.

    Raises:
        SettingsError: The code is not written so.
    """
    body = struct.pack(">iiiII", *split_code(code), level, 0, 0) + _bytes(text)
    return _message(timestamp_s, SOURCE_CONTROLLER, _ERROR_CODE, body)


def safety_mode_message(timestamp_s: float, safety_mode: int, code: str = "C0A0") -> bytes:
    """A change of the safety mode, and the code of what caused it.

    Raises:
        SettingsError: The code is not written as "C204A1".
    """
    body = struct.pack(">iiBII", *split_code(code), safety_mode & 0xFF, 0, 0)
    return _message(timestamp_s, SOURCE_CONTROLLER, _SAFETY_MODE, body)


def popup_message(
    timestamp_s: float,
    title: str,
    text: str,
    *,
    warning: bool = False,
    error: bool = False,
    blocking: bool = False,
    request: int = 0,
) -> bytes:
    """A message on the pendant, as `popup` in a program or on the dashboard shows it.

    Args:
        timestamp_s: Controller time, s.
        title: At most 255 bytes of it are sent.
        text: The message.
        warning: Whether it looks like a warning.
        error: Whether it looks like an error.
        blocking: Whether the program waits for it.
        request: Number by which it can be answered.
    """
    # Assumption: kind of the request 0; no document at hand tells it for a message that asks nothing.
    body = struct.pack(">IB???B", request, 0, warning, error, blocking, len(_short(title)))
    return _message(timestamp_s, SOURCE_PROGRAM, _POPUP, body + _short(title) + _bytes(text))


def split_code(code: str) -> tuple[int, int]:
    """Code and argument of an error code: (153, 0) of "C153A0", (50, 0) of "C50".

    Raises:
        SettingsError: It is not written so.
    """
    found = re.fullmatch(r"C(\d{1,9})(?:A(\d{1,9}))?", code, re.ASCII)
    if found is None:
        raise SettingsError(f"error code {code!r}: write it as UR does, as C153A0")
    return int(found[1]), int(found[2] or 0)


def _message(timestamp_s: float, source: int, kind: int, body: bytes) -> bytes:
    time_us = max(0, round(timestamp_s * 1e6))
    return struct.pack(">iBQbB", 15 + len(body), ROBOT_MESSAGE, time_us, source, kind) + body


def _bytes(text: str) -> bytes:
    return text.encode("utf-8", "replace")


def _short(text: str) -> bytes:
    """Text whose length is told in one byte."""
    return _bytes(text)[:255]
