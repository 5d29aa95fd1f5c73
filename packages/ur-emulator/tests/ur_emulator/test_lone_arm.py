"""One controller by itself, and its simulated arm."""

import numpy as np
import pytest

from tests.ur_emulator.ticking import Lone
from ur_core.errors import SettingsError, UnknownNameError
from ur_core.kinematics import flange_pose
from ur_core.kinematics.robots import ROBOTS
from ur_core.kinematics.ur10 import nominal_dh
from ur_emulator.motion import JointTorques, MotionGenerator
from ur_emulator.script import read
from ur_emulator.world import lone_arm
from ur_emulator.world.lone_arm import LoneArm
from ur_emulator.world.plant import PlantOptions


def arm_of(robot="ur5e", **options):
    return LoneArm(robot, PlantOptions(**{"plant": "nominal", **options}))


def standing(arm):
    plan = np.zeros((1, arm.substeps, 3, 6))
    plan[:, :, 0] = arm.start_q_rad
    return plan


def advance(arm, plan, torque=None):
    arm.advance([plan], [None], [0.0], [torque])


@pytest.mark.parametrize("robot", ROBOTS)
def test_every_model_follows_its_controller_exactly(robot):
    arm = arm_of(robot)
    motion = MotionGenerator(arm.tick_s, arm.substeps, arm.start_q_rad[0], dh=nominal_dh(robot))
    goal = arm.start_q_rad[0] + [0.3, -0.2, 0.1, 0.2, 0.3, -0.3]
    motion.move_joints(goal, 6.0, 2.0)
    most = 0.0
    for _ in range(round(0.5 / arm.tick_s)):
        advance(arm, motion.plan())
        most = max(most, np.abs(arm.read(0).q_rad - motion.q).max())
    assert most < 1e-9
    assert np.allclose(arm.read(0).q_rad, goal, atol=1e-9)
    assert abs(arm.read(0).torque_nm[1]) > 1.0  # the motors carry the arm
    position, _ = arm.pose("wrist_3_link")
    to_flange = flange_pose(goal, nominal_dh(robot))[0] * [-1, -1, 1] - position  # `base` is turned by 180 degrees
    assert np.linalg.norm(to_flange) == pytest.approx(nominal_dh(robot).d_m[5], abs=1e-6)


def test_a_plant_that_is_not_nominal_deviates():
    mild, again, other = arm_of(plant="mild", seed=1), arm_of(plant="mild", seed=1), arm_of(plant="mild", seed=2)
    assert set(mild.sampled) == {"mass_scale", "friction_nm", "lookahead_scale", "latency_s"}
    assert not arm_of().sampled
    for name, value in mild.sampled.items():
        assert np.array_equal(value, again.sampled[name])
        assert not np.array_equal(value, other.sampled[name])
    compensated = mild._model.body_gravcomp * mild._model.body_mass  # by a controller that knows the nominal masses
    assert np.allclose(compensated[2:], (arm_of()._model.body_gravcomp * arm_of()._model.body_mass)[2:])
    plan = standing(mild)
    plan[0, :, 1] = 0.05
    plan[0, :, 0] += 0.05 * lone_arm.STEP_S * np.arange(mild.substeps)[:, None]
    advance(mild, plan[0])
    ideal = arm_of()
    advance(ideal, plan[0])
    assert not np.allclose(mild.read(0).torque_nm, ideal.read(0).torque_nm, rtol=1e-3)


def test_kinematic_errors_displace_the_flange():
    right, wrong = (arm_of(dh_error_m=each).pose("wrist_3_link")[0] for each in (0.0, 0.005))
    assert 5e-4 < np.linalg.norm(right - wrong) < 0.05


@pytest.mark.parametrize("scale", [0.0, 0.9])
def test_torques_move_the_joint_against_what_is_left_of_its_friction(scale):
    arm = arm_of("ur10e", plant="mild", seed=4)
    friction = arm.sampled["friction_nm"][5]
    torque = JointTorques(np.array([0.0, 0.0, 0.0, 0.0, 0.0, 0.5 * friction]), np.full(6, scale))
    for _ in range(100):
        advance(arm, standing(arm)[0], torque)
    assert friction > 0.05
    assert (arm.read(0).qd_rad_s[5] > 0.01) == (scale > 0.5)


@pytest.mark.parametrize("value", [np.nan, 1e300])
def test_a_diverging_simulation_is_reported(value, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)  # MuJoCo logs it there
    arm = arm_of()
    plan = standing(arm)[0]
    plan[0, 0] = value
    advance(arm, plan)
    assert arm.failed
    advance(arm, standing(arm)[0])
    assert np.array_equal(arm.read(0).q_rad, arm.start_q_rad[0])


def test_bodies_and_objects_that_are_not_there_are_named():
    with pytest.raises(UnknownNameError, match="wrist_3_link"):
        arm_of().pose("table")
    with pytest.raises(SettingsError, match="no object to place"):
        arm_of().place(np.zeros(7))


def test_a_push_is_felt_as_long_as_it_lasts():
    arm = arm_of()
    arm.push(0, np.array([5.0, 0, 0, 0, 0, 0]), 2 * arm.tick_s)
    felt = []
    for _ in range(3):
        felt.append(arm.read(0).wrench[0])
        advance(arm, standing(arm)[0])
    assert felt == [5.0, 5.0, 0.0]


# The controller.


def test_a_controller_by_itself_takes_programs_and_requests_without_an_arm():
    cell = Lone(robot="ur3e")
    try:
        (server,) = cell.emulator.servers
        assert server.controller.profile.model == "UR3e"
        assert "gripper" not in server.ports
        text = "movej([0, -1.57, 1.57, -1.57, -1.57, 0.5], a=1.4, v=1.0)\n"
        server.controller.run_script(text, read(text, server.controller.program.builtins))
        cell.tick(1000)
        assert server.controller.values["actual_q"][5] == pytest.approx(0.5, abs=1e-3)
        assert cell.get("state", names=["robot_mode"]) == cell.get("state", arm="ur3e", names=["robot_mode"])
        cell.get("stop", mode=3)
        cell.tick()
        assert server.controller.values["safety_mode"] == 3
        assert "'left'" in cell.refused("state", arm="left")
        assert len(cell.get("pose", body="wrist_3_link")["position_m"]) == 3
    finally:
        cell.close()


@pytest.mark.parametrize(
    ("options", "kind", "text"),
    [
        ({"robot": ["ur5", "ur5"]}, SettingsError, "name the model"),
        ({"robot": "ur7"}, UnknownNameError, "'ur7e'"),
        ({"robot": "ur5e", "polyscope": "3.15"}, SettingsError, "does not run on a UR5e"),
        ({"robot": "ur5e", "task": "Handover"}, SettingsError, "unknown options.*task"),
        ({"robot": "ur5e", "right": "127.0.0.2"}, SettingsError, "unknown options.*right"),
        ({"robot": "ur5e", "tools": "generic_140"}, SettingsError, "unknown options.*tools"),
    ],
)
def test_options_that_do_not_fit_are_named(options, kind, text):
    with pytest.raises(kind, match=text):
        Lone(**options)


def test_what_is_drawn_stands_where_the_arm_stands():
    arm = arm_of()
    plan = standing(arm)[0]
    plan[:, 0] += 0.1
    advance(arm, plan)
    model, data = arm.draw()
    assert np.array_equal(data.qpos, arm.read(0).q_rad)
    assert model.ngeom > 40
    assert np.array_equal(data.body("left/base_link").xpos, np.zeros(3))
    assert arm.draw()[0] is model
