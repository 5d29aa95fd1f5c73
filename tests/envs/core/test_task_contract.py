"""Contract of tasks: what none must return is refused by name, and only values of each arm are split."""

from dataclasses import dataclass

import gymnasium as gym
import numpy as np
import pytest

from dual_ur10.envs import parallel_env
from dual_ur10.envs.api.vector_env import DualArmVectorEnv
from dual_ur10.envs.core.core import Core
from dual_ur10.errors import TaskError
from dual_ur10.policies.evaluation.check import check_policy
from dual_ur10.tasks import (
    ARM_FIELDS,
    Equipment,
    Field,
    MotionLimits,
    ObservationLayout,
    Outcome,
    Prop,
    SceneRequirements,
    Task,
    arm_values,
    register,
)

ID = "Contract/Careless-v0"
STILL = np.zeros(12, dtype=np.float32)
BODY = "<mujoco><worldbody><body {}>{}<geom type='box' size='.02 .02 .02' mass='.1'/></body></worldbody></mujoco>"
PROPS = {
    "mark": Prop(name="mark", mjcf=BODY.format("mocap='true'", "")),
    "box": Prop(name="box", mjcf=BODY.format("", "<freejoint/>")),
    "there": Prop(name="there", mjcf=BODY.format("mocap='true' pos='.1 .2 .3'", "")),
}


@dataclass(frozen=True)
class Mistakes:
    """One mistake, from a step on."""

    mistake: str = ""
    step: int = 0
    props: tuple[str, ...] = ()


class Careless(Task):
    """Task that makes a mistake, and that cannot be copied."""

    limits = MotionLimits()
    weights = {"first": 1.0, "second": 0.5}  # noqa: RUF012  # as tasks state it
    settings_type = Mistakes
    per_arm = ("steps_of_arms",)
    layout = ObservationLayout(*ARM_FIELDS, Field("mark_m", 3, -1.0, 1.0, "position (m)", "mark"))

    def __init__(self, settings, cell, timing, n):
        super().__init__(settings, cell, timing, n)
        self.count, self.drawn, self.open = np.zeros(n, dtype=int), np.zeros(n), (each for each in "a handle")

    @classmethod
    def requirements(cls, settings):
        return SceneRequirements(Equipment(props=tuple(PROPS[name] for name in settings.props)))

    def start(self, rows, rngs):
        self.count[rows], self.drawn[rows] = 0, [rng.random() for rng in rngs]
        return self.at_home(rows)

    def measure(self, state):
        return None

    def makes(self, mistake, due):
        return self.settings.mistake == mistake and due

    def observe(self, state, measured, commanded_q_rad):
        mark_m, due = np.zeros((self.n, 2, 3)), self.count[-1] >= self.settings.step
        for mistake, value in (("nan", np.nan), ("infinity", np.inf), ("outside", 1.5)):
            if self.makes(mistake, due):
                mark_m[-1, 1, 2] = value
        return self.layout.join({**arm_values(state, commanded_q_rad), "mark_m": mark_m})

    def evaluate(self, state, measured):
        terms, never = np.zeros((self.n, 2, 2)), np.zeros(self.n, dtype=bool)
        self.count += 1
        if self.makes("term", self.count[-1] >= self.settings.step):
            terms[-1, 0, 1] = np.nan
        steps = np.stack([self.count, 2 * self.count], axis=1)
        info = {"steps_of_arms": steps, "target_xy": np.stack([self.drawn, -self.drawn], axis=1)}
        if self.settings.mistake == "shared":
            info["steps_of_arms"] = self.count.copy()
        return Outcome(terms, never, self.count >= 10, info)


@pytest.fixture(autouse=True)
def registered(registries):
    register(ID)(Careless)


def made(n=1, **settings):
    core = Core(ID, settings, n=n)
    return core, [np.random.default_rng(row) for row in range(n)]


@pytest.mark.parametrize("n", [1, 3])
@pytest.mark.parametrize(
    ("mistake", "found"),
    [
        ("term", r"term 'second' of the left arm is nan \(cell {last}\)"),
        ("nan", r"field 'mark_m' of the right arm's observation is \[0.0, 0.0, nan\] \(cell {last}\)"),
        ("infinity", r"'mark_m' .* \[0.0, 0.0, inf\] \(cell {last}\)"),
    ],
)
def test_numbers_that_are_not_finite_are_refused_in_the_step_that_has_them(monkeypatch, mistake, found, n):
    core, rngs = made(n, mistake=mistake, step=2)
    core.reset(rngs)
    core.step(np.zeros((n, 12)))
    told = []
    monkeypatch.setattr(core.cell, "stop", told.append)
    with pytest.raises(TaskError, match=found.format(last=n - 1)) as error:
        core.step(np.zeros((n, 12)))
    assert told == [f"the task failed: {error.value}"]
    core.reset(rngs)  # and an episode begins anew


def test_an_observation_outside_its_bounds_is_refused_at_the_first_reset_and_in_a_check():
    core, rngs = made(mistake="outside")
    with pytest.raises(TaskError, match=r"'mark_m' of the right arm's .* is \[0.0, 0.0, 1.5\] .* states -1 to 1"):
        core.reset(rngs)
    with pytest.raises(TaskError, match="'mark_m'"):
        check_policy(lambda observation: STILL, ID, mistake="outside", step=3)


@pytest.mark.parametrize("name", ["mark", "box"])
def test_a_start_without_a_prop_that_stands_nowhere_is_refused(name):
    core, rngs = made(props=(name, "there"))
    with pytest.raises(TaskError, match=f"leaves out the prop '{name}'"):
        core.reset(rngs)
    core, rngs = made(props=("there",))
    core.reset(rngs)


def test_only_values_that_a_task_states_are_split_between_the_agents():
    pair = parallel_env(ID)
    _, begun = pair.reset(seed=1)
    *_, after = pair.step(dict.fromkeys(pair.agents, STILL[:6]))
    for infos, steps in ((begun, 1), (after, 1)):
        assert [infos[arm]["steps_of_arms"] for arm in ("left", "right")] == [steps, 2 * steps]
        drawn = pair.task.drawn[0]
        assert all(infos[arm]["target_xy"].tolist() == [drawn, -drawn] for arm in ("left", "right"))
    single = gym.make(ID)
    single.reset(seed=1)
    assert single.unwrapped.task.drawn == pair.task.drawn  # the info of the reset drew nothing


def test_a_value_of_each_arm_that_info_has_otherwise_is_refused():
    with pytest.raises(TaskError, match=r"'steps_of_arms' of each arm, and its info has \(1,\)"):
        parallel_env(ID, mistake="shared").reset(seed=0)


def test_a_held_arm_is_in_the_info_of_a_simulation_and_warned_of_once(caplog):
    env = DualArmVectorEnv(2, ID, arm="left")
    _, begun = env.reset(seed=0)
    *_, after = env.step(np.zeros((2, 12)))
    assert begun["held_arm"].tolist() == after["held_arm"].tolist() == [[False, True]] * 2
    assert [record.getMessage() for record in caplog.records] == [
        "arm='left': the right arm does not move in this simulation, whatever its actions are. Leave `arm` out to move "
        "both"
    ]
    assert "held_arm" not in gym.make(ID).reset(seed=0)[1]
