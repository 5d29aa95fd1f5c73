"""What an environment is, as far as a policy made for it depends on it. Neither physics nor controllers are needed."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Final, Literal

import numpy as np

from dual_ur10.envs.core.options import EnvOptions
from dual_ur10.envs.core.randomization import Randomization, resolve_randomization
from dual_ur10.envs.core.setup import EnvSetup, load_task
from dual_ur10.envs.tasks.task import Task
from dual_ur10.errors import CheckpointError
from dual_ur10.ids import ENV_IDS, env_id_of, task_name
from dual_ur10.policies.learned import schema
from dual_ur10.sim2real.config.cell import CellConfig
from dual_ur10.sim2real.control.adapter import ActionMode, ServojAdapter
from dual_ur10.sim2real.control.servoj import Family, ServojProfile
from dual_ur10.sim2real.recording.describe import plain
from dual_ur10.types import Array

OPTIONS: Final = ("policy_rate_hz", "action_mode", "action_latency_ticks", "compensate_lag", "randomization")
"""Keywords of every environment that are kept. Where things are (cells, records) is nobody else's business."""

_MOST_SIZE: Final = 4096


@dataclass(frozen=True)
class Space:
    """A `gymnasium.spaces.Box` of one axis.

    Attributes:
        shape: (size,).
        dtype: Of its numbers.
        low, high: (size,) bounds.

    Raises:
        CheckpointError: The bounds do not fit the shape.
    """

    shape: tuple[int]
    dtype: Literal["float32", "float64"]
    low: tuple[float, ...]
    high: tuple[float, ...]

    def __post_init__(self) -> None:
        size = self.shape[0]
        if not 1 <= size <= _MOST_SIZE or len(self.low) != size or len(self.high) != size:
            raise CheckpointError(
                f"a space has shape {self.shape}, {len(self.low)} lower and {len(self.high)} upper bounds: there must "
                f"be one of each for every number, and 1 to {_MOST_SIZE} numbers"
            )
        if not all(low < high for low, high in zip(self.low, self.high, strict=True)):
            raise CheckpointError("a space has a lower bound that is not below the upper one")


@dataclass(frozen=True)
class Rate:
    """When actions are taken.

    Attributes:
        tick_s: Control period of the controllers.
        period_ticks: Ticks of an action.
        latency_ticks: Ticks from an observation to the first target of its action.
    """

    tick_s: float
    period_ticks: int
    latency_ticks: int


@dataclass(frozen=True)
class Actions:
    """What actions mean.

    Attributes:
        mode: See `dual_ur10.sim2real.control.adapter.ServojAdapter`.
        gripper: Whether each arm's action ends with a gripper's opening.
        compensate_lag: Whether the adapter takes the lag of `servoj` out.
        joint_step_rad: What 1 is for each joint where they are steps of joints, else (); speed caps change it.
    """

    mode: ActionMode
    gripper: bool
    compensate_lag: bool
    joint_step_rad: tuple[float, ...]


@dataclass(frozen=True)
class Robot:
    """The arms.

    Attributes:
        model: Always "UR10".
        family: Of their controllers.
        lookahead_s, gain: Settings of `servoj`.
        nominal_dh: Whether left and right have the kinematics of the data sheet; else they are calibrated.
    """

    model: Literal["UR10"]
    family: Family
    lookahead_s: float
    gain: float
    nominal_dh: tuple[bool, bool]


@dataclass(frozen=True)
class Target:
    """An environment, as far as a policy depends on it.

    Attributes:
        env_id: Its id.
        kwargs: Keywords that differ from their defaults: the task's, and of `OPTIONS`.
        observation, action: Its spaces.
        rate: When actions are taken.
        actions: What they mean.
        robot: The arms.

    Raises:
        CheckpointError: There is no such environment.
    """

    env_id: str
    kwargs: dict[str, object]
    observation: Space
    action: Space
    rate: Rate
    actions: Actions
    robot: Robot

    def __post_init__(self) -> None:
        if self.env_id not in ENV_IDS:
            raise CheckpointError(f"there is no environment {self.env_id!r:.80}: there are {', '.join(ENV_IDS)}")
        if self.observation.shape[0] % 2 or self.action.shape[0] % 2:
            raise CheckpointError("observations and actions of two arms have an even number of numbers each")


