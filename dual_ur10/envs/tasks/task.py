"""Interface of a task: start of an episode, observations, rewards and end."""

from __future__ import annotations

import dataclasses
import numbers
from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from typing import Any, ClassVar, Final, Generic, NamedTuple, TypeVar, cast

import numpy as np

from dual_ur10.assets.settings import Equipment, home_q_rad
from dual_ur10.envs.tasks.observation_layout import ConciseView, ObservationLayout
from dual_ur10.errors import SettingsError
from dual_ur10.sim2real.cell.cell import CellState, Start
from dual_ur10.sim2real.cell.cell_config import CellConfig
from dual_ur10.sim2real.control.limits import MotionLimits
from ur_core.mjcf.gains import STIFF, Gains
from ur_core.tools.tool import strokes_m
from ur_core.types import Array, Mask, Rows, changed

FINISH: Final = "finish"
"""Reward term of success: the number of steps that remain when an episode ends with it, times its quality."""


class Outcome(NamedTuple):
    """Evaluation of n cells after a step.

    Attributes:
        terms: (n, 2, terms) raw reward terms of each arm, in the order of `Task.weights`. An arm's own reward is their
            weighted sum; the reward of both together is the mean of the two.
        success: (n,) True if the episode ends with success; only where `over` or `terminal` is True.
        over: (n,) True if the time of the episode has run out.
        info: Values for `info` by name, (n, ...) each; see `Task.per_arm`.
        terminal: (n,) True in a terminal state, with success or failure; None: there is none.
    """

    terms: Array
    success: Mask
    over: Mask
    info: dict[str, Array]
    terminal: Mask | None = None


@dataclasses.dataclass(frozen=True)
class Timing:
    """Rate and latency of actions.

    Attributes:
        period_s: Time between two actions.
        ahead_s: Time from an observation to the end of the motion of its action: period plus action latency.
    """

    period_s: float
    ahead_s: float


@dataclasses.dataclass(frozen=True)
class SceneRequirements:
    """Scene that a task needs in the cell.

    Attributes:
        equipment: Grippers and what they handle.
        timestep_s: Physics step, unless the cell specifies another.
        gains: Gains of the joint servos, unless the cell specifies others.
        closer: Smallest legal distance in m of pairs of bodies that may come closer than the cell's own smallest
            distance, by their names in `dual_ur10.assets.collision_model.clearance_pairs`.
    """

    equipment: Equipment = dataclasses.field(default_factory=Equipment)
    timestep_s: float = 0.002
    gains: Gains = STIFF
    closer: Mapping[tuple[str, str], float] = dataclasses.field(default_factory=dict)


SettingsT = TypeVar("SettingsT")
MeasuredT = TypeVar("MeasuredT")


