"""Kinds of cells that others register."""

from __future__ import annotations

import gymnasium as gym
import numpy as np
import pytest

from dual_ur10 import CellConfig
from dual_ur10.envs.sim.mujoco_cell import make_mujoco_cell
from dual_ur10.errors import ResetRefusedError, SettingsError, UnknownNameError
from dual_ur10.follower import make_follower
from dual_ur10.policies.training.settings import defaults
from dual_ur10.sim2real.cell.cell_kinds import CELL_KINDS, register_cell
from dual_ur10.sim2real.recording.reader import read_run

SINE = "DualUR10/SineTracking-v0"
MADE = []


def lab_cell(request):
    """Return a simulated cell in place of a laboratory's own."""
    MADE.append(request)
    return make_mujoco_cell(request)


@pytest.fixture(autouse=True)
def _kinds():
    """Forget after a test what it registered and made."""
    known = set(CELL_KINDS)
    yield
    for name in set(CELL_KINDS) - known:
        del CELL_KINDS[name]
    MADE.clear()


def test_a_simulated_kind_is_one_for_all_interfaces(tmp_path):
    register_cell("lab", f"{__name__}:lab_cell", controllers=False)
    register_cell("lab", f"{__name__}:lab_cell", controllers=False)  # again, as by a second import
    with gym.make(SINE, cell="lab") as env, gym.make(SINE) as other:
        assert np.array_equal(env.reset(seed=3)[0], other.reset(seed=3)[0])
    envs = gym.make_vec(SINE, num_envs=3, cell=CellConfig(kind="lab", speed_rad_s=0.9), randomization="mild")
    envs.reset(seed=0)
    envs.close()
    with make_follower("lab") as executor:
        assert executor is not None
    with gym.make(SINE, cell="lab", record=str(tmp_path)) as env:
        env.reset(seed=0)
        env.step(env.action_space.sample())
    (folder,) = tmp_path.iterdir()
    assert read_run(folder).header.source == "lab"
    assert [request.n for request in MADE] == [1, 3, 1, 1]
    assert MADE[1].randomized
    assert "mass_scale" in MADE[1].varied
    assert max(MADE[1].limits.speed_rad_s) == 0.9
    assert defaults(SINE, "ppo", keywords={"cell": "lab"}).keywords["cell"] == "lab"


def test_arms_of_controllers_move_only_with_consent():
    register_cell("arms", f"{__name__}:lab_cell", controllers=True)
    with gym.make(SINE, cell="arms") as env:
        core = env.unwrapped.core
        assert core.setup.latency_ticks == 5  # 40 ms
        assert not core.setup.brakes
        env.reset(seed=0)
        with pytest.raises(ResetRefusedError):
            env.reset()
        env.reset(options={"move_to_start": True})
    with pytest.raises(SettingsError, match="3 environments on one cell of controllers"):
        gym.make_vec(SINE, num_envs=3, cell="arms")
    with pytest.raises(SettingsError, match="randomization is for simulated cells"):
        gym.make(SINE, cell="arms", randomization="mild")
    with pytest.raises(SettingsError, match="is not simulated, and training is in simulation"):
        defaults(SINE, "ppo", keywords={"cell": "arms"})
    assert len(MADE) == 1


@pytest.mark.parametrize(
    ("name", "factory", "text"),
    [
        ("my cell", "m:f", "use letters, digits and underscores"),
        ("lab", "f", 'must be "module:function"'),
        ("mujoco", "m:f", "another kind of cell is named 'mujoco'"),
    ],
)
def test_bad_registrations_are_refused(name, factory, text):
    with pytest.raises(SettingsError, match=text):
        register_cell(name, factory, controllers=False)
    assert set(CELL_KINDS) == {"mujoco", "echo", "emulated", "real"}


def test_what_is_unknown_or_absent_is_named():
    with pytest.raises(UnknownNameError, match="unknown cell 'lab': use one of 'mujoco', 'echo', or the path"):
        gym.make(SINE, cell="lab")
    with pytest.raises(UnknownNameError, match="unknown cell kind 'lab'"):
        CellConfig(kind="lab")
    with pytest.raises(SettingsError, match="kind 'real' needs a cell file"):
        CellConfig(kind="real")
    register_cell("lab", "no_such_module_here:f", controllers=False)
    with pytest.raises(SettingsError, match=r"the factory of the cell 'lab', .* cannot be imported"):
        gym.make(SINE, cell="lab")
