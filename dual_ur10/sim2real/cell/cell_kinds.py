"""Kinds of cells by name: those of this package, and those that others register."""

from __future__ import annotations

import re
from dataclasses import dataclass
from typing import Final

from dual_ur10.errors import SettingsError, UnknownNameError
from dual_ur10.ids import discover

_FORM: Final = re.compile(r"[^\W\d][\w.]*:[^\W\d]\w*")


@dataclass(frozen=True, kw_only=True)
class CellKind:
    """Kind of cell.

    Attributes:
        factory: Function, "module:function", that makes the cell of a `CellRequest`.
        controllers: True if arms outside of this program move: there is one cell, a reset that may move needs consent,
            a refused motion ends the episode, nothing is randomized, and the arms are slowed down near obstacles.
        file: True if a cell file describes it.
        commanded: True if its state is what was commanded, and nothing is measured or simulated.
    """

    factory: str
    controllers: bool = False
    file: bool = False
    commanded: bool = False


_TWO_CONTROLLERS: Final = CellKind(
    factory="dual_ur10.sim2real.runtime.rtde_cell:make_rtde_cell", controllers=True, file=True
)

CELL_KINDS: Final = {
    "mujoco": CellKind(factory="dual_ur10.envs.sim.mujoco_cell:make_mujoco_cell"),
    "echo": CellKind(factory="dual_ur10.envs.sim.echo_cell:make_echo_cell", commanded=True),
    "emulated": _TWO_CONTROLLERS,
    "real": _TWO_CONTROLLERS,
}
"""Kinds by name; `register_cell` adds to them."""


def register_cell(name: str, factory: str, *, controllers: bool, commanded: bool = False) -> None:
    """Register a kind of cell of your own, for `gym.make(..., cell=name)` and `CellConfig(kind=name)`.

    Adapter and safety gate stand before it as before every cell. Call this where your package is imported; an entry
    point of the group "dual_ur10.tasks" lets commands find it.

    Args:
        name: New name, of letters, digits and underscores.
        factory: Function, "module:function", that returns the `dual_ur10.sim2real.cell.cell.Cell` of a
            `dual_ur10.sim2real.cell.cell.CellRequest`.
        controllers: See `CellKind`. State True for whatever can hurt somebody.
        commanded: See `CellKind`.

    Raises:
        SettingsError: A value has another form, or another kind has the name.
    """
    if not isinstance(name, str) or not name.isidentifier():
        raise SettingsError(f"the name of a kind of cell is {name!r}: use letters, digits and underscores")
    if not isinstance(factory, str) or _FORM.fullmatch(factory) is None:
        raise SettingsError(f'the factory of the cell {name!r} is {factory!r}: it must be "module:function"')
    kind = CellKind(factory=factory, controllers=bool(controllers), commanded=bool(commanded))
    if CELL_KINDS.setdefault(name, kind) != kind:
        raise SettingsError(f"another kind of cell is named {name!r}, {CELL_KINDS[name].factory}: choose another name")


def cell_kind(name: str) -> CellKind:
    """Return a kind of cell by its name.

    Raises:
        UnknownNameError: There is no such kind.
    """
    if name not in CELL_KINDS:
        discover()
    if name not in CELL_KINDS:
        raise UnknownNameError("cell kind", str(name), list(CELL_KINDS))
    return CELL_KINDS[name]
