"""Environment signature stored in a checkpoint: spaces, rates, action mode and robot.

It is computed from the keywords of an environment. Neither physics nor controllers are needed.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import Annotated, Any, Final, Literal

import numpy as np

from dual_ur10.envs.core.options import IMAGE_OPTIONS, EnvOptions
from dual_ur10.envs.core.randomization import Randomization, resolve_randomization
from dual_ur10.envs.core.setup import EnvSetup, load_task
from dual_ur10.envs.tasks.task import Task
from dual_ur10.errors import CheckpointError
from dual_ur10.ids import TASKS, is_registered, received
from dual_ur10.policies.learned.schema import JsonList, Numbers, Object, StrictJson, Text, Whole
from dual_ur10.sim2real.cell.cell_config import CellConfig
from dual_ur10.sim2real.control.adapter import ActionMode, ServojAdapter
from dual_ur10.sim2real.recording.header import built, field_types, plain
from ur_core.kinematics.frames import ArmMount
from ur_core.kinematics.robots import ROBOTS
from ur_core.kinematics.ur10 import ARMS, Family
from ur_core.servoj import ServojProfile
from ur_core.tools.tool import tools_of

OPTIONS: Final = (
    "policy_rate_hz",
    "action_mode",
    "action_scale",
    "action_latency_ticks",
    "compensate_lag",
    "randomization",
    "observation",
    *IMAGE_OPTIONS,
)
"""Options of the environment that a signature keeps, those of images where they are observed beside the numbers. Paths
of cells and records are private."""

View = Literal["state", "goals", "both"]

_MOST_SIZE: Final = 4096
_BASE: Final = 6
_AND: Final = " + "


@dataclass(frozen=True)
class Space(StrictJson):
    """A `gymnasium.spaces.Box` of one axis.

    Attributes:
        shape: (size,).
        dtype: Type of its numbers.
        low, high: (size,) bounds.

    Raises:
        CheckpointError: The bounds do not fit the shape.
    """

    shape: Annotated[tuple[Whole], JsonList]
    dtype: Literal["float32", "float64"]
    low: Numbers
    high: Numbers

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
class ActionRate(StrictJson):
    """Timing of actions.

    Attributes:
        tick_s: Control period of the controllers, in s.
        period_ticks: Ticks per action.
        latency_ticks: Ticks from an observation to the first target of its action.
    """

    tick_s: float
    period_ticks: Whole
    latency_ticks: Whole


@dataclass(frozen=True)
class Actions(StrictJson):
    """Meaning of actions.

    Attributes:
        mode: See `dual_ur10.sim2real.control.adapter.ServojAdapter`.
        gripper: Each arm's action ends with a gripper width.
        compensate_lag: The adapter compensates the lag of `servoj`.
        joint_step_rad: Step of each joint for an action of 1 with "joint_delta", else (); speed caps and
            `action_scale` change it.
    """

    mode: ActionMode
    gripper: bool
    compensate_lag: bool
    joint_step_rad: Numbers


@dataclass(frozen=True)
class Robot(StrictJson):
    """Arms and their controllers.

    Attributes:
        model: Model of both arms, such as "UR10", or the left and the right one, such as "UR5e + UR10e".
        family: Family of the controllers.
        lookahead_s, gain: Settings of `servoj`.
        nominal_dh: For left and right, True for the kinematics of the data sheet, False for calibrated ones.
        bases: Poses of the left and the right base in the cell frame, six numbers each: position in m, yaw and tilt in
            rad, as of `ur_core.kinematics.frames.ArmMount`.
        tools: Names of the left and the right tool; empty for a task without grippers.
    """

    model: Text
    family: Family
    lookahead_s: float
    gain: float
    nominal_dh: Annotated[tuple[bool, bool], JsonList]
    bases: Numbers
    tools: Annotated[tuple[Text, ...], JsonList]

    def __post_init__(self) -> None:
        _ = self.names
        if len(self.bases) != len(ARMS) * _BASE or len(self.tools) not in (0, len(ARMS)):
            raise CheckpointError(
                f"robot.bases has {len(self.bases)} numbers and robot.tools {len(self.tools)} names: "
                f"there must be {len(ARMS) * _BASE}, and {len(ARMS)} or none"
            )

    def bases_away(self, other: Robot) -> tuple[float, float]:
        """Return the largest distance of a base from that of another cell, in m, and its largest rotation, in rad."""
        away = np.abs(np.subtract(self.bases, other.bases)).reshape(len(ARMS), _BASE)
        return float(np.linalg.norm(away[:, :3], axis=1).max()), float(np.linalg.norm(away[:, 3:], axis=1).max())

    @property
    def names(self) -> tuple[str, str]:
        """Names of both models in `ur_core.kinematics.robots.ROBOTS`.

        Raises:
            CheckpointError: One is none of them.
        """
        titles = self.model.split(_AND)
        found = [name for title in titles for name, model in ROBOTS.items() if model.title == title]
        if not len(found) == len(titles) <= len(ARMS):
            raise CheckpointError(
                f"robot.model is {self.model!r:.80}: allowed are {', '.join(each.title for each in ROBOTS.values())}, "
                f"or two of them with{_AND}between"
            )
        return found[0], found[-1]


@dataclass(frozen=True)
class EnvironmentSignature(StrictJson):
    """Properties of an environment that a policy depends on.

    Attributes:
        env_id: Id of the environment.
        kwargs: Keywords of the task and of `OPTIONS` that differ from their defaults.
        view: "state", all numbers of the task; "goals", its concise view; or "both", all numbers and images.
        observation: Space of the view of both arms together, in its own precision: single for "goals", double for
            "state". Networks compute in single precision, so that no policy depends on `observation_dtype`.
        action: Space of the actions of both arms together.
        rate: Timing of actions.
        actions: Meaning of actions.
        robot: Arms and their controllers.

    Raises:
        CheckpointError: No such environment.
    """

    env_id: Text
    kwargs: Object
    view: View
    observation: Space
    action: Space
    rate: ActionRate
    actions: Actions
    robot: Robot

    def __post_init__(self) -> None:
        if not is_registered(self.env_id):
            raise CheckpointError(f"there is no environment {self.env_id!r:.80}: there are {', '.join(TASKS)}")
        if self.observation.shape[0] % 2 or self.action.shape[0] % 2:
            raise CheckpointError("observations and actions of two arms have an even number of numbers each")


class EnvironmentView:
    """Signature of an environment, and the places of fields in its observations.

    Args:
        setup: Resolved keywords of the environment.
        task: Task of any number of cells.
        adapter: Adapter of any number of cells.

    Attributes:
        setup: Resolved keywords of the environment.
        layout: Fields of an arm in an observation.
        signature: Properties that a policy depends on.
    """

    def __init__(self, setup: EnvSetup, task: Task[Any, Any], adapter: ServojAdapter) -> None:
        self.setup, config = setup, setup.config
        low, high = (each.reshape(-1).astype(np.float32) for each in adapter.action_bounds)
        concise = setup.options.concise
        self.layout = layout = task.concise_view().layout if concise else task.layout
        steps, speed_rad_s = adapter.mode == "joint_delta", np.asarray(task.limits.speed_rad_s)
        step_rad = tuple((speed_rad_s * adapter.action_scale * adapter.period_s).tolist()) if steps else ()
        mounts = (config.left, config.right)
        self.signature = EnvironmentSignature(
            env_id=setup.env_id,
            kwargs=_kwargs(setup),
            view=_view_of(setup.options),
            observation=Space(
                (2 * layout.size,),
                "float32" if concise else "float64",
                tuple(layout.low.tolist()),
                tuple(layout.high.tolist()),
            ),
            action=Space((len(low),), "float32", tuple(low.tolist()), tuple(high.tolist())),
            rate=ActionRate(config.servoj.tick_s, setup.ticks, int(setup.latency_ticks)),
            actions=Actions(adapter.mode, adapter.gripper, bool(adapter.compensate_lag), step_rad),
            robot=Robot(
                _AND.join(dict.fromkeys(mount.model.title for mount in mounts)),
                config.servoj.family,
                float(config.servoj.lookahead_s),
                float(config.servoj.gain),
                (mounts[0].dh.is_nominal, mounts[1].dh.is_nominal),
                tuple(float(x) for each in mounts for x in (*each.position_m, each.yaw_rad, *each.tilt_rad)),
                tuple(tool.name for tool in config.equipment.tools) if config.equipment.grippers else (),
            ),
        )

    def indices(self, names: Iterable[str], *, joint: bool) -> list[int]:
        """Return the positions of fields in the observation of a network.

        Args:
            names: Names of fields. One that a setting of the task or the view leaves out has none.
            joint: The network observes both arms; otherwise one agent.

        Raises:
            UnknownNameError: The task has no such field.
        """
        absent = {*self.setup.task_type.layout.names} - {*self.layout.names}
        found = self.layout.indices(name for name in names if name not in absent)
        return [arm * self.layout.size + index for arm in range(2 if joint else 1) for index in found]


def view_of(env_id: str, keywords: Mapping[str, Any]) -> EnvironmentView:
    """Return the view of an environment with these keywords, without making it.

    Raises:
        UnknownNameError: No such environment, or keyword.
        SettingsError: A value is not legal; or a subclass.
    """
    setup = EnvSetup.resolve(env_id, keywords)
    return EnvironmentView(setup, setup.make_task(), setup.make_adapter())


def view_of_env(env: Any) -> EnvironmentView:
    """Return the view of an environment of any interface.

    Raises:
        CheckpointError: It is no environment of this package.
    """
    core = getattr(getattr(env, "unwrapped", env), "core", None)
    core = getattr(getattr(env, "cells", None), "core", None) if core is None else core
    if core is None:
        raise CheckpointError(f"{type(env).__name__} is no environment of dual_ur10: pass one, or its id and keywords")
    return EnvironmentView(core.setup, core.task, core.pipeline.adapter)


def view_of_signature(signature: EnvironmentSignature) -> EnvironmentView:
    """Return the view of the simulated environment that a checkpoint's signature describes.

    Raises:
        CheckpointError: Its keywords make no environment.
    """
    kind = load_task(signature.env_id).settings_type
    known = [*OPTIONS, *(each.name for each in dataclasses.fields(kind))]
    for name in signature.kwargs:
        if name not in known:
            raise CheckpointError(f"kwargs has an unknown {name!r:.80}: allowed are {', '.join(known)}")
    robot = signature.robot
    try:
        with received("the checkpoint"):
            left, right = (
                ArmMount((x, y, z), yaw, robot=name, tilt_rad=(tilt_x, tilt_y))
                for name, (x, y, z, yaw, tilt_x, tilt_y) in zip(
                    robot.names, np.reshape(robot.bases, (len(ARMS), _BASE)).tolist(), strict=True
                )
            )
            servoj = ServojProfile(robot.family, robot.lookahead_s, robot.gain)
            tools = tools_of(robot.tools) if robot.tools else None
            cell = CellConfig(left=left, right=right, servoj=servoj, tools=tools)
            types = field_types(kind)
            keywords = dict(signature.kwargs)
            keywords |= {name: built(types[name], keywords[name]) for name in types.keys() & keywords.keys()}
            return view_of(signature.env_id, {**keywords, "cell": cell})
    except (ValueError, TypeError, KeyError, AttributeError, OverflowError) as error:
        raise CheckpointError(f"its kwargs make no environment: {error!s:.300}") from error


def _view_of(options: EnvOptions) -> View:
    """Return the view of an observation. Those of images alone, or beside the numbers in one dict, have no name."""
    return options.observation if options.observation in ("goals", "both") else "state"


def _kwargs(setup: EnvSetup) -> dict[str, object]:
    options, settings = setup.options, setup.settings
    found: dict[str, Any] = {name: getattr(options, name) for name in OPTIONS}
    found["action_latency_ticks"] = int(setup.latency_ticks)
    found["observation"] = _view_of(options)
    if found["observation"] != "both":
        found = {name: value for name, value in found.items() if name not in IMAGE_OPTIONS}
    if found["randomization"] is None or isinstance(found["randomization"], Randomization):
        found["randomization"] = dataclasses.asdict(resolve_randomization(found["randomization"]))
    default = EnvOptions()
    result = {name: value for name, value in found.items() if value != getattr(default, name)}
    default = type(settings)()
    for each in dataclasses.fields(settings):
        value = getattr(settings, each.name)
        if plain(value) != plain(getattr(default, each.name)):
            result[each.name] = value
    kept: dict[str, object] = plain(result)
    return kept
