"""URScript's functions for registers, inputs and outputs, messages and the RTDE watchdog."""

from __future__ import annotations

import math
from collections.abc import Generator
from typing import Any

from dual_ur10.errors import MotionError
from dual_ur10.sim2real.emulator.controller import Controller
from dual_ur10.sim2real.emulator.inputs_outputs import CONFIGURABLE, STANDARD, TOOL
from dual_ur10.sim2real.emulator.registers import Watchdog
from dual_ur10.sim2real.emulator.script import Builtins, text
from dual_ur10.sim2real.emulator.script.values import number

_INT_BITS = 32
_WATCHDOG_ACTIONS = ("ignore", "pause", "stop")


def _register(index: int, values: list[Any]) -> int:
    if isinstance(index, bool) or int(index) != index or not 0 <= index < len(values):
        raise MotionError(f"there is no register {index}: they are 0 to {len(values) - 1}")
    return int(index)


def _int32(value: float) -> int:
    if not math.isfinite(number(value)):
        raise MotionError(f"{value!r} does not fit into an integer register")
    whole = int(value) & 0xFFFFFFFF
    return whole - (1 << _INT_BITS) if whole >> (_INT_BITS - 1) else whole


def io_builtins(controller: Controller) -> Builtins:
    """Return the functions by name."""
    registers, io = controller.registers, controller.io

    def read_input_integer_register(address: int) -> int:
        return registers.input_int[_register(address, registers.input_int)]

    def read_input_float_register(address: int) -> float:
        return registers.input_double[_register(address, registers.input_double)]

    def read_input_boolean_register(address: int) -> bool:
        return registers.input_bits[_register(address, registers.input_bits)]

    def read_output_integer_register(address: int) -> int:
        return registers.output_int[_register(address, registers.output_int)]

    def read_output_float_register(address: int) -> float:
        return registers.output_double[_register(address, registers.output_double)]

    def read_output_boolean_register(address: int) -> bool:
        return registers.output_bits[_register(address, registers.output_bits)]

    def write_output_integer_register(address: int, value: int) -> None:
        registers.output_int[_register(address, registers.output_int)] = _int32(value)

    def write_output_float_register(address: int, value: float) -> None:
        registers.output_double[_register(address, registers.output_double)] = float(number(value))

    def write_output_boolean_register(address: int, value: bool) -> None:
        registers.output_bits[_register(address, registers.output_bits)] = _truth(value)

    def set_standard_digital_out(n: int, b: bool) -> None:
        io.set_output(STANDARD + _within(n, 8), _truth(b))

    def set_configurable_digital_out(n: int, b: bool) -> None:
        io.set_output(CONFIGURABLE + _within(n, 8), _truth(b))

    def set_tool_digital_out(n: int, b: bool) -> None:
        io.set_output(TOOL + _within(n, 2), _truth(b))

    def set_digital_out(n: int, b: bool) -> None:
        io.set_output(_old(n), _truth(b))

    def get_standard_digital_out(n: int) -> bool:
        return bool(io.outputs >> STANDARD + _within(n, 8) & 1)

    def get_configurable_digital_out(n: int) -> bool:
        return bool(io.outputs >> CONFIGURABLE + _within(n, 8) & 1)

    def get_tool_digital_out(n: int) -> bool:
        return bool(io.outputs >> TOOL + _within(n, 2) & 1)

    def get_digital_out(n: int) -> bool:
        return bool(io.outputs >> _old(n) & 1)

    def get_standard_digital_in(n: int) -> bool:
        return bool(io.inputs >> STANDARD + _within(n, 8) & 1)

    def get_configurable_digital_in(n: int) -> bool:
        return bool(io.inputs >> CONFIGURABLE + _within(n, 8) & 1)

    def get_tool_digital_in(n: int) -> bool:
        return bool(io.inputs >> TOOL + _within(n, 2) & 1)

    def get_digital_in(n: int) -> bool:
        return bool(io.inputs >> _old(n) & 1)

    def set_standard_analog_out(n: int, f: float) -> None:
        io.set_analog(n, f)

    def set_analog_out(n: int, f: float) -> None:
        io.set_analog(n, f)

    def set_analog_outputdomain(port: int, domain: int) -> None:
        io.set_analog(port, 0.0, bool(domain))

    def set_tool_voltage(voltage: int) -> None:
        io.set_tool_voltage(voltage)

    def textmsg(s1: Any, s2: Any = "") -> None:
        controller.say(f"{text(s1)}{text(s2)}")

    def popup(
        s: Any, title: Any = "Popup", warning: bool = False, error: bool = False, blocking: bool = False
    ) -> Generator[None, None, None]:
        controller.show(text(title), text(s))
        while blocking and controller.popup:
            yield

    def rtde_set_watchdog(variable_name: str, min_frequency: float, action: str = "pause") -> None:
        if action not in _WATCHDOG_ACTIONS:
            raise MotionError(f"a watchdog's action is {action!r}: it must be one of {', '.join(_WATCHDOG_ACTIONS)}")
        controller.watchdog = _watchdog(controller, variable_name, float(number(min_frequency)), action)
        controller.received.watchdog = (controller.ticks, float(min_frequency), action)

    # Every function above is one of URScript's.
    own = locals()
    return {name: value for name, value in own.items() if callable(value)}


def _watchdog(controller: Controller, name: str, frequency: float, action: str) -> Watchdog | None:
    if not isinstance(name, str):
        raise MotionError(f"a watchdog needs the name of a register, found {name!r}")
    if not math.isfinite(frequency):
        raise MotionError(f"a watchdog's frequency is {frequency!r}: it must be a number of Hz")
    if action == "ignore" or frequency <= 0.0:
        return None
    kind, _, index = name.rpartition("_")
    known: dict[str, list[Any]] = {
        "input_int_register": controller.registers.input_int,
        "input_double_register": controller.registers.input_double,
    }
    if kind not in known or not index.isdigit():
        raise MotionError(
            f"a watchdog cannot be set on {name!r}: it must be an input register, such as input_int_register_0"
        )
    _register(int(index), known[kind])
    writes = controller.registers.writes.get(name, 0)
    values, place = known[kind], int(index)
    return Watchdog(name, 1.0 / frequency, action, writes, controller.program.machine, lambda: values[place])


def _within(n: int, count: int) -> int:
    if isinstance(n, bool) or int(n) != n or not 0 <= n < count:
        raise MotionError(f"there is no input or output {n}: they are 0 to {count - 1}")
    return int(n)


def _old(n: int) -> int:
    """Return the bit of an input or output in the old numbering, in which 8 and 9 are the tool's."""
    return TOOL + _within(n, 10) - 8 if n >= 8 else _within(n, 8)


def _truth(value: Any) -> bool:
    return bool(number(value))
