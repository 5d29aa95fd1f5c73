"""Objects of a task of one's own on controllers: placed with their joints at a reset, tracked without grippers."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass

import gymnasium as gym
import numpy as np
import pytest

from dual_ur10.envs.core.options import MOVE_TO_START
from dual_ur10.errors import EmulatorError, StartError
from dual_ur10.tasks import (
    ARM_FIELDS,
    Equipment,
    MotionLimits,
    ObservationLayout,
    Outcome,
    Prop,
    SceneRequirements,
    Start,
    Task,
    arm_values,
    home_q_rad,
    register,
)
from dual_ur10.testing import VirtualCell

BODY = "<mujoco><worldbody><body {}>{}<geom type='box' size='.03 .03 .03' mass='0.2'/></body></worldbody></mujoco>"
BOX = Prop(name="box", mjcf=BODY.format("", "<freejoint/>"))
MARK = Prop(name="mark", mjcf=BODY.format("mocap='true'", ""))
LID = "<body pos='0 0 .04'><joint name='lid' axis='0 0 1' range='0 90' damping='.001'/>"
LID += "<geom type='box' size='.03 .03 .003' mass='0.1'/></body>"
CASE = Prop(name="case", mjcf=BODY.format("pos='.1 .2 .03'", LID))
AT = {"box": (0.1, 0.2, 0.03), "mark": (0.1, -0.2, 0.03)}


@dataclass(frozen=True)
class Nothing:
    """No settings."""


class Look(Task):
    """Bare flanges, a box and a mark on the table."""

    limits = MotionLimits()
    weights = {"nothing": 1.0}  # noqa: RUF012  # as tasks state it
    settings_type = Nothing
    layout = ObservationLayout(*ARM_FIELDS)
    props = (BOX, MARK)

    @classmethod
    def requirements(cls, settings):
        return SceneRequirements(Equipment(props=cls.props))

    def start(self, rows, rngs):
        poses = {each.name: np.array([[*AT[each.name], 1.0, 0.0, 0.0, 0.0]]) for each in self.props if each.posed}
        return Start(home_q_rad((self.cell.left, self.cell.right))[None], objects=poses)

    def measure(self, state):
        return {name: pose.position_m.copy() for name, pose in state.objects.items()}

    def observe(self, state, measured, commanded_q_rad):
        return self.layout.join(arm_values(state, commanded_q_rad))

    def evaluate(self, state, measured):
        never = np.zeros(self.n, dtype=bool)
        return Outcome(np.zeros((self.n, 2, 1)), never, never, measured)


class Mark(Look):
    """Nothing that is free."""

    props = (MARK,)


class Lid(Look):
    """A case with a lid that is opened by half a radian."""

    props = (CASE,)

    def start(self, rows, rngs):
        return super().start(rows, rngs)._replace(joints={"lid": np.array([0.5])})

    def measure(self, state):
        return {"lid_rad": state.joints["lid"].copy()}


@pytest.fixture(autouse=True)
def _tasks(registries):
    register("Lab/Look-v0")(Look)
    register("Lab/Mark-v0")(Mark)
    register("Lab/Lid-v0")(Lid)


@pytest.mark.parametrize("name", ["Look", "Mark"])
def test_props_are_placed_and_tracked_without_grippers(name):
    with VirtualCell(task=name) as cell, gym.make(f"Lab/{name}-v0", cell=cell, disable_env_checker=True) as env:
        env.reset(seed=0)
        still = np.zeros(12, dtype=np.float32)
        info = env.step(still)[-1]
        assert info["mark"] == pytest.approx(AT["mark"], abs=1e-6)
        if name == "Look":
            assert info["box"] == pytest.approx(AT["box"], abs=2e-3)
            cell.ask("place", prop="box", position_m=[-0.1, 0.3, 0.03], quat=[1.0, 0.0, 0.0, 0.0])
            for _ in range(5):
                info = env.step(still)[-1]
            assert info["box"] == pytest.approx([-0.1, 0.3, 0.03], abs=2e-3)


def test_joints_of_props_start_where_the_task_says():
    with VirtualCell(task="Lid") as cell, gym.make("Lab/Lid-v0", cell=cell, disable_env_checker=True) as env:
        still = np.zeros(12, dtype=np.float32)
        for _ in range(2):
            env.reset(seed=0, options={MOVE_TO_START: True})
            assert env.step(still)[-1]["lid_rad"] == pytest.approx(0.5, abs=1e-3)
            cell.ask("set_joints", values={"lid": 1.2})
            for _ in range(5):
                info = env.step(still)[-1]
            assert info["lid_rad"] == pytest.approx(1.2, abs=1e-3)
        for bad, text in (({"lit": 0.0}, "use one of 'lid'"), ({"lid": 1e9}, "allowed are"), ({"lid": "x"}, "lid")):
            with pytest.raises(EmulatorError, match=text):
                cell.ask("set_joints", values=bad)


@pytest.mark.parametrize("tracked", [True, False])
def test_a_person_sets_joints_where_no_program_can(monkeypatch, tracked):
    """But nobody is believed where nothing measures them."""
    asked = []
    monkeypatch.setattr(Lid, "props", (dataclasses.replace(CASE, tracked=tracked),))
    with VirtualCell(task="Lid") as cell:
        env = gym.make("Lab/Lid-v0", cell=cell, disable_env_checker=True, confirm=lambda text: asked.append(text))
        with env:
            env.unwrapped.core.cell._begin._placer = None  # as on a real cell
            with pytest.raises(StartError, match="not confirmed" if tracked else "'lid' .* nothing that sets joints"):
                env.reset(seed=0)
    assert ["The joint lid of the case should be at 0.500 rad" in text for text in asked] == [True] * tracked
