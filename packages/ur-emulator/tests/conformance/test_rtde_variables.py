"""Variables of UR's RTDE guide by version, with their types."""

import math

import pytest

from tests.conformance.wire import Rtde

EVER = (3, 0), (5, 0)
"""CB3 and e-Series software that brought a variable."""

OUTPUTS = {
    (EVER, "DOUBLE"): """timestamp actual_execution_time speed_scaling target_speed_fraction actual_momentum
        actual_main_voltage actual_robot_voltage actual_robot_current standard_analog_input0 standard_analog_input1
        standard_analog_output0 standard_analog_output1 io_current euromap67_24V_voltage euromap67_24V_current
        tool_analog_input0 tool_analog_input1 tool_output_current tool_temperature""",
    (EVER, "VECTOR6D"): """target_q target_qd target_qdd target_current target_moment actual_q actual_qd actual_current
        joint_control_output actual_TCP_pose actual_TCP_speed actual_TCP_force target_TCP_pose target_TCP_speed
        joint_temperatures actual_joint_voltage""",
    (EVER, "VECTOR3D"): "actual_tool_accelerometer",
    (EVER, "VECTOR6INT32"): "joint_mode",
    (EVER, "INT32"): "robot_mode safety_mode tool_output_voltage",
    (EVER, "UINT64"): "actual_digital_input_bits actual_digital_output_bits",
    (EVER, "UINT32"): """runtime_state robot_status_bits safety_status_bits analog_io_types euromap67_input_bits
        euromap67_output_bits tool_mode tool_analog_input_types""",
    (((3, 5), (5, 0)), "VECTOR3D"): "elbow_position elbow_velocity",
    (((3, 10), (5, 4)), "INT32"): "safety_status",
    (((3, 11), (5, 5, 1)), "DOUBLE"): "payload",
    (((3, 11), (5, 5, 1)), "VECTOR3D"): "payload_cog",
    (((3, 12), (5, 5, 1)), "VECTOR6D"): "tcp_offset",
    (((3, 15), (5, 11)), "VECTOR6D"): "payload_inertia",
    ((None, (5, 9)), "VECTOR6D"): "ft_raw_wrench",
    ((None, (5, 23)), "VECTOR6D"): "actual_current_as_torque",
    ((None, (5, 26)), "UINT64"): "control_step",
}

LOW, HIGH = ((3, 4), (5, 0)), ((3, 9), (5, 3))

REGISTERS = {
    (LOW, "UINT32"): ["bit_registers0_to_31", "bit_registers32_to_63"],
    (HIGH, "BOOL"): [f"bit_register_{bit}" for bit in range(64, 128)],
    (LOW, "INT32"): [f"int_register_{number}" for number in range(24)],
    (HIGH, "INT32"): [f"int_register_{number}" for number in range(24, 48)],
    (LOW, "DOUBLE"): [f"double_register_{number}" for number in range(24)],
    (HIGH, "DOUBLE"): [f"double_register_{number}" for number in range(24, 48)],
}

INPUTS = {
    (EVER, "UINT32"): "speed_slider_mask",
    (EVER, "DOUBLE"): "speed_slider_fraction standard_analog_output_0 standard_analog_output_1",
    (EVER, "UINT8"): """standard_digital_output_mask standard_digital_output configurable_digital_output_mask
        configurable_digital_output tool_digital_output_mask tool_digital_output standard_analog_output_mask
        standard_analog_output_type""",
    (((3, 3), (5, 0)), "VECTOR6D"): "external_force_torque",
}


def listed(controller, table, prefix=""):
    """Return name, type, and whether the controller has it."""
    return [
        (prefix + name, kind, controller.has(e_series, cb3))
        for ((cb3, e_series), kind), names in table.items()
        for name in (names.split() if isinstance(names, str) else names)
    ]


def outputs_of(controller):
    return listed(controller, OUTPUTS) + [
        each for prefix in ("input_", "output_") for each in listed(controller, REGISTERS, prefix)
    ]


def test_every_output_has_its_documented_type(controller):
    with Rtde(controller.host) as rtde:
        variables = outputs_of(controller)
        _, types = rtde.outputs(",".join(name for name, _, _ in variables))
    reported = dict(zip([name for name, _, _ in variables], types, strict=True))
    assert reported == {name: kind if exists else "NOT_FOUND" for name, kind, exists in variables}


def test_all_outputs_at_once_unpack_to_finite_numbers(controller):
    names = [name for name, _, exists in outputs_of(controller) if exists]
    with controller.rtde(",".join(names), hz=10.0) as rtde:
        packages = [rtde.data() for _ in range(2)]
    for package in packages:
        assert list(package) == names
        for name, value in package.items():
            assert all(map(math.isfinite, value if isinstance(value, tuple) else (value,))), name
    assert packages[1]["timestamp"] > packages[0]["timestamp"]


@pytest.mark.parametrize("kind", ["DOUBLE", "INT32", "UINT32", "UINT64", "BOOL", "VECTOR6D", "VECTOR3D"])
def test_outputs_do_not_depend_on_their_place_in_the_package(controller, kind):
    """The same variable first and last in a package, among all of a type."""
    names = [name for name, its, exists in outputs_of(controller) if exists and its == kind][:40]
    with controller.rtde(",".join(["target_q", *names, "robot_mode,standard_analog_output0"])) as rtde:
        packed = rtde.data()
    with controller.rtde("robot_mode,target_q,standard_analog_output0") as rtde:
        alone = rtde.data()
    assert {name: packed[name] for name in alone} == alone


def test_every_input_has_its_documented_type(controller):
    variables = listed(controller, INPUTS) + listed(controller, REGISTERS, "input_")
    found, expected = {}, {}
    with Rtde(controller.host) as rtde:
        for name, kind, exists in variables:
            found[name] = rtde.inputs(name)[1]
            expected[name] = [kind if exists else "NOT_FOUND"]
    # On a real controller a fieldbus may use some.
    assert {name: kinds for name, kinds in found.items() if kinds != ["IN_USE"]} == {
        name: expected[name] for name, kinds in found.items() if kinds != ["IN_USE"]
    }
    assert sum(kinds == ["IN_USE"] for kinds in found.values()) < len(found) / 2


def test_timestamps_are_of_the_same_clock_on_all_connections(controller):
    with controller.rtde("timestamp") as one, controller.rtde("timestamp") as other:
        first = one.data()["timestamp"]
        later = other.until(lambda now: now["timestamp"] > first, "the other clock to get there")[-1]["timestamp"]
        assert one.until(lambda now: now["timestamp"] >= later, "the clock to get there")[-1]["timestamp"] == later
