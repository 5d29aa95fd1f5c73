"""`direct_torque` of an emulated controller, on the simulated arm behind it."""

from __future__ import annotations

import math
import sys
from collections.abc import Iterator

import mujoco
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tests.soak import scaled
from tests.ur_emulator.ticking import Lone, program
from ur_core.kinematics import dynamics
from ur_core.kinematics.dynamics import inverse_dynamics, mass_matrix
from ur_core.kinematics.robots import ROBOTS
from ur_core.kinematics.ur10 import JOINT_RANGE_RAD
from ur_core.protocol.modes import RuntimeState, SafetyMode
from ur_core.types import Array

TICK_S = 0.002
ROBOT = ROBOTS["ur10e"]
HOLD = "while True:\n  direct_torque([0, 0, 0, 0, 0, 0])\nend"


class Arm(Lone):
    """Emulated UR10e, or UR10, which runs a program."""

    def __init__(self, body: str = "", *, polyscope: str = "5.26") -> None:
        super().__init__(robot="ur10" if polyscope.startswith("3") else "ur10e", polyscope=polyscope)
        self.server = self.emulator.servers[0]
        self.controller = self.server.controller
        self.home = self.q
        if body:
            self.run(body)

    @property
    def q(self) -> Array:
        return self.emulator.world.read(0).q_rad.copy()

    @property
    def qd(self) -> Array:
        return self.emulator.world.read(0).qd_rad_s.copy()

    @property
    def state(self) -> int:
        return int(self.controller.values["runtime_state"])

    def run(self, body: str) -> None:
        self.controller.run_script(program(body))

    def passing(self, seconds: float) -> Array:
        """Return positions (n, 6) of the following control periods."""
        path = [self.q]
        for _ in range(round(seconds / TICK_S)):
            self.tick()
            path.append(self.q)
        return np.array(path)


@pytest.fixture
def arm() -> Iterator[Arm]:
    arm = Arm()
    yield arm
    arm.close()


def test_the_arm_holds_still_at_no_torque(arm):
    arm.run(HOLD)
    path = arm.passing(0.5)
    assert arm.controller.motion.torques is not None
    assert np.abs(path - path[0]).max() < 1e-9
    assert arm.controller.values["target_qdd"] == (0.0,) * 6


def test_a_torque_accelerates_the_joints_as_the_mass_matrix_demands(arm):
    torque = np.array([20.0, -15.0, 10.0, 3.0, -2.0, 1.0])
    arm.run(f"while True:\n  direct_torque({torque.tolist()})\nend")
    arm.tick(6)  # the first period runs the program
    inertia = mass_matrix(arm.home, robot="ur10e") + np.diag(ROBOT.armature_kg_m2)
    assert np.allclose(arm.qd / (6 * TICK_S), np.linalg.solve(inertia, torque), rtol=0.02)


def test_a_spring_in_the_program_swings_with_its_period(arm):
    inertia = float(mass_matrix(arm.home, robot="ur10e")[5, 5] + ROBOT.armature_kg_m2[5])
    stiffness = 5.0
    arm.run(
        "q0 = get_actual_joint_positions()\nwhile True:\n  q = get_actual_joint_positions()\n"
        f"  direct_torque([0, 0, 0, 0, 0, {stiffness} * (q0[5] + 0.2 - q[5])])\nend"
    )
    period_s = math.tau * math.sqrt(inertia / stiffness)
    wrist = arm.passing(2.2 * period_s)[:, 5] - arm.home[5]
    peaks = [k for k in range(1, len(wrist) - 1) if wrist[k - 1] < wrist[k] >= wrist[k + 1]]
    assert np.diff(peaks) * TICK_S == pytest.approx(period_s, rel=0.02)
    assert wrist.max() == pytest.approx(0.4, rel=0.02)


def test_without_another_call_the_arm_returns_to_position_control_and_stops(arm):
    arm.run("k = 0\nwhile k < 100:\n  direct_torque([8, 0, 0, 0, 0, 0])\n  k = k + 1\nend\nwhile True:\n  sync()\nend")
    arm.passing(0.2)
    speed = arm.qd[0]
    assert speed > 0.1
    assert arm.controller.motion.torques is not None
    arm.tick()
    assert arm.controller.motion.torques is None
    path = arm.passing(0.5)
    assert arm.state == RuntimeState.PLAYING
    assert arm.controller.values["safety_mode"] == SafetyMode.NORMAL
    assert np.abs(arm.qd).max() < 1e-3
    assert path[-1, 0] - path[0, 0] < 1.2 * speed**2 / (2 * 8.0) + 0.01
    assert np.abs(arm.passing(0.2) - path[-1]).max() < 1e-4


