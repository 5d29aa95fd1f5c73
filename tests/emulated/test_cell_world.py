"""The simulation behind two emulated controllers."""

import dataclasses

import numpy as np
import pytest

from dual_ur10.assets.props import TARGET
from dual_ur10.emulated.cell_world import CellWorld
from dual_ur10.sim2real.cell.cell_config import CellConfig
from tests.emulated.ticking import Cell
from ur_core.errors import SettingsError, UnknownNameError
from ur_core.kinematics import flange_pose
from ur_core.kinematics.ur10 import NOMINAL_DH
from ur_core.servoj import ServojProfile
from ur_emulator.motion import JointTorques, MotionGenerator
from ur_emulator.world.plant import PlantOptions

TASKS = (None, "SineTracking", "SyncCarry", "Handover")


def world_of(task="SineTracking", family="cb3", **options):
    return CellWorld(CellConfig(servoj=ServojProfile(family=family)), task, PlantOptions(**options))


def standing(world):
    plans = np.zeros((2, world.substeps, 3, 6))
    plans[:, :, 0] = world.start_q_rad[:, None]
    return plans


def widths(world):
    return [world.read(arm).gripper_m for arm in range(2)]


@pytest.mark.parametrize("task", TASKS)
@pytest.mark.parametrize("family", ["cb3", "e-series"])
def test_arms_stand_where_the_task_begins(task, family):
    world = world_of(task, family, plant="nominal")
    for _ in range(50):
        world.advance(standing(world), widths(world), world.gripper_kg)
    for arm in range(2):
        reading = world.read(arm)
        assert np.allclose(reading.q_rad, world.start_q_rad[arm], atol=1e-9)
        assert np.allclose(reading.wrench, 0.0, atol=1e-6)
        assert abs(reading.torque_nm[1]) > 20.0
        assert (reading.gripper_m is None) == (task in (None, "SineTracking"))


def test_a_nominal_arm_at_rest_reports_equal_joints():
    cell = Cell(family="e-series")
    controller = cell.emulator.servers[0].controller
    controller.run_script("movej([0, -1.57, -1.57, -1.57, 1.57, 0], a=3, v=3)")
    cell.tick(2000)
    at_rest = {np.array(controller.values["actual_q"]).tobytes() for _ in range(300) if cell.tick() is None}
    away_rad = np.abs(controller.values["actual_q"] - cell.emulator.world.read(0).q_rad).max()
    cell.close()
    assert len(at_rest) == 1
    assert 0.0 < away_rad <= 1e-12


def test_a_nominal_arm_follows_its_controller_exactly():
    world = world_of(plant="nominal")
    motions = [MotionGenerator(0.008, world.substeps, world.start_q_rad[arm], dh=NOMINAL_DH) for arm in range(2)]
    goal = world.start_q_rad[0] + [0.3, -0.2, 0.1, 0.2, 0.3, -0.3]
    motions[0].move_joints(goal, 1.4, 1.0)
    most = 0.0
    for _ in range(200):
        world.advance([motion.plan() for motion in motions], [None, None], [0.0, 0.0])
        most = max(most, np.abs(world.read(0).q_rad - motions[0].q).max())
        assert np.allclose(world.read(1).q_rad, world.start_q_rad[1], atol=1e-9)
    assert np.allclose(world.read(0).q_rad, goal, atol=1e-6)
    assert most < 1e-4


def test_the_default_plant_differs_and_stays_near():
    nominal, mild = world_of(plant="nominal"), world_of(seed=3)
    assert not nominal.sampled
    assert set(mild.sampled) >= {"mass_scale", "friction_nm", "lookahead_scale", "latency_s", "base_shift_m"}
    assert not np.allclose(mild.lookahead_scale, 1.0)
    assert np.abs(mild.sampled["base_shift_m"]).max() <= 0.5e-3
    assert np.abs(mild.sampled["base_shift_m"]).max() > 0.0
    bodies = ["left/base_link", "right/base_link"]
    shift = [np.abs(nominal.pose(body)[0] - mild.pose(body)[0]).max() for body in bodies]
    assert all(0.0 < each <= 0.5e-3 for each in shift)


def test_latency_of_the_plant_is_whole_steps_before_the_law_acts():
    late = world_of("SyncCarry", seed=1)
    steps = [len(delay._waiting) for delay in late._delays]
    assert steps == np.rint(late.sampled["latency_s"][0] / 0.001).astype(int).tolist()
    assert max(steps) > 0
    plan = np.arange(late.substeps * 18, dtype=float).reshape(late.substeps, 3, 6)
    delay = late._delays[int(np.argmax(steps))]
    first, second = delay(plan), delay(plan + 1000.0)
    passed = np.concatenate([first, second])[max(steps) :]
    assert np.array_equal(passed[: len(plan)], plan)


