"""The unmodified `ur_rtde` with emulated controllers of both families."""

import math
import re
import signal
import subprocess
import sys

import numpy as np
import pytest

from tests.soak import scaled
from tests.ur_emulator import clients
from tests.ur_emulator.pairs import EmulatedPair
from ur_core.kinematics import flange_pose
from ur_core.kinematics.robots import MODEL_OF_FAMILY
from ur_core.kinematics.rotations import quat_from_rotvec, quat_to_matrix
from ur_core.kinematics.ur10 import NOMINAL_DH, TICK_S, nominal_dh
from ur_core.servoj import ServojLaw
from ur_emulator.emulator import BOOT_S

FAMILIES = ("cb3", "e-series")

pytestmark = [
    pytest.mark.streams,
    pytest.mark.skipif(
        not sys.platform.startswith("linux"), reason="loopback addresses other than 127.0.0.1 exist on Linux only"
    ),
]


@pytest.fixture(scope="module", params=FAMILIES)
def cell(request):
    with EmulatedPair(robot=MODEL_OF_FAMILY[request.param]) as cell:
        cell.family = request.param
        yield cell


@pytest.fixture
def host(cell):
    """Address of the left controller, with its arm running and no program."""
    cell.wait_until("left", "robot_mode", 7)
    cell.wait_until("left", "safety_mode", 1)
    return cell.left


def near(first, second, tolerance):
    return np.abs(np.asarray(first) - np.asarray(second)).max() <= tolerance


def same_pose(first, second, tolerance):
    """Compare poses: a rotation by pi has two rotation vectors."""
    turns = [quat_to_matrix(quat_from_rotvec(np.array(each[3:]))) for each in (first, second)]
    return near(first[:3], second[:3], tolerance) and near(*turns, tolerance)


def test_moves_end_where_they_should(host):
    done = clients.run(clients.moves, host)
    for name in ("moveJ", "moveL_FK", "back"):
        ok, wanted, found = done[name]
        assert ok, name
        assert near(wanted, found, 1e-4), name
    for name in ("moveL", "moveJ_IK"):
        ok, wanted, found = done[name]
        assert ok, name
        assert same_pose(wanted, found, 1e-4), name
    assert done["isSteady"]
    assert not done["steady while moving"]
    assert done["running while moving"]
    begin, rest, later, speed = done["stopJ"]
    assert not near(begin, done["home"], 1e-3)  # it was still far from its target
    assert near(rest, later, 1e-5)
    assert near(speed, [0.0] * 6, 1e-4)
    begin, goal, rest, later = done["stopL"]
    assert begin[2] + 0.01 < rest[2] < goal[2] - 0.01
    assert near(rest[:2], begin[:2], 1e-3)  # it stopped on its line
    assert near(rest, later, 1e-5)


def test_servoj_is_executed_in_order_and_follows_the_law(cell, host):
    first = cell.ask("setpoints", arm="left")["count"]
    tick_s = TICK_S[cell.family]
    done = clients.run(clients.servo, host, 400, 0.008)
    targets = {tuple(target): number for number, target in enumerate(done["targets"])}
    setpoints = cell.setpoints("left", first)
    order = [targets[tuple(each[1])] for each in setpoints]
    assert order == sorted(order)
    assert len(set(order)) > 100  # however busy the machine is
    assert order[-1] == len(targets) - 1
    assert near(done["end"], done["targets"][-1], 1e-5)
    # What the controller made of them is the law, run from one executed set-point to the next.
    timestamp, q = done["seen"]
    assert not near(q, done["end"], 1e-5)  # it still moved
    law = ServojLaw(0.05, 800.0).transition(tick_s)
    latest = {tick: target for tick, target, *_ in setpoints}
    state, last = np.array([done["home"], [0.0] * 6]), np.array(done["home"])
    for tick in range(setpoints[0][0], round((timestamp - BOOT_S[0]) / tick_s)):
        last = np.array(latest.get(tick, last))
        state = law @ (state - [last, np.zeros(6)]) + [last, np.zeros(6)]
    assert near(state[0], q, 1e-6)


def test_two_arms_follow_the_law_from_one_process(cell):
    tick_s = TICK_S[cell.family]
    for arm in ("left", "right"):
        cell.wait_until(arm, "robot_mode", 7)
        cell.wait_until(arm, "runtime_state", 1)
    before = [cell.ask("setpoints", arm=arm)["count"] for arm in ("left", "right")]
    done = clients.run(clients.servo_both, [cell.left, cell.right], scaled(7500), 0.008, timeout=150)
    for arm, name in enumerate(("left", "right")):
        number = {tuple(target): k for k, target in enumerate(done["sent"][arm])}
        setpoints = cell.setpoints(name, before[arm])
        order = [number[tuple(each[1])] for each in setpoints]
        assert order == sorted(order)  # an ordered subsequence of the sent targets, some held
        assert len(set(order)) > len(number) / 2
        latest = {tick: target for tick, target, *_ in setpoints}
        law = ServojLaw(0.05, 800.0).transition(tick_s)
        state, target = np.array([done["home"][arm], [0.0] * 6]), np.array(done["home"][arm])
        expected = {}
        for tick in range(setpoints[0][0], setpoints[-1][0]):
            expected[tick] = state[0]  # measured at the begin of the tick
            target = np.array(latest.get(tick, target))
            state = law @ (state - [target, np.zeros(6)]) + [target, np.zeros(6)]
        errors = []
        for timestamp, q in done["seen"][arm]:
            tick = round((timestamp - BOOT_S[arm]) / tick_s)
            if tick in expected:
                errors.append(
                    np.linalg.norm(flange_pose(q, NOMINAL_DH)[0] - flange_pose(expected[tick], NOMINAL_DH)[0])
                )
        assert len(errors) > len(number) / 2
        assert max(errors) < 0.5e-3
        moved = np.ptp([q for _, q in done["seen"][arm]], axis=0)
        assert moved[0] > 0.1


