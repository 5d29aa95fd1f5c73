import math
import struct
from dataclasses import replace

import pytest

from tests.ur_emulator.rtde_bytes import RECEIVED, SERVOJ, VERSION_2, RtdeBench, data, inputs, message, outputs
from ur_core.errors import ClosedError, ProtocolError, SettingsError
from ur_core.protocol.rtde import TextKind
from ur_emulator.controller.registers import Registers
from ur_emulator.controller.rtde_variables import zero_values
from ur_emulator.ports.rtde_session import RtdePort
from ur_emulator.profile import profile_of

START = b"\x00\x03S"
PAUSE = b"\x00\x03P"


@pytest.fixture
def controller():
    return RtdeBench()


@pytest.fixture
def session(controller):
    return controller.session()


# What goes over the wire, byte for byte.


@pytest.mark.parametrize(("asked", "answer"), [(1, 1), (2, 1), (0, 0), (3, 0), (0xFFFF, 0)])
def test_versions_1_and_2_are_accepted(asked, answer):
    session = RtdeBench().port.open()
    assert session.receive(b"\x00\x05V" + struct.pack(">H", asked)) == b"\x00\x04V" + bytes([answer])
    assert session.version == (asked if answer else 1)


def test_a_refused_version_leaves_the_one_before(session):
    session.receive(b"\x00\x05V\x00\x03")
    assert session.version == 2


@pytest.mark.parametrize(
    ("family", "answer"),
    [
        ("cb3", "0013 76 00000003 0000000f 00000008 00019f63"),
        ("e-series", "0013 76 00000005 0000000c 00000005 0000044d"),
    ],
)
def test_the_controller_reports_its_version(family, answer):
    assert RtdeBench(family).port.open().receive(b"\x00\x03v") == bytes.fromhex(answer)


@pytest.mark.parametrize("names", [b"timestamp,actual_q", b"timestamp,actual_q,"])
def test_output_setup(names):
    request = b"\x00" + bytes([11 + len(names)]) + b"O\x40\x5f\x40\x00\x00\x00\x00\x00" + names
    assert RtdeBench().session().receive(request) == b"\x00\x13O\x01DOUBLE,VECTOR6D"


def test_unknown_outputs_are_named_and_prevent_a_start(session):
    assert session.receive(outputs(["timestamp", "nothing", "robot_mode"])) == b"\x00\x1aO\x00DOUBLE,NOT_FOUND,INT32"
    assert session.receive(START) == b"\x00\x04S\x00"
    assert not session.started
    assert session.publish(0) == b""


def test_variables_of_later_versions_are_not_found():
    controller = RtdeBench("cb3")
    assert b"NOT_FOUND" in controller.session().receive(outputs(["ft_raw_wrench"]))
    assert b"NOT_FOUND" not in RtdeBench("e-series").session().receive(outputs(["ft_raw_wrench"]))


def test_input_setup_numbers_recipes_from_1(session):
    assert session.receive(b"\x00\x18Iinput_int_register_0,") == b"\x00\x09I\x01INT32"
    assert session.receive(inputs(["input_double_register_0"])) == b"\x00\x0aI\x02DOUBLE"
    both = session.receive(inputs(["input_int_register_0", "input_double_register_0"]))
    assert both == b"\x00\x10I\x03INT32,DOUBLE"


def test_unknown_inputs_claim_neither_number_nor_variable(controller):
    session = controller.session()
    assert session.receive(inputs(["input_int_register_0", "actual_q"])) == b"\x00\x13I\x00INT32,NOT_FOUND"
    assert controller.port.owners == {}
    assert session.receive(inputs(["input_int_register_0"]))[3] == 1


def test_inputs_in_use_by_another_connection(controller):
    first, second = controller.session(), controller.session()
    first.receive(inputs(["input_int_register_0"]))
    answer = second.receive(inputs(["input_int_register_1", "input_int_register_0"]))
    assert answer == b"\x00\x10I\x00INT32,IN_USE"
    assert b"IN_USE" not in first.receive(inputs(["input_int_register_1"]))  # the refused recipe claimed nothing
    assert b"IN_USE" not in second.receive(inputs(["speed_slider_mask"]))
    assert b"IN_USE" in first.receive(inputs(["speed_slider_mask"]))


def test_inputs_are_released_with_their_connection(controller):
    first, second = controller.session(inputs(["input_int_register_0"])), controller.session()
    second.receive(inputs(["input_int_register_1"]))
    first.close()
    first.close()
    assert controller.port.owners == {"input_int_register_1": second}
    assert second.receive(inputs(["input_int_register_0"])) == b"\x00\x09I\x02INT32"


