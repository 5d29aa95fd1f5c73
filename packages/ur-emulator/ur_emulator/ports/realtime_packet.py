"""Packet of the real-time interface (ports 30003 and 30013), sent every control period.

An INT32 with the packet's length, then doubles, all big-endian. Fields and their order: the table of UR's article
"Remote control via TCP/IP". Later versions only append.
"""

from __future__ import annotations

import struct
from collections.abc import Mapping
from typing import Any, Final, NamedTuple

from ur_emulator.profile import ControllerProfile


class RealtimeField(NamedTuple):
    """Doubles of the packet.

    Attributes:
        offset: First byte.
        doubles: Number of doubles.
        name: RTDE output variable; "" for undocumented fields, which are sent as zeros.
    """

    offset: int
    doubles: int
    name: str


FIELDS: Final = (
    RealtimeField(4, 1, "timestamp"),
    RealtimeField(12, 6, "target_q"),
    RealtimeField(60, 6, "target_qd"),
    RealtimeField(108, 6, "target_qdd"),
    RealtimeField(156, 6, "target_current"),
    RealtimeField(204, 6, "target_moment"),
    RealtimeField(252, 6, "actual_q"),
    RealtimeField(300, 6, "actual_qd"),
    RealtimeField(348, 6, "actual_current"),
    RealtimeField(396, 6, "joint_control_output"),
    RealtimeField(444, 6, "actual_TCP_pose"),
    RealtimeField(492, 6, "actual_TCP_speed"),
    RealtimeField(540, 6, "actual_TCP_force"),
    RealtimeField(588, 6, "target_TCP_pose"),
    RealtimeField(636, 6, "target_TCP_speed"),
    RealtimeField(684, 1, "actual_digital_input_bits"),
    RealtimeField(692, 6, "joint_temperatures"),
    RealtimeField(740, 1, "actual_execution_time"),
    RealtimeField(748, 1, ""),
    RealtimeField(756, 1, "robot_mode"),
    RealtimeField(764, 6, "joint_mode"),
    RealtimeField(812, 1, "safety_mode"),
    RealtimeField(820, 6, ""),
    RealtimeField(868, 3, "actual_tool_accelerometer"),
    RealtimeField(892, 6, ""),
    RealtimeField(940, 1, "speed_scaling"),
    RealtimeField(948, 1, "actual_momentum"),
    RealtimeField(956, 2, ""),
    RealtimeField(972, 1, "actual_main_voltage"),
    RealtimeField(980, 1, "actual_robot_voltage"),
    RealtimeField(988, 1, "actual_robot_current"),
    RealtimeField(996, 6, "actual_joint_voltage"),
    RealtimeField(1044, 1, "actual_digital_output_bits"),
    RealtimeField(1052, 1, "runtime_state"),
    RealtimeField(1060, 3, "elbow_position"),
    RealtimeField(1084, 3, "elbow_velocity"),
    RealtimeField(1108, 1, "safety_status"),
    RealtimeField(1116, 3, ""),
    RealtimeField(1140, 1, "payload"),
    RealtimeField(1148, 3, "payload_cog"),
    RealtimeField(1172, 6, "payload_inertia"),
)

LENGTHS: Final = (
    # Length, first PolyScope 5 and first PolyScope 3 that has it. Assumption: the versions of PolyScope 3 before
    # 3.15, which no document at hand gives.
    (1220, (5, 10), (3, 15)),
    (1140, (5, 9), (3, 14)),
    (1116, (5, 4), (3, 10)),
    (1108, (5, 0), (3, 5)),
    (1060, None, (3, 2)),
    (1044, None, (3, 0)),
)
"""Length of the packet by version, bytes, newest first."""


_ZEROS: Final = {count: (0.0,) * count for count in range(1, 7)}


class RealtimePacket:
    """Encoder of the packet of one controller.

    Args:
        profile: Profile of the controller.

    Attributes:
        length: Length of the packet, bytes.
        names: RTDE output variables that `pack` reads.
    """

    def __init__(self, profile: ControllerProfile) -> None:
        self.length = packet_length(profile)
        fields = [field for field in FIELDS if field.offset < self.length]
        self.names = tuple(field.name for field in fields if field.name)
        self._fields = tuple((field.name, field.doubles) for field in fields)
        self._struct = struct.Struct(f">i{(self.length - 4) // 8}d")

    def pack(self, values: Mapping[str, Any]) -> bytes:
        """Encode the packet.

        Args:
            values: Values by name of the RTDE output variable: a number, or a tuple of the field's length.

        Raises:
            KeyError: A name of `names` is missing.
            struct.error: A value has the wrong length.
        """
        numbers: list[float] = []
        for name, count in self._fields:
            if count > 1:
                numbers += values[name] if name else _ZEROS[count]
            else:
                numbers.append(values[name] if name else 0.0)
        return self._struct.pack(self.length, *numbers)


def packet_length(profile: ControllerProfile) -> int:
    """Return the length of the packet of one controller, bytes."""
    never = (99, 0)
    return next((length for length, e, cb3 in LENGTHS if profile.at_least(e or never, cb3)), LENGTHS[-1][0])
