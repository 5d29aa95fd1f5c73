"""Bytes of RTDE clients, composed by hand."""

from __future__ import annotations

import struct
from collections.abc import Iterable, Mapping
from typing import Any

from ur_emulator.controller.registers import Registers
from ur_emulator.controller.rtde_variables import zero_values
from ur_emulator.ports.rtde_session import RtdePort, RtdeSession
from ur_emulator.profile import profile_of

VERSION_2 = b"\x00\x05V\x00\x02"

SERVOJ = ["input_int_register_0", *(f"input_double_register_{number}" for number in range(11))]

RECEIVED = [
    "timestamp",
    "target_q",
    "target_qd",
    "target_qdd",
    "target_current",
    "target_moment",
    "actual_q",
    "actual_qd",
    "actual_current",
    "joint_control_output",
    "actual_TCP_pose",
    "actual_TCP_speed",
    "actual_TCP_force",
    "target_TCP_pose",
    "target_TCP_speed",
    "actual_digital_input_bits",
    "joint_temperatures",
    "actual_execution_time",
    "robot_mode",
    "joint_mode",
    "safety_mode",
    "actual_tool_accelerometer",
    "speed_scaling",
    "target_speed_fraction",
    "actual_momentum",
    "actual_main_voltage",
    "actual_robot_voltage",
    "actual_robot_current",
    "actual_joint_voltage",
    "actual_digital_output_bits",
    "runtime_state",
    "standard_analog_input0",
    "standard_analog_input1",
    "standard_analog_output0",
    "standard_analog_output1",
    "robot_status_bits",
    "safety_status_bits",
]


def message(kind: str, payload: bytes = b"") -> bytes:
    return struct.pack(">HB", 3 + len(payload), ord(kind)) + payload


def outputs(names: Iterable[str], frequency_hz: float = 500.0) -> bytes:
    return message("O", struct.pack(">d", frequency_hz) + "".join(name + "," for name in names).encode())


def inputs(names: Iterable[str]) -> bytes:
    return message("I", "".join(name + "," for name in names).encode())


def data(recipe: int, layout: str, *values: Any) -> bytes:
    return message("U", struct.pack(">B" + layout, recipe, *values))


class RtdeBench:
    """RTDE port of a controller, with records of its input."""

    def __init__(self, family: str = "e-series") -> None:
        self.profile = profile_of(family)
        self.registers = Registers()
        self.values = zero_values(self.profile)
        self.forwarded: list[dict[str, Any]] = []
        self.port = RtdePort(self.profile, self.registers, self.values, self._note)

    def _note(self, others: Mapping[str, Any]) -> None:
        self.forwarded.append(dict(others))

    def session(self, *requests: bytes) -> RtdeSession:
        """Open a connection of version 2 that has sent `requests`."""
        session = self.port.open()
        session.receive(b"".join([VERSION_2, *requests]))
        return session

    def written(self) -> tuple[Any, ...]:
        """Return copies of everything that clients can write, and of the forwarded inputs."""
        registers = self.registers
        numbers = (registers.input_int, [repr(x) for x in registers.input_double], registers.input_bits)
        return *map(list, numbers), dict(registers.writes), repr(self.forwarded)
