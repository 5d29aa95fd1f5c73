"""RTDE variables of a controller, from UR's RTDE guide.

Columns of the tables: name, type, and the versions of CB3 and e-Series software that introduced the variable; a minus
where none did. A question mark marks an undocumented version. Registers of the same kind share a row.
"""

from __future__ import annotations

import re
from functools import cache
from typing import Final

from ur_core.protocol.rtde import TYPES, DataType, Value
from ur_emulator.controller.registers import Registers
from ur_emulator.profile import ControllerProfile

Version = tuple[int, ...]

_E_SERIES: Final = 5
"""First major version of the e-Series. Later ones use the same column."""

_REGISTERS: Final = """
input_bit_registers0_to_31               UINT32        3.4    5.0
input_bit_registers32_to_63              UINT32        3.4    5.0
input_bit_register_64..127               BOOL          3.9    5.3
input_int_register_0..23                 INT32         3.4    5.0
input_int_register_24..47                INT32         3.9    5.3
input_double_register_0..23              DOUBLE        3.4    5.0
input_double_register_24..47             DOUBLE        3.9    5.3
"""
"""Input registers, which clients write and can read back."""

_INPUTS: Final = (
    _REGISTERS
    + """
speed_slider_mask                        UINT32        3.0    5.0
speed_slider_fraction                    DOUBLE        3.0    5.0
standard_digital_output_mask             UINT8         3.0    5.0
standard_digital_output                  UINT8         3.0    5.0
configurable_digital_output_mask         UINT8         3.0    5.0
configurable_digital_output              UINT8         3.0    5.0
tool_digital_output_mask                 UINT8         3.0    5.0
tool_digital_output                      UINT8         3.0    5.0
standard_analog_output_mask              UINT8         3.0    5.0
standard_analog_output_type              UINT8         3.0    5.0
standard_analog_output_0                 DOUBLE        3.0    5.0
standard_analog_output_1                 DOUBLE        3.0    5.0
external_force_torque                    VECTOR6D      3.3    5.0
"""
)

