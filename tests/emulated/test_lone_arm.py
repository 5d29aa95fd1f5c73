"""An arm by itself against the suite: published hashes of its motion, its plants, and modules that it does not load."""

import subprocess
import sys

import numpy as np
import pytest

from dual_ur10.envs.core.randomization import JOINT_FRICTION_NM, PRESETS
from tests import rollout_hashes
from tests.ur_emulator.test_lone_arm import advance, arm_of
from ur_core.kinematics.ur10 import nominal_dh
from ur_emulator.motion import JointTorques, MotionGenerator
from ur_emulator.world import lone_arm
from ur_emulator.world.lone_arm import DEVIATIONS
from ur_emulator.world.plant import PLANTS


@pytest.mark.parametrize("plant", rollout_hashes.PLANTS)
@pytest.mark.parametrize("robot", rollout_hashes.ROBOTS)
def test_motion_hash(robot, plant):
    rollout_hashes.check(f"{robot}, {plant}", lambda: moved(robot, plant))


def moved(robot, plant):
    """Hash a move of all joints, a push and torques of the servos after it."""
    arm = arm_of(robot, plant=plant, seed=5)
    motion = MotionGenerator(arm.tick_s, arm.substeps, arm.start_q_rad[0], dh=nominal_dh(robot))
    motion.move_joints(arm.start_q_rad[0] + [0.3, -0.2, 0.1, 0.2, 0.3, -0.3], 1.4, 1.0)
    seen = [arm.start_q_rad, *arm.sampled.values()]
    for tick in range(100):
        torque = JointTorques(np.full(6, 0.5), np.full(6, 0.9)) if tick >= 80 else None
        if tick == 60:
            arm.push(0, np.array([5.0, 3.0, -4.0, 0.2, 0.1, 0.3]), 10 * arm.tick_s)
        advance(arm, motion.plan(), torque)
        reading = arm.read(0)
        seen += [reading.q_rad, reading.qd_rad_s, reading.torque_nm, reading.wrench, *arm.pose("wrist_3_link")]
    assert not arm.failed
    return rollout_hashes.digest(*seen)


def test_plants_are_the_randomizations_of_cells():
    assert tuple(DEVIATIONS) == PLANTS
    assert lone_arm._FRICTION_NM == JOINT_FRICTION_NM
    for name in ("mild", "wide"):
        preset, own = PRESETS[name], DEVIATIONS[name]
        assert (own.mass, own.joint_friction, own.lookahead) == (preset.mass, preset.joint_friction, preset.lookahead)
        assert own.latency_s == pytest.approx(preset.latency_s + preset.skew_s)


def test_it_loads_nothing_of_the_suite():
    code = (
        "import sys\n"
        "from ur_emulator.emulator import ControllerOptions, Emulator\n"
        "Emulator(ControllerOptions(robot='ur3e')).close()\n"
        "print(*[name for name in sys.modules if name.startswith('dual_ur10')])\n"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True, timeout=120)
    assert done.stdout.split() == []
