import math
import struct
import sys

import pytest
from hypothesis import given
from hypothesis import strategies as st

from ur_core.errors import SettingsError
from ur_core.protocol.rtde import TYPES
from ur_emulator.controller.registers import Registers
from ur_emulator.controller.rtde_variables import input_types, output_types, zero_values
from ur_emulator.ports.rtde_recipes import InputRecipe, OutputRecipe
from ur_emulator.profile import profile_of

PROFILE = profile_of("e-series")
OUTPUTS = output_types(PROFILE)


def output_recipe(names, values, registers=None, numbered=True):
    return OutputRecipe([(name, OUTPUTS[name]) for name in names], values, registers or Registers(), numbered=numbered)


def input_recipe(names, registers):
    kinds = input_types(PROFILE)
    return InputRecipe([(name, kinds[name]) for name in names], registers)


def element(code):
    if code == "d":
        return st.floats(allow_nan=False)
    if code == "?":
        return st.booleans()
    low, high = {"B": (0, 255), "I": (0, 2**32 - 1), "i": (-(2**31), 2**31 - 1), "Q": (0, 2**64 - 1)}[code]
    return st.integers(low, high)


@given(st.lists(st.sampled_from(sorted(OUTPUTS)), min_size=1, max_size=40), st.data(), st.booleans())
def test_every_recipe_is_packed_as_if_by_hand(names, draw, numbered):
    values, registers = zero_values(PROFILE), Registers()
    expected = b""
    chosen = {}
    for name in names:
        kind = OUTPUTS[name]
        if name not in chosen:
            elements = draw.draw(st.tuples(*[element(kind.code)] * kind.count))
            chosen[name] = elements
            if (place := registers.find(name)) is None:
                values[name] = elements if kind.count > 1 else elements[0]
            elif isinstance(place[1], slice):
                place[0][place[1]] = [bool(elements[0] >> bit & 1) for bit in range(32)]
            else:
                place[0][place[1]] = elements[0]
        for part in chosen[name]:
            expected += struct.pack(">" + kind.code, part)
    number = b"\x01" if numbered else b""
    header = struct.pack(">HB", 3 + len(number) + len(expected), ord("U"))
    assert output_recipe(names, values, registers, numbered).package() == header + number + expected


def test_packages_follow_the_values():
    values, registers = zero_values(PROFILE), Registers()
    recipe = output_recipe(["timestamp", "output_int_register_7", "output_bit_registers32_to_63"], values, registers)
    values["timestamp"] = 1.5
    registers.output_int[7] = -2
    registers.output_bits[33] = True
    assert struct.unpack(">HBBdiI", recipe.package()) == (20, ord("U"), 1, 1.5, -2, 2)
    registers.output_bits[63] = True
    assert recipe.package()[-4:] == b"\x80\x00\x00\x02"


def test_numbers_that_do_not_fit_are_masked():
    values = zero_values(PROFILE)
    values.update(
        timestamp=math.nan,
        robot_mode=1 << 32 | 7,
        joint_mode=(1 << 31, 2.5, math.inf, 3, -4, 5),
        actual_q=(1, 2, 3, 4, 5, math.inf),
        runtime_state=-1,
    )
    package = output_recipe(["timestamp", "robot_mode", "joint_mode", "actual_q", "runtime_state"], values).package()
    time, *rest = struct.unpack(">di6i6dI", package[4:])
    assert math.isnan(time)
    assert rest == [7, -(1 << 31), 2, 0, 3, -4, 5, 1, 2, 3, 4, 5, math.inf, 2**32 - 1]


@pytest.mark.parametrize("wrong", [(0.0,) * 5, (0.0,) * 7, 0.0, "text", None])
@pytest.mark.parametrize("names", [["actual_q"], ["actual_q", "actual_qd", "timestamp"]])
def test_a_vector_of_another_length_is_an_error_by_name(names, wrong):
    values = {**zero_values(PROFILE), "actual_q": wrong}
    with pytest.raises(SettingsError, match="value of actual_q"):
        output_recipe(names, values).package()


def test_inputs_reach_their_registers():
    registers = Registers()
    names = ["input_int_register_47", "speed_slider_fraction", "input_bit_registers0_to_31", "input_double_register_3"]
    names += ["external_force_torque", "input_bit_register_64"]
    recipe = input_recipe(names, registers)
    others = recipe.apply(struct.pack(">idId6d?", -9, 0.25, 0x80000005, 2.5, 1, 2, 3, 4, 5, 6, True))
    assert others == {"speed_slider_fraction": 0.25, "external_force_torque": (1, 2, 3, 4, 5, 6)}
    assert registers.input_int[47] == -9
    assert registers.input_double[3] == 2.5
    assert [i for i, bit in enumerate(registers.input_bits) if bit] == [0, 2, 31, 64]
    assert registers.input_bits[31] is True
    assert registers.writes == dict.fromkeys(names, 1)
    recipe.apply(bytes(recipe.size))
    assert not any(registers.input_bits)
    assert registers.input_int[47] == 0
    assert registers.writes == dict.fromkeys(names, 2)


def test_complete_variables_of_a_short_package_are_applied():
    names = ["input_int_register_0", "external_force_torque", "input_bit_registers0_to_31", "input_double_register_0"]
    whole = struct.pack(">i6dId", 7, 1, 2, 3, 4, 5, 6, 1, 8.5)
    ends = {"input_int_register_0": 4, "external_force_torque": 52, "input_bit_registers0_to_31": 56}
    ends["input_double_register_0"] = 64
    for size in range(len(whole) + 9):
        registers = Registers()
        others = input_recipe(names, registers).apply((whole + b"surplus!")[:size])
        assert set(registers.writes) == {name for name, end in ends.items() if end <= size}
        assert registers.input_int[0] == (7 if size >= 4 else 0)
        assert others == ({"external_force_torque": (1, 2, 3, 4, 5, 6)} if size >= 52 else {})
        assert registers.input_bits[0] == (size >= 56)
        assert registers.input_double[0] == (8.5 if size >= 64 else 0.0)


@pytest.mark.parametrize("name", ["input_int_register_0", "input_bit_registers0_to_31", "external_force_torque"])
def test_a_short_package_takes_no_longer_for_a_long_recipe(name):
    """Thousands of them come in one piece."""

    def lines(count):
        recipe, found = input_recipe([name] * count, Registers()), 0

        def trace(frame, event, argument):
            nonlocal found
            found += event == "line"
            return trace

        before = sys.gettrace()
        sys.settrace(trace)
        recipe.apply(b"")
        sys.settrace(before)
        return found

    assert lines(100) == lines(1) > 0


def test_a_register_listed_twice_takes_the_last_value():
    registers = Registers()
    input_recipe(["input_int_register_0", "input_int_register_0"], registers).apply(struct.pack(">2i", 1, 2))
    assert registers.input_int[0] == 2
    assert registers.writes["input_int_register_0"] == 2


def test_every_input_can_be_written():
    kinds = input_types(PROFILE)
    names = sorted(kinds)
    registers = Registers()
    recipe = input_recipe(names, registers)
    assert recipe.size == sum(kinds[name].count * struct.calcsize(">" + kinds[name].code) for name in names)
    others = recipe.apply(bytes(recipe.size))
    assert set(registers.writes) == set(names)
    assert others == {name: kinds[name].zero for name in names if registers.find(name) is None}
    assert TYPES["VECTOR6D"] is kinds["external_force_torque"]
