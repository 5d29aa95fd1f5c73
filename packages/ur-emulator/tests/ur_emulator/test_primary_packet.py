import dataclasses
import pickle
import struct

import pytest

from ur_core.errors import ScriptNameError, ScriptRuntimeError, SettingsError
from ur_core.kinematics.ur10 import DH_A_M, NOMINAL_DH
from ur_core.protocol import primary_messages as messages
from ur_core.protocol.modes import RobotMode, RuntimeState, SafetyBits, SafetyMode
from ur_core.protocol.primary_packet import NAMES, PrimaryPacket, kinematics_checksums
from ur_emulator.profile import PROFILES

CB3, E_SERIES = PROFILES["cb3"], PROFILES["e-series"]

VALUES = {
    "timestamp": 12.5,
    "robot_mode": RobotMode.RUNNING,
    "safety_mode": SafetyMode.NORMAL,
    "safety_status_bits": int(SafetyBits.NORMAL),
    "runtime_state": RuntimeState.STOPPED,
    "target_speed_fraction": 0.75,
    "speed_scaling": 0.5,
    "actual_q": (0.1, 0.2, 0.3, 0.4, 0.5, 0.6),
    "target_q": (1.1, 1.2, 1.3, 1.4, 1.5, 1.6),
    "actual_qd": (2.1, 2.2, 2.3, 2.4, 2.5, 2.6),
    "actual_current": (1.0, 2.0, 3.0, 4.0, 5.0, 6.0),
    "actual_joint_voltage": (48.0, 47.0, 46.0, 45.0, 44.0, 43.0),
    "joint_temperatures": (25.0, 26.0, 27.0, 28.0, 29.0, 30.0),
    "joint_mode": (253, 253, 253, 253, 253, 247),
    "actual_TCP_pose": (-0.1, -0.2, 0.3, 0.01, 0.02, 0.03),
    "actual_TCP_force": (1.0, -2.0, 3.0, -4.0, 5.0, -6.0),
    "tcp_offset": (0.0, 0.0, 0.15, 0.0, 0.0, 0.1),
    "elbow_position": (0.7, 0.8, 0.9),
    "actual_digital_input_bits": 0x2_0101,
    "actual_digital_output_bits": 0x1_8003,
    "analog_io_types": 0b1001,
    "standard_analog_input0": 1.25,
    "standard_analog_input1": 2.25,
    "standard_analog_output0": 3.25,
    "standard_analog_output1": 4.25,
    "actual_robot_voltage": 48.0,
    "actual_robot_current": 1.5,
    "io_current": 0.25,
    "tool_analog_input_types": 0b10,
    "tool_analog_input0": 5.25,
    "tool_analog_input1": 6.25,
    "tool_output_voltage": 24,
    "tool_output_current": 0.5,
    "tool_temperature": 30.5,
    "tool_mode": 253,
}


def split(packet: bytes) -> dict[int, bytes]:
    """Return the sub-packages of a robot state by type, with headers, as a client finds them."""
    size, kind = struct.unpack_from(">iB", packet)
    assert (size, kind) == (len(packet), 16)
    found, at = {}, 5
    while at < size:
        length, kind = struct.unpack_from(">iB", packet, at)
        assert length >= 5
        assert kind not in found
        found[kind] = packet[at : at + length]
        at += length
    assert at == size
    return found


def state(profile=E_SERIES, kinematics=NOMINAL_DH, **changes) -> dict[int, bytes]:
    return split(PrimaryPacket(profile, kinematics).state({**VALUES, **changes}))


def test_sizes_of_an_e_series():
    # Sizes of a packet recorded from URSim 5.8.
    sizes = {0: 47, 1: 251, 4: 101, 5: 225, 9: 53, 3: 75, 2: 37, 6: 445, 7: 61, 8: 9, 10: 43, 11: 26, 12: 8}
    found = state()
    assert {kind: len(part) for kind, part in found.items()} == sizes
    assert list(found) == list(sizes)
    assert len(PrimaryPacket(E_SERIES, NOMINAL_DH).state(VALUES)) == 1386


def test_sizes_of_a_cb3():
    # Clients of a CB3 recognise the robot mode by the size 46.
    sizes = {0: 46, 1: 251, 4: 101, 5: 225, 9: 53, 3: 72, 2: 37, 6: 445, 7: 61, 8: 8, 10: 43}
    assert {kind: len(part) for kind, part in state(CB3).items()} == sizes


def test_every_name_is_needed_and_no_other():
    packet = PrimaryPacket(E_SERIES, NOMINAL_DH)
    assert set(NAMES) == set(VALUES)
    for name in NAMES:
        with pytest.raises(KeyError, match=name):
            packet.state({key: value for key, value in VALUES.items() if key != name})


