"""Emulated grippers: their interface, one at a digital output, and which one an entry of a cell file stands for."""

from __future__ import annotations

from collections.abc import Callable
from typing import Protocol

from pydantic import TypeAdapter, ValidationError

from dual_ur10.errors import SettingsError
from dual_ur10.sim2real.config.cell_file_tables import DigitalGripper, Gripper, NoGripper, OwnGripper
from ur_core.objects import load_object
from ur_core.tools.tool import Tool, tool_named
from ur_emulator.robotiq import LAG_S, LATENCY_S, RobotiqGripper, approached


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
        entry: Output, and the level that opens it.
        outputs: Function that returns the bits of the controller's digital outputs.
    """

    port: int | None = None
    powered = True

    def __init__(self, tool: Tool, entry: DigitalGripper, outputs: Callable[[], int]) -> None:
        self._tool, self._entry, self._outputs = tool, entry, outputs
        self._reference_m: float | None = None

    def answer(self, line: str) -> str:
        """Return nothing: it has no port."""
        return ""

    def tick(self, dt_s: float, width_m: float) -> float:
        """See `EmulatedGripper`. Without power it keeps its hold."""
        tool, before_m = self._tool, width_m if self._reference_m is None else self._reference_m
        if self.powered:
            level = bool(self._outputs() >> self._entry.output & 1)
            goal_m = tool.stroke_m if level == self._entry.open_level else 0.0
            ahead_m = tool.force_n[1] / tool.servo_kp + (LAG_S + LATENCY_S) * tool.speed_m_s[1]
            before_m = approached(before_m, goal_m, tool.speed_m_s[1] * dt_s, width_m, ahead_m)
        self._reference_m = min(max(before_m, 0.0), tool.stroke_m)
        return self._reference_m


def entry_of(name: str, tool: Tool) -> Gripper:
    """Return the entry of a cell file with which an emulated cell has a tool: that of the first of its drivers.

    Args:
        name: Name of the tool in cell files.
        tool: The tool.

    Raises:
        SettingsError: There is no such kind of driver.
    """
    driver = tool.drivers[0]
    own = {"kind": "own", "driver": driver} if ":" in driver else {"kind": driver}
    output = {"output": 0} if driver == "digital_output" else {}
    try:
        entry: Gripper = TypeAdapter(Gripper).validate_python({**own, **output, "tool": name})
    except ValidationError as error:
        raise SettingsError(
            f"the tool {tool.name!r} is driven by {driver!r}, and no cell file has such a gripper: name a kind, or a "
            'driver of your own, "module:Class"'
        ) from error
    return entry


def gripper_of(entry: Gripper, outputs: Callable[[], int]) -> EmulatedGripper | None:
    """Return the emulated gripper of an entry of a cell file; None: nothing drives it, and its fingers stay.

    Args:
        entry: The entry.
        outputs: Function that returns the bits of the controller's digital outputs.

    Raises:
        SettingsError: It has a driver of one's own that names no emulated gripper.
    """
    if isinstance(entry, NoGripper):
        return None
    tool = tool_named(entry.tool)
    if isinstance(entry, DigitalGripper):
        return DigitalOutputGripper(tool, entry, outputs)
    if not isinstance(entry, OwnGripper):
        return RobotiqGripper(tool, port=entry.port)
    emulated = getattr(load_object(entry.driver, "the driver of a gripper"), "emulated", "")
    if not emulated:
        raise SettingsError(
            f"the driver {entry.driver} names no emulated gripper, and this cell is to emulate one: set its attribute "
            '`emulated` to "module:Class", see docs/how-to/own-gripper.md'
        )
    found: EmulatedGripper = load_object(emulated, f"the emulated gripper of {entry.driver}")(tool)
    return found
