"""Unmodified examples of `ur_rtde` on the emulated UR10e at 127.0.0.1."""

import fcntl
import os
import signal
import subprocess
import sys
import tarfile
import tempfile
import time
from pathlib import Path

import numpy as np
import pytest

from ur_emulator.emulated_controller import EmulatedController

SOURCE = Path(sys.prefix) / "sdist" / "ur_rtde-1.6.5.tar.gz"
START = [-1.54, -1.83, -2.28, -0.59, 1.60, 0.023]

pytestmark = [
    pytest.mark.skipif(not SOURCE.exists(), reason="`make install` fetches the source of ur_rtde"),
    pytest.mark.streams,
]


@pytest.fixture(scope="module")
def examples(tmp_path_factory):
    folder = tmp_path_factory.mktemp("examples")
    with tarfile.open(SOURCE) as archive:
        for member in archive.getmembers():
            if "/examples/py/" in member.name and member.isfile():
                member.name = Path(member.name).name
                archive.extract(member, folder, filter="data")
    return folder


@pytest.fixture(scope="module", params=["5.12"])
def controller(request):
    """One of one PolyScope version; a module has one at a time."""
    # 127.0.0.1 is one address for all that run at the same time.
    with (Path(tempfile.gettempdir()) / f"dual_ur10-127.0.0.1-{os.getuid()}.lock").open("w") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        with EmulatedController("ur10e", host="127.0.0.1", polyscope=request.param, plant="nominal") as controller:
            yield controller


def run(controller, examples, name, timeout=90):
    controller.wait_for("robot_mode", 7)
    before = controller.ask("state", names=["actual_q"])["actual_q"]
    command = [sys.executable, str(examples / name)]
    done = subprocess.run(command, cwd=examples, capture_output=True, text=True, timeout=timeout, check=False)
    assert done.returncode == 0, done.stderr
    state = controller.ask("state")
    assert state["safety_mode"] == 1
    return np.array(before), state, done.stdout


def test_servoj(controller, examples):
    first = controller.ask("setpoints")["count"]
    _, state, _ = run(controller, examples, "servoj_example.py")
    setpoints = controller.setpoints(controller.robot, first)
    turned = np.array([each[1] for each in setpoints])[:, :2] - START[:2]
    assert (np.diff(turned, axis=0) >= 0).all()  # in order
    assert len(setpoints) > 300
    assert turned.max() > 0.9
    # It stops at its last target, which it follows with the lag of its lookahead.
    assert np.allclose(state["actual_q"][:2], START[:2] + turned[-1], atol=0.12)
    assert np.allclose(state["actual_q"][2:], START[2:], atol=5e-3)
    assert state["runtime_state"] == 1


def test_speedj(controller, examples):
    _, state, _ = run(controller, examples, "speedj_example.py")
    moved = np.array(state["actual_q"]) - START
    assert np.allclose(moved[:2], moved[0], atol=1e-3)  # both joints alike
    assert 0.3 < moved[0] < 1.5
    assert np.allclose(moved[2:], 0.0, atol=1e-4)


def test_force_mode(controller, examples):
    # What pushes it down for half of the time pushes it up for the other half.
    before = controller.ask("setpoints")["count"]
    _, state, _ = run(controller, examples, "forcemode_example.py")
    assert np.allclose(state["actual_q"], START, atol=0.05)
    assert controller.ask("setpoints")["count"] == before


def test_moves_that_are_stopped(controller, examples):
    before, state, _ = run(controller, examples, "move_async_example.py")
    assert np.allclose(state["actual_q"], before, atol=1e-4)


def test_path_with_progress(controller, examples):
    _, state, output = run(controller, examples, "move_path_async_example.py")
    assert np.allclose(state["actual_TCP_pose"], [-0.14, -0.4, 0.1, 0, 3.14, 0], atol=1e-4)
    assert "Path finished!" in output
    assert "Async path finished..." in output
    assert output.count("Moving to path waypoint") >= 3


def test_path_with_blends(controller, examples):
    _, state, _ = run(controller, examples, "movel_path_with_blend_example.py")
    assert np.allclose(state["actual_TCP_pose"], [-0.32, -0.61, 0.31, -0.001, 3.12, 0.04], atol=1e-4)


def test_outputs(controller, examples):
    _, state, output = run(controller, examples, "io_example.py")
    assert output.splitlines()[-2:] == ["Standard digital out (7) is HIGH", "Tool digital out (16) is HIGH"]
    assert state["actual_digital_output_bits"] == 1 << 7 | 1 << 16
    assert state["standard_analog_output1"] == pytest.approx(0.008)


@pytest.mark.parametrize("name", ["record_data_example.py", "realtime_control_example.py"])
def test_endless_ones_run_until_they_are_interrupted(controller, examples, name):
    first = controller.ask("setpoints")["count"]

    def works():
        recorded = examples / "robot_data.csv"
        rows = recorded.read_text().count("\n") if recorded.exists() else 0
        moved = controller.ask("setpoints")["count"] - first
        return (rows if name.startswith("record") else moved) > 200

    run_until(controller, examples, name, works)
    assert controller.ask("state", names=["safety_mode"]) == {"safety_mode": 1}


@pytest.mark.parametrize("controller", ["5.26"], indirect=True)
def test_torque_control_swings_the_arm(controller, examples):
    """What follows the interrupt is not asserted: the last torque acts until the client's process has ended."""
    before = controller.ask("state", names=["actual_q"])["actual_q"]
    shoulder = []

    def works():
        found = controller.ask("state", names=["actual_q", "safety_mode"])
        assert found["safety_mode"] == 1
        shoulder.append(found["actual_q"][1] - before[1])
        return max(shoulder) > 0.2

    run_until(controller, examples, "joint_pd_torque_control.py", works)
    assert controller.ask("setpoints")["count"] == 0


def run_until(controller, examples, name, works):
    """Run an example until it works, and interrupt it."""
    controller.wait_for("robot_mode", 7)
    with (examples / f"{name}.log").open("w+") as log:
        process = subprocess.Popen([sys.executable, name], cwd=examples, stdout=log, stderr=log)
        try:
            end = time.monotonic() + 30.0
            while time.monotonic() < end and process.poll() is None:
                if works():
                    break
                time.sleep(0.1)
            else:
                log.seek(0)
                pytest.fail(f"it did nothing: {log.read()}")
            assert process.poll() is None
            process.send_signal(signal.SIGINT)
            process.wait(30)
        finally:
            process.kill()
            process.wait()
        log.seek(0)
        assert "Segmentation" not in log.read()
    assert process.returncode in (0, 1, 130, -signal.SIGINT)
