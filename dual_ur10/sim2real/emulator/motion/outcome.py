"""How a motion ends: its handle, and the reasons for which a controller stops protectively."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

# Codes and meanings: the error codes of UR's service manual.
JOINT_LIMIT: Final = "C150A0"  # position close to joint limits
SINGULARITY: Final = "C154A0"  # position in singularity
SUDDEN_CHANGE: Final = "C204A1"  # path sanity check: sudden change in target position
SUDDEN_STOP: Final = "C204A3"  # path sanity check: sudden stop
INVALID_SETPOINT: Final = "C204A5"  # path sanity check: the program resulted in an invalid setpoint


@dataclass(frozen=True)
class MotionFault:
    """Why a UR controller would stop protectively.

    Attributes:
        code: UR's error code.
        text: What was found, what is allowed.
    """

    code: str
    text: str


class Handle:
    """What a program waits for.

    Attributes:
        done: Whether the function that moves the arm returns now: the motion has ended, its blend has begun, or its
            time is over.
        aborted: Whether the motion was cut short by a fault, a stop or another motion. Then it is done, too.
    """

    __slots__ = ("aborted", "done")

    def __init__(self) -> None:
        self.done = self.aborted = False

    def abort(self) -> None:
        """The motion ends before it was done."""
        if not self.done:
            self.done = self.aborted = True
