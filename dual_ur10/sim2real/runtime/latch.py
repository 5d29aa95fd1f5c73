"""Files that outlive a program, also a power cut: faults that no person has cleared, and the lock of each arm."""

from __future__ import annotations

import contextlib
import fcntl
import json
import logging
import os
import re
from dataclasses import dataclass
from pathlib import Path
from typing import IO, Final

from dual_ur10.errors import CellBusyError, CellFaulted, SettingsError
from dual_ur10.sim2real.cell_file.cell_file import CellFile
from ur_core.files import sync_folder
from ur_core.kinematics.ur10 import ARMS
from ur_core.processes.system import LOCAL, System

log = logging.getLogger(__name__)

_MOST_BYTES: Final = 64 * 1024
_TRIES: Final = 4  # to take a lock


def _keys(cell: CellFile) -> list[str]:
    """Return a key for each controller. An emulated one gets a new key at each start."""
    process = "" if cell.emulator is None or cell.emulator.pid is None else f"-{cell.emulator.pid}"
    return [f"{arm.host}{process}" for arm in cell.arms]


def _read(path: Path) -> bytes:
    """Return a small file's bytes; a link is refused, as its target could disappear."""
    handle = os.open(path, os.O_RDONLY | os.O_NOFOLLOW | os.O_NONBLOCK | os.O_CLOEXEC)
    with os.fdopen(handle, "rb") as file:
        return file.read(_MOST_BYTES)


_OF_EMULATOR: Final = re.compile(r"fault-127(?:\.\d+){3}-(\d+)\.json|lock-127(?:\.\d+){3}", re.ASCII)
_MOVING: Final = re.compile(rb"\d+ moving 127(?:\.\d+){3}(?:-(\d+))?\n?")


def clear_ended(system: System = LOCAL) -> None:
    """Remove the faults of emulators that have ended, and unused locks of loopback addresses.

    A note of moving arms keeps a lock while the emulator of these arms runs, or if nothing names its process.

    Raises:
        SettingsError: There is no state folder.
    """

    def has_ended(pid: bytes | str | None) -> bool:
        return pid is not None and not system.is_running(int(pid))

    for path in system.state_folder().iterdir():
        found = _OF_EMULATOR.fullmatch(path.name)
        if found is None:
            continue
        with contextlib.suppress(OSError, OverflowError):
            if found[1] is None:
                with open(os.open(path, os.O_RDWR | os.O_NOFOLLOW | os.O_NONBLOCK | os.O_CLOEXEC), "rb") as file:
                    fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
                    noted = _MOVING.fullmatch(content := file.read(512))
                    if has_ended(noted[1]) if noted else b"moving" not in content:
                        path.unlink()
            elif has_ended(found[1]):
                path.unlink()


@dataclass(frozen=True)
class Fault:
    """Reason of a latched stop.

    Attributes:
        text: Reason.
        when_utc: Time of the note.
        arm: Arm whose controller the note belongs to: "left" or "right".
    """

    text: str
    when_utc: str
    arm: str


class Latch:
    """Faults of a cell's controllers, kept in files until a person clears them.

    Args:
        cell: Cell file.
        system: Clock and state folder.
    """

    def __init__(self, cell: CellFile, system: System = LOCAL) -> None:
        self._cell, self._system = cell, system
        self._folder = system.state_folder()
        self._paths = [self._folder / f"fault-{key}.json" for key in _keys(cell)]

    def set(self, text: str) -> None:
        """Note a fault of both arms. An earlier one is kept. Returns once it is on the disk.

        Raises:
            OSError: It cannot be written.
        """
        note = json.dumps({"text": text, "when_utc": f"{self._system.clock.utc():%Y-%m-%d %H:%M:%S}"})
        for path in self._paths:
            with contextlib.suppress(FileExistsError):
                handle = os.open(path, os.O_WRONLY | os.O_CREAT | os.O_EXCL | os.O_NOFOLLOW, 0o600)
                with os.fdopen(handle, "w") as file:
                    _write(file, note + "\n")
        sync_folder(self._folder)

    def read(self) -> Fault | None:
        """Return the fault that nobody has cleared, or None. A note that cannot be read counts as a fault."""
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
                f"the arms were stopped at {fault.when_utc} UTC: {fault.text}. Check both arms, correct the "
                f"cause, then {self._cell.clearing}"
            )

    def clear(self) -> None:
        """Clear the faults, once a person has checked both arms.

        Raises:
            CellBusyError: A program moves the arms.
        """
        lock = CellLock(self._cell, self._system)
        for path in self._paths:
            path.unlink(missing_ok=True)
        lock.release()


