"""Cell files as text: how values are written as TOML, and the commented file to begin with."""

from __future__ import annotations

import contextlib
import json
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, Final

from dual_ur10.errors import CellFileError, DualUR10Error
from dual_ur10.files import check_target
from dual_ur10.kinematics.ur10 import ARMS
from dual_ur10.sim2real.config.cell_file_schema import rows

Comment = Callable[[str], str | None]

EXAMPLES: Final = """\
# More that a cell file may say: take the "# " away from what you need. All keys are in docs/reference/cell-file.md.
#
# [left.calibration]  # as on the controller; without it, the nominal UR10
# a_m = [0.0, -0.612, -0.5723, 0.0, 0.0, 0.0]
# d_m = [0.1273, 0.0, 0.0, 0.163941, 0.1157, 0.0922]
#
# [tracker]  # where the poses of objects come from
# kind = "attached"
# arm = "left"
# position_m = [0.0, 0.0, 0.17]
#
# [[obstacle]]
# name = "wall"
# kind = "plane"
# point_m = [1.0, 0.0, 0.0]
# normal = [-1.0, 0.0, 0.0]
#
# [[obstacle]]
# name = "cabinet"
# kind = "box"
# position_m = [0.0, 1.6, 0.4]
# size_m = [0.6, 0.4, 0.8]
#
# [[obstacle]]
# name = "post"
# kind = "capsule"
# from_m = [0.9, -1.2, 0.0]
# to_m = [0.9, -1.2, 1.5]
# radius_m = 0.05
"""


def toml_text(values: Mapping[str, Any], comment: Comment = lambda path: None) -> str:
    """Plain values as TOML.

    Args:
        values: Numbers, texts, switches, sequences of them, tables, and sequences of tables.
        comment: What to write after a key, or above a table, by its path.
    """
    return "\n".join(_blocks(values, "", "", comment))


def _blocks(values: Mapping[str, Any], header: str, path: str, comment: Comment) -> list[str]:
    """One text per table, the given one first."""
    above = comment(path) if path else None
    lines = ([f"# {above}"] if above else []) + ([header] if header else [])
    inner: list[str] = []
    for name, value in values.items():
        here = f"{path}.{name}" if path else name
        if isinstance(value, Mapping):
            inner += _blocks(value, f"[{here}]", here, comment)
        elif isinstance(value, list | tuple) and value and isinstance(value[0], Mapping):
            for each in value:
                inner += _blocks(each, f"[[{here}]]", here, comment)
        else:
            beside = comment(here)
            lines.append(f"{name} = {_value(value)}" + (f"  # {beside}" if beside else ""))
    # A table that only holds tables needs no header of its own.
    return (["\n".join(lines) + "\n"] if len(lines) > (1 if header else 0) or not inner else []) + inner


def _value(value: Any) -> str:
    if isinstance(value, Sequence) and not isinstance(value, str):
        return f"[{', '.join(map(_value, value))}]"
    # JSON's escapes are TOML's, but for a control character that JSON leaves as it is.
    return json.dumps(value, ensure_ascii=False).replace("\x7f", "\\u007f")


def commented(values: Mapping[str, Any]) -> str:
    """A file to begin with: each key of the left arm and of the cell explained, and examples of what else there is."""
    meanings = {path.replace("ARM.", f"{ARMS[0]}."): key for path, key in rows()}
    titles = {ARMS[0]: "The left arm.", ARMS[1]: "The right arm; its keys mean the same."}

    def comment(path: str) -> str | None:
        if path in titles:
            return titles[path]
        key = meanings.get(path)
        return None if key is None else f"{key.meaning}: {key.allowed}"

    begin = "# A cell of two UR10s. To check it: python -m dual_ur10 cell check FILE"
    return f"{begin}\n\n{toml_text(values, comment)}\n{EXAMPLES}"


def write_new(path: str | Path, text: str) -> None:
    """Write a file where there is none.

    Raises:
        CellFileError: There is something.
        DualUR10Error: It cannot be written.
    """
    target = Path(path)
    check_target(target)
    try:
        file = target.open("x", encoding="utf-8", newline="")
    except FileExistsError:
        raise CellFileError(
            f"{path} exists: it was left as it is. Name another file, or move that one away first"
        ) from None
    except OSError as error:
        raise DualUR10Error(f"cannot write {path}: {error}") from error
    try:
        with file:
            file.write(text)
    except OSError as error:
        with contextlib.suppress(OSError):
            target.unlink()
        raise DualUR10Error(f"cannot write {path}: {error}") from error
