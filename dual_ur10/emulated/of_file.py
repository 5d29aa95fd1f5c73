"""Emulated controllers in place of the two of a cell file, for `ur-emulator --cell`."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from dual_ur10.emulated.cell_emulator import CellEmulator, CellOptions
from dual_ur10.errors import SettingsError
from dual_ur10.sim2real.cell_file.cell_file import load_cell_file


def of_cell(path: Path, hosts: Sequence[str], seed: int, options: dict[str, Any]) -> CellEmulator:
    """Return emulated controllers in place of the two of a real cell: models, mounts, grippers and serial numbers.

    Args:
        path: Cell file.
        hosts: Address of each.
        seed: Seed of the plant and of a task's start.
        options: Other options, see `CellOptions`.

    Raises:
        SettingsError: Or one of its kinds: the file cannot be read, or is that of an emulated cell.
    """
    file = load_cell_file(path)
    if file.kind != "real":
        raise SettingsError(
            f"{path} is the file of an emulated cell, and holds for the process that wrote it: "
            "`dual-ur10 emulate --cell` starts such a cell and writes its file"
        )
    left, right = hosts
    chosen = CellOptions(left=left, right=right, task=file.task, seed=seed, **options)
    emulator = CellEmulator(chosen, config=file.simulated(), grippers=[arm.gripper for arm in file.arms])
    for server, arm in zip(emulator.servers, file.arms, strict=True):
        if arm.serial_number is not None:
            server.pretend(dataclasses.replace(server.shown, serial_number=arm.serial_number), server.kinematics)
    return emulator
