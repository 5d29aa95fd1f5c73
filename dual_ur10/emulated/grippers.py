"""Emulated grippers of a cell: the entry of a cell file for a tool, and the gripper that an entry stands for."""

from __future__ import annotations

from collections.abc import Callable

from pydantic import TypeAdapter, ValidationError

from dual_ur10.errors import SettingsError
from dual_ur10.sim2real.cell_file.tables import DigitalGripper, Gripper, NoGripper, OwnGripper
from ur_core.objects import load_object
from ur_core.tools.tool import Tool, tool_named
from ur_emulator.ports.grippers import DigitalOutputGripper, EmulatedGripper
from ur_emulator.ports.robotiq import RobotiqGripper


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
        return DigitalOutputGripper(tool, entry.output, entry.open_level, outputs)
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
