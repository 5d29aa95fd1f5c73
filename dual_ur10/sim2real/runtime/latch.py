"""What outlives a program: that arms were stopped and nobody has looked yet, and who moves them now."""

from __future__ import annotations

import contextlib
import fcntl
import json
import os
import time
from dataclasses import dataclass
from pathlib import Path
from typing import IO, Final

from dual_ur10.errors import CellBusyError, CellFaulted, SettingsError
from dual_ur10.kinematics.ur10 import ARMS
from dual_ur10.sim2real.config.cell_file import CellFile

_MOST_BYTES: Final = 64 * 1024


def state_folder() -> Path:
    """Where faults and locks are kept, for this user alone: in `$XDG_STATE_HOME`, or `~/.local/state`.

    Raises:
        SettingsError: It cannot be made, or belongs to somebody else.
    """
    home = os.environ.get("XDG_STATE_HOME", "")
    path = (Path(home) if os.path.isabs(home) else Path.home() / ".local" / "state") / "dual_ur10"
    try:
        path.mkdir(mode=0o700, parents=True, exist_ok=True)
        if path.stat().st_uid != os.getuid():
            raise SettingsError(f"{path} belongs to another user: faults and locks of cells are kept there. Remove it")
        path.chmod(0o700)
    except OSError as error:
        raise SettingsError(f"cannot keep faults and locks of cells in {path}: {error}. Set XDG_STATE_HOME") from error
    return path


def _keys(cell: CellFile) -> list[str]:
    """A name for each controller. One that is emulated is another one after each start."""
    process = "" if cell.emulator is None or cell.emulator.pid is None else f"-{cell.emulator.pid}"
    return [f"{arm.host}{process}" for arm in cell.arms]


def _read(path: Path) -> bytes:
    """A small file. A link is none: what it says could be lost with what it points to."""
    handle = os.open(path, os.O_RDONLY | os.O_NOFOLLOW | os.O_NONBLOCK | os.O_CLOEXEC)
    with os.fdopen(handle, "rb") as file:
        return file.read(_MOST_BYTES)


@dataclass(frozen=True)
class Fault:
    """Why arms were stopped.

    Attributes:
        text: The reason.
        when_utc: When it was noted.
        arm: Whose controller's note this is: "left" or "right".
    """

    text: str
    when_utc: str
    arm: str


class Latch:
    """The faults of a cell's controllers, kept in files until a person clears them.

    Args:
        cell: The cell.
    """

    def __init__(self, cell: CellFile) -> None:
        self._cell = cell
        folder = state_folder()
        self._paths = [folder / f"fault-{key}.json" for key in _keys(cell)]

    def set(self, text: str) -> None:
        """Both arms were stopped. A fault that is there already stays."""
        for path in self._paths:
            note = json.dumps({"text": text, "when_utc": time.strftime("%Y-%m-%d %H:%M:%S", time.gmtime())})
            with contextlib.suppress(FileExistsError):
                handle = os.open(path, os.O_WRONLY | os.O_CREAT | os.O_EXCL | os.O_NOFOLLOW, 0o600)
                with os.fdopen(handle, "w") as file:
                    file.write(note + "\n")

    def read(self) -> Fault | None:
        """A fault that nobody has cleared; None: there is none. One that cannot be read is one."""
        for arm, path in zip(ARMS, self._paths, strict=True):
            try:
                values = json.loads(_read(path))
                return Fault(str(values["text"]), str(values["when_utc"]), arm)
            except FileNotFoundError:
                continue
            except (OSError, ValueError, KeyError, TypeError, RecursionError) as error:
                return Fault(f"{path} cannot be read ({error})", "", arm)
        return None

    def check(self) -> None:
        """Refuse a cell with a fault.

        Raises:
            CellFaulted: There is one.
        """
        fault = self.read()
        if fault is not None:
            raise CellFaulted(
                f"the arms were stopped at {fault.when_utc} UTC: {fault.text}. Look at both arms, put right what is "
                f"wrong, then say `python -m dual_ur10 cell clear {self._cell.source}`"
            )

    def clear(self) -> None:
        """A person has looked.

        Raises:
            CellBusyError: A program moves the arms.
        """
        lock = CellLock(self._cell)
        for path in self._paths:
            path.unlink(missing_ok=True)
        lock.release()


class CellLock:
    """Sees to it that one program at a time moves an arm. It ends with the program, however that ends.

    Args:
        cell: The cell whose arms are locked.

    Attributes:
        left_moving: Whether the program that held it before moved the arms, and has not said that it stopped them.

    Raises:
        CellBusyError: Another program holds one of them.
        SettingsError: A lock cannot be kept.
    """

    def __init__(self, cell: CellFile) -> None:
        self._files: list[IO[str]] = []
        self._keys = _keys(cell)
        self._pid = os.getpid()
        self.left_moving = False
        folder = state_folder()
        try:
            for arm, entry in zip(ARMS, cell.arms, strict=True):
                self._lock(folder / f"lock-{entry.host}", arm, entry.host)
        except BaseException:
            self.release(in_order=False)
            raise

    def _lock(self, path: Path, arm: str, host: str) -> None:
        try:
            handle = os.open(path, os.O_RDWR | os.O_CREAT | os.O_NOFOLLOW | os.O_CLOEXEC, 0o600)
        except OSError as error:
            raise SettingsError(f"cannot keep a lock in {path}: {error}. Remove it") from error
        file = os.fdopen(handle, "r+")
        try:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            holder = (file.read(256).split() or ["unknown"])[0]
            file.close()
            if holder == str(os.getpid()):
                raise CellBusyError(
                    f"the {arm} arm at {host} is moved by this program already: close the environment that does "
                    "(`env.close()`), then make another"
                ) from None
            raise CellBusyError(
                f"the {arm} arm at {host} is moved by another program (process {holder}): end that first"
            ) from None
        key = self._keys[len(self._files)]
        moving = file.read(512).split()[1:] == ["moving", key]
        self.left_moving |= moving
        self._files.append(file)
        # What is said there stays until it is noted as a fault, or until a person has looked.
        _write(file, f"{os.getpid()} moving {key}\n" if moving else f"{os.getpid()}\n")

    def note_moving(self) -> None:
        """The arms are moved from now on: if the program ends without a word, the next one is told.

        Raises:
            SettingsError: It cannot be noted.
        """
        for file, key in zip(self._files, self._keys, strict=True):
            try:
                _write(file, f"{os.getpid()} moving {key}\n")
            except OSError as error:
                raise SettingsError(
                    f"cannot note in {state_folder()} that arms move: {error}. Make room there"
                ) from error

    def release(self, *, in_order: bool = True) -> None:
        """Let others in. May be called twice.

        Args:
            in_order: Nothing moves any more, or what did is noted as a fault. Else what was said of that stays.
        """
        files, self._files = self._files, []
        for file in files:
            with contextlib.suppress(OSError):
                if os.getpid() == self._pid:
                    try:
                        if in_order:
                            _write(file, f"{self._pid}\n")
                    finally:
                        fcntl.flock(file, fcntl.LOCK_UN)  # a process that was forked meanwhile has the file open, too
            with contextlib.suppress(OSError):
                file.close()


def _write(file: IO[str], text: str) -> None:
    file.seek(0)
    file.truncate()
    file.write(text)
    file.flush()
