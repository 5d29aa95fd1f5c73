"""Objects of a task of one's own on controllers: placed at a reset, and tracked without grippers."""

from __future__ import annotations

from dataclasses import dataclass

import gymnasium as gym
import numpy as np
import pytest

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
        poses = {each.name: np.array([[*AT[each.name], 1.0, 0.0, 0.0, 0.0]]) for each in self.props}
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


@pytest.fixture(autouse=True)
def _tasks(registries):
    register("Lab/Look-v0")(Look)
    register("Lab/Mark-v0")(Mark)


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
