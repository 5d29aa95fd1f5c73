"""Two arms lift a bar, by programs on port 30003 and the text protocol of their grippers, observed by a camera."""

import numpy as np
import pytest

from dual_ur10.assets.props import GRIP_DISTANCE_M, GRIP_QUAT
from dual_ur10.sim2real.cell.cell_config import CellConfig
from dual_ur10.testing import VirtualCell
from ur_core.kinematics.frames import Frames
from ur_core.kinematics.rotations import quat_multiply, quat_to_rotvec, rotate
from ur_core.tools.robotiq_2f85 import ROBOTIQ_2F85 as TOOL

ARMS = ("left", "right")


class Gripper:
    """Client of the gripper's port."""

    def __init__(self, cell, host):
        self._clock, self._port = cell.clock, cell.system.connect(host, 63352, 5.0)

    def ask(self, line):
        self._port.send_now(f"{line}\n".encode())
        self._clock.wait((self._port.fileno(),), self._clock.now_s() + 1.0)
        return self._port.receive_now(64).decode()

    def set(self, words):
        assert self.ask(f"SET {words}") == "ack"

    def get(self, name):
        word, value = self.ask(f"GET {name}").split()
        assert word == name
        return int(value)

    def wait(self, name, values, within_s=20.0):
        end = self._clock.now_s() + within_s
        while self._clock.now_s() < end:
            found = self.get(name)
            if found in values:
                return found
            self._clock.sleep(0.02)
        raise AssertionError(f"{name} is {found} and not one of {values}")


@pytest.fixture(params=["nominal", "mild"])
def cell(request):
    with VirtualCell(task="SyncCarry", plant=request.param) as cell:
        yield cell


def move_both(cell, scripts, poses):
    for script, pose in zip(scripts, poses, strict=True):
        script.send_now(f"movel(p{[float(each) for each in pose]}, a=0.4, v=0.1)\n".encode())
    end = cell.clock.now_s() + 60.0
    while cell.clock.now_s() < end:
        states = [cell.ask("state", arm=arm, names=["target_TCP_pose", "runtime_state", "safety_mode"]) for arm in ARMS]
        there = [
            np.allclose(each["target_TCP_pose"][:3], pose[:3], atol=1e-6)
            for each, pose in zip(states, poses, strict=True)
        ]
        if all(there) and all(each["runtime_state"] == 1 for each in states):
            return
        assert all(each["safety_mode"] == 1 for each in states)
        cell.clock.sleep(0.02)
    raise AssertionError(f"the arms did not arrive: {states}")


def test_two_arms_lift_a_bar(cell):
    config = CellConfig()
    frames = Frames((config.left, config.right))
    bar = cell.ask("pose", body="bar")
    position, quat = np.array(bar["position_m"]), np.array(bar["quat"])

    def grips(height):
        """Return the flange poses that grip the bar, in each arm's base frame, at a height above it."""
        along = rotate(quat, np.array([0.0, GRIP_DISTANCE_M / 2, 0.0]))
        points = np.add([position + along, position - along], [0.0, 0.0, height + TOOL.tcp_m])
        rotation = quat_multiply(quat, GRIP_QUAT)
        rotations = frames.quat_to_base(np.array([rotation, rotation]))
        places = frames.position_to_base(points)
        return [[*place, *quat_to_rotvec(each)] for place, each in zip(places, rotations, strict=True)]

    grippers = [Gripper(cell, host) for host in (cell.left, cell.right)]
    scripts = [cell.system.connect(host, 30003, 5.0) for host in (cell.left, cell.right)]
    for gripper in grippers:
        assert gripper.get("STA") == 0  # nothing works before it is activated
        gripper.set("ACT 1")
    for gripper in grippers:
        gripper.wait("STA", [3])
        gripper.set("GTO 1 POS 0 SPE 255 FOR 255")
    move_both(cell, scripts, grips(0.08))
    move_both(cell, scripts, grips(0.0))
    for gripper in grippers:
        gripper.set("POS 255")
    for gripper in grippers:
        assert gripper.wait("OBJ", [1, 2, 3]) == 2  # it met something while closing
        assert 100 < gripper.get("POS") < 160  # a bar of 40 mm in a stroke of 85 mm
    move_both(cell, scripts, grips(0.06))
    cell.clock.sleep(0.3)
    lifted = cell.ask("pose", body="bar")
    assert np.allclose(np.subtract(lifted["position_m"], position), [0.0, 0.0, 0.06], atol=5e-3)
    force = [cell.ask("state", arm=arm, names=["actual_TCP_force"])["actual_TCP_force"] for arm in ARMS]
    assert -60.0 < force[0][2] + force[1][2] < -25.0  # the weight of 4 kg pulls both flanges down
    for gripper in grippers:
        gripper.set("POS 0")
    for gripper in grippers:
        assert gripper.wait("OBJ", [1, 2, 3]) == 3
    cell.clock.sleep(0.5)
    fallen = cell.ask("pose", body="bar", noise_m=1e-6)
    assert fallen["position_m"][2] < lifted["position_m"][2] - 0.04
