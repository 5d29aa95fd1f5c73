"""Event messages of the primary interface, ports 30001 and 30011.

Each is a packet of type 20: INT32 size, UINT8 20, UINT64 timestamp in µs, INT8 source, UINT8 kind, then its own fields;
all big-endian, texts without an end mark. Layouts: UR's client interface article, and the parsers of Universal Robots'
client library for all but the popup.
"""

from __future__ import annotations

import re
import struct
from dataclasses import dataclass
from enum import IntEnum
from typing import Final

from ur_core.errors import ScriptError, ScriptNameError, SettingsError
from ur_core.kinematics.ur10 import Family

ROBOT_MESSAGE: Final = 20
"""Type of these packets."""

SOURCE_CONTROLLER: Final = -2
SOURCE_PROGRAM: Final = -3
"""Sources of messages: the controller, and the program it runs. Values: packets recorded from URSim."""

PROGRAM_STARTED: Final = "PROGRAM_XXX_STARTED"
PROGRAM_STOPPED: Final = "PROGRAM_XXX_STOPPED"
"""Titles of the key messages at start and end of a program. Source: the parser tests of UR's client library."""

_TEXT, _POPUP, _VERSION, _SAFETY_MODE, _ERROR_CODE, _KEY, _RUNTIME_EXCEPTION = 0, 2, 3, 5, 6, 7, 10


@dataclass(frozen=True, kw_only=True)
class ControllerIdentity:
    """Identity of a controller, as its packets report it.

    Attributes:
        family: "cb3" or "e-series".
        version: Major, minor, bugfix and build of the software.
        released: Release date of the software.
        robot_type: UR's number of the robot; 2 is the UR10.
        safety_checksum: Checksum of the safety settings, 0 to 2**32 - 1.
    """

    family: Family
    version: tuple[int, int, int, int]
    released: str
    robot_type: int = 2
    safety_checksum: int = 0x57F4285B


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
    """Return the message of `textmsg` in a program."""
    return _message(timestamp_s, SOURCE_PROGRAM, _TEXT, _bytes(text))


def key_message(timestamp_s: float, title: str, text: str, *, code: int = 0, argument: int = 0) -> bytes:
    """Return an event with a title, such as `PROGRAM_STARTED` with the program's name."""
    body = struct.pack(">iiB", code, argument, len(_short(title))) + _short(title) + _bytes(text)
    return _message(timestamp_s, SOURCE_CONTROLLER, _KEY, body)


def runtime_exception_message(timestamp_s: float, line: int, column: int, text: str) -> bytes:
    """Return the error that ended a program.

    Args:
        timestamp_s: Controller time, s.
        line: Line of the program, from 1.
        column: Column, from 1.
        text: Description of the error.
    """
    return _message(timestamp_s, SOURCE_PROGRAM, _RUNTIME_EXCEPTION, struct.pack(">ii", line, column) + _bytes(text))


def script_error_message(timestamp_s: float, error: ScriptError) -> bytes:
    """Return the same for an error of the script interpreter: an unknown name in UR's words, others in its own."""
    text = f"{error.reason}: {error.word}"
    if isinstance(error, ScriptNameError):
        text = f"compile_error_name_not_found:{error.word}:"  # a message of URSim in the tests of UR's client library
    return runtime_exception_message(timestamp_s, error.line, error.column, text)


def error_code_message(
    timestamp_s: float, code: str, text: str = "", *, level: ReportLevel = ReportLevel.VIOLATION
) -> bytes:
    """Return an error code, as the log on the pendant shows it.

    Args:
        timestamp_s: Controller time, s.
        code: Code in UR's notation: "C153A0".
        text: Explanation.
        level: Severity.

    Raises:
        SettingsError: The code is not in that notation.
    """
    body = struct.pack(">iiiII", *split_code(code), level, 0, 0) + _bytes(text)
    return _message(timestamp_s, SOURCE_CONTROLLER, _ERROR_CODE, body)


def safety_mode_message(timestamp_s: float, safety_mode: int, code: str = "C0A0") -> bytes:
    """Return a change of the safety mode, with the code of its cause.

    Raises:
        SettingsError: The code is not in the notation "C204A1".
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
    """Return a message on the pendant, as `popup` in a program or on the dashboard shows it.

    Args:
        timestamp_s: Controller time, s.
        title: At most 255 bytes of it are sent.
        text: The message.
        warning: True for the style of a warning.
        error: True for the style of an error.
        blocking: True if the program waits for it.
        request: Number under which it can be answered.
    """
    # Assumption: request type 0. No document at hand gives it for a message without a question.
    body = struct.pack(">IB???B", request, 0, warning, error, blocking, len(_short(title)))
    return _message(timestamp_s, SOURCE_PROGRAM, _POPUP, body + _short(title) + _bytes(text))


def split_code(code: str) -> tuple[int, int]:
    """Return number and argument of an error code: (153, 0) for "C153A0", (50, 0) for "C50".

    Raises:
        SettingsError: It is not in that notation.
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
    """Return a text whose length fits into one byte."""
    return _bytes(text)[:255]
