"""URScript's functions for registers and digital inputs and outputs."""

import pytest

from tests.sim2real.emulator.ticking import program


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
