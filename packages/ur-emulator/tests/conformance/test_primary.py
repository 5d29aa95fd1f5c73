"""Primary and secondary interfaces, ports 30001 and 30002."""

import itertools
import struct

import pytest

from tests.conformance import wire
from tests.conformance.wire import (
    CARTESIAN_DATA,
    JOINT_DATA,
    MASTERBOARD_DATA,
    PRIMARY,
    ROBOT_MESSAGE,
    ROBOT_MODE_DATA,
    SECONDARY,
    TOOL_DATA,
    Primary,
    joint_data,
    pose_distance,
    robot_mode_data,
)

PORTS = pytest.mark.parametrize("port", [PRIMARY, SECONDARY])

KNOWN = set(range(15))
"""Types of sub-packages in UR's client interface article and client library."""

SIZES = {
    # Bytes behind the header, by type, of all versions since 3.5.
    ROBOT_MODE_DATA: {41, 42},
    JOINT_DATA: {6 * 41},
    TOOL_DATA: {32},
    CARTESIAN_DATA: {12 * 8},
    5: {6 * 4 + 24 * 8 + 4},
    6: {53 * 8 + 4 * 4},
    7: {7 * 8},
}


@PORTS
def test_the_version_comes_first(controller, port):
    with Primary(controller.host, port) as primary:
        kind, body = primary.packet()
    assert kind == ROBOT_MESSAGE
    source, message, length = struct.unpack_from(">bBB", body, 8)
    assert (source, message) == (-2, 3)
    assert body[11 : 11 + length] == b"URControl"
    major, minor, bugfix, build = struct.unpack_from(">BBii", body, 11 + length)
    assert (major, minor, bugfix, build) == controller.version
    assert body[21 + length :].decode("ascii")


@PORTS
def test_every_state_has_known_sub_packages(controller, port):
    with Primary(controller.host, port) as primary:
        states = [primary.state() for _ in range(3)]
    for state in states:
        assert set(state) <= KNOWN
        assert {ROBOT_MODE_DATA, JOINT_DATA, TOOL_DATA, MASTERBOARD_DATA, CARTESIAN_DATA} <= set(state)
        for kind, sizes in SIZES.items():
            if kind in state:
                assert len(state[kind]) in sizes, kind
    assert len(states[0][ROBOT_MODE_DATA]) == (41 if controller.family == "cb3" else 42)


def test_states_come_ten_times_a_second(controller):
    with Primary(controller.host) as primary:
        times = [robot_mode_data(primary.state()[ROBOT_MODE_DATA])["timestamp_us"] for _ in range(5)]
    periods = sorted((b - a) / 1e6 for a, b in itertools.pairwise(times))
    assert periods[1] == pytest.approx(0.1, abs=2.5 * controller.tick_s)


def state_with_rtde(controller, names):
    """Return a state, and the RTDE package nearest to its time."""
    with controller.rtde(f"timestamp,{names}") as rtde, Primary(controller.host) as primary:
        first = rtde.data()["timestamp"]
        for _ in wire.Bounded("a state since then"):
            state = primary.state()
            time_s = robot_mode_data(state[ROBOT_MODE_DATA])["timestamp_us"] / 1e6
            if time_s > first:
                break
        packages = rtde.until(lambda now: now["timestamp"] >= time_s, "the same time on RTDE")
    package = min(packages, key=lambda each: abs(each["timestamp"] - time_s))
    assert abs(package["timestamp"] - time_s) <= controller.tick_s
    return state, package


def test_the_robot_mode_data_agree_with_rtde(controller):
    names = "robot_mode,runtime_state,safety_mode,target_speed_fraction,speed_scaling"
    for running in (False, True):
        if running:
            controller.call("while True:\n sync()\nend")
            with controller.rtde() as rtde:
                rtde.until(lambda now: now["runtime_state"] == 2, "the program to run")
        state, package = state_with_rtde(controller, names)
        mode = robot_mode_data(state[ROBOT_MODE_DATA])
        assert mode["robot_mode"] == package["robot_mode"] == 7
        assert mode["program_running"] == running == (package["runtime_state"] == 2)
        assert not mode["program_paused"]
        assert mode["connected"]
        assert mode["enabled"]
        assert mode["power_on"]
        assert not mode["emergency_stopped"]
        assert not mode["protective_stopped"]
        assert mode["target_speed_fraction"] == pytest.approx(package["target_speed_fraction"])
        assert mode["speed_scaling"] == pytest.approx(package["speed_scaling"], abs=0.05)


def test_joints_pose_and_masterboard_agree_with_rtde_at_rest(controller):
    names = "actual_q,target_q,actual_TCP_pose,safety_mode,actual_digital_output_bits"
    state, package = state_with_rtde(controller, names)
    actual, target, speed = joint_data(state[JOINT_DATA])
    assert actual == pytest.approx(package["actual_q"], abs=1e-3)
    assert target == pytest.approx(package["target_q"], abs=1e-6)
    assert max(map(abs, speed)) < 0.05
    assert max(pose_distance(struct.unpack_from(">6d", state[CARTESIAN_DATA]), package["actual_TCP_pose"])) < 2e-3
    _, outputs = struct.unpack_from(">II", state[MASTERBOARD_DATA])
    assert outputs == package["actual_digital_output_bits"]
    assert state[MASTERBOARD_DATA][60] == package["safety_mode"]
