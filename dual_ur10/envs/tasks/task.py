"""What a task is: where an episode starts, what is observed, what is rewarded, when it ends."""

from __future__ import annotations

import dataclasses
import numbers
from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from typing import Any, ClassVar, Generic, NamedTuple, TypeVar

import numpy as np

from dual_ur10.assets.settings import Equipment
from dual_ur10.envs.tasks.observation_layout import ObservationLayout
from dual_ur10.errors import SettingsError
from dual_ur10.sim2real.config.cell import CellConfig, CellState, Start
from dual_ur10.sim2real.control.limits import MotionLimits
from dual_ur10.types import Array, Mask, Rows


class Outcome(NamedTuple):
    """What a task says of n cells after a step.

    Attributes:
        terms: (n, 2, terms) raw reward terms of each arm, in the order of `Task.weights`. An arm's own reward is their
            weighted sum; the reward of both together is the mean of the two.
        success: (n,) whether the task is done well. True only where `over` or `terminal` is.
        over: (n,) whether the time of the episode has run out.
        info: Values for `info` by name, (n, ...) each. One with an axis of 2 behind that is of the left and the right
            arm; others must not have one there.
        terminal: (n,) whether a state is reached from which there is nothing more to do, well done or not; None: none.
    """

    terms: Array
    success: Mask
    over: Mask
    info: dict[str, Array]
    terminal: Mask | None = None


@dataclasses.dataclass(frozen=True)
class Timing:
    """When things happen.

    Attributes:
        period_s: Time between two actions.
        ahead_s: Time from an observation to where the motion of its action ends: period and action latency.
    """

    period_s: float
    ahead_s: float


@dataclasses.dataclass(frozen=True)
class SceneRequirements:
    """Scene that a task needs in the cell.

    Attributes:
        equipment: Grippers and what they handle.
        timestep_s: Physics step, if the cell does not say otherwise.
        gains: Joint servos, if the cell does not say otherwise.
        closer: Smallest legal distance in m of pairs of bodies that may come closer than the cell's own smallest
            distance, by their names in `dual_ur10.assets.collision_model.clearance_pairs`.
    """

    equipment: Equipment = dataclasses.field(default_factory=Equipment)
    timestep_s: float = 0.002
    gains: str = "stiff"
    closer: Mapping[tuple[str, str], float] = dataclasses.field(default_factory=dict)


SettingsT = TypeVar("SettingsT")
MeasuredT = TypeVar("MeasuredT")


class Task(ABC, Generic[SettingsT, MeasuredT]):
    """A task for n cells. It sees nothing but `CellState`, and keeps what belongs to the running episodes.

    Attributes:
        name: As in the id.
        limits: What the arms may do in this task, in simulation and in reality; of an object, as far as its cell
            allows it.
        weights: Weight of each reward term, by its name.
        coupled: Whether both arms hold one object between them.
        stages: Names of the stages that `info["stage"]` counts, if there are any; 0 is before the first.
        settings_type: Dataclass of what the user may set.
        layout: Fields of an observation; of an object, as its settings ask for them.

    Args:
        settings: What the user may set.
        cell: The cell it runs in.
        timing: Rate and latency of actions.
        n: Number of cells.
    """

    name: ClassVar[str]
    limits: MotionLimits
    weights: ClassVar[Mapping[str, float]]
    stages: ClassVar[tuple[str, ...]] = ()
    coupled: ClassVar[bool] = False
    settings_type: ClassVar[type[Any]]
    layout: ObservationLayout

    def __init__(self, settings: SettingsT, cell: CellConfig, timing: Timing, n: int) -> None:
        self.settings, self.cell, self.timing, self.n = settings, cell, timing, n
        self.limits = cell.capped(type(self).limits)
        self.layout = self.layout_for(settings)

    @classmethod
    def layout_for(cls, settings: SettingsT) -> ObservationLayout:
        """Return the fields that an observation has with these settings."""
        return cls.layout

    @classmethod
    def agent_layout_for(cls, settings: SettingsT) -> ObservationLayout:
        """Return the fields of each agent's own observation, which begin with those of its arm."""
        return cls.layout_for(settings)

    @classmethod
    def requirements(cls, settings: SettingsT) -> SceneRequirements:
        """Return the scene that the task needs in the cell."""
        return SceneRequirements()

    @abstractmethod
    def start(self, rows: Rows, rngs: Sequence[np.random.Generator]) -> Start:
        """Draw new episodes for `rows`, one generator each. Returns how they begin, (len(rows), ...) each."""

    @abstractmethod
    def measure(self, state: CellState) -> MeasuredT:
        """Everything about a state that observation and reward share.

        It keeps nothing, for it may be called for the true state and for the measured one. What `observe` takes from it
        depends on poses and openings alone: noise of joints and wrenches does not ask for another call.
        """

    @abstractmethod
    def observe(self, state: CellState, measured: MeasuredT, commanded_q_rad: Array) -> Array:
        """Observations, (n, size): the left arm's numbers, then the right arm's."""

    def observe_agents(self, observation: Array) -> Array:
        """Return each agent's own observation, (n, 2, size), from those of both, (n, size); for any n."""
        return observation.reshape(len(observation), 2, -1)

    @abstractmethod
    def evaluate(self, state: CellState, measured: MeasuredT) -> Outcome:
        """Reward terms and success. Called once per step, for it may keep count of an episode."""

    def payload_kg(self) -> Array | None:
        """(n, 2) mass that each gripper holds at the end of the period to come, as told to the controllers."""
        return None


def duration_ratio(wanted: MotionLimits, allowed: MotionLimits) -> float:
    """How many times longer a motion takes within `allowed` than within `wanted`, at most."""
    joints = max(a / b for a, b in zip(wanted.speed_rad_s, allowed.speed_rad_s, strict=True))
    return max(1.0, joints, wanted.tcp_speed_m_s / allowed.tcp_speed_m_s)


def check_numbers(settings: Any, *ranges: tuple[str, float, float]) -> None:
    """Make fields of frozen settings plain floats.

    Raises:
        SettingsError: One is not a number within its range.
    """
    for name, low, high in ranges:
        value = getattr(settings, name)
        if isinstance(value, bool) or not isinstance(value, numbers.Real) or not low <= float(value) <= high:
            raise SettingsError(f"{name} is {value!r}: it must be a number, {low:g} to {high:g}")
        object.__setattr__(settings, name, float(value))


_LOG_TENTH = float(np.log(0.1))


def gaussian(distance: Array, margin: float | Array) -> Array:
    """1 at distance 0, 0.1 at `margin`: dm_control's `tolerance` with bounds (0, 0) and its gaussian sigmoid."""
    scaled = distance / margin
    result: Array = np.exp(scaled * scaled * _LOG_TENTH)
    return result
