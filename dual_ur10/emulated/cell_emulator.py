"""Emulated controllers of a cell: the scene of a task behind them, its grippers, and the cell file."""

from __future__ import annotations

import contextlib
import dataclasses
import json
import tomllib
from collections.abc import Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any

from dual_ur10.assets.settings import default_mount
from dual_ur10.emulated.cell_world import CellWorld
from dual_ur10.emulated.grippers import entry_of, gripper_of
from dual_ur10.errors import SettingsError
from dual_ur10.ids import env_id_of
from dual_ur10.sim2real.cell.cell_config import CellConfig
from dual_ur10.sim2real.cell_file.tables import Gripper, NoGripper, read_keywords
from dual_ur10.sim2real.cell_file.text import toml_text
from dual_ur10.sim2real.runtime.latch import clear_ended
from ur_core.files import check_target, write_text
from ur_core.kinematics.robots import robot_model
from ur_core.kinematics.ur10 import ARMS
from ur_core.processes.system import LOCAL, System
from ur_core.servoj import ServojProfile
from ur_emulator.emulator import Emulator, EmulatorOptions, serve_json
from ur_emulator.profile import profile_of, profile_of_version


@dataclasses.dataclass(frozen=True, kw_only=True)
class CellOptions(EmulatorOptions):
    """Options of an emulated cell.

    Attributes:
        left, right: Loopback addresses; None finds free ones.
        family: Family of both controllers; None: that of `robot`.
        robot: Model of both arms, or of the left and the right one; None: a UR10, or a UR10e of the e-Series.
        task: Id or name of the environment whose scene is simulated; None: two arms on a table, of any model.
        settings: Keywords of that task, of values that JSON holds; None: none.
        tools: Tool of both arms, or of the left and the right one, by name or as "module:NAME", driven by the first
            of its `drivers`; None: those of the task.
        cell: Path of the cell file to write, or None.
    """

    left: str | None = None
    right: str | None = None
    family: str | None = None
    robot: str | Sequence[str] | None = None
    task: str | None = None
    settings: Mapping[str, Any] | None = None
    tools: str | Sequence[str] | None = None
    cell: str | None = None


class CellEmulator(Emulator):
    """Both controllers of a cell and their world; see `Emulator`.

    Args:
        options: Options of the cell. The seed is that of the start of a task's episode, too.
        config: Cell of both arms; None: that of the arms that the options name.
        grippers: Entries of a cell file for the grippers of both arms; None: those of the cell's tools.
        system: Clock and network.

    Raises:
        AddressError: An address cannot be used.
        DualUR10Error: An option is invalid, or the cell file cannot be written.
    """

    options: CellOptions

    def __init__(
        self,
        options: CellOptions,
        *,
        config: CellConfig | None = None,
        grippers: Sequence[Gripper] | None = None,
        system: System = LOCAL,
    ) -> None:
        try:
            self._settings = json.dumps(dict(options.settings or {}), allow_nan=False)
        except (TypeError, ValueError) as error:
            raise SettingsError(
                f"settings are {options.settings!r:.200}: they must be keywords by name, of values that JSON holds "
                f"({error}). Name an object of your own as module:NAME"
            ) from error
        nominal = cell_of(options) if config is None else config
        world = CellWorld(nominal, options.task, options, read_keywords(self._settings))
        self._grippers = _grippers_of(options, world, grippers)
        super().__init__(
            options,
            world=world,
            hosts=(options.left, options.right),
            grippers=[partial(gripper_of, entry) for entry in self._grippers],
            system=system,
        )
        if options.cell is not None:
            try:
                write_cell_file(options.cell, self.description())
            except BaseException:
                self.close()
                raise

    def description(self) -> dict[str, Any]:
        """Return the content of the cell file."""
        found = super().description()
        for name, server, entry in zip(self.world.names, self.servers, self._grippers, strict=True):
            if server.gripper is not None:
                found[name]["gripper"] = entry.mapping()
        task = {} if self.options.task is None else {"task": env_id_of(self.options.task)}
        settings = {"settings": self._settings} if self.options.settings else {}
        found["emulator"] = {**task, **settings, **found["emulator"]}
        return found

    def prepare(self) -> None:
        """Clear away the latches of emulated cells that have ended."""
        with contextlib.suppress(SettingsError):  # without a state folder there is nothing to clear away
            clear_ended(self._system)


def cell_of(options: CellOptions) -> CellConfig:
    """Return the cell of the arms that options name.

    Raises:
        UnknownNameError: There is no such model or tool.
        SettingsError: Or one of its kinds: there is no such family or version, or they do not fit.
    """
    family, robots = options.family, _both("robot", options.robot, "ur5e")
    tools: Any = _both("tools", options.tools, "robotiq_2f85")
    if robots is None:
        if family is None and options.polyscope is not None:
            family = profile_of_version(options.polyscope).family
        return CellConfig(servoj=ServojProfile(profile_of(family or "cb3").family), tools=tools)
    for each in robots:
        robot_model(each)
    left, right = (default_mount(arm, robot) for arm, robot in enumerate(robots))
    if family is None:
        return CellConfig(left=left, right=right, tools=tools)
    return CellConfig(left=left, right=right, servoj=ServojProfile(profile_of(family).family), tools=tools)


def _both(name: str, value: str | Sequence[str] | None, example: str) -> Sequence[str] | None:
    """Return an option for both arms; None: it is not given.

    Raises:
        SettingsError: There are not two.
    """
    both = [value] * len(ARMS) if isinstance(value, str) else value
    if both is not None and (not isinstance(both, tuple | list) or len(both) != len(ARMS)):
        raise SettingsError(f"{name} is {value!r}: name one, or one for each arm, such as {example!r}")
    return both


def _grippers_of(options: CellOptions, world: CellWorld, entries: Sequence[Gripper] | None) -> Sequence[Gripper]:
    """Return the entry of a cell file for the gripper of each arm.

    Raises:
        SettingsError: Options name tools, and the scene has no grippers; or nothing drives a tool.
    """
    named = _both("tools", options.tools, "")
    if named is not None and None in world.tools:
        raise SettingsError(
            f"tools is {options.tools!r}, and this scene has no grippers: name a task that has, such as Handover"
        )
    names = [None if tool is None else tool.name for tool in world.tools] if named is None else named
    return [
        NoGripper() if tool is None or name is None else entries[arm] if entries else entry_of(name, tool)
        for arm, (name, tool) in enumerate(zip(names, world.tools, strict=True))
    ]


def write_cell_file(path: str | Path, description: Mapping[str, Any]) -> None:
    """Write a description as TOML.

    Args:
        path: Target file. Only a file of an emulated cell is replaced.
        description: Tables by name, with plain values, or plain values.

    Raises:
        SettingsError: Another file exists there.
        DualUR10Error: The file cannot be written.
    """
    path = check_target(path)
    if path.exists():
        try:
            kind = tomllib.loads(path.read_text()).get("kind")
        except (OSError, ValueError, RecursionError):
            kind = None
        if kind != "emulated":
            raise SettingsError(
                f"{path} exists and is no file of an emulated cell: it was not changed. Name another with --cell"
            )
    write_text(path, toml_text(description))


if __name__ == "__main__":
    serve_json(lambda values: CellEmulator(CellOptions.from_mapping(values)))
