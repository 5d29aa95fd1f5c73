r"""Emulated Robotiq gripper with its URCap's server on port 63352: text commands for the registers of the gripper.

    SET ACT 1 GTO 1 POS 255 SPE 255 FOR 100  ->  ack
    GET POS                                  ->  POS 3

Registers and their meaning: Robotiq's manual of the 2F-85; their names on this port: Robotiq's URCap. "Assumption"
marks behaviour that neither specifies.
"""

from __future__ import annotations

import math
from typing import Final

from ur_core.tools.robotiq_2f85 import ROBOTIQ_2F85
from ur_core.tools.tool import Tool
from ur_emulator.addresses import PORTS

ACTIVATION_S: Final = 1.0
"""Shortest activation. Assumption: the real gripper opens and closes fully, this one only opens."""

STALL_S: Final = 0.15
"""Fingers that press without progress for this long are blocked. Assumption."""

PROGRESS_M: Final = 0.0003
"""Smallest progress: one step of POS."""

REACHED_M: Final = 0.001
"""Tolerance of the requested width: three steps of POS."""

LATENCY_S: Final = 0.1
"""Time from a command to the first motion of the fingers, as in the simulated gripper."""

LAG_S: Final = 0.02
"""Lead of the reference over moving fingers, as a time: more than the servo's own lag."""

_FLAGS: Final = ("ACT", "GTO", "ATR", "ARD")
_BYTES: Final = ("POS", "SPE", "FOR", "SID")  # SID selects one of several grippers; it is stored but unused
_NOT_UNDERSTOOD: Final = "?"

# Object status.
MOVING, STOPPED_OPENING, STOPPED_CLOSING, AT_POSITION = range(4)

# Fault status.
NO_FAULT, ACTIVATION_UNDER_WAY, NOT_ACTIVATED, RELEASING, RELEASED = 0, 5, 7, 11, 15


