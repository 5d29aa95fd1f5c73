"""What one emulated controller was sent that moves its arm: counted from its start, whoever sent it."""

from __future__ import annotations

from collections import deque
from collections.abc import Sequence
from typing import Any, Final, NamedTuple

from dual_ur10.sim2real.emulator.registers import Registers

_MOST: Final = 50_000  # packages that are kept

COMMAND_REGISTERS: Final = {"input_int_register_0": 0, "input_int_register_24": 24}
"""Where `ur_rtde` writes what its control script is to do; the second one with its upper range of registers. What
belongs to it is in the double registers from the same number on."""

MOTION_COMMANDS: Final = frozenset((1, 2, 3, 4, 6, 9, 10, 11, 12, 18, 24, 31, 41, 45, 51, 52, 66))
"""Commands of `ur_rtde` 1.6.5 that move an arm, let it be moved, or stop it hard: moveJ and moveL, force mode, speedJ,
speedL, servoJ, servoL, servoC, teach mode, a protective stop, jogging, paths, contact, freedrive, torque. Others read,
set, end a motion, or only show that somebody is there (0)."""


class MotionPackage(NamedTuple):
    """One package with such a command.

    Attributes:
        tick: Control periods that had begun when it came: it can take effect in the next one.
        command: Of `MOTION_COMMANDS`.
        numbers: The first six double registers: the target, where there is one.
    """

    tick: int
    command: int
    numbers: tuple[float, ...]


class Received:
    """What came for one controller.

    Attributes:
        motion: The last packages that carry a motion command, oldest first.
        motion_count: How many there were.
        uploads: Programs that came on the ports 30001, 30002 and 30003, whether they were refused or run.
        upload_tick: When the last one came; None: there was none.
        watchdog: What the last watchdog was set to: tick, Hz, action; None: there was none.
        ended_tick: Control period in which a program ended last; None: none has.
        stop_tick: Control period in which the last stop that was injected took effect, or None.
    """

    def __init__(self, registers: Registers) -> None:
        self._registers = registers
        self.motion: deque[MotionPackage] = deque(maxlen=_MOST)
        self.motion_count = 0
        self.uploads = 0
        self.upload_tick: int | None = None
        self.watchdog: tuple[int, float, str] | None = None
        self.ended_tick: int | None = None
        self.stop_tick: int | None = None

    def package(self, names: Sequence[str], tick: int) -> None:
        """An RTDE client has written these inputs.

        Args:
            names: RTDE's.
            tick: Control periods that have begun.
        """
        for name, first in COMMAND_REGISTERS.items():
            if name in names:
                command = self._registers.input_int[first]
                if command in MOTION_COMMANDS:
                    self.motion_count += 1
                    numbers = self._registers.input_double[first : first + 6]
                    self.motion.append(MotionPackage(tick, command, tuple(numbers)))

    def upload(self, tick: int) -> None:
        """A program has come."""
        self.uploads, self.upload_tick = self.uploads + 1, tick

    def counts(self) -> dict[str, Any]:
        """All that is counted."""
        return {
            "motion": self.motion_count,
            "motion_tick": self.motion[-1].tick if self.motion else None,
            "uploads": self.uploads,
            "upload_tick": self.upload_tick,
            "watchdog": self.watchdog,
            "ended_tick": self.ended_tick,
            "stop_tick": self.stop_tick,
        }