_OUTPUTS: Final = (
    _REGISTERS
    + """
timestamp                                DOUBLE        3.0    5.0
target_q                                 VECTOR6D      3.0    5.0
target_qd                                VECTOR6D      3.0    5.0
target_qdd                               VECTOR6D      3.0    5.0
target_current                           VECTOR6D      3.0    5.0
target_moment                            VECTOR6D      3.0    5.0
actual_q                                 VECTOR6D      3.0    5.0
actual_qd                                VECTOR6D      3.0    5.0
actual_current                           VECTOR6D      3.0    5.0
actual_current_window                    VECTOR6D      3.0?   5.0?
actual_current_as_torque                 VECTOR6D      -      5.23
joint_control_output                     VECTOR6D      3.0    5.0
actual_TCP_pose                          VECTOR6D      3.0    5.0
actual_TCP_speed                         VECTOR6D      3.0    5.0
actual_TCP_force                         VECTOR6D      3.0    5.0
target_TCP_pose                          VECTOR6D      3.0    5.0
target_TCP_speed                         VECTOR6D      3.0    5.0
actual_TCP_acceleration                  VECTOR6D      -      5.23?
target_TCP_acceleration                  VECTOR6D      -      5.23?
tcp_offset                               VECTOR6D      3.12   5.5.1
actual_digital_input_bits                UINT64        3.0    5.0
actual_configurable_digital_input_bits   UINT64        -      5.23?
joint_temperatures                       VECTOR6D      3.0    5.0
actual_execution_time                    DOUBLE        3.0    5.0
target_execution_time                    DOUBLE        -      5.23?
robot_mode                               INT32         3.0    5.0
joint_mode                               VECTOR6INT32  3.0    5.0
safety_mode                              INT32         3.0    5.0
safety_status                            INT32         3.10   5.4
actual_tool_accelerometer                VECTOR3D      3.0    5.0
speed_scaling                            DOUBLE        3.0    5.0
target_speed_fraction                    DOUBLE        3.0    5.0
actual_momentum                          DOUBLE        3.0    5.0
actual_main_voltage                      DOUBLE        3.0    5.0
actual_robot_voltage                     DOUBLE        3.0    5.0
actual_robot_current                     DOUBLE        3.0    5.0
actual_joint_voltage                     VECTOR6D      3.0    5.0
actual_digital_output_bits               UINT64        3.0    5.0
actual_configurable_digital_output_bits  UINT64        -      5.23?
runtime_state                            UINT32        3.0    5.0
elbow_position                           VECTOR3D      3.5    5.0
elbow_velocity                           VECTOR3D      3.5    5.0
robot_status_bits                        UINT32        3.0    5.0
safety_status_bits                       UINT32        3.0    5.0
analog_io_types                          UINT32        3.0    5.0
standard_analog_input0                   DOUBLE        3.0    5.0
standard_analog_input1                   DOUBLE        3.0    5.0
standard_analog_output0                  DOUBLE        3.0    5.0
standard_analog_output1                  DOUBLE        3.0    5.0
io_current                               DOUBLE        3.0    5.0
euromap67_input_bits                     UINT32        3.0    5.0
euromap67_output_bits                    UINT32        3.0    5.0
euromap67_24V_voltage                    DOUBLE        3.0    5.0
euromap67_24V_current                    DOUBLE        3.0    5.0
tool_mode                                UINT32        3.0    5.0
tool_analog_input_types                  UINT32        3.0    5.0
tool_analog_input0                       DOUBLE        3.0    5.0
tool_analog_input1                       DOUBLE        3.0    5.0
tool_output_voltage                      INT32         3.0    5.0
tool_output_current                      DOUBLE        3.0    5.0
tool_temperature                         DOUBLE        3.0    5.0
tool_output_mode                         UINT8         -      5.2?
tool_digital_output0_mode                UINT8         -      5.2?
tool_digital_output1_mode                UINT8         -      5.2?
tcp_force_scalar                         DOUBLE        3.0?   5.0?
joint_position_deviation_ratio           DOUBLE        -      5.5?
collision_detection_ratio                DOUBLE        -      5.15?
ft_raw_wrench                            VECTOR6D      -      5.9
wrench_calc_from_currents                VECTOR6D      -      5.15?
payload                                  DOUBLE        3.11   5.5.1
payload_cog                              VECTOR3D      3.11   5.5.1
payload_inertia                          VECTOR6D      3.15   5.11
script_control_line                      UINT32        3.14?  5.9?
time_scale_source                        INT32         -      5.17?
actual_robot_energy_consumed             DOUBLE        -      5.15?
actual_robot_braking_energy_dissipated   DOUBLE        -      5.15?
encoder0_raw                             INT32         -      5.15?
encoder1_raw                             INT32         -      5.15?
target_gravity                           VECTOR3D      -      5.23?
target_base_acceleration                 VECTOR6D      -      5.23?
target_base_wrench                       VECTOR6D      -      5.26?
control_step                             UINT64        -      5.26
output_bit_registers0_to_31              UINT32        3.4    5.0
output_bit_registers32_to_63             UINT32        3.4    5.0
output_bit_register_64..127              BOOL          3.9    5.3
output_int_register_0..23                INT32         3.4    5.0
output_int_register_24..47               INT32         3.9    5.3
output_double_register_0..23             DOUBLE        3.4    5.0
output_double_register_24..47            DOUBLE        3.9    5.3
"""
)


def output_types(profile: ControllerProfile) -> dict[str, DataType]:
    """Return the types of the variables that clients of this controller can read."""
    return dict(_of_version(_OUTPUTS, profile.version))


def input_types(profile: ControllerProfile) -> dict[str, DataType]:
    """Return the types of the variables that clients of this controller can write."""
    return dict(_of_version(_INPUTS, profile.version))


def zero_values(profile: ControllerProfile) -> dict[str, Value]:
    """Return a zero for every readable variable that is no register."""
    registers = Registers()
    return {name: kind.zero for name, kind in output_types(profile).items() if registers.find(name) is None}


@cache
def _rows(table: str) -> tuple[tuple[str, DataType, Version | None, Version | None], ...]:
    """Return name, type and versions of every variable in a table."""
    rows = []
    for line in filter(None, table.splitlines()):
        names, kind, cb3, e_series = line.split()
        rows += [(name, TYPES[kind], _version(cb3), _version(e_series)) for name in _names(names)]
    return tuple(rows)


def _names(text: str) -> list[str]:
    match = re.fullmatch(r"(.*_)(\d+)\.\.(\d+)", text)
    if match is None:
        return [text]
    prefix, first, last = match.groups()
    return [f"{prefix}{number}" for number in range(int(first), int(last) + 1)]


def _version(text: str) -> Version | None:
    return None if text == "-" else tuple(map(int, text.rstrip("?").split(".")))


@cache
def _of_version(table: str, version: Version) -> dict[str, DataType]:
    found = {}
    for name, kind, cb3, e_series in _rows(table):
        since = e_series if version[0] >= _E_SERIES else cb3
        if since is not None and version >= since:
            found[name] = kind
    return found