def test_streams_move_the_arm_and_end(host):
    done = clients.run(clients.streams, host)
    assert near(done["speedJ while"], [0.1, 0, 0, 0, 0, -0.2], 2e-3)
    begin, end, speed = done["speedJ"]
    assert end[0] > begin[0] + 0.01
    assert near(end[1:5], begin[1:5], 1e-5)
    assert near(speed, [0.0] * 6, 1e-4)
    assert near(done["speedL while"][:3], [0, 0, 0.05], 1e-3)
    begin, end, speed = done["speedL"]
    assert end[2] > begin[2] + 0.005
    assert near(end[:2], begin[:2], 1e-3)
    assert near(speed, [0.0] * 6, 1e-4)
    assert same_pose(*done["servoL"], 1e-4)
    begin, end, speed = done["jog"]
    assert end[1] > begin[1] + 0.01
    assert near(speed, [0.0] * 6, 1e-4)
    assert done["servoC"]
    assert same_pose(*done["servoC moved"], 1e-4)
    # What this client does wrong, it does wrong here, too.
    assert not done["after servoC"]
    assert done["back"]


def test_kinematics_and_values_of_the_controller(cell, host):
    done = clients.run(clients.queries, host)
    e_series = cell.family == "e-series"
    q, pose = done["q"], done["pose"]
    position, _ = flange_pose(q, nominal_dh(MODEL_OF_FAMILY[cell.family]))
    assert near(pose[:3], position, 1e-9)
    assert same_pose(done["default pose"], pose, 1e-6)
    assert near(done["tcp"], [0.01, 0.02, 0.15, 0.1, 0, 0], 1e-12)
    assert not near(done["pose at tcp"], pose, 1e-2)
    assert same_pose(done["forward"], done["pose at tcp"], 1e-6)
    assert same_pose(done["flange"], pose, 1e-6)
    assert near(done["inverse"], q, 1e-6)
    assert near(done["inverse default"], q, 1e-6)
    assert done["has solution"] == [True, False]
    assert done["pose safe"] == [True, False]
    assert done["joints safe"] == [True, False]
    assert near(done["poseTrans"], [0.1, 1.2, 0.3, 0, 0, math.pi / 2], 1e-9)
    assert done["payload"] == [True, 1.5]
    assert done["target payload"]
    if e_series:
        assert done["target payload is"] == [1.0, [0, 0, 0.05], [0.01, 0.01, 0.01, 0, 0, 0]]
        assert done["step time"] == 0.002
        assert near(done["history"], q, 1e-4)
        assert same_pose(done["waypoint"], pose, 1e-3)
    assert abs(done["torques"][1]) > 20.0  # it carries its own weight
    for name in ("gravity", "steady", "zero ft", "running"):
        assert done[name], name
    assert done["external ft"] == [True, True]
    assert done["damping"] == [True, True]
    assert done["modes"] == [7, 1, 2]
    assert done["bits"] == [3, 1]
    assert done["speeds"] == [1.0, 1.0]
    assert near(done["force"], [0.0] * 6, 20.0)
    assert done["running after stop"] is False
    assert done["after stop"] is False
    assert done["uploaded again"]
    assert done["and moved"]


def test_compliance(cell, host):
    done = clients.run(clients.compliance, host)
    begin, end, speed = done["forceMode"]
    assert end[2] > begin[2] + 0.002
    assert near(end[:2], begin[:2], 2e-3)
    assert near(speed, [0.0] * 6, 0.02)
    assert done["teach"] == [True, True]
    assert done["freedrive"][::2] == [True, True]
    assert near(done["after"], end, 5e-3)  # without an external force
    if cell.family == "e-series":
        assert done["contact"] == [True, False, False]
        assert done["toolContact"] == 0
    assert done["back"]


def test_paths_and_their_progress(cell, host):
    done = clients.run(clients.paths, host)
    for name, alike in (("moveJ path", near), ("moveL path", same_pose)):
        ok, wanted, found = done[name]
        assert ok, name
        assert alike(wanted, found, 1e-4), name
    assert done["started"]
    states = [tuple(word) for word in done["progress"]]
    assert states[-1] == (False, -1)
    running = [progress for active, progress in states if active]
    assert running == sorted(running)
    assert set(running) <= {0, 1, 2}
    assert 2 in running
    assert near(*done["movePath"], 1e-4)
    assert done["custom"]
    assert done["custom did"]