class Described:
    """An environment and what it says of itself.

    Args:
        setup: Of the environment.
        task: Its task, for any number of cells.
        adapter: Likewise.

    Attributes:
        setup: As given.
        target: What a policy depends on.
    """

    def __init__(self, setup: EnvSetup, task: Task[Any, Any], adapter: ServojAdapter) -> None:
        self.setup, self._task, config = setup, task, setup.config
        low, high = (each.reshape(-1).astype(np.float32) for each in adapter.action_bounds)
        layout = task.layout
        steps = adapter.mode == "joint_delta"
        step_rad = tuple((np.asarray(task.limits.speed_rad_s) * adapter.period_s).tolist()) if steps else ()
        mounts = (config.left, config.right)
        self.target = Target(
            env_id=env_id_of(task.name),
            kwargs=_kwargs(setup),
            observation=Space((2 * layout.size,), "float64", tuple(layout.low.tolist()), tuple(layout.high.tolist())),
            action=Space((len(low),), "float32", tuple(low.tolist()), tuple(high.tolist())),
            rate=Rate(config.servoj.tick_s, setup.ticks, int(setup.latency_ticks)),
            actions=Actions(adapter.mode, adapter.gripper, bool(adapter.compensate_lag), step_rad),
            robot=Robot(
                "UR10",
                config.servoj.family,
                float(config.servoj.lookahead_s),
                float(config.servoj.gain),
                (mounts[0].dh.is_nominal, mounts[1].dh.is_nominal),
            ),
        )

    @property
    def agent_size(self) -> int:
        """Number of values that each agent observes."""
        return self.setup.task_type.agent_layout_for(self.setup.settings).size

    def split(self, observation: Array) -> Array:
        """Each agent's own observation, (n, 2, size), from those of both, (n, size)."""
        return self._task.observe_agents(observation)


def described(env_id: str, keywords: Mapping[str, Any]) -> Described:
    """The environment with these keywords, which is not made.

    Raises:
        UnknownNameError: There is no such environment, or keyword.
        SettingsError: Or one of its kinds: a value is not legal.
    """
    setup = EnvSetup.resolve(task_name(env_id_of(env_id)), keywords)
    adapter = setup.make_adapter()
    return Described(setup, setup.make_task(), adapter)


def described_env(env: Any) -> Described:
    """An environment of any of the interfaces.

    Raises:
        CheckpointError: It is none.
    """
    core = getattr(getattr(env, "unwrapped", env), "core", None)
    core = getattr(getattr(env, "cells", None), "core", None) if core is None else core
    if core is None:
        raise CheckpointError(f"{type(env).__name__} is no environment of dual_ur10: pass one, or its id and keywords")
    return Described(core.setup, core.task, core.pipeline.adapter)


def described_target(target: Target) -> Described:
    """The environment that somebody's target speaks of, in simulation.

    Raises:
        CheckpointError: Its keywords do not make one.
    """
    kind = load_task(task_name(target.env_id))
    known = [*OPTIONS, *(each.name for each in dataclasses.fields(kind.settings_type))]
    for name in target.kwargs:
        if name not in known:
            raise CheckpointError(f"kwargs has an unknown {name!r:.80}: allowed are {', '.join(known)}")
    robot = target.robot
    try:
        cell = CellConfig(servoj=ServojProfile(robot.family, robot.lookahead_s, robot.gain))
        return described(target.env_id, {**target.kwargs, "cell": cell})
    except (ValueError, TypeError, KeyError, AttributeError, OverflowError) as error:
        raise CheckpointError(f"its kwargs make no environment: {error!s:.300}") from error


def _kwargs(setup: EnvSetup) -> dict[str, object]:
    options, settings = setup.options, setup.settings
    found: dict[str, Any] = {name: getattr(options, name) for name in OPTIONS}
    found["action_latency_ticks"] = int(setup.latency_ticks)
    if found["randomization"] is None or isinstance(found["randomization"], Randomization):
        found["randomization"] = dataclasses.asdict(resolve_randomization(found["randomization"]))
    default = EnvOptions()
    result = {name: value for name, value in found.items() if value != getattr(default, name)}
    default = type(settings)()
    for each in dataclasses.fields(settings):
        value = getattr(settings, each.name)
        if plain(value) != plain(getattr(default, each.name)):
            result[each.name] = value
    checked: dict[str, object] = schema.plain(plain(result), "kwargs")
    return checked
