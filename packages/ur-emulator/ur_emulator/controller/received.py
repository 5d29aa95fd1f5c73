"""Record of the motion commands that one emulated controller received, from any client since its start."""

from __future__ import annotations

from collections import deque
from collections.abc import Collection
from typing import Any, Final

from ur_emulator.controller.registers import Registers

_MOST: Final = 50_000  # kept packages

COMMAND_REGISTERS: Final = {"input_int_register_0": 0, "input_int_register_24": 24}
"""Registers in which `ur_rtde` writes the command for its control script; the second with its upper range of registers.
Arguments are in the double registers from the same number on.
"""

MOTION_COMMANDS: Final = frozenset((1, 2, 3, 4, 6, 9, 10, 11, 12, 18, 24, 31, 41, 45, 51, 52, 66))
"""Commands of `ur_rtde` 1.6.5 that move an arm, release it, or stop it hard: moveJ and moveL, force mode, speedJ,
speedL, servoJ, servoL, servoC, teach mode, a protective stop, jogging, paths, contact, freedrive, torque. Others read,
set, end a motion, or keep the connection alive (0).
"""


MotionPackage = tuple[int, int, tuple[float, ...]]
"""One package with a motion command: control periods begun at its arrival, the command, and the first six double
registers, the target if the command has one. It can take effect in the next control period.

A plain tuple of numbers, since the garbage collector visits each kept named tuple in every collection.
"""


class Received:
    """Record of one controller.

    Attributes:
        motion: Last packages with a motion command, oldest first.
        motion_count: Number of all of them.
        uploads: Programs received on the ports 30001, 30002 and 30003, refused ones too.
        program: Text of the last one.
        upload_tick: Control period of the last one, or None.
        watchdog: Last watchdog setting: tick, Hz, action; or None.
        ended_tick: Control period in which a program last ended, or None.
        stop_tick: Control period in which the last injected stop took effect, or None.
    """

    def __init__(self, registers: Registers) -> None:
        self._registers = registers
        self.motion: deque[MotionPackage] = deque(maxlen=_MOST)
        self.motion_count = 0
        self.uploads = 0
        self.program = ""
        self.upload_tick: int | None = None
        self.watchdog: tuple[int, float, str] | None = None
        self.ended_tick: int | None = None
        self.stop_tick: int | None = None

    def package(self, names: Collection[str], tick: int) -> None:
        """Record the inputs written by an RTDE client.

        Args:
            names: RTDE names.
            tick: Control periods begun.
        """
        for name, first in COMMAND_REGISTERS.items():
            if name in names:
                command = self._registers.input_int[first]
                if command in MOTION_COMMANDS:
                    self.motion_count += 1
                    numbers = self._registers.input_double[first : first + 6]
                    self.motion.append((tick, command, tuple(numbers)))

    def upload(self, tick: int, text: str) -> None:
        """Record a received program."""
        self.uploads, self.upload_tick, self.program = self.uploads + 1, tick, text

    def counts(self) -> dict[str, Any]:
        """Return all counts."""
        return {
            "motion": self.motion_count,
            "motion_tick": self.motion[-1][0] if self.motion else None,
            "uploads": self.uploads,
            "upload_tick": self.upload_tick,
            "watchdog": self.watchdog,
            "ended_tick": self.ended_tick,
            "stop_tick": self.stop_tick,
        }