def test_one_connection_may_list_a_register_in_many_recipes(session):
    numbers = [session.receive(inputs(["input_int_register_0"]))[3] for _ in range(255)]
    assert numbers == list(range(1, 256))
    with pytest.raises(ProtocolError, match="255"):
        session.receive(inputs(["input_int_register_0"]))


def test_the_input_recipes_of_a_connection_have_a_bounded_number_of_variables(controller):
    session = controller.session(*[inputs(["input_int_register_0"] * 1024)] * 4)
    with pytest.raises(ProtocolError, match="more than 4096 variables"):
        session.receive(inputs(["input_int_register_0"]))
    assert controller.port.owners == {}


def test_start_pause_and_start_again():
    session = RtdeBench().session(outputs(["robot_mode"]))
    assert session.publish(0) == b""
    assert session.receive(START) == b"\x00\x04S\x01"
    assert session.publish(1) == b"\x00\x08U\x01\x00\x00\x00\x00"
    assert session.receive(PAUSE) == b"\x00\x04P\x01"
    assert session.publish(2) == b""
    session.receive(START)
    assert session.publish(3) != b""
    assert session.published == 2


def test_start_is_refused_without_outputs():
    assert RtdeBench().session(inputs(["input_int_register_0"])).receive(START) == b"\x00\x04S\x00"


def test_an_empty_output_recipe_is_refused(session):
    assert session.receive(outputs([])) == b"\x00\x04O\x00"
    assert session.receive(START) == b"\x00\x04S\x00"
    assert session.receive(inputs([])) == b"\x00\x04I\x00"


def test_text_messages_go_to_started_sessions_only():
    session = RtdeBench().session(outputs(["robot_mode"]))
    assert session.text("halt", "arm", TextKind.ERROR) == b""
    session.receive(START)
    assert session.text("halt", "arm", TextKind.ERROR) == b"\x00\x0dM\x04halt\x03arm\x01"
    session.receive(PAUSE)
    assert session.text("halt") == b""


# Version 1.


def test_version_1_has_no_frequency_and_output_recipe_number():
    controller = RtdeBench("cb3")
    session = controller.port.open()
    assert session.receive(message("O", b"timestamp,robot_mode")) == b"\x00\x0fODOUBLE,INT32"
    assert session.receive(START) == b"\x00\x04S\x01"
    controller.values["robot_mode"] = 7
    assert session.publish(0) == b"\x00\x0fU" + struct.pack(">di", 0.0, 7)
    assert session.text("halt", "arm", TextKind.WARNING) == b"\x00\x08M\x02halt"


def test_version_1_has_numbers_of_input_recipes(controller):
    session = controller.port.open()
    assert session.receive(inputs(["input_int_register_5"])) == b"\x00\x09I\x01INT32"
    session.receive(data(1, "i", 4))
    assert controller.registers.input_int[5] == 4


def test_packages_follow_a_change_of_version():
    session = RtdeBench().port.open()
    session.receive(message("O", b"robot_mode") + START)
    assert session.publish(0) == b"\x00\x07U\x00\x00\x00\x00"
    session.receive(VERSION_2)
    assert session.publish(1) == b"\x00\x08U\x01\x00\x00\x00\x00"


def test_requests_of_a_version_prepare_no_recipe():
    """A recipe of a thousand variables takes milliseconds, and one read holds a thousand requests."""
    session = RtdeBench().session(outputs(["robot_mode"] * 1000), START)
    before = session._outputs
    session.receive(b"\0\5V\0\1\0\5V\0\2" * 800 + b"\0\5V\0\1")
    assert session._outputs is before
    assert len(session.publish(0)) == 3 + 4 * 1000
    assert session._outputs is not before


# Data to the client.


def test_connections_with_one_recipe_share_its_package(controller):
    sessions = [controller.session(outputs(names), START) for names in (RECEIVED, RECEIVED, [*RECEIVED, "payload"])]
    controller.values["robot_mode"] = 7
    packages = {}
    first, second, other = (each.publish(0, packages) for each in sessions)
    assert first == second == sessions[0]._outputs.package()
    assert second is first
    assert len(other) > len(first)
    assert len(packages) == 2


