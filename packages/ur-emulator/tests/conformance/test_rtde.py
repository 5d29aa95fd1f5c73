"""RTDE, port 30004."""

import itertools
import struct

import pytest

from tests.conformance import wire
from tests.conformance.wire import Bounded, Dashboard, Rtde, version_of

INPUT = "input_int_register_20"
OTHERS = ("input_int_register_21", "input_double_register_20")


def wait_for_ticks(controller, count):
    """Wait for control periods, by another connection's timestamps."""
    with controller.rtde("timestamp") as rtde:
        first = rtde.data()["timestamp"]
        rtde.until(lambda now: now["timestamp"] >= first + count * controller.tick_s, "time to pass")


def test_version_2_and_1_of_the_protocol_are_spoken_and_no_other(controller):
    with Rtde(controller.host) as rtde:
        for version, answer in ((3, b"\0"), (1, b"\1"), (65535, b"\0"), (2, b"\1")):
            assert rtde.request(wire.VERSION, struct.pack(">H", version)) == answer
        assert rtde.outputs("timestamp") == (1, ["DOUBLE"])


def test_the_controllers_version_is_that_of_its_dashboard(controller):
    with Rtde(controller.host) as rtde, Dashboard(controller.host) as dashboard:
        version = struct.unpack(">4I", rtde.request(wire.URCONTROL))
        assert version == version_of(dashboard.ask("PolyscopeVersion"))
    assert version[0] == 3 if controller.family == "cb3" else version[0] >= 5


def test_version_1_has_no_frequency_and_no_recipe_number(controller):
    with Rtde(controller.host, version=1) as rtde:
        assert rtde.outputs("timestamp,robot_mode,actual_q") == (None, ["DOUBLE", "INT32", "VECTOR6D"])
        assert rtde.start()
        first, second = rtde.data(), rtde.data()
    assert second["timestamp"] > first["timestamp"]
    assert first["robot_mode"] == 7


def test_unknown_outputs_are_named(controller):
    with Rtde(controller.host) as rtde:
        assert rtde.outputs("timestamp,no_such_thing,actual_q")[1] == ["DOUBLE", "NOT_FOUND", "VECTOR6D"]
        assert rtde.outputs("timestamp") == (1, ["DOUBLE"])
        assert rtde.start()
        assert rtde.data()["timestamp"] > 0


def test_unknown_inputs_are_named_and_claim_nothing(controller):
    with Rtde(controller.host) as one, Rtde(controller.host) as other:
        number, types = one.inputs(f"{INPUT},no_such_thing")
        assert number == 0
        assert types[1] == "NOT_FOUND"
        assert other.inputs(INPUT)[1] == ["INT32"]


def test_an_input_belongs_to_one_connection(controller):
    with Rtde(controller.host) as one:
        number, types = one.inputs(f"{INPUT},{OTHERS[1]}")
        assert (number, types) == (1, ["INT32", "DOUBLE"])
        assert one.inputs(INPUT) == (2, ["INT32"])
        with Rtde(controller.host) as other:
            assert other.inputs(f"{OTHERS[0]},{INPUT}") == (0, ["INT32", "IN_USE"])
            assert other.inputs(OTHERS[0])[1] == ["INT32"]
    with Rtde(controller.host) as other:
        for _ in Bounded("an input to be free again"):
            number, types = other.inputs(f"{INPUT},{OTHERS[1]}")
            if types == ["INT32", "DOUBLE"]:
                break
        assert number > 0


def test_a_trailing_comma_names_nothing(controller):
    with Rtde(controller.host) as rtde:
        assert rtde.outputs("timestamp,robot_mode,") == (1, ["DOUBLE", "INT32"])
        assert rtde.inputs(f"{INPUT},") == (1, ["INT32"])
        assert rtde.start()
        assert rtde.data()["robot_mode"] == 7


def test_nothing_is_sent_before_start_and_after_pause(controller):
    with Rtde(controller.host) as rtde:
        rtde.outputs("timestamp")
        wait_for_ticks(controller, 20)
        assert rtde.silent
        assert rtde.start()
        before = rtde.data()["timestamp"]
        assert rtde.pause()
        wait_for_ticks(controller, 20)
        assert rtde.silent
        assert rtde.start()
        assert rtde.data()["timestamp"] > before + 19 * controller.tick_s


def test_a_package_comes_every_control_period(controller):
    with controller.rtde("timestamp") as rtde:
        times = [rtde.data()["timestamp"] for _ in range(100)]
    periods = [(b - a) / controller.tick_s for a, b in itertools.pairwise(times)]
    assert all(abs(each - round(each)) < 1e-3 and round(each) >= 1 for each in periods)
    # UR's guide lets a controller leave packages out under load.
    assert sum(round(each) == 1 for each in periods) >= 90


@pytest.mark.parametrize("hz", [25.0, 12.5, 1e6])
def test_packages_have_the_requested_frequency(controller, hz):
    period = max(1 / hz, controller.tick_s)
    with controller.rtde("timestamp", hz=hz) as rtde:
        times = [rtde.data()["timestamp"] for _ in range(6)]
    periods = sorted(b - a for a, b in itertools.pairwise(times))
    assert periods[2] == pytest.approx(period, abs=1e-6)
    assert periods[0] > period - 1e-6


def test_short_and_long_packages_are_applied_partly(controller, token):
    with controller.rtde(f"{INPUT},{OTHERS[0]}") as rtde:
        recipe, _ = rtde.inputs(f"{INPUT},{OTHERS[0]}")
        rtde.write(recipe, token, -token)
        rtde.until(lambda now: now == {INPUT: token, OTHERS[0]: -token}, "registers to be written")
        rtde.frame(wire.DATA, struct.pack(">Bi", recipe, token + 1))
        rtde.until(lambda now: now == {INPUT: token + 1, OTHERS[0]: -token}, "the first register to be written")
        rtde.frame(wire.DATA, struct.pack(">Biid", recipe, token + 2, token + 3, 0.5))
        rtde.until(lambda now: now == {INPUT: token + 2, OTHERS[0]: token + 3}, "both registers to be written")


def test_inputs_need_no_start(controller, token):
    with Rtde(controller.host) as writer, controller.rtde(INPUT) as reader:
        recipe, _ = writer.inputs(INPUT)
        writer.write(recipe, token)
        reader.until(lambda now: now[INPUT] == token, "a register to be written")


def test_requests_arrive_in_any_pieces(controller):
    with Rtde(controller.host) as rtde:
        request = struct.pack(">HB", 3, wire.URCONTROL)
        answers = [rtde.request(wire.URCONTROL)]
        for byte in request:
            rtde.send(bytes([byte]))
        rtde.send(request * 2)
        for _ in range(3):
            kind, answer = rtde.receive()
            assert kind == wire.URCONTROL
            answers.append(answer)
    assert len(set(answers)) == 1


def test_a_package_of_an_unknown_recipe_disturbs_no_other_client(controller):
    with controller.rtde("timestamp") as other, Rtde(controller.host) as rtde:
        rtde.frame(wire.DATA, struct.pack(">Bi", 77, 1))
        before = other.data()["timestamp"]
        other.until(lambda now: now["timestamp"] > before + 10 * controller.tick_s, "time to pass")
