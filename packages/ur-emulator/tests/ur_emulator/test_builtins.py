"""URScript's functions: their names, and those for registers and digital inputs and outputs."""

import pytest

from tests.ur_emulator.ticking import HOME, Bench, program
from ur_core.protocol.primary_messages import popup_message

BOTH = """
acos asin atan atan2 binary_list_to_integer ceil cos d2r enable_external_ft_sensor end_force_mode end_freedrive_mode
end_teach_mode floor force force_mode force_mode_set_damping force_mode_set_gain_scaling freedrive_mode
ft_rtde_input_enable get_actual_joint_positions get_actual_joint_positions_history get_actual_joint_speeds
get_actual_tcp_pose get_actual_tcp_speed get_actual_tool_flange_pose get_configurable_digital_in
get_configurable_digital_out get_controller_temp get_digital_in get_digital_out get_forward_kin get_inverse_kin
get_inverse_kin_has_solution get_joint_positions get_joint_temp get_joint_torques get_list_length
get_standard_digital_in get_standard_digital_out get_steptime get_target_joint_positions get_target_joint_speeds
get_target_payload get_target_payload_cog get_target_payload_inertia get_target_tcp_pose get_target_tcp_speed
get_tcp_force get_tcp_offset get_tool_digital_in get_tool_digital_out integer_to_binary_list interpolate_pose
is_steady is_within_safety_limits length log movec movej movel movep norm point_dist popup pose_add pose_inv pose_sub
pose_trans pow protective_stop r2d random read_input_boolean_register read_input_float_register
read_input_integer_register read_output_boolean_register read_output_float_register read_output_integer_register
rotvec2rpy rpy2rotvec rtde_set_watchdog servoc servoj set_analog_out set_analog_outputdomain
set_configurable_digital_out set_digital_out set_gravity set_payload set_payload_cog set_payload_mass
set_standard_analog_out set_standard_digital_out set_target_payload set_tcp set_tool_digital_out set_tool_voltage sin
sleep socket_close socket_get_var socket_open socket_read_ascii_float socket_read_binary_integer socket_read_byte_list
socket_read_line socket_read_string socket_send_byte socket_send_int socket_send_line socket_send_string
socket_set_var speedj speedl sqrt stopj stopl str_at str_cat str_empty str_find str_len str_sub sync tan teach_mode
textmsg to_num to_str tool_contact write_output_boolean_register write_output_float_register
write_output_integer_register zero_ftsensor
"""
E_SERIES = """
get_freedrive_status get_target_waypoint
"""


@pytest.mark.parametrize(("family", "names"), [("cb3", BOTH), ("e-series", BOTH + E_SERIES)])
def test_programs_have_all_functions_by_name(family, names):
    assert sorted(Bench(family).controller.program.builtins) == sorted(names.split())


@pytest.mark.parametrize(
    ("group", "number", "bit"),
    [("standard_", 7, 7), ("configurable_", 1, 9), ("tool_", 1, 17), ("", 3, 3), ("", 9, 17)],
)
def test_each_group_of_digital_signals_has_its_bits(bench, group, number, bit):
    bench.controller.io.set_input(bit, True)
    bench.run(
        program(
            f"set_{group}digital_out({number}, True)\n"
            f"write_output_boolean_register(0, get_{group}digital_out({number}))\n"
            f"write_output_boolean_register(1, get_{group}digital_in({number}))"
        )
    )
    bench.tick(2)
    assert bench.controller.io.outputs == 1 << bit
    assert bench.controller.registers.output_bits[:2] == [True, True]


@pytest.mark.parametrize(
    ("kind", "name", "value"), [("integer", "int", -7), ("float", "double", 2.5), ("boolean", "bits", True)]
)
def test_each_kind_of_register_is_read_and_written(bench, kind, name, value):
    getattr(bench.controller.registers, f"input_{name}")[5] = value
    bench.run(
        program(
            f"write_output_{kind}_register(3, read_input_{kind}_register(5))\n"
            f"write_output_{kind}_register(4, read_output_{kind}_register(3))"
        )
    )
    bench.tick(2)
    assert getattr(bench.controller.registers, f"output_{name}")[3:5] == [value, value]