def test_a_package_holds_values_in_the_requested_order(controller):
    session = controller.session(
        outputs([*RECEIVED, "payload_cog", "output_int_register_2", "output_double_register_12"])
    )
    session.receive(START)
    controller.values.update(
        timestamp=12.5,
        actual_q=(1.0, 2.0, 3.0, 4.0, 5.0, 6.0),
        robot_mode=-1,
        joint_mode=(253, 253, 253, 253, 253, 247),
        actual_tool_accelerometer=(7.0, 8.0, 9.0),
        actual_digital_output_bits=1 << 63,
        safety_status_bits=1,
        payload_cog=(0.1, 0.2, 0.3),
    )
    controller.registers.output_int[2] = -5
    controller.registers.output_double[12] = 0.5
    package = session.publish(0)
    assert len(package) == 4 + 948 + 24 + 4 + 8
    assert struct.unpack(">HBB", package[:4]) == (len(package), 85, 1)

    def at(offset, layout):
        return struct.unpack_from(">" + layout, package, 4 + offset)

    # Offsets counted from the types: 1 double, 5 vectors, then actual_q.
    assert at(0, "d") == (12.5,)
    assert at(248, "6d") == (1, 2, 3, 4, 5, 6)
    assert at(680, "Q") == (0,)
    assert at(744, "i") == (-1,)
    assert at(748, "6i") == (253, 253, 253, 253, 253, 247)
    assert at(776, "3d") == (7, 8, 9)
    assert at(896, "Q") == (1 << 63,)
    assert at(944, "I") == (1,)
    assert at(948, "3d") == (0.1, 0.2, 0.3)
    assert at(972, "id") == (-5, 0.5)


@pytest.mark.parametrize(
    ("family", "frequency_hz", "divider"),
    [
        ("cb3", 125.0, 1),
        ("cb3", 500.0, 1),
        ("cb3", 62.5, 2),
        ("cb3", 50.0, 2),
        ("cb3", 10.0, 12),
        ("e-series", 500.0, 1),
        ("e-series", 125.0, 4),
        ("e-series", 1.0, 500),
        ("e-series", 0.0, 1),
        ("e-series", -5.0, 1),
        ("e-series", math.nan, 1),
        ("e-series", math.inf, 1),
        ("e-series", -math.inf, 1),
        ("e-series", 5e-324, 10**9),
    ],
)
def test_frequencies_are_whole_parts_of_the_rate(family, frequency_hz, divider):
    session = RtdeBench(family).session(outputs(["timestamp"], frequency_hz), START)
    assert session.divider == divider
    due = [tick for tick in range(1000, 1100) if session.publish(tick)]
    assert due == list(range(1000, 1100, divider))


def test_skipped_or_restarted_ticks_keep_the_stream():
    session = RtdeBench().session(outputs(["timestamp"], 125.0), START)
    ticks = [10, 11, 14, 15, 30, 31, 34, 35, 2, 3, 6]
    assert [tick for tick in ticks if session.publish(tick)] == [10, 14, 30, 34, 2, 6]


def test_a_new_output_setup_replaces_the_previous_one():
    session = RtdeBench().session(outputs(["timestamp"]), START, outputs(["robot_mode"]))
    assert session.started
    assert len(session.publish(0)) == 8
    session.receive(outputs(["nothing"]))
    assert not session.started
    assert session.receive(START) == b"\x00\x04S\x00"


def test_sessions_have_their_own_recipes(controller):
    one = controller.session(outputs(["timestamp"]), START)
    other = controller.session(outputs(["robot_mode"]), START)
    assert (len(one.publish(0)), len(other.publish(0))) == (12, 8)


# Data from the client.


def test_inputs_take_effect_at_once_without_start(controller):
    session = controller.session(inputs(SERVOJ))
    assert session.receive(data(1, "i11d", 11, *range(11))) == b""
    assert controller.registers.input_int[0] == 11
    assert controller.registers.input_double[:11] == list(range(11))
    assert controller.registers.writes == dict.fromkeys(SERVOJ, 1)
    assert session.data_packages == 1
    assert controller.forwarded == []


def test_of_two_packages_at_once_the_last_wins(controller):
    session = controller.session(inputs(["input_int_register_0"]))
    session.receive(data(1, "i", 1) + data(1, "i", 2))
    assert controller.registers.input_int[0] == 2
    assert controller.registers.writes["input_int_register_0"] == 2


def test_other_inputs_are_handed_on(controller):
    names = ["input_int_register_23", "standard_digital_output_mask", "standard_digital_output"]
    controller.session(inputs(names)).receive(data(1, "iBB", 5, 4, 255))
    assert controller.forwarded == [{"standard_digital_output_mask": 4, "standard_digital_output": 255}]
    assert controller.registers.input_int[23] == 5


