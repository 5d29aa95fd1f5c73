"""URScript's functions for registers, inputs and outputs, messages and the RTDE watchdog."""

from __future__ import annotations

import math
from collections.abc import Callable, Generator
from typing import Any

from ur_core.errors import MotionError
from ur_emulator.controller.controller import Controller
from ur_emulator.controller.inputs_outputs import CONFIGURABLE, STANDARD, TOOL, InputsOutputs
from ur_emulator.controller.registers import Registers, Watchdog
from ur_emulator.controller.rtde_variables import input_types
from ur_emulator.script import Builtins, text
from ur_emulator.script.values import number

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
    io = controller.io

    def set_analog_out(n: int, f: float) -> None:
        io.set_analog(n, f)

    def set_analog_outputdomain(port: int, domain: int) -> None:
        io.set_analog(port, 0.0, bool(domain))

    def set_tool_voltage(voltage: int) -> None:
        io.set_tool_voltage(voltage)

    def textmsg(s1: Any, s2: Any = "") -> None:
        controller.send_text(f"{text(s1)}{text(s2)}")

    def popup(
        s: Any, title: Any = "Popup", warning: bool = False, error: bool = False, blocking: bool = False
    ) -> Generator[None, None, None]:
        style = {"warning": _truth(warning), "error": _truth(error), "blocking": _truth(blocking)}
        controller.open_popup(text(title), text(s), **style)
        while blocking and controller.popup:
            yield

    def rtde_set_watchdog(variable_name: str, min_frequency: float, action: str = "pause") -> None:
        if action not in _WATCHDOG_ACTIONS:
            raise MotionError(f"a watchdog's action is {action!r}: it must be one of {', '.join(_WATCHDOG_ACTIONS)}")
        watchdog = _watchdog(controller, variable_name, float(number(min_frequency)), action)
        controller.watchdogs.pop(variable_name, None)
        if watchdog is not None:
            controller.watchdogs[variable_name] = watchdog
        controller.received.watchdog = (controller.ticks, float(min_frequency), action)

    functions = (set_analog_out, set_analog_outputdomain, set_tool_voltage, textmsg, popup, rtde_set_watchdog)
    return {
        **_register_builtins(controller.registers),
        **_digital_builtins(io),
        **{each.__name__: each for each in functions},
        "set_standard_analog_out": set_analog_out,
    }


def _register_builtins(registers: Registers) -> Builtins:
    def reader(values: list[Any]) -> Callable[..., Any]:
        count = len(values)

        def read(address: int) -> Any:
            if address.__class__ is int and 0 <= address < count:  # as nearly always
                return values[address]
            return values[_register(address, values)]

        return read

    def writer(values: list[Any], convert: Callable[[Any], Any]) -> Callable[..., None]:
        def write(address: int, value: Any) -> None:
            values[_register(address, values)] = convert(value)

        return write

    outputs: dict[str, tuple[list[Any], Callable[[Any], Any]]] = {
        "integer": (registers.output_int, _int32),
        "float": (registers.output_double, lambda value: float(number(value))),
        "boolean": (registers.output_bits, _truth),
    }
    inputs: tuple[list[Any], ...] = (registers.input_int, registers.input_double, registers.input_bits)
    functions: Builtins = {
        f"read_input_{kind}_register": reader(values) for kind, values in zip(outputs, inputs, strict=True)
    }
    for kind, (values, convert) in outputs.items():
        functions[f"read_output_{kind}_register"] = reader(values)
        functions[f"write_output_{kind}_register"] = writer(values, convert)
    return functions


def _digital_builtins(io: InputsOutputs) -> Builtins:
    def group(bit: Callable[[int], int]) -> tuple[Callable[..., Any], ...]:
        def set_out(n: int, b: bool) -> None:
            io.set_output(bit(n), _truth(b))

        def get_out(n: int) -> bool:
            return bool(io.outputs >> bit(n) & 1)

        def get_in(n: int) -> bool:
            return bool(io.inputs >> bit(n) & 1)

        return set_out, get_out, get_in

    groups: dict[str, Callable[[int], int]] = {
        "standard_": lambda n: STANDARD + _within(n, 8),
        "configurable_": lambda n: CONFIGURABLE + _within(n, 8),
        "tool_": lambda n: TOOL + _within(n, 2),
        "": _old,
    }
    functions: Builtins = {}
    for name, bit in groups.items():
        names = (f"set_{name}digital_out", f"get_{name}digital_out", f"get_{name}digital_in")
        functions.update(zip(names, group(bit), strict=True))
    return functions


def _watchdog(controller: Controller, name: str, frequency: float, action: str) -> Watchdog | None:
    if not isinstance(name, str) or name not in input_types(controller.profile):
        raise MotionError(
            f"a watchdog cannot be set on {name!r}: it must be an RTDE input, such as input_int_register_0"
        )
    if not math.isfinite(frequency):
        raise MotionError(f"a watchdog's frequency is {frequency!r}: it must be a number of Hz")
    if action == "ignore" or frequency <= 0.0:
        return None
    writes = controller.registers.writes.get(name, 0)
    return Watchdog(name, 1.0 / frequency, action, writes, controller.program.machine)


def _within(n: int, count: int) -> int:
    if isinstance(n, bool) or int(n) != n or not 0 <= n < count:
        raise MotionError(f"there is no input or output {n}: they are 0 to {count - 1}")
    return int(n)


def _old(n: int) -> int:
    """Return the bit of an input or output in the old numbering, in which 8 and 9 are the tool's."""
    return TOOL + _within(n, 10) - 8 if n >= 8 else _within(n, 8)


def _truth(value: Any) -> bool:
    return bool(number(value))
