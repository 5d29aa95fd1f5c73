"""Faults that make a controller stop protectively."""

from __future__ import annotations

import numpy as np
import pytest

from tests.ur_emulator.motion_runs import Q0, at_rest, motion, pose, run, until_done, until_fault
from ur_core.errors import MotionError


@pytest.mark.parametrize(
    ("call", "code"),
    [
        (lambda arm: arm.servo_joints([0.3, -1.2, 3.2, -1.0, -1.4, 0.2], 0.008, 0.1, 300), "C150A0"),
        (lambda arm: arm.move_linear([2.0, 0, 0, 0, 0, 0], 1.0, 1.0), "C154A0"),
        (lambda arm: arm.move_linear([50.0, 0, 0, 0, 0, 0], 1.0, 1.0), "C154A0"),
    ],
)
def test_targets_that_cannot_be_reached(call, code):
    arm = motion()
    handle = call(arm)
    assert arm.fault is not None
    assert arm.fault.code == code
    assert not handle.done
    arm.plan()
    assert handle.done
    assert handle.aborted
    assert np.array_equal(arm.q, Q0)


@pytest.mark.parametrize("target", [[7.0, 0, 0, 0, 0, 0], [0, 0, 3.2, 0, 0, 0]])
def test_joint_targets_beyond_the_limits(target):
    arm = motion()
    handle = arm.move_joints(Q0 + 0.1, 1.0, 1.0)
    run(arm, 10)
    with pytest.raises(MotionError, match="allowed are"):
        arm.move_joints(target, 1.0, 1.0)
    assert arm.fault is None
    until_done(arm, handle)
    assert np.allclose(arm.q, Q0 + 0.1)


def test_a_line_through_an_unreachable_region():
    arm = motion(np.array([0.0, -1.0, 1.4, -2.0, -1.57, 0.0]))
    there = np.array(arm.tcp_pose(np.array([3.0, -1.0, 1.4, -2.0, -1.57, 0.0])))  # the base is on the line
    handle = arm.move_linear(there, 1.0, 0.5)
    assert arm.fault is None
    until_fault(arm, "C154A0")
    assert handle.aborted
    at_rest(arm, 40)


def test_commands_are_refused_until_the_fault_is_cleared():
    arm = motion()
    arm.move_linear([2.0, 0, 0, 0, 0, 0], 1.0, 1.0)
    for command in (
        lambda: arm.move_joints(Q0 + 0.1, 1.0, 1.0),
        lambda: arm.move_linear(pose(arm, 0.1), 1.0, 1.0),
        lambda: arm.servo_joints(Q0, 0.008, 0.1, 300),
        lambda: arm.speed_joints([0.1] * 6, 1.0),
        lambda: arm.speed_linear([0.1] * 6, 1.0),
        lambda: arm.stop_joints(1.0),
        lambda: arm.stop_linear(1.0),
    ):
        handle = command()
        assert not handle.done
        run(arm, 2)
        assert handle.aborted
    arm.freedrive()
    arm.force_mode([0.0] * 6, [1] * 6, [10.0] * 6, 2, [0.1] * 6)
    run(arm, 10)
    assert np.array_equal(arm.q, Q0)
    arm.fault = None
    until_done(arm, arm.move_joints(Q0 + 0.1, 1.0, 1.0))
    assert np.allclose(arm.q, Q0 + 0.1)