def test_short_and_long_packages_are_applied_partly(controller):
    session = controller.session(inputs(["input_int_register_0", "input_double_register_0"]))
    session.receive(data(1, "i", 1))
    assert (session.short_packages, session.long_packages) == (1, 0)
    assert controller.registers.input_int[0] == 1
    session.receive(data(1, "id6d", 2, 2.5, *[9.0] * 6))
    assert (session.short_packages, session.long_packages) == (1, 1)
    assert (controller.registers.input_int[0], controller.registers.input_double[0]) == (2, 2.5)
    session.receive(data(1, "id", 3, 3.5))
    assert (session.short_packages, session.long_packages, session.data_packages) == (1, 1, 3)


# What no client sends.


@pytest.mark.parametrize(
    ("bad", "reason"),
    [
        (b"\x00\x02U", "frame of 2 bytes"),
        (b"\x00\x03U", "recipe \\(none\\)"),
        (data(0, "i", 1), "recipe 0"),
        (data(2, "i", 1), "recipe 2"),
        (b"\x00\x04V\x02", "protocol version"),
        (b"\x00\x0aO1234567", "frequency"),
        (message("I", b"a," * 1025), "1025 variables"),
        (message("O", bytes(8) + b"a," * 1025), "1025 variables"),
    ],
)
def test_protocol_errors_end_the_session_and_free_its_inputs(controller, bad, reason):
    session = controller.session(outputs(["timestamp"]), inputs(["input_int_register_0"]), START)
    with pytest.raises(ProtocolError, match=reason):
        session.receive(data(1, "i", 6) + bad)
    assert controller.registers.input_int[0] == 6
    assert not session.started
    assert session.publish(0) == b""
    assert controller.port.owners == {}
    with pytest.raises(ClosedError):
        session.receive(b"")


def test_the_largest_recipes_fit_into_a_frame(session):
    answer = session.receive(message("O", bytes(8) + b"target_q," * 1024))
    assert len(answer) == 4 + 1024 * 9 - 1
    session.receive(START)
    assert len(session.publish(0)) == 4 + 1024 * 48


def test_unknown_kinds_and_texts_are_only_counted(session):
    assert session.receive(message("x", b"abc") + message("M", b"\x02hi\x00\x03") + message("M")) == b""
    assert (session.unknown_packages, session.text_messages) == (1, 2)
    assert session.receive(START) == b"\x00\x04S\x00"


def test_a_closed_session_is_silent():
    session = RtdeBench().session(outputs(["timestamp"]), START)
    session.close()
    assert (session.publish(0), session.text("halt")) == (b"", b"")
    with pytest.raises(ClosedError):
        session.receive(START)


def test_a_port_needs_every_value():
    profile = profile_of("cb3")
    values = zero_values(profile)
    del values["actual_q"]
    with pytest.raises(SettingsError, match="lack actual_q:"):
        RtdePort(profile, Registers(), values, print)


# As ur_rtde does it.


def test_both_families_have_the_variables_of_ur_rtde():
    registers = [f"output_int_register_{n}" for n in (2, *range(12, 20))]
    registers += [f"output_double_register_{n}" for n in range(12, 20)]
    for family, extra in (("cb3", []), ("e-series", ["ft_raw_wrench"])):
        names = [*RECEIVED, *extra, "payload", "payload_cog", "payload_inertia", *registers]
        answer = RtdeBench(family).session().receive(outputs(names))
        assert answer[3] == 1
        assert len(answer[4:].split(b",")) == len(names)


def test_direct_torque_registers_of_later_versions():
    profile = replace(profile_of("e-series"), version=(5, 23, 0, 1))
    port = RtdePort(profile, Registers(), zero_values(profile), print)
    session = port.open()
    session.receive(VERSION_2)
    names = ["actual_current_as_torque", *(f"output_double_register_{n}" for n in (*range(24), *range(36, 48)))]
    assert b"NOT_FOUND" not in session.receive(outputs(names))


def test_its_control_and_io_connections_live_side_by_side(controller):
    control = controller.session(inputs(SERVOJ), inputs(["input_int_register_0", "external_force_torque"]))
    io = controller.session()
    names = ["input_int_register_23", "standard_analog_output_mask", "standard_analog_output_type"]
    assert b"IN_USE" not in io.receive(inputs([*names, "standard_analog_output_0", "standard_analog_output_1"]))
    io.receive(data(1, "iBBdd", 5, 1, 0, 0.5, 6.95e-310))
    assert controller.forwarded[0]["standard_analog_output_0"] == 0.5
    control.receive(data(2, "i6d", 55, *range(6)))
    assert controller.forwarded[1] == {"external_force_torque": (0, 1, 2, 3, 4, 5)}
    assert b"IN_USE" in controller.session().receive(inputs(["input_int_register_0"]))
