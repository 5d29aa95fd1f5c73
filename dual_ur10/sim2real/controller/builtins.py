"""The functions that programs may call, of one controller."""

from __future__ import annotations

from typing import TYPE_CHECKING

from dual_ur10.sim2real.controller.builtins_io import io_builtins
from dual_ur10.sim2real.controller.builtins_motion import motion_builtins
from dual_ur10.sim2real.controller.builtins_robot import robot_builtins
from dual_ur10.sim2real.controller.script import library

if TYPE_CHECKING:
    from dual_ur10.sim2real.controller.controller import Builtins, Controller


def builtins_of(controller: Controller) -> Builtins:
    """Every built-in function, by name, as the controller's version has them."""
    return {
        **library(controller.profile.tick_s),
        **motion_builtins(controller),
        **io_builtins(controller),
        **robot_builtins(controller),
    }
