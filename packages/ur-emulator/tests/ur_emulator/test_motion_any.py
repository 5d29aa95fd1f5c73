"""Any sequence of commands moves the arm without jumps and within its limits."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st

from tests.soak import scaled
from tests.ur_emulator.motion_runs import DT, Q0, SUBSTEPS, at_rest, motion
from ur_core.errors import MotionError
from ur_core.kinematics.ur10 import JOINT_RANGE_RAD, JOINT_SPEED_RAD_S
from ur_emulator.motion import MotionGenerator
from ur_emulator.motion.servo import Servo
from ur_emulator.motion.trajectories import ACCELERATION_LIMIT_RAD_S2, Superposed

SIX = st.lists(st.floats(-1, 1), min_size=6, max_size=6).map(np.array)
NAMES = (
    "movej",
    "movel",
    "movec",
    "servoj",
    "speedj",
    "speedl",
    "stopj",
    "stopl",
    "force",
    "end_force",
    "freedrive",
    "end_freedrive",
    "halt",
    "set_tcp",
    "nothing",
)
COMMAND = st.tuples(
    st.sampled_from(NAMES), SIX, st.floats(0.2, 5.0), st.floats(0.05, 1.5), st.integers(1, 60), st.booleans()
)


def _command(arm: MotionGenerator, name: str, x: np.ndarray, a: float, v: float, blends: bool) -> None:
    r = 0.05 if blends else 0.0
    here = np.array(arm.tcp_pose(arm.q))
    if name == "movej":
        arm.move_joints(arm.q + x, a, v, 0.0, r)
    elif name == "movel":
        arm.move_linear(here + 0.2 * x, a, v, 0.0, r)
    elif name == "movec":
        arm.move_circular(here + np.array([0.1, 0.05 * x[0], 0, 0, 0, 0]), here + 0.1 * x, a, v, r)
    elif name == "servoj":
        arm.servo_joints(arm.q + 0.02 * x, 0.1 * v, 0.03 + 0.1 * v, 300 * a)
    elif name == "speedj":
        arm.speed_joints(2 * x, a, v if blends else 0.0)
    elif name == "speedl":
        arm.speed_linear(0.3 * x, a, v if blends else 0.0)
    elif name == "stopj":
        arm.stop_joints(a)
    elif name == "stopl":
        arm.stop_linear(a)
    elif name == "force":
        arm.force_mode(here, x > 0, 20 * x, 2, [0.1] * 6)
    elif name == "freedrive":
        arm.freedrive(x > 0, here)
    elif name == "set_tcp":
        arm.set_tcp(0.2 * x)
    elif name != "nothing":
        {"halt": arm.halt, "end_force": arm.end_force_mode, "end_freedrive": arm.end_freedrive}[name]()


# Promised accelerations, rad/s²: the limit of programs, which a governed path may exceed by a tenth. Where two motions
# add up, it is twice that. The compliance of the TCP comes on top.
PROGRAM = 1.1 * ACCELERATION_LIMIT_RAD_S2
COMPLIANCE = 8.0


def _promised(arm: MotionGenerator, law: tuple[float, float]) -> float:
    """Return the acceleration (rad/s²) that no joint of the present motion exceeds in trajectory time."""
    trajectory = arm._trajectory
    if not isinstance(trajectory, Servo):
        return (2 if isinstance(trajectory, Superposed) else 1) * PROGRAM + COMPLIANCE
    # The law is an oscillator, whose energy falls: |gain e| and |gain lookahead v| are below their parts of it.
    gain, lookahead = law
    away, rate = np.abs(trajectory.target - trajectory.q), np.abs(trajectory.rate())
    energy = np.sqrt(rate**2 + gain * away**2).max()
    return (np.sqrt(gain) + gain * lookahead) * energy + PROGRAM + COMPLIANCE


@settings(max_examples=scaled(1500, 33))
@example(  # the wrist turns while the TCP's compliance ends
    [
        ("set_tcp", np.array([0, 0, 0, 0, 0, -0.75]), 1.0, 1.0, 1, False),
        ("freedrive", np.ones(6), 1.0, 1.0, 60, False),
        ("stopj", np.zeros(6), 1.0, 1.0, 1, False),
        ("movel", np.array([-1.0, 0, 0, 0, 0, 0]), 4.0, 1.0, 39, False),
    ],
    np.array([-1.0, 0, 0, 0, -1.0, 0]),
    [1.0] * 8,
)
@example(  # stops what yields while time slows down
    [
        *([("nothing", np.zeros(6), 1.0, 1.0, 1, False)] * 3),
        ("freedrive", np.array([0, 0, 0, 1.0, 0, 1.0]), 1.0, 1.0, 23, False),
        ("movej", np.zeros(6), 1.0, 1.0, 1, False),
        ("halt", np.zeros(6), 1.0, 1.0, 1, False),
    ],
    np.array([0, 0, 0, 1.0, 1.0, 0]),
    [0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 0.0],
)
@given(
    commands=st.lists(COMMAND, min_size=1, max_size=8),
    wrench=SIX,
    scalings=st.lists(st.sampled_from([0.0, 0.3, 1.0]), min_size=8, max_size=8),
)
def test_any_commands_move_without_jumps(commands, wrench, scalings):
    arm = motion()
    q, speed, scaling, law, promised = arm.q.copy(), np.zeros(6), 1.0, (0.0, 0.0), 0.0
    for (name, x, a, v, ticks, blends), wanted in zip(commands, scalings, strict=False):
        _command(arm, name, x, a, v, blends)
        if name == "servoj":
            law = max(300 * a, 100.0), 0.03 + 0.1 * v
        for _ in range(ticks):
            before = scaling
            scaling += min(max(wanted - scaling, -0.1), 0.1)
            if scaling < 1e-9:
                scaling = 0.0
            fastest = np.abs(arm._rate + arm._yield).max()
            # A difference of two steps can belong to two motions.
            most = max(promised, _promised(arm, law))
            plan = arm.plan(scaling, wrench=30 * wrench)
            # The rows are differences of each other, across ticks, too.
            path = np.vstack([plan[:, 0], arm.q[None]])
            assert np.array_equal(plan[0, 0], q)
            assert np.abs(np.diff(path, axis=0) - plan[:, 1] * DT).max() < 1e-12
            accelerations = np.diff(np.vstack([speed[None], plan[:, 1]]), axis=0) / DT
            assert np.abs(accelerations - plan[:, 2]).max() < 1e-6
            assert np.array_equal(arm.qd, plan[-1, 1])
            assert np.array_equal(arm.qdd, plan[-1, 2])
            assert np.isfinite(plan).all()
            # 10 % for servoj and near singularities, 40 % for the compliance of the TCP.
            assert (np.abs(plan[:, 1]) <= 1.5 * JOINT_SPEED_RAD_S + 1e-9).all()
            promised = _promised(arm, law)
            change = abs(scaling - before)  # within one physics step
            fastest = max(fastest, np.abs(arm._rate + arm._yield).max())
            most = max(most, promised) * (1 + change) + change / DT * fastest
            assert np.abs(plan[:, 2]).max() <= most + 1e-6
            q, speed = arm.q, arm.qd
        if arm.fault is not None and blends:
            arm.fault = None
    arm.halt()
    if arm.fault is not None or arm.moving:
        at_rest(arm)
    assert (np.abs(arm.q) <= JOINT_RANGE_RAD + 0.25).all()


@pytest.mark.parametrize("bad", [math.nan, math.inf, -math.inf, "1", None])
@pytest.mark.parametrize("place", range(6))
def test_arguments_that_are_no_numbers_move_nothing(bad, place):
    arm = motion()
    values = list(Q0)
    values[place] = bad
    calls = [
        lambda: arm.move_joints(values, 1.0, 1.0),
        lambda: arm.move_linear(values, 1.0, 1.0),
        lambda: arm.move_process(values, 1.0, 1.0),
        lambda: arm.move_circular(values, Q0, 1.0, 1.0),
        lambda: arm.move_circular(Q0, values, 1.0, 1.0),
        lambda: arm.servo_circular(values, 1.0, 1.0),
        lambda: arm.servo_joints(values, 0.008, 0.1, 300),
        lambda: arm.speed_joints(values, 1.0),
        lambda: arm.speed_linear(values, 1.0),
        lambda: arm.force_mode(values, [0] * 6, [0.0] * 6, 2, [0.1] * 6),
        lambda: arm.force_mode([0.0] * 6, [0] * 6, values, 2, [0.1] * 6),
        lambda: arm.force_mode([0.0] * 6, [0] * 6, [0.0] * 6, 2, values),
        lambda: arm.freedrive([1] * 6, values),
        lambda: arm.set_tcp(values),
        lambda: arm.forward(values),
        lambda: arm.inverse(values, Q0),
        lambda: arm.inverse(arm.tcp_pose(Q0), values),
        lambda: arm.move_joints(Q0 + 0.1, bad, 1.0),
        lambda: arm.move_joints(Q0 + 0.1, 1.0, bad),
        lambda: arm.move_joints(Q0 + 0.1, 1.0, 1.0, bad),
        lambda: arm.move_linear(arm.tcp_pose(Q0), 1.0, 1.0, 0.0, bad),
        lambda: arm.servo_joints(Q0, bad, 0.1, 300),
        lambda: arm.servo_joints(Q0, 0.008, bad, 300),
        lambda: arm.servo_joints(Q0, 0.008, 0.1, bad),
        lambda: arm.speed_joints(Q0, 1.0, bad),
        lambda: arm.stop_joints(bad),
        lambda: arm.stop_linear(bad),
        lambda: arm.force_mode_settings(gain_scaling=math.nan if bad is None else bad),
    ]
    for call in calls:
        with pytest.raises(MotionError):
            call()
    plan = arm.plan()
    assert not plan[:, 1:].any()
    assert not arm.moving


@pytest.mark.parametrize(
    "call",
    [
        lambda arm: arm.move_joints(Q0[:5], 1.0, 1.0),
        lambda arm: arm.move_joints([*Q0, 0.0], 1.0, 1.0),
        lambda arm: arm.move_joints(Q0 + 0.1, 0.0, 1.0),
        lambda arm: arm.move_joints(Q0 + 0.1, 1.0, -1.0),
        lambda arm: arm.move_joints(Q0 + 0.1, 1.0, 1.0, -1.0),
        lambda arm: arm.move_joints(Q0 + 0.1, 1.0, 1.0, 0.0, -0.1),
        lambda arm: arm.servo_joints(Q0, -0.1, 0.1, 300),
        lambda arm: arm.speed_joints(Q0, 0.0),
        lambda arm: arm.stop_joints(0.0),
        lambda arm: arm.stop_linear(-1.0),
        lambda arm: arm.move_linear([1e300, 0, 0, 0, 0, 0], 1.0, 1.0),
        lambda arm: arm.move_linear([0, 0, 0, 1e300, 0, 0], 1.0, 1.0),
        lambda arm: arm.force_mode([0.0] * 6, [1] * 6, [0.0] * 6, 4, [0.1] * 6),
        lambda arm: arm.plan(1.01),
        lambda arm: arm.plan(-0.01),
        lambda arm: arm.plan(math.nan),
        lambda arm: motion([math.nan] * 6),
    ],
)
def test_arguments_that_make_no_sense(call):
    arm = motion()
    with pytest.raises(MotionError):
        call(arm)
    assert np.array_equal(arm.plan()[:, 0], np.tile(Q0, (SUBSTEPS, 1)))


@pytest.mark.parametrize("number", [1e-300, 1e-12, 1e12, 1e300])
def test_extreme_numbers_are_survived(number):
    for command in (
        lambda arm: arm.move_joints(Q0 + 0.5, number, 1.0),
        lambda arm: arm.move_joints(Q0 + 0.5, 1.0, number),
        lambda arm: arm.move_joints(Q0 + 0.5, 1.0, 1.0, number),
        lambda arm: arm.move_joints(Q0 + 0.5, 1.0, 1.0, 0.0, number),
        lambda arm: arm.move_linear(np.array(arm.tcp_pose(Q0)) + 0.05, number, 0.1),
        lambda arm: arm.move_linear(np.array(arm.tcp_pose(Q0)) + 0.05, 1.0, number),
        lambda arm: arm.servo_joints(Q0 + 0.01, number, number, number),
        lambda arm: arm.speed_joints([number] * 6, 1.0, number),
        lambda arm: arm.speed_joints([1.0] * 6, number),
        lambda arm: arm.speed_linear([number] * 6, number, number),
        lambda arm: arm.force_mode([0.0] * 6, [1] * 6, [number] * 6, 1, [number] * 6),
    ):
        arm = motion()
        command(arm)
        for _ in range(30):
            plan = arm.plan(wrench=[number] * 6)
            assert np.isfinite(plan).all()
            assert (np.abs(plan[:, 1]) <= 1.2 * JOINT_SPEED_RAD_S).all()
        arm.stop_joints(1.0)
        arm.plan()