@pytest.mark.parametrize("joint", ["-1", "6", "1.0"])
def test_a_joint_that_does_not_exist_ends_the_program(bench, joint):
    bench.run(program(f"x = get_joint_temp(5)\nx = get_joint_temp({joint})"))
    assert b"get_joint_temp" not in b"".join(bench.controller.messages)
    bench.tick()
    assert b": get_joint_temp" in b"".join(bench.controller.messages)


@pytest.mark.parametrize("style", ["warning", "error", "blocking"])
def test_the_style_of_a_popup_is_reported(bench, style):
    bench.run(program(f'popup("look", "at", {style}=True)'))
    bench.tick()
    expected = popup_message(bench.controller.time_s, "at", "look", **{style: True})
    assert expected in bench.controller.messages


def test_a_contact_lasts_since_a_force_against_its_direction_began(bench):
    """In each direction for itself, whoever asked before, and since before the first question."""
    bench.tick()
    bench.wrench[0] = -50.0
    bench.tick(3)
    directions = "[1, 0, 0, 0, 0, 0]", "[-1, 0, 0, 0, 0, 0]", "[2, 2, 0, 0, 0, 0]", ""
    asked = "".join(
        f"  write_output_integer_register({k}, tool_contact({each}))\n" for k, each in enumerate(directions)
    )
    bench.run(program(f"while True:\n{asked}  sync()\nend"))
    outputs = bench.controller.registers.output_int
    bench.tick()
    assert outputs[:4] == [4, 0, 4, 4]
    bench.tick()
    assert outputs[:4] == [5, 0, 5, 5]
    bench.wrench[:2] = 50.0, -20.0
    bench.tick()
    assert outputs[:4] == [0, 1, 0, 6]
    bench.tick(2000)
    assert outputs[:4] == [0, 999, 0, 999]


def test_an_arm_is_steady_once_it_has_stood_for_half_a_second(bench):
    asked = (
        "thread ask():\n while True:\n  write_output_boolean_register(0, is_steady())\n  sync()\n end\nend\nrun ask()\n"
    )
    bench.run(program(f"{asked}movej({[0.2, *HOME[1:]]})\nsleep(9)"))
    outputs = bench.controller.registers.output_bits
    bench.until(lambda: not bench.controller.motion.moving and bench.controller.ticks > 9)
    assert 0.48 <= bench.until(lambda: outputs[0]) * bench.tick_s <= 0.52
    bench.passing(1.0)
    assert outputs[0]
    bench.run(program(f"{asked}speedj([0.1, 0, 0, 0, 0, 0], 1, 1)"))
    bench.tick(2)
    assert not outputs[0]


@pytest.mark.parametrize(("mode", "moves"), [("0", True), ("False", True), ("1", False)])
def test_another_mode_of_movec_ends_the_program(bench, mode, moves):
    via, to = (f"pose_add(get_target_tcp_pose(), p[{x}, 0.02, 0, 0, 0, 0])" for x in (0.02, 0.05))
    bench.run(program(f"movec({via}, {to}, mode={mode})\nsleep(9)"))
    bench.tick(5)
    assert (bench.moved > 0.0) == moves
    assert (b"not emulated" in b"".join(bench.controller.messages)) != moves


def test_freedrive_is_far_from_singularities():
    bench = Bench("e-series")
    bench.run(
        program("freedrive_mode()\nsync()\nwrite_output_integer_register(0, 5 - get_freedrive_status())\nsleep(9)")
    )
    bench.tick(3)
    assert bench.controller.motion.free
    assert bench.controller.registers.output_int[0] == 5
