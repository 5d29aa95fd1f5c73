from dataclasses import replace

import pytest

from ur_emulator.controller.rtde_variables import input_types, output_types, zero_values
from ur_emulator.profile import PROFILES

CB3, E_SERIES = PROFILES["cb3"], PROFILES["e-series"]


def of(profile, *version):
    return replace(profile, version=(*version, *(0,) * (4 - len(version))))


@pytest.mark.parametrize(
    ("name", "brought_cb3", "brought_e_series"),
    [
        ("output_int_register_23", (3, 4), (5, 0)),
        ("output_double_register_24", (3, 9), (5, 3)),
        ("input_bit_register_64", (3, 9), (5, 3)),
        ("payload", (3, 11), (5, 5, 1)),
        ("payload_inertia", (3, 15), (5, 11)),
        ("tcp_offset", (3, 12), (5, 5, 1)),
        ("ft_raw_wrench", None, (5, 9)),
        ("actual_current_as_torque", None, (5, 23)),
        ("safety_status", (3, 10), (5, 4)),
    ],
)
def test_variables_depend_on_the_version(name, brought_cb3, brought_e_series):
    for profile, brought, first, last in (
        (CB3, brought_cb3, (3, 0), (3, 99)),
        (E_SERIES, brought_e_series, (5, 0), (10, 9)),
    ):
        assert (name in output_types(of(profile, *last))) == (brought is not None)
        if brought is None:
            continue
        assert name in output_types(of(profile, *brought))
        before = (*brought[:-1], brought[-1] - 1)
        if before >= first:
            assert name not in output_types(of(profile, *before))


@pytest.mark.parametrize("profile", [CB3, E_SERIES])
def test_registers_are_all_there_and_can_be_read_back(profile):
    inputs, outputs = input_types(profile), output_types(profile)
    for direction, found in (("input", inputs), ("input", outputs), ("output", outputs)):
        assert sum(name.startswith(f"{direction}_int_register_") for name in found) == 48
        assert sum(name.startswith(f"{direction}_double_register_") for name in found) == 48
        assert sum(name.startswith(f"{direction}_bit_register_") for name in found) == 64
    assert inputs["input_int_register_0"].name == "INT32"
    assert outputs["output_bit_register_64"].name == "BOOL"
    assert outputs["output_bit_registers0_to_31"].name == "UINT32"
    assert not any(name.startswith("output") for name in inputs)


def test_zero_values_are_all_outputs_but_registers():
    for profile in (CB3, E_SERIES):
        zeros = zero_values(profile)
        registers = {name for name in output_types(profile) if "_register" in name}
        assert zeros.keys() == output_types(profile).keys() - registers
        assert zeros["actual_q"] == (0.0,) * 6
        assert zeros["joint_mode"] == (0,) * 6
        assert zeros["actual_tool_accelerometer"] == (0.0,) * 3
        assert zeros["robot_mode"] == 0


def test_returned_dictionaries_are_copies():
    for function in (zero_values, output_types, input_types):
        function(CB3).clear()
        assert function(CB3)


def test_inputs_of_the_rtde_guide():
    kinds = {name: kind.name for name, kind in input_types(CB3).items() if "register" not in name}
    assert kinds.pop("speed_slider_mask") == "UINT32"
    assert kinds.pop("external_force_torque") == "VECTOR6D"
    for name in ("speed_slider_fraction", "standard_analog_output_0", "standard_analog_output_1"):
        assert kinds.pop(name) == "DOUBLE"
    assert set(kinds.values()) == {"UINT8"}
    assert len(kinds) == 8


def test_variables_beyond_the_documented_ones_have_their_names():
    names = """
        actual_TCP_acceleration actual_configurable_digital_input_bits actual_configurable_digital_output_bits
        actual_current_window actual_robot_braking_energy_dissipated actual_robot_energy_consumed
        collision_detection_ratio encoder0_raw encoder1_raw joint_position_deviation_ratio script_control_line
        target_TCP_acceleration target_base_acceleration target_base_wrench target_execution_time target_gravity
        tcp_force_scalar time_scale_source tool_digital_output0_mode tool_digital_output1_mode tool_output_mode
        wrench_calc_from_currents
    """
    assert set(names.split()) <= set(output_types(of(E_SERIES, 5, 26)))