class CellLock:
    """Lock that lets one program at a time move an arm. It ends with the program, however that ends.

    Args:
        cell: Cell file of the arms.
        system: State folder.

    Attributes:
        left_moving: True if the previous holder moved the arms and did not note that it stopped them.

    Raises:
        CellBusyError: Another program holds one of them.
        SettingsError: A lock cannot be kept.
    """

    def __init__(self, cell: CellFile, system: System = LOCAL) -> None:
        self._files: list[IO[str]] = []
        self._keys = _keys(cell)
        self._pid = os.getpid()
        self.left_moving = False
        self._folder, self._clock = system.state_folder(), system.clock
        try:
            for arm, entry in zip(ARMS, cell.arms, strict=True):
                self._lock(self._folder / f"lock-{entry.host}", arm, entry.host)
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
            self._take(file)
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
        if os.fstat(file.fileno()).st_nlink == 0:  # `clear_ended` was faster
            file.close()
            self._lock(path, arm, host)
            return
        key = self._keys[len(self._files)]
        moving = file.readline(512).split()[1:] == ["moving", key]  # an interrupted `_write` leaves more lines
        self.left_moving |= moving
        self._files.append(file)
        # The note of moving arms stays until it is latched as a fault or a person clears it.
        _write(file, f"{os.getpid()} moving {key}\n" if moving else f"{os.getpid()}\n")

    def _take(self, file: IO[str]) -> None:
        """Take the lock. `clear_ended` of a starting emulator holds it for a moment."""
        for _ in range(_TRIES):
            with contextlib.suppress(BlockingIOError):
                return fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
            self._clock.sleep(0.01)
        return fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)

    def note_moving(self) -> None:
        """Note on the disk that the arms move from now on, for the next program in case this one is killed.

        Raises:
            SettingsError: The note cannot be written.
        """
        for file, key in zip(self._files, self._keys, strict=True):
            try:
                _write(file, f"{os.getpid()} moving {key}\n")
                sync_folder(self._folder)
            except OSError as error:
                raise SettingsError(
                    f"cannot note in {self._folder} that arms move: {error}. Make room there"
                ) from error

    def release(self, *, in_order: bool = True) -> None:
        """Release the lock. May be called twice.

        Args:
            in_order: The arms have stopped, or the fault is latched. Otherwise the note of moving arms stays.
        """
        files, self._files = self._files, []
        for file in files:
            with contextlib.suppress(OSError):
                if os.getpid() == self._pid:
                    try:
                        if in_order:
                            _write(file, f"{self._pid}\n")
                    finally:
                        fcntl.flock(file, fcntl.LOCK_UN)  # a forked process has the file open, too
            with contextlib.suppress(OSError):
                file.close()


class Claim:
    """Claim of a cell's arms by a program that moves them, from before it connects until they rest.

    Nobody else moves them meanwhile, no latched stop waits for a person, and no end of the program goes unnoticed.

    Args:
        file: Cell file of the arms.
        system: Clock and state folder.

    Attributes:
        latch: Faults of the cell.

    Raises:
        CellFaulted: A latched stop was not cleared, or the previous program left moving arms.
        CellBusyError: Another program moves one of the arms.
        SettingsError: A lock cannot be kept.
        OSError: A fault cannot be latched.
    """

    def __init__(self, file: CellFile, system: System = LOCAL) -> None:
        self.latch = Latch(file, system)
        self.latch.check()
        self._lock = CellLock(file, system)
        self._in_order, self._unlatched = True, ""
        try:
            if self._lock.left_moving:
                self.latch.set("the program that moved the arms before ended without stopping them in order")
            self.latch.check()  # again: the previous holder of the lock may have stopped them meanwhile
        except BaseException:
            self._lock.release(in_order=False)
            raise

    def note_moving(self) -> None:
        """Note on the disk that arms move, until their stop was seen or is latched.

        Raises:
            CellFaulted: A stop could not be latched before.
            SettingsError: The note cannot be written.
        """
        if self._unlatched:
            raise CellFaulted(f"both arms were stopped before, which could not be latched: {self._unlatched}")
        self._lock.note_moving()
        self._in_order = False

    def note_stopped(self, seen: bool = True) -> None:
        """Note whether all arms were seen to have stopped, or not to have begun."""
        self._in_order = seen and not self._unlatched

    def latch_stop(self, reason: str) -> None:
        """Latch a stop of both arms. If that fails, the note of moving arms stays."""
        self._in_order = False
        try:
            self.latch.set(reason)
            self._in_order = True
        except OSError as error:
            self._unlatched = reason
            log.error("both arms were stopped (%s), and the fault cannot be latched: %s", reason, error)

    def release(self) -> None:
        """Let other programs move the arms. May be called twice."""
        self._lock.release(in_order=self._in_order)


def _write(file: IO[str], text: str) -> None:
    """Replace a file's content, on the disk. The old text is cut off last: an interruption keeps its note."""
    file.seek(0)
    file.write(text)
    file.flush()
    file.truncate()
    os.fsync(file.fileno())
