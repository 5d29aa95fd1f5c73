"""The mirror model returns for measured arms the same states as the simulated cell."""

from __future__ import annotations

import numpy as np
import pytest

from dual_ur10 import ENV_IDS
from dual_ur10.envs.core.setup import EnvSetup
from dual_ur10.envs.sim.mujoco_cell import MujocoCell
from dual_ur10.errors import UnknownNameError
from dual_ur10.sim2real.cell.cell_config import CellConfig
from dual_ur10.sim2real.cell.mirror_model import MirrorModel
from dual_ur10.sim2real.control.adapter import Command
from ur_core.kinematics.poses import Poses

TASKS = ENV_IDS
TICKS = 5


def simulated(name, **cell):
    """Return a task's simulated cell and a start."""
    setup = EnvSetup.resolve(name, {"cell": CellConfig(**cell)})
    return MujocoCell(setup.config, TICKS), setup.make_task().start(np.array([0]), [np.random.default_rng(5)])


def moving(cell, start, periods=6):
    """Yield states of a wave of all joints while the grippers close."""
    state = cell.reset(start).state
    yield state
    direction = np.random.default_rng(1).uniform(-1, 1, (2, 6))
    for period in range(periods):
        time = (period * TICKS + np.arange(1, TICKS + 1)) * 0.008
        targets = start.q_rad[:, None] + 0.1 * (1 - np.cos(3 * time))[:, None, None] * direction
        gripper = None if start.gripper_m is None else np.full((1, TICKS, 2), [0.05, 0.03])
        yield cell.advance(Command(targets, gripper)).state


def shown(mirror, state):
    """Return the mirror's state from the measurements of a state."""
    gripped = state.gripper_m is not None
    poses = {name: Poses(pose.position_m[0], pose.quat[0]) for name, pose in state.objects.items()}
    mirror.place(poses, {name: float(value[0]) for name, value in state.joints.items()})
    more = {"gripper_m": state.gripper_m[0], "wrench": state.wrench[0]} if gripped else {}
    return mirror.follow(float(state.time_s[0]), state.q_rad[0], state.qd_rad_s[0], **more)


def assert_equal(found, expected):
    assert set(found.objects) == set(expected.objects)
    for name, pose in expected.objects.items():
        for part, other in zip(pose, found.objects[name], strict=True):
            np.testing.assert_allclose(other, part, atol=1e-13, rtol=0, err_msg=name)
    for field, value in expected._asdict().items():
        other = getattr(found, field)
        if field in ("objects", "joints"):
            continue
        if value is None:
            assert other is None, field
            continue
        assert other.dtype == np.asarray(value).dtype, field
        np.testing.assert_allclose(other, value, atol=1e-13, rtol=0, err_msg=field)


@pytest.mark.parametrize("name", TASKS)
def test_its_states_equal_those_of_the_simulated_cell(name):
    cell, start = simulated(name)
    mirror = MirrorModel(cell.config.scene)
    states = 0
    for state in moving(cell, start):
        assert_equal(shown(mirror, state), state)
        states += 1
    assert states == 7
    assert np.abs(state.q_rad - start.q_rad).max() > 0.01
    cell.close()


@pytest.mark.parametrize("name", TASKS)
def test_returned_states_do_not_change(name):
    cell, start = simulated(name)
    mirror = MirrorModel(cell.config.scene)
    states = moving(cell, start)
    first = shown(mirror, next(states))
    arrays = [
        each for each in (*first, *(part for pose in first.objects.values() for part in pose)) if each is not None
    ]
    arrays = [each for each in arrays if isinstance(each, np.ndarray)]
    kept = [each.copy() for each in arrays]
    for state in states:
        shown(mirror, state)
    for value, copy in zip(arrays, kept, strict=True):
        assert (value == copy).all()
    cell.close()


def test_props_stay_where_an_episode_begins():
    cell, start = simulated("Handover")
    state = cell.reset(start).state
    mirror = MirrorModel(cell.config.scene)
    mirror.start(start)
    found = mirror.follow(1.5, state.q_rad[0], state.qd_rad_s[0], gripper_m=state.gripper_m[0], wrench=state.wrench[0])
    for name in ("block", "target"):
        assert np.array_equal(np.concatenate(found.objects[name], axis=1), start.objects[name])
    mirror.start(start._replace(objects={}))
    back = mirror.follow(1.5, state.q_rad[0], state.qd_rad_s[0]).objects["block"]
    assert np.concatenate(back, axis=1).tolist() == [[0, 0, 0.02, 1, 0, 0, 0]]  # where the MJCF has it
    assert found.time_s.tolist() == [1.5]
    assert not found.failed.any()
    with pytest.raises(UnknownNameError, match="'brick': use one of 'block', 'target'"):
        mirror.start(start._replace(objects={"brick": start.objects["block"]}))


@pytest.mark.parametrize("name", TASKS)
def test_the_rendered_model_has_the_same_state(name):
    cell, start = simulated(name)
    mirror = MirrorModel(cell.config.scene)
    *_, state = moving(cell, start)
    shown(mirror, state)
    (model, data), (model2, data2) = mirror.model_and_data(), cell.model_and_data(0)
    assert mirror.model_and_data()[0] is model
    assert [model.body(each).name for each in range(model.nbody)] == [
        model2.body(each).name for each in range(model2.nbody)
    ]
    fingers = [each for each in range(model.nbody) if "finger" in model.body(each).name]
    others = np.setdiff1d(np.arange(model.nbody), fingers)
    np.testing.assert_allclose(data.xpos[others], data2.xpos[others], atol=1e-12)
    np.testing.assert_allclose(data.xquat[others], data2.xquat[others], atol=1e-12)
    np.testing.assert_allclose(data.xpos[fingers], data2.xpos[fingers], atol=1e-3)
    cell.close()
