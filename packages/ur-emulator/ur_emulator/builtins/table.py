"""All URScript builtins of one controller."""

from __future__ import annotations

from typing import Any, Final

from ur_emulator.builtins.dynamics_functions import dynamics_builtins, optimove_builtins, torque_builtins
from ur_emulator.builtins.io_functions import io_builtins
from ur_emulator.builtins.motion_functions import MotionOwner, motion_builtins
from ur_emulator.builtins.robot_functions import robot_builtins
from ur_emulator.builtins.socket_functions import socket_builtins
from ur_emulator.controller.controller import Controller
from ur_emulator.script import Builtins, VersionBuiltins, library

_ELEMENTS_PER_STEP = 8

_Version = tuple[int, ...]

SINCE: Final[dict[str, tuple[_Version, _Version | None]]] = {
    "tool_contact": ((5, 4), (3, 14)),
    "get_steptime": ((5, 4), (3, 14)),
    "get_actual_joint_positions_history": ((5, 4), (3, 14)),
    "get_target_waypoint": ((5, 3), None),
    "ft_rtde_input_enable": ((5, 9), (3, 14)),
    "protective_stop": ((5, 0), (3, 8)),
    "get_tcp_offset": ((5, 0), (3, 6)),
    "get_inverse_kin_has_solution": ((5, 10), (3, 15)),
    "set_target_payload": ((5, 10), (3, 15)),
    "get_target_payload_inertia": ((5, 10), (3, 15)),
    "force_mode_set_damping": ((5, 0), (3, 5)),
    "get_freedrive_status": ((5, 10), None),
    "optimovej": ((5, 21), None),
    "optimovel": ((5, 21), None),
    "direct_torque": ((5, 23), None),
    "get_actual_joint_accelerations": ((5, 23), None),
    "get_coriolis_and_centrifugal_torques": ((5, 23), None),
    "get_jacobian": ((5, 23), None),
    "get_jacobian_time_derivative": ((5, 23), None),
    "get_mass_matrix": ((5, 23), None),
    "get_target_joint_accelerations": ((5, 23), None),
}
"""First versions of PolyScope 5 and of PolyScope 3 with a function, None for never; the others are in all.

`direct_torque`, its friction scales and the functions of the dynamics: UR's script manual and the release it names
for each. `optimovej` and `optimovel`: the tests of UR's client library, which need 5.21.
"""


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
    own, owner, profile = library(controller.profile.tick_s), MotionOwner(controller), controller.profile
    functions = {
        **own,
        **_costly(controller, own),
        **motion_builtins(controller, owner),
        **io_builtins(controller),
        **robot_builtins(controller),
        **socket_builtins(controller),
        **dynamics_builtins(controller),
        **torque_builtins(controller, owner),
        **optimove_builtins(controller, owner),
    }
    absent = {}
    for name, (e_series, cb3) in SINCE.items():
        if not profile.at_least(e_series, cb3):
            del functions[name]
            absent[name] = _needs(e_series, cb3, profile.version)
    return VersionBuiltins(functions, absent)


def _needs(e_series: _Version, cb3: _Version | None, found: _Version) -> str:
    first = " or ".join(".".join(map(str, each)) for each in (e_series, cb3) if each is not None)
    return f"it needs PolyScope {first} or later, and this controller has {'.'.join(map(str, found[:3]))}"
