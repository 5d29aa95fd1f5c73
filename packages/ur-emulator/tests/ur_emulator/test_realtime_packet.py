import dataclasses
import struct

import pytest

from ur_emulator.ports.realtime_packet import FIELDS, LENGTHS, RealtimePacket, packet_length
from ur_emulator.profile import PROFILES


def numbered() -> dict[str, float | tuple[float, ...]]:
    """Return values that are all different."""
    values: dict[str, float | tuple[float, ...]] = {}
    for i, field in enumerate(FIELDS):
        numbers = tuple(100.0 * i + k + 0.5 for k in range(field.doubles))
        values[field.name] = numbers if field.doubles > 1 else numbers[0]
    return values


def doubles(packet: bytes, offset: int, count: int) -> tuple[float, ...]:
    return struct.unpack_from(f">{count}d", packet, offset)


@pytest.mark.parametrize("family", PROFILES)
def test_packet_of_the_tested_profiles(family):
    packer, values = RealtimePacket(PROFILES[family]), numbered()
    packet = packer.pack(values)
    assert len(packet) == packer.length == struct.unpack(">i", packet[:4])[0] == 1220
    # Offsets as clients have them, not from the table under test.
    for offset, name in (
        (4, "timestamp"),
        (12, "target_q"),
        (60, "target_qd"),
        (108, "target_qdd"),
        (252, "actual_q"),
        (300, "actual_qd"),
        (396, "joint_control_output"),
        (444, "actual_TCP_pose"),
        (492, "actual_TCP_speed"),
        (540, "actual_TCP_force"),
        (588, "target_TCP_pose"),
        (684, "actual_digital_input_bits"),
        (692, "joint_temperatures"),
        (756, "robot_mode"),
        (764, "joint_mode"),
        (812, "safety_mode"),
        (868, "actual_tool_accelerometer"),
        (940, "speed_scaling"),
        (972, "actual_main_voltage"),
        (996, "actual_joint_voltage"),
        (1044, "actual_digital_output_bits"),
        (1052, "runtime_state"),
        (1060, "elbow_position"),
        (1108, "safety_status"),
        (1140, "payload"),
        (1148, "payload_cog"),
        (1172, "payload_inertia"),
    ):
        value = values[name]
        expected = value if isinstance(value, tuple) else (value,)
        assert doubles(packet, offset, len(expected)) == expected, name
    for offset, count in ((748, 1), (820, 6), (892, 6), (956, 2), (1116, 3)):
        assert doubles(packet, offset, count) == (0.0,) * count


def test_fields_lie_side_by_side():
    end = 4
    for field in FIELDS:
        assert field.offset == end, field
        end += 8 * field.doubles
    assert end == 1220


@pytest.mark.parametrize(
    ("version", "length"),
    [
        ((3, 0), 1044),
        ((3, 1), 1044),
        ((3, 2), 1060),
        ((3, 4), 1060),
        ((3, 5), 1108),
        ((3, 9), 1108),
        ((3, 10), 1116),
        ((3, 13), 1116),
        ((3, 14), 1140),
        ((3, 15), 1220),
        ((5, 0), 1108),
        ((5, 3), 1108),
        ((5, 4), 1116),
        ((5, 8), 1116),
        ((5, 9), 1140),
        ((5, 10), 1220),
        ((5, 23), 1220),
    ],
)
def test_lengths_by_version(version, length):
    profile = dataclasses.replace(PROFILES["cb3" if version[0] == 3 else "e-series"], version=(*version, 0, 1))
    assert packet_length(profile) == length
    packer = RealtimePacket(profile)
    whole = RealtimePacket(PROFILES["cb3"]).pack(numbered())
    packet = packer.pack({name: numbered()[name] for name in packer.names})
    assert len(packet) == length
    assert packet[4:] == whole[4:length]


def test_lengths_end_where_fields_end():
    ends = {field.offset for field in FIELDS} | {1220}
    assert {length for length, _, _ in LENGTHS} <= ends


def test_a_missing_or_misshapen_value_is_refused():
    packer, values = RealtimePacket(PROFILES["cb3"]), numbered()
    with pytest.raises(KeyError, match="payload_cog"):
        packer.pack({name: value for name, value in values.items() if name != "payload_cog"})
    with pytest.raises(struct.error):
        packer.pack({**values, "actual_q": (0.0,) * 5})
