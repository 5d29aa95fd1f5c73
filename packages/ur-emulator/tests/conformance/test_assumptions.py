"""Assumptions about controllers, as far as clients can test them with an arm that stands."""

import ast
import dataclasses
from pathlib import Path

import pytest

from ur_emulator.profile import Assumptions

UNSEEN = {
    "emergency_stop_pauses": "somebody has to press the button",
    "safeguard_resumes": "somebody has to open the safeguard",
    "deviation_rad": "something has to hold the arm back",
    "deviation_ticks": "something has to hold the arm back",
    "restart_safety_s": "a violation or a fault has to come first",
}
"""Assumptions that no client can test, with the reason. `tests/ur_emulator` tests them on emulated ones."""

TRACE = "timestamp,runtime_state,output_int_register_10,output_double_register_10,output_bit_registers32_to_63"


def test_every_assumption_has_a_test_or_a_reason_why_not():
    marked = {
        argument.value
        for path in Path(__file__).parent.glob("test_*.py")
        for call in ast.walk(ast.parse(path.read_text()))
        if isinstance(call, ast.Call) and ast.unparse(call.func) == "pytest.mark.assumption"
        for argument in call.args
        if isinstance(argument, ast.Constant)
    }
    fields = {field.name for field in dataclasses.fields(Assumptions)}
    assert marked | UNSEEN.keys() == fields
    assert not marked & UNSEEN.keys()


@pytest.mark.assumption("output_registers_persist")
def test_output_registers_outlast_a_program(controller, token):
    with controller.rtde(TRACE) as rtde:
        controller.call(
            f"write_output_integer_register(10, {token})\nwrite_output_float_register(10, {token} / 2)\n"
            "write_output_boolean_register(40, True)\nsync()\nsync()"
        )
        rtde.until(lambda now: now[TRACE.split(",")[2]] == token, "the program to write")
        ended = rtde.until(lambda now: now["runtime_state"] == 1, "the program to end")[-1]["timestamp"]
        later = rtde.until(lambda now: now["timestamp"] > ended + 20 * controller.tick_s, "time to pass")[-1]
    kept = (later["output_int_register_10"], later["output_double_register_10"], later[TRACE.split(",")[-1]] >> 8 & 1)
    assert (kept == (token, token / 2, 1)) == controller.assumed.output_registers_persist


WATCHED_HZ = 2
FED_S = 1.3

WATCHDOG = f'rtde_set_watchdog("input_int_register_20", {WATCHED_HZ}, "{{action}}")\nwhile True:\n sync()\nend'


@pytest.mark.assumption("watchdog_counts_unchanged")
def test_a_watchdog_is_fed_by_a_value_that_does_not_change(controller):
    with controller.rtde(TRACE) as rtde:
        recipe, _ = rtde.inputs("input_int_register_20")
        rtde.write(recipe, 0)
        controller.call(WATCHDOG.format(action="stop"))
        begin = rtde.until(lambda now: now["runtime_state"] == 2, "the program to run")[-1]["timestamp"]
        while True:
            rtde.write(recipe, 0)
            now = rtde.data()
            if now["runtime_state"] != 2 or now["timestamp"] > begin + FED_S:
                break
        assert (now["runtime_state"] == 2) == controller.assumed.watchdog_counts_unchanged
        if now["runtime_state"] == 2:
            ended = rtde.until(lambda now: now["runtime_state"] == 1, "the watchdog")[-1]["timestamp"]
            assert ended - now["timestamp"] == pytest.approx(1 / WATCHED_HZ, abs=0.1)


@pytest.mark.parametrize(("action", "state"), [("stop", 1), ("pause", 4)])
def test_a_watchdog_that_is_not_fed_acts(controller, action, state):
    with controller.rtde(TRACE) as rtde:
        controller.call(WATCHDOG.format(action=action))
        begin = rtde.until(lambda now: now["runtime_state"] == 2, "the program to run")[-1]["timestamp"]
        ended = rtde.until(lambda now: now["runtime_state"] == state, "the watchdog")[-1]["timestamp"]
    assert ended - begin > 0.9 / WATCHED_HZ


def test_a_program_without_a_watchdog_continues(controller):
    with controller.rtde(TRACE) as rtde:
        controller.call(WATCHDOG.format(action="ignore"))
        begin = rtde.until(lambda now: now["runtime_state"] == 2, "the program to run")[-1]["timestamp"]
        seen = rtde.until(lambda now: now["timestamp"] > begin + 1.5 / WATCHED_HZ, "time to pass")
    assert {each["runtime_state"] for each in seen} == {2}


@pytest.mark.assumption("infinite_loop_steps")
@pytest.mark.parametrize("fraction", [0.9, 3.0])
def test_a_control_period_has_a_budget_of_statements(controller, token, fraction):
    # An iteration counts as two statements: the loop and the assignment.
    rounds = int(fraction * controller.assumed.infinite_loop_steps / 2)
    with controller.rtde(TRACE) as rtde:
        controller.call(
            f"sync()\ni = 0\nwhile i < {rounds}:\n i = i + 1\nend\nwrite_output_integer_register(10, {token})\nsync()"
        )
        rtde.until(lambda now: now["runtime_state"] == 2, "the program to run")
        seen = rtde.until(lambda now: now["runtime_state"] == 1, "the program to end")
    assert (seen[-1]["output_int_register_10"] == token) == (fraction < 1)


@pytest.mark.assumption("infinite_loop_steps")
def test_a_loop_that_never_waits_ends_its_program(controller, token):
    with controller.rtde(TRACE) as rtde:
        controller.call(f"write_output_integer_register(10, {token})\nsync()\nwhile True:\n i = 1\nend")
        rtde.until(lambda now: now["output_int_register_10"] == token, "the program to run")
        rtde.until(lambda now: now["runtime_state"] == 1, "the program to be ended")
        controller.call(f"write_output_integer_register(10, {-token})")
        rtde.until(lambda now: now["output_int_register_10"] == -token, "the next program to run")
