"""Status of an arm: one state lets it move, and every other one stops it."""

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from tests.ur_emulator.statuses import status_of
from ur_core.links.arm_status import (
    OPTIONAL_VARIABLES,
    ROW,
    ROW_SIZE,
    STATUS_VARIABLES,
    ArmStatus,
    stop_reason,
)
from ur_core.links.rtde_link import RtdeLink
from ur_core.links.rtde_stream import Sample
from ur_emulator.controller.rtde_variables import output_types, zero_values
from ur_emulator.profile import PROFILES


def test_an_arm_may_move_in_one_state():
    assert stop_reason(status_of()) is None


@pytest.mark.parametrize("allow_reduced", [False, True])
def test_all_safety_modes(allow_reduced):
    for mode in (*range(-1, 256), 1 << 31, -(1 << 31)):
        bits = 2 if mode == 2 else 1
        reason = stop_reason(status_of(safety_mode=mode, safety_status_bits=bits), allow_reduced=allow_reduced)
        if mode == 1 or (mode == 2 and allow_reduced):
            assert reason is None
        else:
            assert reason.startswith(f"safety mode {mode} (")


def test_safety_modes_have_their_names():
    assert stop_reason(status_of(safety_mode=3)) == "safety mode 3 (PROTECTIVE_STOP)"
    assert stop_reason(status_of(safety_mode=21)) == "safety mode 21 (unknown)"


def test_all_robot_modes():
    for mode in range(-1, 256):
        reason = stop_reason(status_of(robot_mode=mode))
        assert reason is None if mode == 7 else reason.startswith(f"robot mode {mode} ("), mode
    assert stop_reason(status_of(robot_mode=5)) == "robot mode 5 (IDLE)"


def test_all_program_states():
    for state in range(256):
        reason = stop_reason(status_of(runtime_state=state))
        assert reason is None if state == 2 else reason.startswith(f"program state {state} ("), state
        assert stop_reason(status_of(runtime_state=state), playing=False) is None
    assert stop_reason(status_of(runtime_state=0)).startswith("program state 0 (STOPPING): its program was stopped")


@pytest.mark.parametrize("allow_reduced", [False, True])
def test_all_safety_bits(allow_reduced):
    for place in range(32):
        reason = stop_reason(status_of(safety_status_bits=1 | 1 << place), allow_reduced=allow_reduced)
        fine = place == 0 or (place == 1 and allow_reduced)
        assert (reason is None) == fine, (place, reason)
    text = stop_reason(status_of(safety_status_bits=0b101_0000_0001))
    assert text == "safety status bits 0x501: safety violation, stopped due to safety"
    assert stop_reason(status_of(safety_status_bits=3)) == "safety status bits 0x3: reduced mode"
    assert "neither" in stop_reason(status_of(safety_status_bits=0))
    assert "0x800" in stop_reason(status_of(safety_status_bits=0x801))


def test_robot_bits():
    assert "no power" in stop_reason(status_of(robot_status_bits=2))
    assert "freedrive" in stop_reason(status_of(robot_status_bits=7))
    assert stop_reason(status_of(robot_status_bits=1)) is None


@pytest.mark.parametrize("bad", [math.nan, math.inf, -math.inf])
def test_numbers_that_are_not_finite_stop(bad):
    for values in (
        {"actual_q": (0.0,) * 5 + (bad,)},
        {"actual_qd": (bad,) + (0.0,) * 5},
        {"speed_scaling": bad},
        {"target_speed_fraction": bad},
    ):
        assert "finite" in stop_reason(status_of(**values))


@given(
    st.integers(-5, 300), st.integers(-5, 300), st.integers(0, 2**32 - 1), st.integers(0, 2**32 - 1),
    st.integers(0, 300), st.booleans(), st.booleans(),
)  # fmt: skip
def test_no_other_state_lets_it_move(safety, robot, safety_bits, robot_bits, runtime, reduced, playing):
    status = status_of(
        safety_mode=safety, robot_mode=robot, safety_status_bits=safety_bits, robot_status_bits=robot_bits,
        runtime_state=runtime,
    )  # fmt: skip
    if stop_reason(status, allow_reduced=reduced, playing=playing) is None:
        assert safety == 1 or (safety == 2 and reduced)
        assert safety_bits in ({1, 2, 3} if reduced else {1})
        assert robot == 7
        assert robot_bits & 0b101 == 0b001
        assert runtime == 2 or not playing