@pytest.mark.parametrize(
    "after",
    ["stopj(4)", "speedj([0.3, 0, 0, 0, 0, 0], 2, 0.5)\nstopj(2)", "movej(get_actual_joint_positions(), a=2, v=1)"],
)
def test_another_command_takes_over_from_the_measured_motion(arm, after):
    arm.run(f"k = 0\nwhile k < 100:\n  direct_torque([8, 0, 0, 0, 0.2, 0])\n  k = k + 1\nend\n{after}")
    path = arm.passing(2.0)
    assert arm.state == RuntimeState.STOPPED
    assert arm.controller.values["safety_mode"] == SafetyMode.NORMAL
    assert np.abs(arm.qd).max() < 1e-3
    speeds = np.diff(path, axis=0) / TICK_S
    assert speeds.max() > 0.1
    assert np.abs(np.diff(speeds, axis=0)).max() / TICK_S < 12.0  # no jolt


def test_torques_act_whatever_the_speed_slider_is(arm):
    arm.controller.io.slider = 0.0
    arm.passing(0.5)
    arm.run("while True:\n  direct_torque([0, 0, 0, 0, 0, 1])\nend")
    arm.passing(0.05)
    assert arm.qd[5] > 0.1
    arm.passing(1.0)
    assert arm.controller.values["safety_mode"] == SafetyMode.PROTECTIVE_STOP  # and so do the limits
    assert np.abs(arm.qd).max() < 1e-2


def test_a_payload_that_is_set_and_not_there_lifts_the_arm(arm):
    arm.run(f"set_payload(5.0, [0, 0, 0.1])\n{HOLD}")
    arm.tick(2)
    lift = arm.controller.torques.torque_nm
    q, still = arm.controller.reading.q_rad, np.zeros(6)
    expected = inverse_dynamics(q, still, still, 5.0, (0.0, 0.0, 0.1), robot="ur10e")
    expected -= inverse_dynamics(q, still, still, robot="ur10e")
    assert np.allclose(lift, expected, atol=1e-9)
    height = arm.controller.values["actual_TCP_pose"][2]
    arm.passing(0.2)
    assert arm.controller.values["actual_TCP_pose"][2] > height + 0.01


@pytest.mark.parametrize(
    ("call", "reason"),
    [
        ("[0, 331, 0, 0, 0, 0]", "the torque of direct_torque is 331 N·m at joint 1: allowed are ±330"),
        ("[0, 0, 0, 0, 0, -57]", "is -57 N·m at joint 5: allowed are ±56"),
        ("[0, 0, read_input_float_register(0), 0, 0, 0]", "must be six finite numbers"),
        ("[0, 0, read_input_float_register(1), 0, 0, 0]", "must be six finite numbers"),
        ("[0, 0, 0, 0, 0]", "must be six finite numbers"),
        ("5", "must be six finite numbers"),
        ("[0, 0, 0, 0, 0, 0], coulomb_scale=[0, 0, 0, 0, 0, 1.1]", "coulomb_scale of direct_torque is"),
        ("[0, 0, 0, 0, 0, 0], viscous_scale=[0, -0.1, 0, 0, 0, 0]", "viscous_scale of direct_torque is"),
        ("[0, 0, 0, 0, 0, 0], viscous_scale=[1, 1]", "viscous_scale of direct_torque must be six finite numbers"),
        ('[0, 0, 0, 0, 0, 0], friction_comp="yes"', "friction_comp of direct_torque is 'yes'"),
    ],
)
def test_commands_out_of_bounds_stop_the_program_and_move_nothing(arm, call, reason, caplog):
    arm.controller.registers.input_double[:2] = [math.nan, math.inf]
    arm.run(f"direct_torque({call})\nwhile True:\n  sync()\nend")
    path = arm.passing(0.1)
    assert arm.state == RuntimeState.STOPPED
    assert reason in caplog.text
    assert np.abs(path - path[0]).max() < 1e-9
    assert arm.controller.motion.torques is None


def test_an_invalid_torque_stops_an_arm_that_moves(arm):
    arm.run(
        "k = 0\nwhile k < 100:\n  direct_torque([8, 0, 0, 0, 0, 0])\n  k = k + 1\nend\n"
        "direct_torque([999, 0, 0, 0, 0, 0])"
    )
    arm.passing(0.21)
    assert arm.qd[0] > 0.1
    arm.passing(0.3)
    assert arm.state == RuntimeState.STOPPED
    assert np.abs(arm.qd).max() < 1e-3


