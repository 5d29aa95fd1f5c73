"""Last commanded positions of arms without encoders, kept in a file that outlives the program."""

from __future__ import annotations

import json
import math
from typing import Any, Final, NamedTuple

from dual_ur10.errors import DualUR10Error, SettingsError
from dual_ur10.files import write_text
from dual_ur10.sim2real.processes.system import System

_MOST_BYTES: Final = 64 * 1024


class Commanded(NamedTuple):
    """Content of the file.

    Attributes:
        q_rad: Commanded joint positions, (6,) of each arm: at the end of the last motion, or at the beginning of one
            that has not ended.
        settled: True if that motion has ended.
        boot: Number of the device's start, then.
    """

    q_rad: tuple[tuple[float, ...], ...]
    settled: bool
    boot: int


class CommandedPositions:
    """File of one device in the user's state folder. It is replaced as a whole, and never deleted.

    Args:
        device: Number of the device.
        arms: Number of its arms.
        system: State folder and date.

    Attributes:
        path: The file.

    Raises:
        SettingsError: There is no state folder.
    """

    def __init__(self, device: int, arms: int, system: System) -> None:
        self._arms, self._system = arms, system
        self.path = system.state_folder() / f"serial-arm-{device:08x}.json"

    def read(self) -> Commanded | None:
        """Return the content, or None if nothing was ever commanded.

        Raises:
            SettingsError: It cannot be read. It stays as it is.
        """
        try:
            with self.path.open("rb") as file:
                values = json.loads(file.read(_MOST_BYTES))
            found = Commanded(tuple(_six(row) for row in values["q_rad"]), values["settled"], values["boot"])
            if len(found.q_rad) != self._arms or type(found.settled) is not bool or type(found.boot) is not int:
                raise ValueError(f"it is not that of {self._arms} arm(s)")
            return found
        except FileNotFoundError:
            return None
        except (OSError, ValueError, KeyError, TypeError, RecursionError) as error:
            raise SettingsError(
                f"{self.path}, the last commanded position of this arm, cannot be read ({error}): look where the arm "
                "stands, move the file away, and declare the position"
            ) from error

    def write(self, commanded: Commanded) -> None:
        """Replace the content.

        Raises:
            DualUR10Error: It cannot be written. The old content stays.
        """
        values = {**commanded._asdict(), "when_utc": f"{self._system.clock.utc():%Y-%m-%d %H:%M:%S}"}
        try:
            write_text(self.path, json.dumps(values) + "\n")
        except DualUR10Error as error:
            raise DualUR10Error(f"{error}: nothing moves while the position cannot be kept. Make room there") from error


def _six(row: Any) -> tuple[float, ...]:
    numbers = tuple(float(each) for each in row)
    if len(numbers) != 6 or not all(map(math.isfinite, numbers)):
        raise ValueError("a row is not six numbers")
    return numbers