@pytest.mark.parametrize("profile", [CB3, E_SERIES])
def test_robot_mode(profile):
    part = state(profile)[0]
    assert struct.unpack_from(">Q", part, 5) == (12_500_000,)
    assert list(part[13:22]) == [1, 1, 1, 0, 0, 0, 0, RobotMode.RUNNING, 0]
    assert struct.unpack_from(">ddd", part, 22) == (0.75, 0.5, 1.0)


@pytest.mark.parametrize(
    ("changes", "flags"),
    [
        ({"robot_mode": RobotMode.POWER_OFF}, {15: 0, 20: 3}),
        ({"robot_mode": RobotMode.IDLE}, {15: 1, 20: 5}),
        ({"robot_mode": RobotMode.NO_CONTROLLER}, {15: 0, 20: 255}),
        ({"safety_status_bits": SafetyBits.PROTECTIVE_STOPPED}, {16: 0, 17: 1}),
        ({"safety_status_bits": SafetyBits.ROBOT_EMERGENCY_STOPPED}, {16: 1, 17: 0}),
        ({"safety_status_bits": SafetyBits.SYSTEM_EMERGENCY_STOPPED}, {16: 1}),
        ({"safety_status_bits": int(SafetyBits.EMERGENCY_STOPPED)}, {16: 1}),
        ({"runtime_state": RuntimeState.PLAYING}, {18: 1, 19: 0}),
        ({"runtime_state": RuntimeState.RESUMING}, {18: 1, 19: 0}),
        ({"runtime_state": RuntimeState.PAUSED}, {18: 0, 19: 1}),
        ({"runtime_state": RuntimeState.PAUSING}, {18: 0, 19: 1}),
        ({"control_mode": 2}, {21: 2}),
    ],
)
def test_flags_of_the_robot_mode(changes, flags):
    part = state(**changes)[0]
    assert {offset: part[offset] for offset in flags} == flags


def test_joints():
    part = state()[1]
    for i in range(6):
        *numbers, mode = struct.unpack_from(">dddffffB", part, 5 + 41 * i)
        names = ("actual_q", "target_q", "actual_qd", "actual_current", "actual_joint_voltage", "joint_temperatures")
        assert numbers == [VALUES[name][i] for name in (*names, "joint_temperatures")]
        assert mode == VALUES["joint_mode"][i]


def test_pose_force_and_elbow():
    found = state()
    expected = VALUES["actual_TCP_pose"] + VALUES["tcp_offset"]
    assert struct.unpack_from(">12d", found[4], 5) == expected
    assert struct.unpack_from(">6d", found[7], 5) == VALUES["actual_TCP_force"]
    assert struct.unpack_from(">3d", found[10], 11) == VALUES["elbow_position"]


@pytest.mark.parametrize("profile", [CB3, E_SERIES])
def test_masterboard(profile):
    part = state(profile, safety_mode=SafetyMode.REDUCED, safety_status_bits=SafetyBits.REDUCED)[3]
    assert struct.unpack_from(">IIBB", part, 5) == (0x2_0101, 0x1_8003, 1, 0)
    assert struct.unpack_from(">ddBBdd", part, 15) == (1.25, 2.25, 0, 1, 3.25, 4.25)
    assert struct.unpack_from(">fff", part, 53) == (48.0, 1.5, 0.25)
    assert list(part[65:68]) == [SafetyMode.REDUCED, 1, 0]


@pytest.mark.parametrize("types", [0, 1, 2, 4, 8, 0b0110, 15])
def test_ranges_of_analogue_signals(types):
    found = state(analog_io_types=types, tool_analog_input_types=types & 3)
    bits = [types >> i & 1 for i in range(4)]
    assert [*found[3][13:15], *found[3][31:33]] == bits
    assert list(found[2][5:7]) == bits[:2]
    assert found[3][66] == 0  # reduced mode


def test_tool_and_freedrive():
    found = state(freedrive_pressed=True)
    fields = (0, 1, 5.25, 6.25, 48.0, 24, 0.5, 30.5, 253)
    assert struct.unpack_from(">BBddfBffB", found[2], 5) == fields
    assert struct.unpack_from(">iiiff", found[11], 6) == (115200, 0, 1, 1.5, 3.5)
    assert list(found[8][5:]) == [1, 1, 0, 1]
    assert list(state(CB3)[8][5:]) == [0, 1, 0]


