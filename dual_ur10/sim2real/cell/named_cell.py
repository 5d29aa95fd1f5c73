"""Cells and their configurations by name. The reader of cell files loads only for the path of one."""

from __future__ import annotations

import os
from typing import Final

from dual_ur10.errors import UnknownNameError
from dual_ur10.ids import discover
from dual_ur10.sim2real.cell.cell import Cell, CellRequest
from dual_ur10.sim2real.cell.cell_config import CellConfig, HostedCell
from dual_ur10.sim2real.cell.cell_kinds import CELL_KINDS, cell_kind
from ur_core.objects import load_object

READER: Final = "dual_ur10.sim2real.cell_file.cell_file:load_cell_file"
"""Reader of cell files, "module:function"."""


def resolve_cell(cell: object) -> CellConfig:
    """Return the configuration that the keyword `cell` of an environment stands for.

    Args:
        cell: "mujoco", "echo" or another kind without a cell file, a `CellConfig`, the path of a cell file, or a
            `HostedCell`.

    Raises:
        UnknownNameError: None of them.
        CellFileError: The cell file cannot be read or is not legal.
    """
    if isinstance(cell, CellConfig):
        return cell
    if isinstance(cell, HostedCell):
        return cell.config()
    if isinstance(cell, os.PathLike) or (isinstance(cell, str) and ("/" in cell or cell.endswith(".toml"))):
        config: CellConfig = load_object(READER, "the reader of cell files", registered=True)(os.fspath(cell)).config()
        return config
    if isinstance(cell, str) and cell not in CELL_KINDS:
        discover()
    without_file = [name for name, kind in CELL_KINDS.items() if not kind.file]
    if not isinstance(cell, str) or cell not in without_file:
        other = "the path of a cell file, such as lab.toml, a CellConfig, or a dual_ur10.testing.VirtualCell"
        raise UnknownNameError("cell", str(cell), without_file, other)
    return CellConfig(kind=cell)


def make_cell(request: CellRequest) -> Cell:
    """Make the cell of a request.

    Raises:
        SettingsError: Its kind cannot serve the request, or its factory cannot be imported.
        DualUR10Error: It cannot be made; see its class.
    """
    name = request.config.kind
    factory = load_object(cell_kind(name).factory, f"the factory of the cell {name!r}", registered=True)
    cell: Cell = factory(request)
    return cell
