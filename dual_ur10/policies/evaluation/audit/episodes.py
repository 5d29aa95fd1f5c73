"""Episodes of a task's script with changes of what it sees and of what it does, many in one batch."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Mapping, Sequence
from typing import Any, Final, NamedTuple

import numpy as np

from dual_ur10.envs.api.vector_env import DualArmVectorEnv
from dual_ur10.envs.tasks.observation_layout import ObservationLayout
from dual_ur10.errors import DualUR10Error
from dual_ur10.policies.policy import Policy
from ur_core.kinematics.frames import Frames
from ur_core.types import Array

JOINTS: Final = 6
"""First numbers of an arm's action; one more is that of its gripper."""


@dataclasses.dataclass
class RunningEpisode:
    """Running episode.

    Attributes:
        rng: Random numbers of this episode.
        to_base: (2, 3, 3) rotations from the cell frame to the bases.
        horizon: Steps of an episode.
        period_s: Time of a step.
        step: Steps so far.
        fields: Fields of the observation that the script sees, (2, field size) each, which may be changed.
        action: (2, size) action of both arms, which may be changed.
        info: Numbers of the last step's `info`.
        memory: State of a behaviour.
        changed: The behaviour has changed an action, or does not ask the script.
        lost: The script cannot go on from where a change has led it, and all joints stop.
    """

    rng: np.random.Generator
    to_base: Array
    horizon: int
    period_s: float
    step: int = 0
    fields: Mapping[str, Array] = dataclasses.field(default_factory=dict)
    action: Array = dataclasses.field(default_factory=lambda: np.zeros((2, JOINTS)))
    info: dict[str, Any] = dataclasses.field(default_factory=dict)
    memory: dict[str, Any] = dataclasses.field(default_factory=dict)
    changed: bool = False
    lost: bool = False

    @property
    def joints(self) -> Array:
        """(2, 6) part of the action that moves joints, or tools."""
        return self.action[:, :JOINTS]

    @property
    def grippers(self) -> Array:
        """(2, 1) part of the action that moves grippers, -1 closed to 1 open; (2, 0) without any."""
        return self.action[:, JOINTS:]

    def direction(self, *, common: bool) -> Array:
        """Return a random horizontal direction in the bases, (2, 3): one for both arms, or one for each."""
        if "direction" not in self.memory:
            sampled = self.rng.normal(size=(1 if common else 2, 3)) * (1.0, 1.0, 0.0)
            sampled = np.broadcast_to(sampled / np.linalg.norm(sampled, axis=1, keepdims=True), (2, 3))
            self.memory["direction"] = np.einsum("aij,aj->ai", self.to_base, sampled)
        found: Array = self.memory["direction"]
        return found


Change = Callable[[RunningEpisode], None]


def nothing(row: RunningEpisode) -> None:
    """Change nothing."""


@dataclasses.dataclass(frozen=True)
class Behaviour:
    """The scripted policy with changes of what it sees and of what it does.

    Attributes:
        group: "floor", "script", "disturbed" or "cheat": of a floor or cheat none may succeed.
        acts: Change of the action.
        sees: Change of the observation that the script sees.
        waits: True in steps in which all joints stop, and the script is not asked.
        scripted: False if the action does not depend on the script, which then is not asked at all.
    """

    group: str
    acts: Change = nothing
    sees: Change = nothing
    waits: Callable[[RunningEpisode], bool] = lambda row: False
    scripted: bool = True


def zero(row: RunningEpisode) -> None:
    """Act with zeros."""
    row.action[:] = 0.0


def uniform(row: RunningEpisode) -> None:
    """Act at random."""
    row.action[:] = row.rng.uniform(-1.0, 1.0, row.action.shape)


def normal(row: RunningEpisode) -> None:
    """Act at random, less widely."""
    row.action[:] = row.rng.normal(0.0, 0.3, row.action.shape)


def hold(row: RunningEpisode) -> None:
    """Stop all joints; the grippers keep their commands."""
    row.joints[:] = 0.0


def release(row: RunningEpisode) -> None:
    """Stop all joints and open the grippers."""
    row.action[:] = 1.0
    hold(row)


def until(over: Callable[[RunningEpisode], bool], instead: Change) -> Change:
    """Return a change that does something else from when a condition is first true."""

    def act(row: RunningEpisode) -> None:
        row.memory["over"] = row.memory.get("over", False) or over(row)
        if row.memory["over"]:
            instead(row)

    return act


def part(share: float) -> Callable[[RunningEpisode], bool]:
    """Return the condition that a share of the episode is over."""
    return lambda row: row.step >= share * row.horizon


def stage(number: int) -> Callable[[RunningEpisode], bool]:
    """Return the condition that a number of stages is passed."""
    return lambda row: row.info.get("stage", 0) >= number


FLOORS: Final = {
    "zero": Behaviour("floor", zero, scripted=False),
    "uniform": Behaviour("floor", uniform, scripted=False),
    "normal": Behaviour("floor", normal, scripted=False),
}
"""Behaviours that know nothing of a task."""

SCRIPT: Final = Behaviour("script")


class Job(NamedTuple):
    """Episode to run."""

    name: str
    behaviour: Behaviour
    seed: int


