"""Emulated grippers: their interface, and one at a digital output."""

from __future__ import annotations

from collections.abc import Callable
from typing import Protocol

from ur_core.tools.tool import Tool
from ur_emulator.ports.robotiq import LAG_S, LATENCY_S, approached


class EmulatedGripper(Protocol):
    """Gripper at the flange of an emulated arm. The class that a driver of one's own names is made with the tool.

    Attributes:
        port: TCP port at the address of the controller where clients send lines; None: there is none.
        powered: Whether the tool has power; set before each `tick`.
    """

    port: int | None
    powered: bool

    def answer(self, line: str) -> str:
        """Return the answer to a line from a client, with its end of line."""
        ...

    def tick(self, dt_s: float, width_m: float) -> float:
        """Advance by `dt_s`. Return the width to command to the servo of the fingers, given the measured one, m."""
        ...


class DigitalOutputGripper:
    """Gripper that an output of the controller opens and closes, with its largest speed and force; it reports nothing.

    Args:
        tool: Its figures.
        output: Number of the output.
        open_level: Level of the output that opens it.
        outputs: Function that returns the bits of the controller's digital outputs.
    """

    port: int | None = None
    powered = True

    def __init__(self, tool: Tool, output: int, open_level: bool, outputs: Callable[[], int]) -> None:
        self._tool, self._output, self._open_level, self._outputs = tool, output, open_level, outputs
        self._reference_m: float | None = None

    def answer(self, line: str) -> str:
        """Return nothing: it has no port."""
        return ""

    def tick(self, dt_s: float, width_m: float) -> float:
        """See `EmulatedGripper`. Without power it keeps its hold."""
        tool, before_m = self._tool, width_m if self._reference_m is None else self._reference_m
        if self.powered:
            level = bool(self._outputs() >> self._output & 1)
            goal_m = tool.stroke_m if level == self._open_level else 0.0
            ahead_m = tool.force_n[1] / tool.servo_kp + (LAG_S + LATENCY_S) * tool.speed_m_s[1]
            before_m = approached(before_m, goal_m, tool.speed_m_s[1] * dt_s, width_m, ahead_m)
        self._reference_m = min(max(before_m, 0.0), tool.stroke_m)
        return self._reference_m
