"""`optimovej` and `optimovel`: moves at fractions of what the arm can do."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tests.soak import scaled
from tests.ur_emulator.test_direct_torque import TICK_S, Arm
from ur_core.kinematics.dynamics import inverse_dynamics
from ur_core.kinematics.robots import ROBOTS
from ur_core.kinematics.ur10 import nominal_dh
from ur_core.protocol.modes import RuntimeState, SafetyMode
from ur_emulator.motion.capability import Load, joint_capability, line_capability
from ur_emulator.motion.tool_kinematics import ArmKinematics, Frame, Tcp

ROBOT = ROBOTS["ur10e"]
UNLOADED = Load(0.0, (0.0, 0.0, 0.0))


@pytest.fixture(scope="module")
def arm():
    arm = Arm(polyscope="5.22")
    yield arm
    arm.close()


def go(arm, body):
    """Run a program to its end, and return positions (n, 6)."""
    arm.run(body)
    path = [arm.q]
    for _ in range(3000):
        arm.tick()
        path.append(arm.q)
        if arm.state == RuntimeState.STOPPED:
            return np.array(path)
    raise AssertionError(f"the program does not end: {arm.controller.safety.reason}")


def at_home(arm):
    if np.abs(arm.q - arm.home).max() > 1e-6:
        go(arm, f"movej({arm.home.tolist()}, a=8, v=3)\nsleep(0.1)")


joints = st.lists(st.floats(-0.6, 0.6), min_size=6, max_size=6)


@pytest.mark.parametrize("shift", [(0.5, -0.2, -0.3, 0.2, 0.3, 0.1), (-0.1, 0.0, 0.1, 0.0, -0.4, 0.3)])
def test_the_arm_follows_the_quickest_move(arm, shift):
    at_home(arm)
    goal = np.add(arm.home, shift)
    path = go(arm, f"optimovej({goal.tolist()}, a=1, v=1)\nsleep(0.05)")
    assert np.abs(path[-1] - goal).max() < 1e-3
    speeds = np.abs(np.diff(path, axis=0)) / TICK_S
    assert 0.5 < (speeds / ROBOT.joint_speed_rad_s).max() <= 1.02


def test_a_long_move_reaches_its_fraction_of_the_speed(arm):
    at_home(arm)
    path = go(arm, f"optimovej({np.add(arm.home, [0, 0, 0, 0, 0, 1.5]).tolist()}, a=0.8, v=0.6)")
    assert np.abs(np.diff(path[:, 5])).max() / TICK_S == pytest.approx(0.6 * ROBOT.joint_speed_rad_s[5], rel=1e-3)


@pytest.mark.parametrize("move", ["optimovej({goal}", "optimovel(get_forward_kin({goal})"])
def test_greater_fractions_are_quicker(arm, move):
    lengths = []
    for fractions in (")", ", a=0.6, v=0.5)", ", a=1, v=1)"):
        at_home(arm)
        call = move.format(goal=np.add(arm.home, [0.1, 0.05, -0.1, 0.1, 0.1, 0.2]).tolist())
        lengths.append(len(go(arm, call + fractions)))
    assert lengths == sorted(lengths, reverse=True)
    assert lengths[0] > 1.3 * lengths[-1]


def test_lines_are_straight(arm):
    at_home(arm)
    kinematics, tool, shift = arm.controller.motion.arm, Tcp(), np.array([0.1, -0.05, 0.1])
    start = kinematics.tcp(arm.q, tool).position
    goal = [*(start + shift).tolist(), *arm.controller.motion.tcp_pose(arm.q)[3:]]
    path = go(arm, f"optimovel(p{goal}, a=1, v=1)\nsleep(0.05)")
    places = np.array([kinematics.tcp(q, tool).position for q in path[::5]]) - start
    direction = shift / np.linalg.norm(shift)
    assert np.abs(places - np.outer(places @ direction, direction)).max() < 1e-3
    assert np.abs(kinematics.tcp(path[-1], tool).position - goal[:3]).max() < 1e-3


@pytest.mark.parametrize("name", ["optimovej", "optimovel"])
@pytest.mark.parametrize(
    ("arguments", "reason"),
    [
        ("a=1.4", "a of {name} is 1.4: it is a fraction of what the arm can do, above 0 and at most 1"),
        ("v=0", "v of {name} is 0: it is a fraction"),
        ("v=-0.5", "v of {name} is -0.5: it is a fraction"),
        ("v=read_input_float_register(0)", "v of {name} is nan: it must be a finite number"),
        ("r=-1", "must not be negative"),
    ],
)
def test_fractions_out_of_bounds_are_refused(arm, name, arguments, reason, caplog):
    at_home(arm)
    arm.controller.registers.input_double[0] = math.nan
    before = arm.q
    goal = "[0, -1.5, 1.5, -1.5, -1.5, 0]" if name == "optimovej" else "p[0.5, 0.2, 0.4, 0, 3.1, 0]"
    go(arm, f"{name}({goal}, {arguments})")
    assert reason.format(name=name) in caplog.text
    assert np.abs(arm.q - before).max() < 1e-6


@pytest.mark.parametrize("goal", ["[0, -1.5, 1.5]", '"cup"', "5"])
@pytest.mark.parametrize("name", ["optimovej", "optimovel"])
def test_goals_that_are_no_target_are_refused(arm, name, goal):
    at_home(arm)
    before = arm.q
    go(arm, f"{name}({goal})")
    assert np.abs(arm.q - before).max() < 1e-6


def test_a_pose_out_of_reach_stops_the_arm_protectively():
    arm = Arm("optimovel(p[3, 0, 0.4, 0, 3.1, 0])\nsleep(1)", polyscope="5.22")
    try:
        arm.tick(5)
        assert arm.controller.values["safety_mode"] == SafetyMode.PROTECTIVE_STOP
    finally:
        arm.close()


@settings(max_examples=scaled(200), deadline=None)
@given(robot=st.sampled_from(("ur3e", "ur5e", "ur10e", "ur20")), start=joints, shift=joints, mass=st.floats(0.0, 3.0))
def test_the_largest_acceleration_takes_the_torque_of_one_joint(robot, start, shift, mass):
    """Inverse dynamics at both ends: no joint exceeds its torque, and one reaches it unless the cap is reached."""
    facts, load = ROBOTS[robot], Load(mass, (0.0, 0.0, 0.05))
    q, distance = np.add(start, [0, -1.4, 1.6, -1.8, -1.6, 0]), float(np.abs(shift).max())
    if distance < 0.01:
        return
    able = joint_capability(robot, q, q + shift, load)
    slope, used = np.array(shift) / distance, []
    for place in (q, q + shift):
        weight = inverse_dynamics(place, np.zeros(6), np.zeros(6), *load, robot=robot)
        total = inverse_dynamics(place, np.zeros(6), able.acceleration * slope, *load, robot=robot)
        rotors = able.acceleration * slope * facts.armature_kg_m2
        # Weight may help or hinder; only the hindered side is used.
        used.append((np.abs(total + rotors - weight) + np.abs(weight)) / facts.joint_torque_nm)
    assert np.max(used) <= 1.0 + 1e-9
    assert np.max(used) == pytest.approx(1.0) or able.acceleration == 40.0
    assert (np.abs(slope) * able.speed <= facts.joint_speed_rad_s + 1e-9).all()


def test_the_capability_on_a_line_is_that_of_its_joints():
    arm, tool = ArmKinematics(nominal_dh("ur10e")), Tcp()
    q = np.array([0.0, -1.4, 1.8, -2.0, -1.57, 0.0])
    start = arm.tcp(q, tool)
    able = line_capability(arm, tool, q, Frame(np.add(start.position, [0.0, 0.0, 0.1]), start.rotation), UNLOADED)
    assert able is not None
    jacobian = arm.jacobian(q, tool)
    rates = np.linalg.solve(jacobian, [0.0, 0.0, able.speed, 0.0, 0.0, 0.0])
    assert 0.8 < (np.abs(rates) / ROBOT.joint_speed_rad_s).max() <= 1.05
    assert line_capability(arm, tool, q, Frame(np.array([3.0, 0.0, 0.0]), start.rotation), UNLOADED) is None
    same = line_capability(arm, tool, q, start, UNLOADED)
    assert same is not None
    assert same.speed == 5.0
