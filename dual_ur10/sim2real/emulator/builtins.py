"""All URScript builtins of one controller."""

from __future__ import annotations

from typing import Any

from dual_ur10.sim2real.emulator.builtins_io import io_builtins
from dual_ur10.sim2real.emulator.builtins_motion import motion_builtins
from dual_ur10.sim2real.emulator.builtins_robot import robot_builtins
from dual_ur10.sim2real.emulator.builtins_socket import socket_builtins
from dual_ur10.sim2real.emulator.controller import Controller
from dual_ur10.sim2real.emulator.script import Builtins, library

_ELEMENTS_PER_STEP = 8


def _costly(controller: Controller, own: Builtins) -> Builtins:
    """Return functions whose duration depends on the size of their argument: they count as several statements."""

    def norm(a: Any) -> float:
        controller.spend(_size(a))
        found: float = own["norm"](a)
        return found

    def to_str(val: Any) -> str:
        controller.spend(_size(val))
        found: str = own["to_str"](val)
        return found

    def str_cat(op1: Any, op2: Any) -> str:
        controller.spend(_size(op1) + _size(op2))
        found: str = own["str_cat"](op1, op2)
        return found

    return {"norm": norm, "to_str": to_str, "str_cat": str_cat}


def _size(value: Any) -> int:
    """Return the number of statements that a value counts for."""
    if not isinstance(value, list):
        return 0
    return sum(len(each) if isinstance(each, list) else 1 for each in value) // _ELEMENTS_PER_STEP


def builtins_of(controller: Controller) -> Builtins:
    """Return every builtin by name, as the controller's version has them."""
    own = library(controller.profile.tick_s)
    return {
        **own,
        **_costly(controller, own),
        **motion_builtins(controller),
        **io_builtins(controller),
        **robot_builtins(controller),
        **socket_builtins(controller),
    }
