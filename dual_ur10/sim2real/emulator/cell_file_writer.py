"""The file that says where an emulated cell is, for the programs that are to talk to it."""

from __future__ import annotations

import tomllib
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from dual_ur10.errors import SettingsError
from dual_ur10.files import write_text
from dual_ur10.sim2real.config.cell_file_text import toml_text


def write_cell_file(path: str | Path, description: Mapping[str, Any]) -> None:
    """Write a description as TOML.

    Args:
        path: Where to. A file of an emulated cell is replaced; any other is left alone.
        description: Tables by name, with plain values, or plain values.

    Raises:
        SettingsError: There is another file.
        DualUR10Error: The place cannot be written to.
    """
    path = Path(path)
    if path.exists():
        try:
            kind = tomllib.loads(path.read_text()).get("kind")
        except (OSError, ValueError, RecursionError):
            kind = None
        if kind != "emulated":
            raise SettingsError(
                f"{path} exists and is no file of an emulated cell: it was left as it is. Name another with --cell"
            )
    write_text(path, toml_text(description))
