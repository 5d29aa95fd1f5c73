from ur_emulator.controller.registers import Registers


def test_all_registers_are_zero_at_first():
    registers = Registers()
    assert registers.input_int == registers.output_int == [0] * 48
    assert registers.input_double == registers.output_double == [0.0] * 48
    assert registers.input_bits == registers.output_bits == [False] * 128
    assert registers.writes["input_int_register_0"] == 0


def test_two_controllers_share_nothing():
    one, other = Registers(), Registers()
    one.input_int[0] = one.output_bits[5] = 1
    one.writes["input_int_register_0"] += 1
    assert other == Registers()


def test_registers_are_found_by_their_rtde_names():
    registers = Registers()
    for name, cells, where in [
        ("input_int_register_0", registers.input_int, 0),
        ("input_double_register_47", registers.input_double, 47),
        ("input_bit_register_127", registers.input_bits, 127),
        ("output_int_register_24", registers.output_int, 24),
        ("output_double_register_1", registers.output_double, 1),
        ("output_bit_register_64", registers.output_bits, 64),
        ("input_bit_registers0_to_31", registers.input_bits, slice(0, 32)),
        ("output_bit_registers32_to_63", registers.output_bits, slice(32, 64)),
    ]:
        found = registers.find(name)
        assert found is not None
        assert found[0] is cells
        assert found[1] == where


def test_other_names_are_no_registers():
    for name in (
        "actual_q",
        "input_int_register_48",
        "output_double_register_100",
        "input_bit_register_128",
        "input_int_register_",
        "input_int_register_-1",
        "input_int_register_01",
        "input_int_register_1 ",
        "output_float_register_1",
        "output_bit_registers_0_to_31",
    ):
        assert Registers().find(name) is None


def test_clearing_outputs_keeps_lists_and_inputs():
    registers = Registers()
    lists = registers.output_int, registers.output_double, registers.output_bits
    for cells in (*lists, registers.input_int):
        cells[3] = 1
    registers.clear_outputs()
    assert [cells[3] for cells in lists] == [0, 0, 0]
    assert [len(cells) for cells in lists] == [48, 48, 128]
    assert registers.output_int is lists[0]
    assert registers.output_double is lists[1]
    assert registers.output_bits is lists[2]
    assert registers.input_int[3] == 1