@dataclasses.dataclass(frozen=True)
class AuditEpisode:
    """Episode that has run; k is the number of its steps.

    Attributes:
        name, group: Of its behaviour.
        seed: Seed of its reset.
        success: True if the task reports success.
        observations: (k + 1, size).
        actions: (k, 2, size).
        rewards: (k,).
        numbers: Numbers of `info` by name, (k, ...), those that have at most two values.
        changed: The behaviour changed an action of the script, or did not ask it.
        cut: Its time ran out.
    """

    name: str
    group: str
    seed: int
    success: bool
    observations: Array
    actions: Array
    rewards: Array
    numbers: Mapping[str, Array]
    changed: bool
    cut: bool

    @property
    def earned(self) -> float:
        """Return of the episode."""
        return float(self.rewards.sum())

    @property
    def steps(self) -> int:
        """Number of steps."""
        return len(self.rewards)


def run(
    env: DualArmVectorEnv,
    jobs: Sequence[Job],
    make_script: Callable[[], Policy] | None,
    horizon: int,
    on_step: Callable[[float], None] = lambda done: None,
) -> list[AuditEpisode]:
    """Run episodes, each row the next one when its own has ended; no result depends on the number of rows.

    Args:
        env: Vector environment without automatic resets.
        jobs: Episodes, at least one for each row.
        make_script: Function that returns a new script; None: no behaviour needs one.
        horizon: Steps of an episode.
        on_step: Callback after each step with the number of episodes that have run.
    """
    core, n = env.core, env.num_envs
    to_base = Frames((core.config.left, core.config.right)).rotation

    def begun(job: Job) -> RunningEpisode:
        return RunningEpisode(np.random.default_rng(job.seed), to_base, horizon, core.timing.period_s)

    scripts = [None if make_script is None else make_script() for _ in range(n)]  # one that waits is not always asked
    current, rows = list(range(n)), [begun(job) for job in jobs[:n]]
    found: list[AuditEpisode | None] = [None] * len(jobs)
    observation, _ = env.reset(seed=[job.seed for job in jobs[:n]])
    traces = [_Trace(each) for each in observation]
    live, upcoming = np.ones(n, dtype=bool), n
    action = np.zeros((n, 2, core.action_space.shape[0] // 2))
    while live.any():
        for k in np.flatnonzero(live).tolist():
            rows[k].action = action[k]
            _act(rows[k], jobs[current[k]].behaviour, scripts[k], core.task.layout, observation[k])
        observation, reward, terminated, truncated, info = env.step(action.reshape(n, -1).astype(np.float32))
        numbers = {
            name: value
            for name, value in info.items()
            if isinstance(value, np.ndarray) and value.dtype.kind in "fi" and value.shape[1:] in ((), (2,))
        }
        over = terminated | truncated
        for k in np.flatnonzero(live).tolist():
            row, job = rows[k], jobs[current[k]]
            row.step += 1
            row.info = {name: np.array(value[k], dtype=np.float64) for name, value in numbers.items()}
            traces[k].add(action[k], observation[k], reward[k], row.info)
            if over[k]:
                success = bool(info["is_success"][k])
                found[current[k]] = traces[k].episode(job, success, changed=row.changed, cut=bool(truncated[k]))
                live[k] = upcoming < len(jobs)
                current[k], upcoming = (upcoming, upcoming + 1) if live[k] else (current[k], upcoming)
        if over.any() and live.any():
            observation, _ = env.reset(seed=[jobs[k].seed for k in current], options={"reset_mask": over})
            action[over] = 0.0
            for k in np.flatnonzero(over).tolist():
                rows[k], traces[k] = begun(jobs[current[k]]), _Trace(observation[k])
        on_step(sum(each is not None for each in found))
    return [each for each in found if each is not None]


def _act(
    row: RunningEpisode, behaviour: Behaviour, script: Policy | None, layout: ObservationLayout, observation: Array
) -> None:
    """Set the action of a row."""
    shown = observation.copy()
    row.fields = layout.split(shown)
    if script is not None and row.step == 0:
        script.reset()
    if row.lost or behaviour.waits(row):
        hold(row)
        row.changed = True
        return
    behaviour.sees(row)
    if behaviour.scripted and script is not None:
        try:
            row.action[:] = np.asarray(script(shown)).reshape(row.action.shape)
        except DualUR10Error:
            if behaviour.group == "script":
                raise
            row.lost = row.changed = True
            hold(row)
            return
    asked = row.action.copy()
    behaviour.acts(row)
    row.changed = row.changed or not behaviour.scripted or not np.array_equal(asked, row.action)


class _Trace:
    """Recorder of a running episode."""

    def __init__(self, observation: Array) -> None:
        self._observations = [observation.copy()]
        self._actions: list[Array] = []
        self._rewards: list[float] = []
        self._numbers: list[dict[str, Array]] = []

    def add(self, action: Array, observation: Array, reward: float, numbers: dict[str, Array]) -> None:
        """Add a step."""
        self._actions.append(action.copy())
        self._observations.append(observation.copy())
        self._rewards.append(float(reward))
        self._numbers.append(numbers)

    def episode(self, job: Job, success: bool, *, changed: bool, cut: bool) -> AuditEpisode:
        """Return the episode, which has ended."""
        names = self._numbers[-1].keys() & self._numbers[0].keys()
        numbers = {name: np.array([each[name] for each in self._numbers]) for name in sorted(names)}
        observations, actions, rewards = map(np.array, (self._observations, self._actions, self._rewards))
        return AuditEpisode(
            job.name,
            job.behaviour.group,
            job.seed,
            success,
            observations,
            actions,
            rewards,
            numbers,
            changed,
            cut,
        )
