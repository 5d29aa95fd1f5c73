"""Placer of the objects that a task handles, for cells in which a program can do that."""

from __future__ import annotations

from collections.abc import Sequence

from dual_ur10.errors import EmulatorError, LinkError, OperationRefusedError
from dual_ur10.sim2real.config.cell_file import CellFile
from dual_ur10.sim2real.links.json_link import JsonLink
from dual_ur10.sim2real.processes.system import LOCAL, System
from dual_ur10.types import Closing


class ObjectPlacer(Closing):
    """Client that puts objects of a task at poses, at rest.

    Args:
        link: Connection to the service; the placer closes it.
    """

    def __init__(self, link: JsonLink) -> None:
        self._link = link

    def place(self, name: str, position_m: Sequence[float], quat: Sequence[float]) -> None:
        """Put an object at a pose in the cell frame.

        Args:
            name: Name of the prop.
            position_m: (3,) of its centre.
            quat: (4,) its orientation (w, x, y, z).

        Raises:
            EmulatorError: There is no object, it cannot be put there, or there was no answer.
        """
        pose = {
            "prop": name,
            "position_m": [float(each) for each in position_m],
            "quat": [float(each) for each in quat],
        }
        try:
            self._link.ask("place", **pose)
        except (LinkError, OperationRefusedError) as error:
            raise EmulatorError(f"the {name} was not placed: {error}") from error

    def close(self) -> None:
        """End the connection. May be called twice."""
        self._link.close()


def placer_of(cell_file: CellFile, system: System = LOCAL) -> ObjectPlacer | None:
    """Return the placer that a cell file names, or None if a person places the objects."""
    entry = cell_file.emulator
    if entry is None:
        return None
    return ObjectPlacer(JsonLink("object placer", cell_file.left.host, entry.port, system=system))
