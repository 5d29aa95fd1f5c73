"""Emulated cells that are ticked by hand, without processes and clocks."""

from __future__ import annotations

from typing import Any

from dual_ur10.emulated.cell_emulator import CellEmulator, CellOptions
from tests.ur_emulator.ticking import Ticked


class Cell(Ticked):
    """Two controllers."""

    def __init__(self, **options: Any) -> None:
        super().__init__(CellEmulator(CellOptions.from_mapping({"plant": "nominal", **options})))