def test_every_variable_has_its_own_field():
    types = output_types(PROFILES["cb3"])
    values, expected = {}, {}
    for number, name in enumerate((*STATUS_VARIABLES, *OPTIONAL_VARIABLES), start=1):
        values[name] = float(number) if types[name].count == 1 else (float(number),) * types[name].count
    status = ArmStatus.from_sample(Sample(values, 0.5))._asdict()
    assert status.pop("arrival_s") == 0.5
    assert sorted(status.values(), key=str) == sorted(values.values(), key=str)
    expected = {"slider": "target_speed_fraction", "q_rad": "actual_q", "current_a": "actual_current"}
    expected |= {
        "temperature_c": "joint_temperatures",
        "tcp_offset": "tcp_offset",
        "digital_outputs": "actual_digital_output_bits",
    }
    for field, name in expected.items():
        assert status[field] == values[name]


def test_optional_values_may_be_missing():
    values = {**zero_values(PROFILES["cb3"])}
    for name in OPTIONAL_VARIABLES:
        del values[name]
    status = ArmStatus.from_sample(Sample(values, 0.0))
    assert (status.payload_kg, status.payload_cog_m, status.tcp_offset) == (None, None, None)
    with pytest.raises(KeyError):
        ArmStatus.from_sample(Sample({}, 0.0))


@st.composite
def statuses(draw):
    """Random statuses, with and without optional values."""
    types, values = output_types(PROFILES["cb3"]), {}
    known = draw(st.sampled_from([0, 1, 3]))
    for name in (*STATUS_VARIABLES, *OPTIONAL_VARIABLES[:known]):
        kind = types[name]
        if "INT" in kind.name:
            low, high = (-(1 << 31), (1 << 31) - 1) if kind.name.startswith("INT") else (0, (1 << 32) - 1)
            number = st.integers(low, high)
        else:
            number = st.floats(allow_nan=False)
        values[name] = draw(number) if kind.count == 1 else tuple(draw(number) for _ in range(kind.count))
    return ArmStatus.from_sample(Sample(values, draw(st.floats(0.0, 1e9))))


@given(statuses(), st.booleans())
def test_a_row_holds_the_whole_status(status, as_array):
    row = status.row()
    assert len(row) == ROW_SIZE
    assert all(isinstance(each, float) for each in row)
    found = ArmStatus.from_row(np.array(row) if as_array else row)
    assert found == status
    for name, value in status._asdict().items():
        if not isinstance(value, float):  # integers stay integers: they hold bits
            assert type(getattr(found, name)) is type(value), name


def test_the_order_of_a_row_is_that_of_its_names():
    types, values, number = output_types(PROFILES["cb3"]), {}, 0.0
    for name in (*STATUS_VARIABLES, *OPTIONAL_VARIABLES):
        count = types[name].count
        values[name] = number if count == 1 else tuple(number + each for each in range(count))
        number += count
    status = ArmStatus.from_sample(Sample(values, -1.0))
    row, at = status.row(), 0
    assert row[0] == -1.0
    for name, size in ROW:
        value = getattr(status, name)
        assert row[at : at + size] == ([value] if size == 1 else list(value)), name
        at += size
    assert at == len(row) == ROW_SIZE
    assert [name for name, _ in ROW] == list(ArmStatus._fields)
    assert sorted(row) == list(range(-1, int(number)))


def test_stops_of_an_emulated_controller(cell):
    with RtdeLink(cell.left, STATUS_VARIABLES, optional=OPTIONAL_VARIABLES, system=cell.system) as link:

        def until(reason, **options):
            end = cell.clock.now_s() + 20.0
            found = "nothing yet"
            while (found and found.partition(": ")[0]) != reason:
                assert cell.clock.now_s() < end, found
                for sample in link.poll():
                    found = stop_reason(ArmStatus.from_sample(sample), **options)
                cell.clock.sleep(0.002)

        until(None, playing=False)
        until("program state 1 (STOPPED)")
        cell.ask("reduce", arm="left")
        until("safety mode 2 (REDUCED)")
        until(None, playing=False, allow_reduced=True)
        cell.ask("reduce", arm="left", on=False)
        for mode, name in ((5, "SAFEGUARD_STOP"), (99, "unknown"), (3, "PROTECTIVE_STOP")):
            until(None, playing=False)
            cell.ask("stop", arm="left", mode=mode)
            until(f"safety mode {mode} ({name})", playing=False)
            cell.ask("release", arm="left", mode=mode)