def test_inputs_outputs_and_registers(host):
    done = clients.run(clients.inputs_outputs, host)
    assert done["set"] == [True] * 18
    assert done["cleared"] == [False] * 18
    assert near(done["analog"], [5.0, 0.004 + 0.25 * 0.016], 1e-9)
    assert near(done["slider"], [0.3, 0.3], 1e-6)
    assert done["registers"] == [True, True]
    assert [each[0] for each in done["bad register"]] == ["ValueError", "ValueError"]
    assert done["echo"] == [7, 2.5]


def test_arguments_that_the_client_refuses_or_passes(host):
    done = clients.run(clients.arguments, host)
    for name in ("speed", "lookahead", "gain"):
        assert done[name][0] == "ValueError", name
    assert done["nan"] is False
    assert done["running"] is False  # the program was stopped by the controller
    assert near(done["q"], done["begin"], 1e-6)


def test_a_silent_client_is_stopped_by_its_watchdog(host):
    done = clients.run(clients.watchdog, host)
    assert done["set"]
    assert done["kept"]
    assert done["stopped after"] < 15.0
    assert done["next"] is False


def test_dashboard_client(cell, host):
    done = clients.run(clients.dashboard, host)
    e_series = cell.family == "e-series"
    assert done["robotmode"] == "Robotmode: RUNNING"
    assert done["safetymode"] == "Safetymode: NORMAL"
    assert done["safetystatus"] == "Safetystatus: NORMAL"
    assert re.match(r"(STOPPED|PLAYING|PAUSED) ", done["programState"])
    assert re.search(r"\d+\.\d+\.\d+\.\d+", done["polyscopeVersion"])
    assert done["running"] is False
    assert done["isConnected"] is True
    assert done["isInRemoteControl"] is e_series
    assert "UR10" in done["getRobotModel"]
    if e_series:
        assert done["getSerialNumber"].isdigit()
    for name in ("popup", "closePopup", "closeSafetyPopup", "addToLog", "unlockProtectiveStop", "powerOff", "powerOn"):
        assert done[name] is None, name
    assert done["play"] is not None  # the arm has no power yet
    assert done["load"] is not None
    assert done["robotmode at the end"] == "Robotmode: RUNNING"


def test_recovery_from_a_protective_stop(host):
    done = clients.run(clients.protective_stop, host)
    assert done["stopped"] == [True, 3, "Safetymode: PROTECTIVE_STOP"]
    assert done["state"][0] == 4  # paused, as assumed
    assert done["state"][1].startswith("PAUSED")
    assert done["too early"] is not None
    assert "5s" in done["too early"][1]
    assert done["unlocked"] is None
    assert done["after"] == [False, 1, 4]
    assert near(*done["q"], 1e-4)  # neither the stop nor its end moved the arm
    assert done["uploaded"]
    assert done["moves"]


def test_registers_have_one_owner(host):
    kind, text = clients.run(clients.second_control, host)
    assert kind == "RuntimeError"
    assert "already in use" in text


def test_a_killed_client_leaves_its_registers_to_the_next(host):
    command = f"from tests.ur_emulator import clients; clients.hold({host!r}, 60)"
    process = subprocess.Popen([sys.executable, "-c", command], cwd=clients.ROOT, stdout=subprocess.PIPE, text=True)
    try:
        assert process.stdout.readline() == "READY\n"
        process.send_signal(signal.SIGKILL)
        process.wait(10)
        assert clients.run(clients.moves, host)["moveJ"][0]
    finally:
        process.kill()
        process.wait()
        process.stdout.close()


SCRIPT = """def own():
  write_output_integer_register(0, 1)
  while True:
    if read_input_integer_register(0) == 1:
      q = get_actual_joint_positions()
      q[0] = q[0] + SHIFT
      movej(q, a=1.0, v=1.0)
      write_output_integer_register(0, 2)
      while read_input_integer_register(0) != 0:
        sync()
      end
      write_output_integer_register(0, 1)
    elif read_input_integer_register(0) == 255:
      halt
    end
    sync()
  end
end
"""


@pytest.mark.parametrize("shift", [0.05, -0.1])
def test_the_uploaded_script_runs(host, tmp_path, shift):
    """The same call of the client does what a constant in the script specifies."""
    path = tmp_path / "own.script"
    path.write_text(SCRIPT.replace("SHIFT", str(shift)))
    done = clients.run(clients.constant_changed, host, str(path))
    assert done["moved"]
    assert done["end"][0] == pytest.approx(done["begin"][0] + shift, abs=1e-4)


def test_only_an_e_series_has_remote_control(cell, host):
    cell.ask("remote", arm="left", on=False)
    try:
        if cell.family == "cb3":
            assert clients.run(clients.moves, host)["moveJ"][0]
        else:
            with pytest.raises(clients.ClientFailed, match="remote control"):
                clients.run(clients.moves, host)
    finally:
        cell.ask("remote", arm="left", on=True)
