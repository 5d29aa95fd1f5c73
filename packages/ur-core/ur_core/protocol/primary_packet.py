"""Robot state packets of the primary and secondary interfaces, ports 30001, 30002, 30011 and 30012.

A packet of type 16 is a list of sub-packages, each an INT32 size, a UINT8 type and its fields, all big-endian. Layouts:
UR's client interface article, the parsers of Universal Robots' client library, and the sizes in a packet recorded from
URSim 5.8. Fields that no simulated robot has are sent as that packet has them.
"""

from __future__ import annotations

import struct
import zlib
from collections.abc import Callable, Mapping
from typing import Any, Final

from ur_core.kinematics.robots import robot_model
from ur_core.kinematics.ur10 import HARD_ACCELERATION_RAD_S2, JOINT_RANGE_RAD, DHParameters
from ur_core.protocol.modes import RobotMode, RuntimeState, SafetyBits
from ur_core.protocol.primary_messages import ControllerIdentity, version_message

ROBOT_STATE: Final = 16
"""Type of the packet."""

RATE_HZ: Final = 10
"""Rate at which it is sent."""

Values = Mapping[str, Any]

_CALIBRATED: Final = 2  # assumption: "calibration status" of a calibrated arm; 0 is that of a nominal one
_EMERGENCY: Final = SafetyBits.SYSTEM_EMERGENCY_STOPPED | SafetyBits.ROBOT_EMERGENCY_STOPPED

# Defaults of the pendant for movej and movel: URScript manual, a=1.4, v=1.05, a=1.2, v=0.25.
_DEFAULTS: Final = (1.05, 1.4, 0.25, 1.2)
_EQUIVALENT_RADIUS_M: Final = 0.25


class PrimaryPacket:
    """Packer of the state of one controller.

    Args:
        identity: Version, robot type and safety settings of the controller.
        kinematics: Calibrated kinematics of the arm.
    """

    def __init__(self, identity: ControllerIdentity, kinematics: DHParameters) -> None:
        self._e_series = identity.family == "e-series"
        self._safety_checksum = struct.pack(">I", identity.safety_checksum)
        self._version = version_message(identity)
        self._kinematics = _package(5, _kinematics(kinematics))
        self._configuration = _package(6, _configuration(identity, kinematics))
        # Assumption: a CB3 sends no data of the tool's connector.
        packers: tuple[Callable[[Values], bytes], ...] = (
            self._robot_mode,
            _joints,
            _cartesian,
            lambda _: self._kinematics,
            _calibration,
            self._masterboard,
            _tool,
            lambda _: self._configuration,
            _force_mode,
            self._additional,
            self._safety,
        )
        self._packers = (*packers, _tool_connector, _tool_mode) if self._e_series else packers

    def version_message(self) -> bytes:
        """Return the first message of every connection."""
        return self._version

    def state(self, values: Values) -> bytes:
        """Return a packet.

        Args:
            values: Values by name of the RTDE output variable; also `control_mode`, if it is not 0 (position).

        Raises:
            KeyError: A variable of `NAMES` is missing.
        """
        body = b"".join([pack(values) for pack in self._packers])
        return struct.pack(">iB", 5 + len(body), ROBOT_STATE) + body

    def _robot_mode(self, values: Values) -> bytes:
        bits, mode, state = values["safety_status_bits"], values["robot_mode"], values["runtime_state"]
        fields = struct.pack(
            ">Q7?BBddd",
            round(values["timestamp"] * 1e6),
            True,  # real robot connected: clients refuse to work with a simulated one
            True,
            mode >= RobotMode.POWER_ON,
            bool(bits & (_EMERGENCY | SafetyBits.EMERGENCY_STOPPED)),
            bool(bits & SafetyBits.PROTECTIVE_STOPPED),
            state in (RuntimeState.PLAYING, RuntimeState.RESUMING),
            state in (RuntimeState.PAUSING, RuntimeState.PAUSED),
            mode & 0xFF,
            values.get("control_mode", 0),
            values["target_speed_fraction"],
            values["speed_scaling"],
            1.0,
        )
        # A CB3 has no reserved byte here; urx, a client of CB3s, distinguishes versions by this size.
        return _package(0, fields + b"\0" if self._e_series else fields)

    def _masterboard(self, values: Values) -> bytes:
        types = values["analog_io_types"]
        bits = values["safety_status_bits"]
        fields = struct.pack(
            ">IIBBddBBddffffBBB",
            values["actual_digital_input_bits"],
            values["actual_digital_output_bits"],
            types & 1,
            types >> 1 & 1,
            values["standard_analog_input0"],
            values["standard_analog_input1"],
            types >> 2 & 1,
            types >> 3 & 1,
            values["standard_analog_output0"],
            values["standard_analog_output1"],
            24.0,
            values["actual_robot_voltage"],
            values["actual_robot_current"],
            values["io_current"],
            values["safety_mode"] & 0xFF,
            bool(bits & SafetyBits.REDUCED),
            0,  # no Euromap 67 interface
        )
        # Assumption: a CB3 ends with the reserved number.
        rest = self._safety_checksum + bytes((1, 1, 1)) if self._e_series else self._safety_checksum
        return _package(3, fields + rest)

    def _additional(self, values: Values) -> bytes:
        freedrive = bool(values.get("freedrive_pressed", False))
        # Assumption: a CB3 has no reserved byte here either.
        fields = struct.pack(">B??", freedrive, True, False)
        return _package(8, fields + b"\1" if self._e_series else fields)

    def _safety(self, values: Values) -> bytes:
        """Layout not documented. It begins with the checksum, and holds the elbow's position and a radius."""
        return _package(10, self._safety_checksum + struct.pack(">2B4d", 1, 1, *values["elbow_position"], 0.13))


