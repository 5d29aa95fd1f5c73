"""Environments of other arms than two UR10s: keyword, families, workspaces, and policies made for other arms."""

from __future__ import annotations

from typing import Any

import gymnasium as gym
import numpy as np
import pytest

import dual_ur10
from dual_ur10 import ArmMount, CellConfig, ServojProfile
from dual_ur10.assets.settings import default_mount
from dual_ur10.envs.core.setup import EnvSetup
from dual_ur10.errors import CheckpointError, SettingsError, UnknownNameError, WorkspaceError
from dual_ur10.policies import load
from dual_ur10.policies.learned.signature import view_of
from dual_ur10.sim2real.control.limits import MotionLimits
from ur_core.kinematics.robots import ROBOTS
from ur_core.kinematics.ur10 import nominal_dh

SINE, CARRY, HANDOVER = (f"DualUR10/{task}-v0" for task in ("SineTracking", "SyncCarry", "Handover"))


def config_of(**keywords: Any) -> CellConfig:
    return EnvSetup.resolve("SineTracking", keywords).config


def test_the_keyword_names_both_arms_or_each() -> None:
    assert config_of().robots == ("ur10", "ur10")
    both = config_of(robot="ur5e")
    assert both.robots == ("ur5e", "ur5e")
    assert both.servoj.family == "e-series"
    assert both.left.position_m == pytest.approx((-0.75 * 0.85 / 1.3, 0.6, 0.0))
    assert config_of(robot=("ur5e", "ur10e")).robots == ("ur5e", "ur10e")
    assert config_of(robot="ur10") == config_of()
    mixed = CellConfig(left=ArmMount((-0.5, 0.6, 0.0), robot="ur5e"), right=ArmMount((-0.75, -0.6, 0.0), robot="ur10e"))
    assert config_of(cell=mixed, robot=("ur5e", "ur10e")).right.dh == nominal_dh("ur10e")
    assert config_of(cell=mixed).servoj == ServojProfile("e-series")


@pytest.mark.parametrize(
    ("keywords", "error", "match"),
    [
        ({"robot": "ur6"}, UnknownNameError, "'ur5e'"),
        ({"robot": ("ur5e", "ur6")}, UnknownNameError, "robot model 'ur6'"),
        ({"robot": ("ur5e",)}, SettingsError, "one for each arm"),
        ({"robot": 5}, SettingsError, "name one model"),
        ({"robot": ("ur10", "ur10e")}, SettingsError, r"right arm is a UR10e, .* \(2 ms\), .* cb3 \(8 ms\)"),
        ({"robot": "ur5e", "cell": CellConfig()}, SettingsError, "the arms of the cell are ur10 and ur10"),
    ],
)
def test_models_that_do_not_exist_or_fit_are_refused(keywords: dict[str, Any], error: type, match: str) -> None:
    with pytest.raises(error, match=match):
        config_of(**keywords)


def test_controllers_are_of_the_family_of_their_arms() -> None:
    assert CellConfig(servoj=ServojProfile("e-series")).robots == ("ur10e", "ur10e")
    assert CellConfig(left=default_mount(0, "ur20")).robots == ("ur20", "ur20")
    assert CellConfig(right=default_mount(1, "ur3")).servoj.family == "cb3"
    for family, robot in (("cb3", "ur5e"), ("e-series", "ur5")):
        with pytest.raises(SettingsError, match="both arms need one control period"):
            CellConfig(left=default_mount(0, robot), servoj=ServojProfile(family, 0.1, 300.0))
    with pytest.raises(SettingsError, match="the left arm is a UR10,"):
        CellConfig(left=ArmMount((-0.8, 0.6, 0.0)), servoj=ServojProfile("e-series"))
    with pytest.raises(SettingsError, match="left of the cell must be an ArmMount"):
        CellConfig(left="ur5e")  # type: ignore[arg-type]


def test_limits_are_those_of_the_weaker_arm() -> None:
    wide = MotionLimits()
    limits = wide.of(("ur5e", "ur30"))
    assert limits.speed_rad_s == (1.68, 1.68, 2.09, 2.51, 2.51, 2.51)
    assert limits.robots == ("ur5e", "ur30")
    with pytest.raises(SettingsError, match="speed_rad_s"):
        MotionLimits(robots=("ur5e", "ur30"))
    setup = EnvSetup.resolve("SineTracking", {"robot": ("ur5e", "ur30")})
    assert setup.limits.robots == ("ur5e", "ur30")
    assert (np.array(setup.limits.speed_rad_s) <= limits.speed_rad_s).all()


@pytest.mark.parametrize("env_id", [SINE, CARRY, HANDOVER])
def test_arms_that_are_too_short_are_refused_with_the_reason(env_id: str) -> None:
    with pytest.raises(WorkspaceError, match=r"the (left|right) arm cannot reach .* m"):
        gym.make(env_id, robot="ur3e")


@pytest.mark.parametrize(
    ("env_id", "robot", "keywords"),
    [
        (SINE, "ur5", {"duration_s": 4.0}),
        (SINE, ("ur16e", "ur20"), {"duration_s": 4.0}),
        (HANDOVER, ("ur5e", "ur10e"), {}),
    ],
)
def test_scripted_policies_do_the_tasks(env_id: str, robot: Any, keywords: dict[str, Any]) -> None:
    env = gym.make(env_id, robot=robot, **keywords)
    policy = load("scripted", env_id, robot=robot, **keywords)
    observation, _ = env.reset(seed=3)
    policy.reset()
    over, info = False, {}
    while not over:
        observation, _, terminated, truncated, info = env.step(policy(observation))
        over = terminated or truncated
    env.close()
    assert info["is_success"]


def test_a_policy_learned_on_other_arms_is_refused() -> None:
    with pytest.raises(CheckpointError, match=r"robot\.model 'UR10', the environment has 'UR10e': use these arms"):
        load("learned", SINE, robot="ur10e")
    assert view_of(SINE, {"robot": ("ur5e", "ur10e")}).signature.robot.model == "UR5e + UR10e"
    assert view_of(SINE, {"robot": "ur8long"}).signature.robot.names == ("ur8long", "ur8long")
    assert view_of(SINE, {}).signature.robot.model == "UR10"


def test_same_seed_same_motion_of_every_generation() -> None:
    for robot in ("ur3", "ur7e", "ur15"):
        shift = {"center_m": ((-0.05, 0.5, 0.35), (-0.05, -0.5, 0.35)), "amplitude_m": 0.02} if robot == "ur3" else {}
        states = []
        for _ in range(2):
            env = gym.make(SINE, robot=robot, randomize=False, **shift)
            env.reset(seed=1)
            env.action_space.seed(1)
            states.append([env.step(env.action_space.sample())[0] for _ in range(5)])
            env.close()
        np.testing.assert_array_equal(*states)
    assert dual_ur10.CellConfig().left.model is ROBOTS["ur10"]