class RobotiqGripper:
    """One gripper.

    Args:
        tool: Its figures: the width at POS 0, 0 at POS 255; speeds of SPE, forces of FOR; and the stiffness of the
            position servo behind `tick`, which converts a grip force to a difference of commanded and measured width.
        latency_s: Latency of that servo.
        port: TCP port of its server.

    Attributes:
        powered: Whether the tool has power. Without it every answer is "?", and the gripper needs a new activation
            afterwards.
    """

    def __init__(
        self, tool: Tool = ROBOTIQ_2F85, *, latency_s: float = LATENCY_S, port: int = PORTS["gripper"]
    ) -> None:
        self.tool, self.latency_s = tool, latency_s
        self.port: int | None = port
        self.stroke_m, self.stiffness_n_m = tool.stroke_m, tool.servo_kp
        self.powered = True
        self._set = {"ACT": 0, "GTO": 0, "ATR": 0, "ARD": 0, "POS": 0, "SPE": 255, "FOR": 255, "SID": 9}
        self._activating_s: float | None = None  # duration of the present activation
        self._active = False
        self._object = MOVING
        self._fault = NO_FAULT
        self._measured_m: float | None = None
        self._reference_m = tool.stroke_m
        self._standing_s = 0.0
        self._left_m = math.inf  # distance left at the last progress
        self._stopped_at_m: float | None = None  # width at which an object stopped the fingers

    @property
    def force_n(self) -> float:
        """Grip force requested by FOR."""
        least, most = self.tool.force_n
        return least + (most - least) * self._set["FOR"] / 255

    @property
    def speed_m_s(self) -> float:
        """Speed of the width requested by SPE."""
        least, most = self.tool.speed_m_s
        return least + (most - least) * self._set["SPE"] / 255

    @property
    def requested_m(self) -> float:
        """Width requested by POS."""
        return self.stroke_m * (1 - self._set["POS"] / 255)

    def answer(self, line: str) -> str:
        r"""Answer one line. "ack" ends without a newline, all other answers with one.

        Clients compare three bytes with "ack"; several answers to GET arrive in one read and are split at `\n`. No
        input raises.
        """
        verb, *words = line.split() or [""]
        if verb == "GET" and len(words) == 1:
            value = self._get(words[0]) if self.powered else None
            return f"{words[0]} {_NOT_UNDERSTOOD if value is None else value}\n"
        if verb == "SET" and words and len(words) % 2 == 0 and self.powered:
            wanted = [(name, _value(name, text)) for name, text in zip(words[::2], words[1::2], strict=True)]
            if all(value is not None for _, value in wanted):
                self._write({name: value for name, value in wanted if value is not None})
                return "ack"
        return f"{_NOT_UNDERSTOOD}\n"

    def tick(self, dt_s: float, width_m: float) -> float:
        """Advance by `dt_s`.

        Args:
            dt_s: Time step, above 0.
            width_m: Measured gripper width.

        Returns:
            Width to command to the servo, m.
        """
        if self._measured_m is None:
            self._reference_m = min(max(width_m, 0.0), self.stroke_m)
        self._measured_m = width_m
        if not self.powered:
            self._reset()
            return self._reference_m  # a worm gear holds
        goal_m, rate_m_s = self._goal()
        if goal_m is not None:
            self._go(goal_m, rate_m_s, dt_s, width_m)
        if self._activating_s is not None:
            self._activating_s += dt_s
            if self._activating_s >= ACTIVATION_S and self._object != MOVING:
                self._activating_s, self._active = None, True
                self._fault = NO_FAULT if self._fault == ACTIVATION_UNDER_WAY else self._fault
                if self._set["GTO"]:
                    self._start()
        if self._fault == RELEASING and self._object != MOVING:
            self._fault = RELEASED
        return self._reference_m

    def _goal(self) -> tuple[float | None, float]:
        """Return the target width, if any, and the speed."""
        if self._fault in (RELEASING, RELEASED):
            return (self.stroke_m if self._set["ARD"] else 0.0), self.tool.speed_m_s[0]
        if self._activating_s is not None:
            return self.stroke_m, self.tool.speed_m_s[1]
        if self._active and self._set["GTO"]:
            return self.requested_m, self.speed_m_s
        return None, 0.0

    def _go(self, goal_m: float, rate_m_s: float, dt_s: float, measured_m: float) -> None:
        """Move the reference, and detect blocked fingers."""
        if self._stopped_at_m is not None:
            passed_m = measured_m - self._stopped_at_m
            if (passed_m if self._object == STOPPED_OPENING else -passed_m) > REACHED_M:
                self._start()  # the obstacle is gone
        press_m = self.force_n / self.stiffness_n_m
        ahead_m = press_m + ((LAG_S + self.latency_s) * rate_m_s if self._stopped_at_m is None else 0.0)
        reference_m = approached(self._reference_m, goal_m, rate_m_s * dt_s, measured_m, ahead_m)
        self._reference_m = min(max(reference_m, 0.0), self.stroke_m)
        if self._object != MOVING:
            return
        left_m = abs(goal_m - measured_m)
        if left_m <= REACHED_M:
            self._object = AT_POSITION
            return
        presses = abs(self._reference_m - measured_m) >= 0.9 * min(press_m, left_m)
        if left_m < self._left_m - PROGRESS_M or not presses:
            self._left_m, self._standing_s = left_m, 0.0
            return
        self._standing_s += dt_s
        if self._standing_s >= STALL_S + self.latency_s:
            self._object = STOPPED_CLOSING if goal_m < measured_m else STOPPED_OPENING
            self._stopped_at_m = measured_m

    def _get(self, name: str) -> int | None:
        if name == "POS":
            measured_m = self._reference_m if self._measured_m is None else self._measured_m
            return min(max(round(255 * (1 - measured_m / self.stroke_m)), 0), 255)
        if name == "PRE":
            return self._set["POS"]
        if name == "STA":
            return 3 if self._active else 1 if self._activating_s is not None else 0
        if name == "OBJ":
            return self._object
        if name == "FLT":
            return self._fault
        return self._set.get(name)

    def _write(self, wanted: dict[str, int]) -> None:
        before = dict(self._set)
        self._set.update(wanted)
        if not self._set["ACT"]:
            if before["ACT"]:
                self._reset()
            if wanted.get("GTO"):
                self._fault = NOT_ACTIVATED
                self._set["GTO"] = 0
            return
        if not before["ACT"]:
            self._fault, self._activating_s = NO_FAULT, 0.0
            self._start()
        if self._set["ATR"] and self._fault not in (RELEASING, RELEASED):
            self._fault, self._activating_s = RELEASING, None
            self._start()
        if self._activating_s is not None and wanted.get("GTO") and before["ACT"]:
            self._fault = ACTIVATION_UNDER_WAY
        moves = ("POS" in wanted and wanted["POS"] != before["POS"]) or self._set["GTO"] != before["GTO"]
        if self._active and moves:
            self._start()

    def _start(self) -> None:
        """Begin a motion, with unknown object status."""
        self._object, self._standing_s, self._left_m, self._stopped_at_m = MOVING, 0.0, math.inf, None

    def _reset(self) -> None:
        """Lose the activation. The fingers stay in place."""
        self._set.update(ACT=0, GTO=0, ATR=0, POS=0)
        self._active, self._activating_s, self._fault = False, None, NO_FAULT
        self._start()


def approached(reference_m: float, goal_m: float, step_m: float, measured_m: float, ahead_m: float) -> float:
    """Return a reference a step nearer to its goal, and at most so far ahead of the measured width."""
    nearer_m = reference_m + min(max(goal_m - reference_m, -step_m), step_m)
    return min(max(nearer_m, measured_m - ahead_m), measured_m + ahead_m)


def _value(name: str, text: str) -> int | None:
    """Parse the value of a writable register; None if there is no such register or the value is out of range."""
    highest = 1 if name in _FLAGS else 255 if name in _BYTES else -1
    if not (text.isascii() and text.isdigit() and len(text) <= 3):
        return None
    return int(text) if int(text) <= highest else None