def test_kinematic_errors_displace_the_flange():
    right, wrong = world_of(plant="nominal"), world_of(plant="nominal", dh_error_m=0.005)
    offsets = []
    for world in (right, wrong):
        nominal = flange_pose(world.start_q_rad[0], NOMINAL_DH)[0]
        base, _ = world.pose("left/base_link")
        true, _ = world.pose("left/wrist_3_link")
        offsets.append(np.linalg.norm(true - base) - np.linalg.norm(nominal))
    assert abs(offsets[0] - offsets[1]) > 5e-4


def test_an_object_is_placed_at_rest():
    world = world_of("Handover", plant="nominal")
    position, quat = world.pose("block")
    lifted = np.add(position, [0.05, -0.02, 0.1])
    world.place(np.array([*lifted, *quat]))
    assert np.allclose(world.pose("block")[0], lifted)
    for _ in range(125):
        world.advance(standing(world), widths(world), world.gripper_kg)
    fallen, _ = world.pose("block")
    assert np.allclose(fallen, np.add(position, [0.05, -0.02, 0.0]), atol=5e-3)
    there = np.array([0.1, -0.4, 0.02, 1.0, 0.0, 0.0, 0.0])
    world.place(there, "target")
    assert np.allclose(world.pose("target")[0], there[:3])
    with pytest.raises(UnknownNameError, match="'brick'"):
        world.place(there, "brick")
    only = dataclasses.replace(world.config.equipment, props=(TARGET,))
    world.config = dataclasses.replace(world.config, equipment=only)
    world.place(there, "target")  # nothing free is needed
    with pytest.raises(SettingsError, match=r"prop is missing: name one of .* target"):
        world.place(there)
    with pytest.raises(SettingsError, match="no object"):
        world_of().place(np.array([0, 0, 0, 1, 0, 0, 0]))


def test_an_undeclared_payload_makes_an_arm_sag():
    declared, silent = world_of("Handover", plant="nominal"), world_of("Handover", plant="nominal")
    for _ in range(125):
        declared.advance(standing(declared), widths(declared), declared.gripper_kg)
        silent.advance(standing(silent), widths(silent), [0.0, 0.0])
    sag = silent.read(0).q_rad - declared.read(0).q_rad
    assert np.abs(sag).max() > 1e-4


def test_bad_names_and_values_are_refused():
    with pytest.raises(UnknownNameError, match="plant"):
        PlantOptions(plant="perfect")
    for value in (-0.001, 0.5, float("nan")):
        with pytest.raises(SettingsError, match="dh_error_m"):
            PlantOptions(dh_error_m=value)
    with pytest.raises(UnknownNameError, match="body"):
        world_of().pose("moon")


def test_a_diverging_simulation_is_reported():
    world = world_of(plant="nominal")
    plans = standing(world)
    plans[0, :, 0] = np.nan
    world.advance(plans, [None, None], [0.0, 0.0])
    assert world.failed
    assert np.isfinite(world.read(0).q_rad).all()


@pytest.mark.parametrize("scale", [0.0, 0.9])
def test_the_controllers_compensate_a_fraction_of_the_friction_of_the_plant(scale):
    world = world_of(family="e-series", seed=4)
    friction = world.sampled["friction_nm"][0, 0, 5]
    torques = JointTorques(np.array([0.0, 0.0, 0.0, 0.0, 0.0, 0.5 * friction]), np.full(6, scale))
    for _ in range(100):
        world.advance(standing(world), widths(world), [0.0, 0.0], [torques, None])
    assert friction > 0.05
    assert (world.read(0).qd_rad_s[5] > 0.01) == (scale > 0.5)


def test_what_follows_torque_control_is_not_delayed_until_the_arm_stops():
    world = world_of("SyncCarry", seed=1)
    delay = max(world._delays, key=lambda each: len(each._waiting))
    moving, standing_there = np.ones((world.substeps, 3, 6)), np.zeros((world.substeps, 3, 6))
    standing_there[:, 0] = 2.0
    assert not np.array_equal(delay(moving), moving)
    assert np.array_equal(delay(moving, free=True), moving)
    assert np.array_equal(delay(moving), moving)
    assert np.array_equal(delay(standing_there), standing_there)
    assert not np.array_equal(delay(moving), moving)