NAMES: Final = (
    *("timestamp", "robot_mode", "safety_mode", "safety_status_bits", "runtime_state"),
    *("target_speed_fraction", "speed_scaling"),
    *(
        "actual_q",
        "target_q",
        "actual_qd",
        "actual_current",
        "actual_joint_voltage",
        "joint_temperatures",
        "joint_mode",
    ),
    *("actual_TCP_pose", "actual_TCP_force", "tcp_offset", "elbow_position"),
    *("actual_digital_input_bits", "actual_digital_output_bits", "analog_io_types"),
    *("standard_analog_input0", "standard_analog_input1", "standard_analog_output0", "standard_analog_output1"),
    *("actual_robot_voltage", "actual_robot_current", "io_current"),
    *("tool_analog_input_types", "tool_analog_input0", "tool_analog_input1"),
    *("tool_output_voltage", "tool_output_current", "tool_temperature", "tool_mode"),
)
"""RTDE output variables that a packet needs."""


def kinematics_checksums(kinematics: DHParameters) -> tuple[int, ...]:
    """Return (6,) checksums, one per joint: CRC-32 of its theta, a, d and alpha as big-endian doubles.

    UR does not publish its own rule; clients only compare.
    """
    rows = zip(kinematics.theta_rad, kinematics.a_m, kinematics.d_m, kinematics.alpha_rad, strict=True)
    # Adding zero makes -0.0 equal to 0.0: it is the same arm.
    return tuple(zlib.crc32(struct.pack(">4d", *(value + 0.0 for value in row))) for row in rows)


def _package(kind: int, fields: bytes) -> bytes:
    return struct.pack(">iB", 5 + len(fields), kind) + fields


_JOINT: Final = struct.Struct(">dddffffB")


def _joints(values: Values) -> bytes:
    names = ("actual_q", "target_q", "actual_qd", "actual_current", "actual_joint_voltage", "joint_temperatures")
    # The temperature of the processors is not known: that of the joints stands for it.
    rows = zip(*(values[name] for name in (*names, "joint_temperatures", "joint_mode")), strict=True)
    return _package(1, b"".join([_JOINT.pack(*row) for row in rows]))


def _cartesian(values: Values) -> bytes:
    return _package(4, struct.pack(">12d", *values["actual_TCP_pose"], *values["tcp_offset"]))


def _kinematics(kinematics: DHParameters) -> bytes:
    return struct.pack(
        ">6I24dI",
        *kinematics_checksums(kinematics),
        *kinematics.theta_rad,
        *kinematics.a_m,
        *kinematics.d_m,
        *kinematics.alpha_rad,
        0 if kinematics.is_nominal else _CALIBRATED,
    )


def _configuration(identity: ControllerIdentity, kinematics: DHParameters) -> bytes:
    limits = [(-limit, limit) for limit in JOINT_RANGE_RAD.tolist()]
    speeds = robot_model(kinematics.robot).joint_speed_rad_s.tolist()
    motion = [(speed, HARD_ACCELERATION_RAD_S2) for speed in speeds]
    masterboard, box, sub_type = (6, 4, 3) if identity.family == "e-series" else (5, 2, 0)
    return struct.pack(
        ">53d4I",
        *(value for pair in limits + motion for value in pair),
        *_DEFAULTS,
        _EQUIVALENT_RADIUS_M,
        *kinematics.a_m,
        *kinematics.d_m,
        *kinematics.alpha_rad,
        *kinematics.theta_rad,
        masterboard,
        box,
        identity.robot_type,
        sub_type,
    )


def _force_mode(values: Values) -> bytes:
    # The last number, the distance from a singularity, is not computed.
    return _package(7, struct.pack(">7d", *values["actual_TCP_force"], 0.0))


def _calibration(_: Values) -> bytes:
    # The layout is not published.
    return _package(9, bytes(48))


def _tool(values: Values) -> bytes:
    types = values["tool_analog_input_types"]
    fields = struct.pack(
        ">BBddfBffB",
        types & 1,
        types >> 1 & 1,
        values["tool_analog_input0"],
        values["tool_analog_input1"],
        values["actual_robot_voltage"],
        values["tool_output_voltage"],
        values["tool_output_current"],
        values["tool_temperature"],
        values["tool_mode"],
    )
    return _package(2, fields)


def _tool_connector(_: Values) -> bytes:
    # Serial connection in the tool's connector: off, with UR's defaults.
    return _package(11, struct.pack(">?iiiff", False, 115200, 0, 1, 1.5, 3.5))


def _tool_mode(_: Values) -> bytes:
    # Digital outputs of the tool: UR's defaults.
    return _package(12, struct.pack(">3B", 0, 1, 1))
