"""Arms under torque control, against an integration of pinocchio's dynamics that shares nothing with MuJoCo."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st

from dual_ur10.assets.settings import default_mount, home_q_rad
from dual_ur10.envs.core.setup import EnvSetup
from dual_ur10.envs.sim.physics import Physics
from dual_ur10.envs.sim.servo_reference import ReferenceMotion
from dual_ur10.sim2real.cell.cell import Start
from dual_ur10.sim2real.cell.cell_config import CellConfig
from dual_ur10.sim2real.cell.perturbation import Perturbation
from tests.soak import scaled
from ur_core.kinematics.dynamics import inverse_dynamics, mass_matrix
from ur_core.kinematics.robots import ROBOTS
from ur_core.mjcf.torque_control import Torques
from ur_core.types import Array

FRICTION_NM = np.array([5.0, 5.0, 3.0, 1.0, 1.0, 1.0])
STILL = np.zeros(6)
SPRING_NM_RAD = np.array([200.0, 200.0, 100.0, 20.0, 20.0, 20.0])

Law = Callable[[Array], Array]


class Bench:
    """Two arms of one model in one cell; the left one is under torque control, the right one holds its position."""

    def __init__(
        self, robot: str = "ur10e", *, step_s: float | None = None, contacts: bool = True, **plant: Any
    ) -> None:
        self.robot = robot
        mounts = [default_mount(arm, robot) for arm in range(2)]
        cell = CellConfig(left=mounts[0], right=mounts[1], timestep_s=step_s)
        config = EnvSetup.resolve("SineTracking", {"cell": cell, "action_latency_ticks": 0}).config
        self.step_s = config.scene.timestep_s
        self.physics = Physics(config, 1, 1, 1, contacts=contacts)
        self.home = home_q_rad(mounts)
        self.motion = ReferenceMotion(np.zeros((1, 6, 12)))
        self.motion.q_rad[:] = self.home.ravel()
        if plant:
            self.physics.perturb(Perturbation(**plant).expanded(1), np.arange(1))
        self.physics.reset(Start(self.home[None]), np.arange(1))

    @property
    def q(self) -> Array:
        return self.physics.state(np.zeros(1), moved=False).q_rad[0, 0].copy()

    @property
    def qd(self) -> Array:
        return self.physics.state(np.zeros(1), moved=False).qd_rad_s[0, 0].copy()

    @property
    def energy_j(self) -> float:
        qd = self.qd
        return float(0.5 * qd @ (mass_matrix(self.q, robot=self.robot) + self.rotors) @ qd)

    @property
    def rotors(self) -> Array:
        return np.diag(ROBOTS[self.robot].armature_kg_m2)

    def run(self, law: Law, seconds: float, friction_scale: float = 1.0) -> Array:
        """Run under a law from positions to torques, and return positions (n, 6) from the first to the last."""
        path = [self.q]
        for _ in range(round(seconds / self.step_s)):
            self.physics.advance(self.motion, torques=(Torques(law(path[-1]), np.full(6, friction_scale)), None))
            path.append(self.q)
        return np.array(path)

    def expected(self, law: Law, start: Array, seconds: float) -> Array:
        """Return the same positions by pinocchio and a Runge-Kutta step of fourth order, from rest."""

        def slope(state: Array) -> Array:
            q, qd = state[:6], state[6:]
            inertial = inverse_dynamics(q, qd, STILL, gravity=False, robot=self.robot)
            matrix = mass_matrix(q, robot=self.robot) + self.rotors
            return np.concatenate([qd, np.linalg.solve(matrix, law(q) - inertial)])

        state, path, h = np.concatenate([start, STILL]), [start], self.step_s
        for _ in range(round(seconds / h)):
            one = slope(state)
            two = slope(state + h / 2 * one)
            three = slope(state + h / 2 * two)
            four = slope(state + h * three)
            state = state + h / 6 * (one + 2 * two + 2 * three + four)
            path.append(state[:6])
        return np.array(path)


def weight(robot: str) -> Law:
    """Return the law that takes the compensation of gravity away: the arm falls."""
    return lambda q: -inverse_dynamics(q, STILL, STILL, robot=robot)


def spring(rest: Array) -> Law:
    return lambda q: SPRING_NM_RAD * (rest - q)


@pytest.mark.parametrize(("robot", "scale"), [("ur10e", 0.0), ("ur10e", 0.8), ("ur5e", 0.8)])
def test_friction_holds_an_arm_still_without_torque(robot, scale):
    friction = FRICTION_NM * ROBOTS[robot].torque_ratio
    bench = Bench(robot, friction_nm=np.tile(friction, (2, 1)), mass_scale=1.01)  # 1 % of its weight is left to it
    seconds = scaled(30_000) * bench.step_s
    path = bench.run(lambda q: STILL, seconds, 1.0 - scale)
    assert np.rad2deg(np.abs(path[-1] - path[0])).max() < 0.01 * seconds / 60.0


@pytest.mark.parametrize("robot", ["ur10e", "ur5e", "ur30"])
def test_a_falling_arm_swings_like_a_pendulum(robot):
    bench = Bench(robot, contacts=False)
    path = bench.run(weight(robot), 0.6)
    expected = bench.expected(weight(robot), path[0], 0.6)
    assert np.ptp(expected, axis=0).max() > 1.0
    assert np.abs(path - expected).max() < 0.02 * np.ptp(expected, axis=0).max()


def test_oscillations_are_as_long_and_wide_as_expected():
    errors = []
    for step_s in (0.002, 0.001):
        bench = Bench(step_s=step_s, contacts=False)
        law = spring(bench.home[0] + [0.3, 0.2, -0.3, 0.4, 0.4, 0.4])
        path = bench.run(law, 1.5)
        expected = bench.expected(law, path[0], 1.5)
        errors.append(np.abs(path - expected).max())
    assert errors[0] < 0.02
    assert errors[1] < 0.6 * errors[0]  # the rest is the integrator's


def test_a_coasting_arm_keeps_its_energy():
    bench = Bench(contacts=False)
    bench.run(spring(bench.home[0] + 0.3), 0.4)
    before = bench.energy_j
    path = bench.run(lambda q: STILL, 0.2)
    assert before > 5.0
    assert np.ptp(path, axis=0).max() > 0.3
    assert bench.energy_j == pytest.approx(before, rel=0.01)


@settings(max_examples=scaled(100), deadline=None)
@given(
    joint=st.integers(0, 5),
    scale=st.floats(0.4, 0.9),
    ratio=st.floats(0.5, 0.9) | st.floats(1.1, 1.5),
    sign=st.sampled_from((-1.0, 1.0)),
)
@example(joint=1, scale=0.5, ratio=1.2, sign=1.0)
def test_a_joint_moves_if_its_torque_exceeds_the_friction_that_is_left(joint, scale, ratio, sign):
    bench = Bench(contacts=False, friction_nm=np.tile(FRICTION_NM, (2, 1)))
    torque = np.zeros(6)
    torque[joint] = sign * ratio * (1.0 - scale) * FRICTION_NM[joint]
    bench.run(lambda q: torque, 0.1, 1.0 - scale)
    assert (sign * bench.qd[joint] > 1e-4) == (ratio > 1.0)


def test_the_servos_work_as_before_once_torque_control_has_ended():
    plant = {"friction_nm": np.tile(FRICTION_NM, (2, 1))}
    bench, other = Bench(**plant), Bench(**plant)
    bench.run(lambda q: STILL, 0.1)
    other.physics.advance(other.motion)
    goal = np.concatenate([bench.home[0] + 0.01, bench.home[1]])
    for each in (bench, other):
        each.physics.reset(Start(each.home[None]), np.arange(1))
        each.motion.q_rad[:] = goal
    for _ in range(50):
        bench.physics.advance(bench.motion)
        other.physics.advance(other.motion)
    assert np.array_equal(bench.q, other.q)
    assert np.abs(bench.q - goal[:6]).max() < 0.005


def test_the_other_arm_holds_its_position():
    bench = Bench()
    bench.run(lambda q: np.array([20.0, 0.0, 0.0, 0.0, 0.0, 5.0]), 0.2)
    right = bench.physics.state(np.zeros(1), moved=False).q_rad[0, 1]
    assert np.ptp(np.array([bench.q, bench.home[0]]), axis=0).max() > 0.05
    assert np.abs(right - bench.home[1]).max() < 1e-6
