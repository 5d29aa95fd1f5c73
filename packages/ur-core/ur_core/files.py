"""Reading of regular files, and atomic and durable writing."""

from __future__ import annotations

import os
import secrets
import stat
from collections.abc import Callable
from pathlib import Path

from ur_core.errors import URError


def read_regular(path: str | Path, most_bytes: int | None = None) -> bytes:
    """Return the content of a regular file. Links are followed.

    A pipe or a device, which could keep the caller waiting, is never read.

    Args:
        path: The file.
        most_bytes: Size of a legal file. At most one byte more is read, so that the caller can refuse a longer one;
            None: all of it is read.

    Raises:
        OSError: There is none, or it cannot be read.
        ValueError: The path cannot be one.
    """
    number = os.open(path, os.O_RDONLY | os.O_NONBLOCK | os.O_CLOEXEC)
    if not stat.S_ISREG(os.fstat(number).st_mode):
        os.close(number)
        raise OSError("it is no regular file")
    with os.fdopen(number, "rb") as file:
        return file.read(-1 if most_bytes is None else most_bytes + 1)


def read_named(
    path: str | Path, most_bytes: int, error: Callable[[str], URError], *, absent: str = "", remedy: str = ""
) -> bytes:
    """Return the content of a regular file that a person named.

    Args:
        path: The file.
        most_bytes: See `read_regular`.
        error: Function that returns the error of a message.
        absent: Message for a file that does not exist; empty: that of the system.
        remedy: Sentence that follows the reason why a file cannot be read.

    Raises:
        URError: As `error`: there is none, or it cannot be read.
    """
    try:
        if not absent or Path(path).exists():
            return read_regular(path, most_bytes)
    except (OSError, ValueError, RuntimeError) as reason:
        raise error(f"cannot read {path}: {reason}{remedy and f'. {remedy}'}") from reason
    raise error(absent)


def check_target(path: str | Path) -> Path:
    """Check that a file can be written, before the work whose result it will hold.

    Args:
        path: The file. Links are followed.

    Returns:
        The path without links.

    Raises:
        URError: Its folder does not exist or cannot be written to, or it is no regular file.
    """
    try:
        target = Path(path).resolve()
        folder, other = target.parent.is_dir(), target.exists() and not target.is_file()
    except (OSError, RuntimeError) as error:  # RuntimeError: links that point to each other
        raise URError(f"cannot write {path}: {error}") from error
    if not folder:
        raise URError(f"cannot write {path}: the folder {target.parent} does not exist: make it first")
    if other:
        raise URError(f"cannot write {path}: it exists and is no regular file")
    if not os.access(target.parent, os.W_OK):
        raise URError(f"cannot write {path}: the folder {target.parent} cannot be written to")
    return target


def write_text(path: str | Path, text: str) -> None:
    """Write a text file in UTF-8 atomically: readers see either the old or the new content.

    Raises:
        URError: The file cannot be written. An old file is unchanged.
    """
    target = check_target(path)
    # In the same folder: a file can be renamed within one file system only.
    # A process id is not unique: another container may share the folder.
    part = target.with_name(f".{target.name[:100]}.{secrets.token_hex(8)}.part")
    try:
        file = part.open("x", encoding="utf-8", newline="")
    except OSError as error:
        raise URError(f"cannot write {path}: {error}") from error
    try:
        with file:
            file.write(text)
            file.flush()
            os.fsync(file.fileno())
        if target.exists():
            part.chmod(stat.S_IMODE(target.stat().st_mode))  # permissions stay
        part.replace(target)
    except OSError as error:
        raise URError(f"cannot write {path}: {error}") from error
    finally:
        part.unlink(missing_ok=True)


def sync_folder(folder: Path) -> None:
    """Make new names in a folder survive a power cut.

    Raises:
        OSError: The disk reports an error.
    """
    number = os.open(folder, os.O_RDONLY | os.O_DIRECTORY | os.O_CLOEXEC)
    try:
        os.fsync(number)
    finally:
        os.close(number)