@settings(max_examples=scaled(60), deadline=None)
@given(joint=st.integers(0, 5), sign=st.sampled_from((-1, 1)), ratio=st.floats(0.05, 1.0))
def test_limits_of_speeds_and_positions_stop_the_arm(joint, sign, ratio):
    torque = [0.0] * 6
    torque[joint] = sign * ratio * ROBOT.joint_torque_nm[joint]
    arm = Arm(f"while True:\n  direct_torque({torque})\nend")
    try:
        path = arm.passing(3.0)
        assert arm.controller.values["safety_mode"] == SafetyMode.PROTECTIVE_STOP
        assert arm.controller.safety.reason.startswith(("C150A0: ", "C204A5: ", "C153A0: "))
        assert arm.controller.motion.torques is None
        assert np.abs(arm.qd).max() < 1e-2
        assert (np.abs(path) <= JOINT_RANGE_RAD + 0.05).all()
        assert (np.abs(np.diff(path, axis=0)) / TICK_S <= 1.5 * ROBOT.joint_speed_rad_s).all()
    finally:
        arm.close()


@pytest.mark.parametrize(
    "mode", [SafetyMode.PROTECTIVE_STOP, SafetyMode.SAFEGUARD_STOP, SafetyMode.ROBOT_EMERGENCY_STOP]
)
def test_stops_end_torque_control(arm, mode):
    arm.run("while True:\n  direct_torque([8, 0, 0, 0, 0, 0])\nend")
    arm.passing(0.2)
    assert arm.qd[0] > 0.1
    arm.controller.stop(mode)
    arm.passing(0.4)
    assert arm.controller.motion.torques is None
    assert np.abs(arm.qd).max() < 1e-3


def test_force_mode_excludes_torque_control(arm, caplog):
    force = "force_mode(p[0,0,0,0,0,0], [0,0,1,0,0,0], [0,0,5,0,0,0], 2, [0.1,0.1,0.1,0.3,0.3,0.3])"
    arm.run(f"{force}\n{HOLD}")
    arm.tick(3)
    assert "call end_force_mode before" in caplog.text
    arm.run(f"{force}\nend_force_mode()\n{HOLD}")
    arm.tick(3)
    assert arm.state == RuntimeState.PLAYING


@pytest.mark.parametrize(
    ("polyscope", "call", "scale", "message"),
    [
        ("5.23", "", [0.8, 0.8, 0.7, 0.8, 0.8, 0.8], ""),
        ("5.23", ", friction_comp=False", [0.0] * 6, ""),
        ("5.25", "", [0.8, 0.8, 0.7, 0.8, 0.8, 0.8], ""),
        ("5.25", ", coulomb_scale=[0, 0.1, 0.2, 0.3, 0.4, 0.5]", [0, 0.1, 0.2, 0.3, 0.4, 0.5], ""),
        ("5.25", ", viscous_scale=[0, 0, 0, 0, 0, 0]", [0.8, 0.8, 0.7, 0.8, 0.8, 0.8], ""),
        ("5.25", ", friction_comp=False", [0.0] * 6, "friction_comp is deprecated"),
        ("5.25", ", coulomb_scale=[1, 1, 1, 1, 1, 1], friction_comp=False", [1.0] * 6, ""),
    ],
)
def test_each_version_has_its_compensation_of_friction(polyscope, call, scale, message):
    arm, texts = Arm(polyscope=polyscope), []
    arm.controller.send_text = texts.append
    arm.run(f"while True:\n  direct_torque([0, 0, 0, 0, 0, 0]{call})\nend")
    try:
        arm.tick(10)
        assert arm.state == RuntimeState.PLAYING
        assert arm.controller.motion.torques.coulomb_scale.tolist() == scale
        assert [message in text for text in texts] == ([True] if message else [])
    finally:
        arm.close()


@pytest.mark.parametrize(
    ("polyscope", "call", "reason"),
    [
        (
            "5.12",
            "direct_torque([0, 0, 0, 0, 0, 0])",
            "it needs PolyScope 5.23 or later, and this controller has 5.12.5",
        ),
        ("5.22", "get_mass_matrix()", "it needs PolyScope 5.23 or later, and this controller has 5.22.0"),
        ("3.15", "optimovej([0, 0, 0, 0, 0, 0])", "it needs PolyScope 5.21 or later, and this controller has 3.15.8"),
        ("5.23", "direct_torque([0, 0, 0, 0, 0, 0], coulomb_scale=[0, 0, 0, 0, 0, 0])", "coulomb_scale"),
        ("5.26", "direct_force([0, 0, 0, 0, 0, 0])", "there is no such function"),
    ],
)
def test_what_a_version_lacks_is_refused_with_the_version_that_has_it(polyscope, call, reason, caplog):
    arm = Arm(f"{call}\nsleep(1)", polyscope=polyscope)
    try:
        arm.tick(3)
        assert arm.state == RuntimeState.STOPPED
        assert reason in caplog.text
    finally:
        arm.close()


