"""CSV file of taught points, in the format of `files`, written row by row."""

from __future__ import annotations

import contextlib
import os
from collections.abc import Sequence
from pathlib import Path
from typing import Final

import numpy as np

from dual_ur10.errors import TrajectoryError
from ur_core.files import check_target
from ur_core.kinematics.ur10 import JOINTS
from ur_core.types import Array, Closing

_SUFFIX: Final = ".csv"


class TaughtFile(Closing):
    """New file to which points are appended. Each is on the disk when `add` returns.

    A file that got no point is removed again.

    Args:
        path: The file; its suffix is .csv.
        arms: Arms of the points.
        at_rest: Write speeds of 0, so that a trajectory rests at each point. Without, it passes them.

    Attributes:
        path: The file.
        count: Number of points.

    Raises:
        TrajectoryError: The suffix is another, or the file exists or cannot be written.
        DualUR10Error: Its folder does not exist, or cannot be written to.
    """

    def __init__(self, path: str | Path, arms: Sequence[str], *, at_rest: bool) -> None:
        self.path, self.count = Path(path), 0
        if self.path.suffix.lower() != _SUFFIX:
            raise TrajectoryError(f"cannot write {path}: the suffix must be {_SUFFIX}")
        names = [f"{arm}/{joint}" for arm in arms for joint in JOINTS]
        speeds = [f"{name}.speed" for name in names] if at_rest else []
        self._zeros = ["0.0"] * len(speeds)
        self._header = ",".join(["time_s", *names, *speeds])
        self._target = check_target(path)
        try:
            self._file = self._target.open("xb", buffering=0)
        except FileExistsError:
            raise TrajectoryError(f"{path} exists: choose another name, or remove it") from None
        except OSError as error:
            raise TrajectoryError(f"cannot write {path}: {error}") from error

    def add(self, time_s: float, q_rad: Array) -> None:
        """Append a point.

        Args:
            time_s: Its time, above that of the point before.
            q_rad: (arms, 6) joint positions.

        Raises:
            TrajectoryError: It cannot be written. Those before it stay.
        """
        row = ",".join([*map(repr, [time_s, *np.asarray(q_rad, dtype=np.float64).ravel().tolist()]), *self._zeros])
        data = f"{row}\n".encode() if self.count else f"{self._header}\n{row}\n".encode()
        before = self._file.tell()
        try:
            if self._file.write(data) != len(data):
                raise OSError("there is no room for a row")
            os.fsync(self._file.fileno())
        except OSError as error:
            with contextlib.suppress(OSError):
                self._file.truncate(before)
                self._file.seek(before)
            raise TrajectoryError(
                f"cannot write {self.path}: {error}. It holds the {self.count} points before: make room, and teach the "
                "rest into another file"
            ) from error
        self.count += 1

    def close(self) -> None:
        """Close the file. May be called twice."""
        if not self._file.closed and not self.count:
            self._target.unlink(missing_ok=True)
        self._file.close()