class Task(ABC, Generic[SettingsT, MeasuredT]):
    """Task for n cells. Its only input is `CellState`; it keeps the state of the running episodes.

    Attributes:
        limits: Motion limits of the task, in simulation and on real arms; those of an instance respect its cell.
        weights: Weight of each reward term, by its name.
        couples: True if both arms may hold one object between them; see `coupled`. The cell must know the bases of two
            real arms well enough for that.
        ramp_kg_s: Rate at which the declared payload follows `load_kg`.
        per_arm: Names of those values of `info` whose second axis is for the left and the right arm, (n, 2, ...). With
            two agents each gets its own part.
        stages: Names of the stages that `info["stage"]` counts, or empty; 0 is before the first stage.
        settings_type: Dataclass of the task's keywords.
        layout: Fields of an observation; those of an instance depend on its settings.
        ranges: Names of those settings that bound the initial pose of an object, which every episode samples between
            minus and plus, and which `Randomization.object_spread` widens.
        sampled: Names of all settings that bound what every episode samples between minus and plus.
        horizon: Steps after which the time of an episode runs out; None: not known in advance.
        accepted: Subjects of findings of `dual_ur10.testing.audit` that are no fault of the task, each with the reason.

    Args:
        settings: Values of the task's keywords.
        cell: The cell; its tools are `cell.equipment.tools`, left and right.
        timing: Rate and latency of actions.
        n: Number of cells.
    """

    limits: MotionLimits
    weights: ClassVar[Mapping[str, float]]
    per_arm: ClassVar[tuple[str, ...]] = ()
    stages: ClassVar[tuple[str, ...]] = ()
    couples: ClassVar[bool] = False
    ramp_kg_s: ClassVar[float] = 2.0
    settings_type: ClassVar[type[Any]]
    ranges: ClassVar[tuple[str, ...]] = ("object_range_m", "object_turn_rad")
    sampled: ClassVar[tuple[str, ...]] = (*ranges, "target_range_m", "target_turn_rad")
    layout: ObservationLayout
    horizon: int | None = None
    accepted: ClassVar[Mapping[str, str]] = {}

    def __init__(self, settings: SettingsT, cell: CellConfig, timing: Timing, n: int) -> None:
        self.settings, self.cell, self.timing, self.n = settings, cell, timing, n
        self.limits = cell.capped(type(self).limits)
        self.layout = self.layout_for(settings).with_stroke(max(strokes_m(cell.equipment.tools)))
        self._declared_kg: Array = np.zeros((n, 2))

    def __repr__(self) -> str:
        return f"{type(self).__name__}({changed(self.settings)})"

    @classmethod
    def layout_for(cls, settings: SettingsT) -> ObservationLayout:
        """Return the fields that an observation has with these settings."""
        return cls.layout

    def concise_view(self) -> ConciseView:
        """Return the view of observations with `observation="goals"`.

        Raises:
            SettingsError: The layout marks no field for it.
        """
        return ConciseView(self.layout, home_q_rad((self.cell.left, self.cell.right)), type(self).__name__)

    @classmethod
    def covered(cls, trained: SettingsT, settings: SettingsT) -> frozenset[str]:
        """Return the keywords whose values lie within the range that a training with other settings sampled."""
        names = {*cls.sampled} & {each.name for each in dataclasses.fields(cast(Any, settings))}
        return frozenset(name for name in names if getattr(settings, name) <= getattr(trained, name))

    @classmethod
    def requirements(cls, settings: SettingsT) -> SceneRequirements:
        """Return the scene that the task needs in the cell."""
        return SceneRequirements()

    def at_home(self, rows: Rows) -> Start:
        """Return the starts of `rows` with both arms at home, open grippers, and props where their MJCF has them."""
        home = np.tile(home_q_rad((self.cell.left, self.cell.right)), (len(rows), 1, 1))
        equipment = self.cell.equipment
        return Start(home, np.tile(strokes_m(equipment.tools), (len(rows), 1)) if equipment.grippers else None)

    @abstractmethod
    def start(self, rows: Rows, rngs: Sequence[np.random.Generator]) -> Start:
        """Sample new episodes for `rows`, one generator each, and return their starts, (len(rows), ...) each.

        Called again with equal generators it must begin the same episodes.
        """

    @abstractmethod
    def measure(self, state: CellState) -> MeasuredT:
        """Compute the quantities that observation and reward share.

        It must keep no state, because it is called for the true state and for the measured one. The part that `observe`
        uses may depend on poses and gripper widths only: noise on joints and wrenches alone needs no further call.
        """

    @abstractmethod
    def observe(self, state: CellState, measured: MeasuredT, commanded_q_rad: Array) -> Array:
        """Assemble the observations, (n, 2 * layout.size). Each arm's half is that of its agent."""

    @abstractmethod
    def evaluate(self, state: CellState, measured: MeasuredT) -> Outcome:
        """Evaluate the state after a step. Call it once per step, because it may count steps of an episode."""

    def failure(self, row: int, outcome: Outcome) -> str:
        """Return the name of the failure for which a row is terminal, for `info["end_reason"]`."""
        return "failure"

    def load_kg(self) -> Array | None:
        """Return the mass that each gripper carries, (n, 2), after the last evaluation; None: it is not declared."""
        return None

    def payload_kg(self) -> Array | None:
        """Return the payload to set on the controllers at the end of the next period, (n, 2); None: none.

        It follows `load_kg` at `ramp_kg_s`, because a payload that jumps makes the arms jump. Call it once per step.
        """
        load_kg = self.load_kg()
        if load_kg is None:
            return None
        most = self.ramp_kg_s * self.timing.period_s
        step = np.minimum(np.maximum(load_kg - self._declared_kg, -most), most)
        self._declared_kg = self._declared_kg + step
        return self._declared_kg

    @property
    def declared_kg(self) -> Array:
        """Payload declared last, (n, 2)."""
        return self._declared_kg.copy()

    def forget_load(self, rows: Rows) -> None:
        """Declare no load at the begin of episodes in `rows`. The stepping core calls it before `start`."""
        self._declared_kg = self._declared_kg.copy()
        self._declared_kg[rows] = 0.0

    def coupled(self) -> Mask:
        """Return the rows, (n,), whose arms hold one object between them, after the last evaluation.

        On two controllers an error of their relative pose then stops both. By default, it is every row of a task that
        `couples`.
        """
        return np.full(self.n, self.couples)


def duration_ratio(wanted: MotionLimits, allowed: MotionLimits) -> float:
    """Return an upper bound of the factor by which a motion takes longer within `allowed` than within `wanted`."""
    joints = max(a / b for a, b in zip(wanted.speed_rad_s, allowed.speed_rad_s, strict=True))
    return max(1.0, joints, wanted.tcp_speed_m_s / allowed.tcp_speed_m_s)


def check_numbers(settings: Any, *ranges: tuple[str, float, float]) -> None:
    """Convert fields of frozen settings to plain floats.

    Raises:
        SettingsError: A value is not a number within its range.
    """
    for name, low, high in ranges:
        value = getattr(settings, name)
        if isinstance(value, bool) or not isinstance(value, numbers.Real) or not low <= float(value) <= high:
            raise SettingsError(f"{name} is {value!r}: it must be a number, {low:g} to {high:g}")
        object.__setattr__(settings, name, float(value))


_LOG_TENTH = float(np.log(0.1))


def gaussian(distance: Array, margin: float | Array) -> Array:
    """Return 1 at distance 0 and 0.1 at `margin`: dm_control's `tolerance` with its gaussian sigmoid."""
    scaled = distance / margin
    result: Array = np.exp(scaled * scaled * _LOG_TENTH)
    return result