def test_kinematics_and_configuration():
    calibrated = dataclasses.replace(
        NOMINAL_DH, a_m=(0.0, *(DH_A_M[1:] + 1e-4).tolist()), theta_rad=(0.0, 1e-3, 0.0, 0.0, 0.0, 0.0)
    )
    found = state(kinematics=calibrated)
    *sums, status = struct.unpack_from(">6I192xI", found[5], 5)
    assert tuple(sums) == kinematics_checksums(calibrated)
    assert status != 0
    rows = calibrated.theta_rad, calibrated.a_m, calibrated.d_m, calibrated.alpha_rad
    assert struct.unpack_from(">24d", found[5], 29) == sum(rows, ())
    configuration = struct.unpack_from(">53d4I", found[6], 5)
    assert configuration[:2] == pytest.approx((-6.2832, 6.2832), abs=1e-4)
    assert configuration[4:6] == pytest.approx((-3.1416, 3.1416), abs=1e-4)
    assert configuration[12] == pytest.approx(2.0944, abs=1e-4)
    assert configuration[24:28] == (1.05, 1.4, 0.25, 1.2)
    assert configuration[29:53] == calibrated.a_m + calibrated.d_m + calibrated.alpha_rad + calibrated.theta_rad
    assert configuration[55] == 2
    (nominal_status,) = struct.unpack_from(">I", state()[5], 221)
    assert nominal_status == 0


def test_checksums_distinguish_calibrations():
    nominal = kinematics_checksums(NOMINAL_DH)
    assert kinematics_checksums(NOMINAL_DH) == nominal
    for i in range(6):
        for name in ("a_m", "d_m", "alpha_rad", "theta_rad"):
            row = list(getattr(NOMINAL_DH, name))
            row[i] += 1e-9
            other = kinematics_checksums(dataclasses.replace(NOMINAL_DH, **{name: tuple(row)}))
            assert [k for k in range(6) if other[k] != nominal[k]] == [i]
    negative_zero = dataclasses.replace(NOMINAL_DH, theta_rad=(-0.0,) * 6)
    assert kinematics_checksums(negative_zero) == nominal
    assert all(0 <= value < 2**32 for value in nominal)


def opened(packet: bytes) -> tuple[int, int, int, bytes]:
    """Return timestamp in µs, source, kind and fields of a robot message."""
    size, package, timestamp, source, kind = struct.unpack_from(">iBQbB", packet)
    assert (size, package) == (len(packet), 20)
    return timestamp, source, kind, packet[15:]


@pytest.mark.parametrize("profile", [CB3, E_SERIES])
def test_version_message(profile):
    packet = PrimaryPacket(profile, NOMINAL_DH).version_message()
    timestamp, source, kind, body = opened(packet)
    assert (timestamp, source, kind) == (0, -2, 3)
    assert body[:10] == b"\x09URControl"
    assert struct.unpack_from(">BBii", body, 10) == profile.version
    assert body[20:].decode() == profile.released


def test_text_and_key_messages():
    assert opened(messages.text_message(1.5, "hällo")) == (1_500_000, -3, 0, "hällo".encode())
    _, _, kind, body = opened(messages.key_message(0.0, "PROGRAM_XXX_STARTED", "mine", code=3, argument=4))
    assert kind == 7
    assert body == struct.pack(">iiB", 3, 4, 19) + b"PROGRAM_XXX_STARTEDmine"


def test_runtime_exception():
    packet = messages.runtime_exception_message(2.0, 3, 1, "compile_error_name_not_found:txtmsg:")
    assert opened(packet) == (2_000_000, -3, 10, b"\0\0\0\3\0\0\0\1compile_error_name_not_found:txtmsg:")
    for error, text in (
        (ScriptRuntimeError(7, "movej", "six joints needed", 3), b"six joints needed: movej"),
        (ScriptNameError(7, "txtmsg", "there is no such function", 3), b"compile_error_name_not_found:txtmsg:"),
    ):
        _, _, kind, body = opened(messages.script_error_message(2.0, error))
        assert (kind, body) == (10, b"\0\0\0\7\0\0\0\3" + text)
        assert pickle.loads(pickle.dumps(error)).column == 3


def test_error_codes_and_safety_modes():
    _, source, kind, body = opened(messages.error_code_message(0.0, "C153A0", "Position deviates from path"))
    assert (source, kind) == (-2, 6)
    assert struct.unpack_from(">iiiII", body) == (153, 0, 3, 0, 0)
    assert body[20:] == b"Position deviates from path"
    _, _, kind, body = opened(messages.safety_mode_message(0.0, SafetyMode.PROTECTIVE_STOP, "C204A1"))
    assert kind == 5
    assert struct.unpack(">iiBII", body) == (204, 1, 3, 0, 0)
    assert messages.split_code("C50") == (50, 0)
    for code in ("153", "C", "CA1", "C1A", "C1A2x", "C-1A0", "C9999999999A0"):
        with pytest.raises(SettingsError, match="C153A0"):
            messages.error_code_message(0.0, code)


def test_popup():
    _, _, kind, body = opened(messages.popup_message(0.0, "Title", "Text", error=True, request=5))
    assert kind == 2
    assert struct.unpack_from(">IB???B", body) == (5, 0, False, True, False, 5)
    assert body[9:] == b"TitleText"
    long = opened(messages.popup_message(0.0, "x" * 300, "Text"))[3]
    assert long[8:] == b"\xff" + b"x" * 255 + b"Text"
    assert opened(messages.popup_message(0.0, "", ""))[3] == bytes(9)
