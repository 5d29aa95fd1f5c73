"""Functions of URScript as methods."""

from __future__ import annotations

from ur_emulator.controller.controller import Controller
from ur_emulator.script import Builtins


class Functions:
    """Functions of one subject: the public methods of a class, with the names that programs write.

    Args:
        controller: Controller that they act on.
    """

    def __init__(self, controller: Controller) -> None:
        self._controller, self._motion = controller, controller.motion

    def by_name(self) -> Builtins:
        """Return the functions by name."""
        return {name: getattr(self, name) for name in vars(type(self)) if not name.startswith("_")}
