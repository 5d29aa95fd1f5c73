"""Table of robots: plausible figures, kinematics against ROS' description of the arms, and refusals."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from tests.kinematics.reference_arm import assert_reaches, calibration, independent_pose, random_q
from tests.soak import scaled
from ur_core import kinematics
from ur_core.errors import SettingsError, UnknownNameError
from ur_core.kinematics import ur10
from ur_core.kinematics.robot_model import REFERENCE_TORQUE_NM, RobotModel, stretched_inertia
from ur_core.kinematics.robots import ROBOTS, robot_model
from ur_core.kinematics.ur10 import JOINT_RANGE_RAD, NOMINAL_DH, DHParameters, nominal_dh

MODELS = pytest.mark.parametrize("model", ROBOTS.values(), ids=ROBOTS)

# Published figures, each beside the one of another source than the table's: lengths d1, a2, a3, d4, d5 and d6 of
# config/ur30/default_kinematics.yaml and of the user manual of the CB3.
FROM_OTHERS = {"ur30": (0.2363, -0.637, -0.5037, 0.201, 0.1593, 0.1543), "ur5": (0.089159, -0.425, -0.39225, 0.10915)}


def tensor(values: tuple[float, ...]) -> np.ndarray:
    xx, yy, zz, xy, xz, yz = values
    return np.array([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]])


def pose_by_offsets(q: np.ndarray, model: RobotModel) -> tuple[np.ndarray, np.ndarray]:
    """Flange in `base` by joint origins as xyz and rpy, as config/<model>/default_kinematics.yaml gives them."""
    d1, a2, a3, d4, d5, d6 = model.lengths_m
    quarter, half = np.pi / 2, np.pi
    origins = (
        ((0, 0, d1), (0, 0, 0)),
        ((0, 0, 0), (quarter, 0, 0)),
        ((a2, 0, 0), (0, 0, 0)),
        ((a3, 0, d4), (0, 0, 0)),
        ((0, -d5, 0), (quarter, 0, 0)),
        ((0, d6, 0), (quarter, half, half)),
    )
    position, rotation = np.zeros((len(q), 3)), Rotation.identity(len(q))
    for joint, (xyz, rpy) in enumerate(origins):
        position = position + rotation.apply(xyz)
        rotation = rotation * Rotation.from_euler("xyz", rpy) * Rotation.from_rotvec(q[:, joint, None] * [0, 0, 1])
    return position, rotation.as_matrix()


def test_all_models_of_the_three_generations_are_there() -> None:
    assert {name for name, model in ROBOTS.items() if model.family == "cb3"} == {"ur3", "ur5", "ur10"}
    assert len(ROBOTS) == 14
    assert all(name == model.name for name, model in ROBOTS.items())
    assert ROBOTS["ur10"].joint_torque_nm == REFERENCE_TORQUE_NM
    assert ROBOTS["ur10"].radius_ratio == (1.0, 1.0, 1.0)
    assert ROBOTS["ur10"].hard_speed_rad_s.tolist() == [1.68, 1.68, 2.51, 2.51, 2.51, 2.51]
    assert ur10.nominal_dh("ur10") is ur10.NOMINAL_DH
    for name, lengths in FROM_OTHERS.items():
        assert ROBOTS[name].lengths_m[: len(lengths)] == lengths


@MODELS
def test_the_figures_of_a_model_are_those_of_an_arm(model: RobotModel) -> None:
    d1, a2, a3, d4, d5, d6 = model.lengths_m
    assert a2 < a3 < 0 < min(d1, d4, d5, d6)
    # Reach is measured from the base axis to the middle of the wrist, by UR to 5 cm.
    assert abs(a2 + a3 - d5) == pytest.approx(model.reach_m, abs=0.14)
    assert min(model.mass_kg) > 0
    for values, mass, com in zip(model.inertia_kg_m2, model.mass_kg, model.com_m, strict=True):
        xx, yy, zz = np.linalg.eigvalsh(tensor(values))
        assert 0 < xx <= yy <= zz < xx + yy + 1e-6
        assert np.sqrt(zz / mass) < max(abs(a2), 0.1)  # radius of gyration
        assert np.linalg.norm(com) < abs(a2)
    # At full stretch the shoulder holds the arm and its payload, and 5 % more.
    stretched = kinematics.inverse_dynamics(np.zeros(6), np.zeros(6), np.zeros(6), model.payload_kg, robot=model.name)
    assert (1.05 * np.abs(stretched) < model.joint_torque_nm).all()
    for origin in (model.inertia_from, model.limits_from):
        assert origin is None or ROBOTS[origin] is not model


@MODELS
def test_lengths_place_the_flange_as_joint_origins_do(model: RobotModel) -> None:
    q = random_q(scaled(20_000), 31)
    position, rotation = kinematics.flange_pose(q, nominal_dh(model.name))
    expected = pose_by_offsets(q, model)
    assert np.abs(position - expected[0]).max() < 1e-9
    assert np.abs(rotation - expected[1]).max() < 1e-9


@MODELS
def test_every_reachable_pose_of_every_model_is_solved(model: RobotModel) -> None:
    dh, count = nominal_dh(model.name), scaled(20_000)
    q = random_q(count, 32)
    position, rotation = kinematics.flange_pose(q, dh)
    found, ok = kinematics.try_nearest(position, rotation, random_q(count, 33), dh)
    assert ok.all()
    assert (np.abs(found) <= JOINT_RANGE_RAD).all()
    reached = kinematics.flange_pose(found, dh)
    assert np.abs(reached[0] - position).max() < 1e-9
    assert np.abs(reached[1] - rotation).max() < 1e-9


@MODELS
def test_a_calibrated_arm_of_every_model_is_solved(model: RobotModel) -> None:
    nominal = nominal_dh(model.name)
    error = calibration(7, 0.3)  # of a UR10
    dh = DHParameters(
        *(
            tuple(np.add(getattr(nominal, name), np.subtract(getattr(error, name), getattr(NOMINAL_DH, name))))
            for name in ("a_m", "d_m", "alpha_rad", "theta_rad")
        ),
        robot=model.name,
    )
    assert not dh.is_nominal
    q = random_q(20, 34)
    position, rotation = independent_pose(q, dh)
    found, ok = kinematics.try_nearest(position, rotation, q, dh)
    assert ok.all()
    assert_reaches(found, position, rotation, dh)


@MODELS
def test_gravity_torque_is_the_slope_of_the_potential_energy(model: RobotModel) -> None:
    """Independent of pinocchio and MuJoCo: heights of the centres of mass by the textbook product of DH matrices."""
    dh = nominal_dh(model.name)

    def energy(q: np.ndarray) -> np.ndarray:
        pose, total = np.tile(np.eye(4), (len(q), 1, 1)), np.zeros(len(q))
        for link in range(6):
            cos, sin = np.cos(q[:, link]), np.sin(q[:, link])
            ca, sa = np.cos(dh.alpha_rad[link]), np.sin(dh.alpha_rad[link])
            step = np.zeros((len(q), 4, 4))
            step[:, 0] = np.stack([cos, -sin * ca, sin * sa, dh.a_m[link] * cos], -1)
            step[:, 1] = np.stack([sin, cos * ca, -cos * sa, dh.a_m[link] * sin], -1)
            step[:, 2], step[:, 3, 3] = (0.0, sa, ca, dh.d_m[link]), 1.0
            pose = pose @ step
            total += 9.81 * model.mass_kg[link] * (pose[:, 2, :3] @ np.array(model.com_m[link]) + pose[:, 2, 3])
        return total

    q, by = random_q(20, 35), 1e-4
    slope = np.stack([(energy(q + by * unit) - energy(q - by * unit)) / (2 * by) for unit in np.eye(6)], -1)
    zero = np.zeros(6)
    torque = kinematics.inverse_dynamics(q, zero, zero, robot=model.name)
    np.testing.assert_allclose(torque, slope, atol=2e-6)


def test_a_stretched_body_keeps_the_sum_of_its_parts() -> None:
    rng = np.random.default_rng(0)
    points, mass = rng.normal(size=(50, 3)), rng.uniform(0.1, 1.0, 50)

    def of(points: np.ndarray, mass: np.ndarray) -> tuple[float, ...]:
        x, y, z = points.T
        moments = (y * y + z * z, x * x + z * z, x * x + y * y, -x * y, -x * z, -y * z)
        return tuple(float(mass @ each) for each in moments)

    expected = of(points * [2.5, 1.0, 1.0], 3.0 * mass)
    np.testing.assert_allclose(stretched_inertia(of(points, mass), 3.0, 2.5), expected, rtol=1e-12)


def test_unknown_models_and_parameters_of_another_model_are_refused() -> None:
    for name in ("ur11", "UR10", "", None, 3):
        with pytest.raises(UnknownNameError, match="robot model"):
            robot_model(name)  # type: ignore[arg-type]
    with pytest.raises(UnknownNameError, match="'ur5e'"):
        dataclasses.replace(ur10.NOMINAL_DH, robot="ur6")
    ur10e = nominal_dh("ur10e")
    with pytest.raises(SettingsError, match=r"UR10's 0\.1273"):
        dataclasses.replace(ur10e, robot="ur10")
    with pytest.raises(SettingsError, match="UR5e's"):
        dataclasses.replace(ur10.NOMINAL_DH, robot="ur5e")
    dataclasses.replace(ur10e, a_m=(0.0, -0.6627, *ur10e.a_m[2:]))
    with pytest.raises(SettingsError, match=r"UR10e's -0\.6127"):
        dataclasses.replace(ur10e, a_m=(0.0, -0.6629, *ur10e.a_m[2:]))
    assert ur10e.is_nominal
    assert nominal_dh("ur10e") is ur10e
    assert ur10e != nominal_dh("ur12e")
