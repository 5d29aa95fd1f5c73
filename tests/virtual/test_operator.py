"""Operators on a virtual cell: what the arms do after an input of a device, by the controllers' clock."""

from dataclasses import replace

import numpy as np
import pytest

import dual_ur10  # noqa: F401  # registers the environments
from dual_ur10.errors import DeviceSilentError, DeviceUnpluggedError, StopPressedError
from dual_ur10.policies.evaluation.rollout import act
from dual_ur10.policies.operators.spacemouse import SpaceMouse
from dual_ur10.sim2real.runtime.runner import least_latency_ticks
from dual_ur10.testing import VirtualCell
from tests.policies.operators.hands import operator_of
from tests.policies.operators.rigs import RawMouse
from ur_core.kinematics.robot_model import TICK_S
from ur_emulator.controller.controller import Controller

KEYWORDS = {"action_mode": "tcp_delta", "policy_rate_hz": 125.0}
LEAST_TICKS = {family: least_latency_ticks(tick_s) for family, tick_s in TICK_S.items()}
MOVED_RAD = 1e-5
FORWARD = np.array([0.25, 0, 0, 0, 0, 0])


class Rig:
    """Virtual cell led by two SpaceMice, and the positions of the left arm by its controller's time."""

    def __init__(self, folder, monkeypatch, task="SineTracking", family="cb3", **keywords):
        self.mice = [RawMouse(folder, "left"), RawMouse(folder, "right")]
        self.seen = []
        rig, tick = self, Controller.tick

        def noted(controller, reading):
            if controller is rig.left:
                rig.seen.append((rig.cell.now_s, np.array(reading.q_rad)))
            return tick(controller, reading)

        self.left = None
        monkeypatch.setattr(Controller, "tick", noted)
        self.cell = VirtualCell(task=task, plant="nominal", family=family)
        self.left = self.cell.emulators[0].servers[0].controller
        keywords = {**KEYWORDS, "action_latency_ticks": LEAST_TICKS[family], **keywords}
        self.env = self.cell.make(f"DualUR10/{task}-v0", disable_env_checker=True, **keywords)
        paths = [mouse.path for mouse in self.mice]
        device = SpaceMouse(left=paths[0], right=paths[1], clock=lambda: self.cell.now_s)
        self.operator = operator_of(device, task, cell=self.cell, **keywords)
        self.observation, _ = self.env.reset(seed=0)
        self.operator.reset()

    def steps(self, count):
        for _ in range(count):
            action = act(self.operator, self.observation, self.env, np.float32)
            self.observation, *_ = self.env.step(action)

    def close(self):
        self.operator.close()
        self.cell.close()


def input_to_motion_s(rig, inputs):
    """Return the times from the reading of an input to the first motion of the arm, by the controller's clock."""
    found = []
    for number in range(inputs):
        rig.steps(100)  # to rest
        still, begun = rig.seen[-1][1], len(rig.seen)
        read_s = rig.cell.now_s
        rig.mice[0].deflect(FORWARD if number % 2 else -FORWARD)
        rig.steps(12)
        moved = next(at for at, q in rig.seen[begun:] if np.abs(q - still).max() > MOVED_RAD)
        found.append(moved - read_s)
        rig.mice[0].deflect(np.zeros(6))
    return np.array(found)


@pytest.mark.parametrize(("family", "most_s"), [("e-series", 0.045), ("cb3", 0.064)])
def test_an_input_at_125_hz_moves_the_arm_soon(tmp_path, monkeypatch, family, most_s):
    """On a CB3 the queue of targets alone takes 40 ms, and each target is held for 8 ms."""
    rig = Rig(tmp_path, monkeypatch, family=family)
    waits = input_to_motion_s(rig, 2)
    rig.close()
    # An input comes at any instant of the 8 ms between two readings.
    times = waits[:, None] + np.linspace(0.0, 0.008, 100)
    assert np.quantile(times, 0.99) <= most_s
    assert waits.min() > 0.016  # the queue alone


@pytest.mark.parametrize(
    ("end", "error", "text"),
    [
        ("unplugged", DeviceUnpluggedError, "left spacemouse"),
        ("stopped", StopPressedError, "the button to stop was pressed"),
    ],
)
def test_a_device_that_is_unplugged_and_the_button_to_stop_stop_both_arms(tmp_path, monkeypatch, end, error, text):
    rig = Rig(tmp_path, monkeypatch)
    rig.mice[0].deflect(FORWARD)
    rig.steps(20)
    if end == "unplugged":
        rig.mice[0].unplug()
    else:
        read = rig.operator.device.read
        monkeypatch.setattr(rig.operator.device, "read", lambda: replace(read(), buttons=frozenset({"stop"})))
    with pytest.raises(error, match=text):
        rig.steps(1)
    rig.cell.clock.sleep(1.0)
    assert text in rig.cell.fault
    last = rig.seen[-1][1]
    rig.cell.clock.sleep(0.1)
    np.testing.assert_allclose(rig.seen[-1][1], last, atol=1e-6)
    rig.env.close()
    rig.cell.clear()
    rig.close()


def test_a_device_that_falls_silent_stops_the_arms_on_their_path_and_is_then_named(tmp_path, monkeypatch):
    rig = Rig(tmp_path, monkeypatch)
    rig.steps(5)  # the first one waits for the arms to begin
    rig.mice[0].deflect(FORWARD)
    rig.steps(9)  # the last reading is 64 ms old
    assert rig.operator.leads.all()
    rig.steps(3)
    assert not rig.operator.leads.any()
    rig.steps(100)
    assert not rig.cell.fault
    with pytest.raises(DeviceSilentError, match="silent for"):
        rig.steps(30)
    rig.env.close()
    rig.cell.clear()
    rig.close()