@pytest.mark.parametrize("call", ["get_mass_matrix()", "optimovej([0, -1, 1, 0, 0, 0])"])
def test_a_program_ends_where_the_extra_of_a_function_is_missing(call, caplog, monkeypatch):
    monkeypatch.setitem(sys.modules, "pinocchio", None)
    dynamics._model.cache_clear()
    arm = Arm(f"{call}\nsleep(1)", polyscope="5.26")
    try:
        arm.tick(40)
        assert arm.state == RuntimeState.STOPPED
        assert 'the dynamics of an arm needs pin: pip install "ur-core[dynamics]"' in caplog.text
    finally:
        arm.close()


def test_a_program_may_define_a_function_that_its_version_lacks():
    arm = Arm(
        "def direct_torque(t):\n  write_output_float_register(0, t)\nend\ndirect_torque(4.5)\nsleep(1)",
        polyscope="5.12",
    )
    try:
        arm.tick(2)
        assert arm.controller.registers.output_double[0] == 4.5
    finally:
        arm.close()


def test_the_controller_knows_the_dynamics_of_the_simulated_arm(arm):
    """Compare with MuJoCo's own mass matrix, bias forces and Jacobian."""
    q, qd = arm.home + 0.1, np.array([0.5, -0.4, 0.3, 0.9, -0.7, 0.6])
    model, data = arm.emulator.world.draw()
    data.qpos[:6], data.qvel[:6] = q, qd
    mujoco.mj_forward(model, data)
    full = np.zeros((model.nv, model.nv))
    for row, unit in zip(full, np.eye(model.nv), strict=True):
        mujoco.mj_mulM(model, data, row, unit)
    model.opt.gravity[:] = 0.0
    mujoco.mj_forward(model, data)
    builtins = arm.controller.program.builtins
    given = (q.tolist(), qd.tolist())
    assert np.allclose(builtins["get_mass_matrix"](given[0], True), full[:6, :6], atol=1e-6)
    rotors = np.diag(ROBOT.armature_kg_m2)
    assert np.allclose(builtins["get_mass_matrix"](given[0]), full[:6, :6] - rotors, atol=1e-6)
    assert np.allclose(builtins["get_coriolis_and_centrifugal_torques"](*given), data.qfrc_bias[:6], atol=1e-6)
    pose, speed = arm.controller.motion.arm.pose_and_speed(q, qd, arm.controller.motion.tool)
    assert len(pose) == 6
    assert np.allclose(np.array(builtins["get_jacobian"](given[0])) @ qd, speed, atol=1e-9)
    h = 1e-4
    after = np.array(builtins["get_jacobian"]((q + h * qd).tolist()))
    before = np.array(builtins["get_jacobian"]((q - h * qd).tolist()))
    derivative = builtins["get_jacobian_time_derivative"](*given)
    assert np.allclose(derivative, (after - before) / (2 * h), atol=1e-6)
    tcp = [0.1, 0.0, 0.2, 0.0, 0.0, 0.0]
    lever = np.array(builtins["get_jacobian"](given[0], tcp)) - builtins["get_jacobian"](given[0])
    assert np.abs(lever[:3]).max() > 0.05
    assert np.allclose(lever[3:], 0.0)


def test_the_queries_are_of_the_present_state_by_default(arm):
    arm.run("while True:\n  direct_torque([8, 0, 0, 0, 0, 2])\nend")
    arm.passing(0.1)
    builtins, reading = arm.controller.program.builtins, arm.controller.reading
    q, qd = reading.q_rad.tolist(), reading.qd_rad_s.tolist()
    assert builtins["get_mass_matrix"]() == builtins["get_mass_matrix"](q)
    assert builtins["get_jacobian"]() == builtins["get_jacobian"](q)
    coriolis = builtins["get_coriolis_and_centrifugal_torques"]
    assert coriolis() == coriolis(q, qd)
    assert builtins["get_target_joint_accelerations"]() == [0.0] * 6
    inertia = mass_matrix(reading.q_rad, robot="ur10e") + np.diag(ROBOT.armature_kg_m2)
    expected = np.linalg.solve(inertia, np.array([8.0, 0, 0, 0, 0, 2.0]) - coriolis())
    assert np.allclose(builtins["get_actual_joint_accelerations"](), expected, atol=0.05)
    assert arm.controller.values["actual_current_as_torque"] == tuple(reading.torque_nm.tolist())
