"""Emulated controllers of other models: reports, cell files, and what the doctor makes of another model."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from dual_ur10.assets.settings import default_mount, home_q_rad
from dual_ur10.emulated.cell_emulator import CellEmulator, CellOptions
from dual_ur10.sim2real.cell_file.cell_file import load_cell_file
from dual_ur10.sim2real.commissioning.findings import ExpectedArm, calibration_findings, model_findings
from ur_core.errors import SettingsError, UnknownNameError
from ur_core.kinematics import flange_pose
from ur_core.kinematics.robots import ROBOTS
from ur_core.kinematics.ur10 import nominal_dh
from ur_core.links.primary_link import PrimaryFacts
from ur_core.protocol.primary_packet import kinematics_checksums
from ur_emulator.profile import PROFILES, profile_for


def facts_of(robot: str) -> PrimaryFacts:
    """What the primary interface of a controller with a nominal arm reports."""
    profile, dh = profile_for(robot), nominal_dh(robot)
    rows = (dh.theta_rad, dh.a_m, dh.d_m, dh.alpha_rad)
    return PrimaryFacts(profile.version, profile.robot_type, kinematics_checksums(dh), *rows)


@pytest.mark.parametrize("robot", ROBOTS)
def test_every_model_is_emulated_without_a_task(robot: str) -> None:
    """Two controllers for a client of one's own need no task that the arms can do: UR3 and UR3e can do none."""
    emulator = CellEmulator(CellOptions(robot=robot, plant="nominal"))
    try:
        for _ in range(3):
            emulator.tick()
        assert not emulator.world.failed
        assert "task" not in emulator.description()["emulator"]
        for arm, server in enumerate(emulator.servers):
            q_rad = server.controller.reading.q_rad
            np.testing.assert_allclose(q_rad, home_q_rad([default_mount(arm, robot)])[0], atol=1e-6)
            assert server.ports.keys() == {"dashboard", "primary", "secondary", "realtime", "rtde"}
    finally:
        emulator.close()


@pytest.mark.parametrize("robots", ["ur5", ("ur5e", "ur10e"), "ur20"])
def test_an_emulated_controller_is_the_robot_that_it_says_it_is(robots: str | tuple[str, str], tmp_path: Path) -> None:
    emulator = CellEmulator(CellOptions(robot=robots, plant="nominal", cell=str(tmp_path / "cell.toml")))
    try:
        pair = (robots, robots) if isinstance(robots, str) else robots
        for _ in range(3):
            emulator.tick()
        for server, robot in zip(emulator.servers, pair, strict=True):
            controller, model = server.controller, ROBOTS[robot]
            assert (controller.profile.model, controller.profile.robot_type) == (model.title, model.robot_type)
            assert controller.dh == nominal_dh(robot)
            assert (controller.motion.joint_speed_rad_s == model.joint_speed_rad_s).all()
            position, _ = flange_pose(controller.reading.q_rad, nominal_dh(robot))
            np.testing.assert_allclose(controller.values["actual_TCP_pose"][:3], position, atol=1e-9)
        cell = load_cell_file(tmp_path / "cell.toml")
        assert tuple(arm.model for arm in cell.arms) == pair
        assert cell.config().robots == pair
    finally:
        emulator.close()


def test_profiles_name_the_default_models() -> None:
    assert profile_for("ur10") == PROFILES["cb3"]
    assert profile_for("ur10e") == PROFILES["e-series"]


@pytest.mark.parametrize(
    ("options", "error", "match"),
    [
        ({"robot": "ur6"}, UnknownNameError, "robot model 'ur6'"),
        ({"robot": "ur5e", "family": "cb3"}, SettingsError, "both arms need one control period"),
        ({"robot": ["ur5", "ur5e"]}, SettingsError, "both arms need one control period"),
        ({"robot": ["ur5"]}, SettingsError, "one for each arm"),
        ({"family": "cb4"}, UnknownNameError, "controller family"),
        ({"polyscope": "5.99"}, UnknownNameError, "PolyScope version '5.99': use one of '3.15', '5.12', '5.21'"),
        ({"polyscope": "5.26", "robot": "ur5"}, SettingsError, "does not run on a UR5, .* is cb3: use 3.15"),
        ({"polyscope": "5.26", "family": "cb3"}, SettingsError, "does not run on a UR10, .* is cb3: use 3.15"),
        ({"polyscope": "3.15", "robot": "ur5e"}, SettingsError, "is e-series: use 5.12, 5.21, 5.22, 5.23, 5.25, 5.26"),
    ],
)
def test_models_that_do_not_exist_or_fit_are_refused(options: dict[str, object], error: type, match: str) -> None:
    with pytest.raises(error, match=match):
        CellEmulator(CellOptions.from_mapping(options))


@pytest.mark.parametrize(
    ("expected", "reported", "failing"),
    [
        ("ur10", "ur10", set()),
        ("ur5e", "ur5e", set()),
        ("ur5e", "ur7e", {"model"}),  # the same mechanics
        ("ur10e", "ur16e", {"model", "robot type", "calibration"}),
        ("ur10", "ur5", {"model", "robot type", "calibration"}),
    ],
)
def test_the_doctor_compares_the_model(expected: str, reported: str, failing: set[str]) -> None:
    arm = ExpectedArm(host="127.0.0.1", family=ROBOTS[expected].family, model=expected, dh=nominal_dh(expected))
    facts = facts_of(reported)
    findings = [
        *model_findings("left", arm, profile_for(reported).model, facts.robot_type),
        *calibration_findings("left", arm, facts),
    ]
    assert {each.name for each in findings if each.level != "ok"} == failing
    assert {each.level for each in findings if each.level != "ok"} <= {"fail"}


@pytest.mark.parametrize(
    ("options", "version", "model"),
    [
        ({}, (3, 15, 8, 106339), "UR10"),
        ({"family": "e-series"}, (5, 12, 5, 1101), "UR10e"),
        ({"polyscope": "5.26"}, (5, 26, 0, 0), "UR10e"),
        ({"polyscope": "5.25", "robot": "ur5e"}, (5, 25, 1, 0), "UR5e"),
        ({"polyscope": "3.15"}, (3, 15, 8, 106339), "UR10"),
    ],
)
def test_controllers_have_the_version_that_was_asked_for(
    options: dict[str, object], version: tuple[int, ...], model: str
) -> None:
    emulator = CellEmulator(CellOptions.from_mapping({**options, "plant": "nominal"}))
    try:
        profiles = [server.controller.profile for server in emulator.servers]
        assert [(each.version, each.model) for each in profiles] == [(version, model)] * 2
    finally:
        emulator.close()
