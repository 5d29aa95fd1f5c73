"""From the keywords of an environment to all that follows from them, before anything is made or connected."""

from __future__ import annotations

import dataclasses
import json
import shlex
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from typing import TYPE_CHECKING, Any, Final, cast

import numpy as np

from dual_ur10.assets.scene import build_model
from dual_ur10.assets.settings import Equipment, default_mount
from dual_ur10.envs.core.options import MOVE_TO_START, OPTION_NAMES, EnvOptions
from dual_ur10.envs.core.randomization import Randomization, resolve_randomization
from dual_ur10.envs.tasks.task import SceneRequirements, Task, Timing
from dual_ur10.errors import ResetRefusedError, SettingsError, UnknownKeywordError, UnknownNameError
from dual_ur10.ids import TASKS, env_id_of
from dual_ur10.sim2real.cell.cell_config import CellConfig, HostedCell
from dual_ur10.sim2real.cell.named_cell import resolve_cell
from dual_ur10.sim2real.cell.perturbation import Perturbation
from dual_ur10.sim2real.control.adapter import ServojAdapter, scale_of_steps
from dual_ur10.sim2real.control.clearance import Clearance
from dual_ur10.sim2real.control.limits import MotionLimits
from ur_core.objects import load_object
from ur_core.processes.system import LOCAL, System

if TYPE_CHECKING:
    from dual_ur10.envs.tasks.staged import StagedTask

REFUSAL: Final = "refusal"
"""Reward term of a step in which the safety gate refuses a motion, and none in the step before."""

REFUSAL_WEIGHT: Final = -1.0
"""Its weight, unless another one is given: what the best step earns."""

PROGRESS_TERM: Final = "progress"
"""Reward term of a step that exceeds all others of its episode so far, of `progress_weight`."""

SUCCESS_TERM: Final = "success"
"""Reward term of the step that ends an episode with success, of `reward="sparse"`."""


def load_task(name: str) -> type[Task[Any, Any]]:
    """Return the class of a task by its id or a shorter name.

    Raises:
        UnknownNameError: There is no such environment.
        SettingsError: Its class cannot be imported, or is no task.
    """
    env_id = env_id_of(name)
    task: type[Task[Any, Any]] = load_object(TASKS[env_id].task, f"the task of {env_id}", registered=True)
    if not isinstance(task, type) or not issubclass(task, Task):
        raise SettingsError(f"{TASKS[env_id].task!r}, registered as {env_id}, is no subclass of {Task.__module__}.Task")
    return task


@contextmanager
def _overflows_named() -> Iterator[None]:
    """Refuse whole numbers that no float holds, which JSON may bring."""
    try:
        yield
    except OverflowError as error:
        raise SettingsError(
            f"a keyword holds a number that is too large: {error}. At most 1e308 is a number here"
        ) from error


@_overflows_named()
def task_settings(env_id: str, keywords: Mapping[str, Any]) -> Any:
    """Return the settings of a task with these keywords.

    Raises:
        UnknownNameError: There is no such environment.
        UnknownKeywordError: The task has no such keyword.
        SettingsError: Or one of its kinds: a value is not legal.
    """
    kind = load_task(env_id).settings_type
    known = [each.name for each in dataclasses.fields(kind)]
    unknown = next((name for name in keywords if name not in known), None)
    if unknown is not None:
        raise UnknownKeywordError.of(f"the task of {env_id_of(env_id)}", str(unknown), known)
    return kind(**keywords)


@dataclasses.dataclass(frozen=True, kw_only=True)
class EnvSetup:
    """Specification of an environment: a pure function of its task and keywords.

    Attributes:
        env_id: Full id of the environment.
        options: Keywords of every environment.
        task_type: Class of the task.
        settings: Settings of the task.
        randomization: Variation from episode to episode.
        requirements: Scene that the task needs.
        system: System on which the environment runs.
        config: The cell, with the task's equipment.
        limits: Motion limits of the task, as far as the cell allows them.
        ticks: Control periods per action.
        latency_ticks: Control periods from an observation to the first target of its action.
        timing: Rate and latency of actions in seconds.
    """

    env_id: str
    system: System
    options: EnvOptions
    task_type: type[Task[Any, Any]]
    settings: Any
    randomization: Randomization
    requirements: SceneRequirements
    config: CellConfig
    limits: MotionLimits
    ticks: int
    latency_ticks: int
    timing: Timing

    @classmethod
    @_overflows_named()
    def resolve(cls, task: str, keywords: Mapping[str, Any], *, ignore_unknown: bool = False) -> EnvSetup:
        """Derive the setup from the keywords of an environment. A path in them is read here.

        Args:
            task: Id of the environment, or a shorter name.
            keywords: Those of `EnvOptions`, and settings of the task.
            ignore_unknown: Accept further keywords, which have no effect.

        Raises:
            UnknownNameError: There is no such environment, or no term that `reward_weights` names.
            UnknownKeywordError: There is no such keyword.
            SettingsError: Or one of its kinds: a value is not legal.
        """
        env_id = env_id_of(task)
        task_type = load_task(env_id)
        options = EnvOptions(**{name: keywords[name] for name in OPTION_NAMES if name in keywords})
        known = [each.name for each in dataclasses.fields(task_type.settings_type)]
        own = {name: value for name, value in keywords.items() if name not in OPTION_NAMES}
        unknown = [name for name in own if name not in known]
        if unknown and not ignore_unknown:
            raise UnknownKeywordError.of(env_id, str(unknown[0]), [*known, *OPTION_NAMES])
        own = {name: value for name, value in own.items() if name in known}
        randomization = resolve_randomization(options.randomization)
        settings = randomization.spread(task_type.settings_type(**own), own, task_type.ranges)
        requirements = task_type.requirements(settings)
        equipment = requirements.equipment
        if options.own_cameras:
            equipment = dataclasses.replace(equipment, cameras=(*equipment.cameras, *options.own_cameras))
        config = _cell_of(options).equipped(equipment, requirements.timestep_s, requirements.gains)
        if options.own_cameras:
            build_model(config.scene, visuals=False)  # refuses them before anything is connected
        tick_s, latency_ticks = config.servoj.tick_s, options.latency_ticks(config)
        ticks = config.servoj.ticks_per_action(options.policy_rate_hz)
        period_s = ticks * tick_s
        setup = cls(
            env_id=env_id,
            system=options.cell.system if isinstance(options.cell, HostedCell) else LOCAL,
            options=options,
            task_type=task_type,
            settings=settings,
            randomization=randomization,
            requirements=requirements,
            config=config,
            limits=config.capped(task_type.limits),
            ticks=ticks,
            latency_ticks=latency_ticks,
            timing=Timing(period_s, period_s + latency_ticks * tick_s),
        )
        setup._check_stages()
        setup._check_emulated_scene()
        if options.reward_weights or options.progress_weight:
            _ = setup.weights  # an unknown term is refused before anything is made
        return setup

    def _check_stages(self) -> None:
        """Check the stages that `starts` and `until` name."""
        options = self.options
        if not options.starts and options.until is None:
            return
        stages = self.task_type.stages if hasattr(self.task_type, "end_after") else ()
        named = {"starts": list(options.starts or ()), "until": [] if options.until is None else [options.until]}
        for keyword, names in named.items():
            if names and not stages:
                raise SettingsError(f"{keyword} names the stage {names[0]!r}, and {self.env_id} has none: leave it out")
            last = stages.index(options.until) if options.until in stages else len(stages) - 1
            allowed = stages if keyword == "until" else stages[:last]  # the last stage ends an episode
            unknown = next((name for name in names if name not in allowed), None)
            if unknown is not None:
                raise UnknownNameError(f"stage of {self.env_id} in {keyword}", str(unknown), list(allowed))
        if options.starts and (self.config.controllers or self.config.state_is_commanded):
            raise SettingsError(
                "starts are states of a simulation, in which an object is held already: leave them out with this cell"
            )

    def _check_emulated_scene(self) -> None:
        """Check that emulated controllers of this task simulate the scene that it has with these settings."""
        emulated = None if self.config.file is None else self.config.file.emulated_scene
        if emulated is None or emulated[0] != self.env_id:
            return
        theirs = task_settings(*emulated)
        if theirs == self.settings or self.task_type.requirements(theirs) == self.requirements:
            return
        names = [each.name for each in dataclasses.fields(theirs)]
        other = [name for name in names if getattr(theirs, name) != getattr(self.settings, name)]
        here, there = ([f"{name}={getattr(of, name)!r:.80}" for name in other] for of in (self.settings, theirs))
        # The cell has only what the command names.
        default = type(theirs)()
        own = {name: value for name in names if (value := getattr(self.settings, name)) != getattr(default, name)}
        try:
            options = "".join(f" --set {shlex.quote(f'{name}={json.dumps(value)}')}" for name, value in own.items())
            start = f"start the cell with `emulate --task {self.env_id}{options}`, in Python with settings={{...}}"
        except TypeError:
            start = 'start the cell with such settings, in which "module:NAME" stands for what no JSON holds'
        raise SettingsError(
            f"{self.env_id} with {', '.join(here)} has another scene than the emulated cell, which has "
            f"{', '.join(there)}: make the environment with these, or {start}"
        )

    @property
    def keeps_time(self) -> bool:
        """True if steps take the time of day; False: as long as they are computed, as in MuJoCo or a virtual cell."""
        return self.config.controllers and self.system is LOCAL

    @property
    def brakes(self) -> bool:
        """True if an episode continues after a motion that the safety gate refused."""
        wanted = self.options.on_refusal
        return not self.config.controllers if wanted is None else wanted == "brake"

    @property
    def weights(self) -> dict[str, float]:
        """Weight of each reward term by its name: those of the task, of refusals where they cost, and of success."""
        found = {**self.task_type.weights, **({REFUSAL: REFUSAL_WEIGHT} if self.brakes else {})}
        if self.options.progress_weight:
            found[PROGRESS_TERM] = float(self.options.progress_weight)
        if self.options.reward == "sparse":
            return {**dict.fromkeys(found, 0.0), SUCCESS_TERM: 1.0}
        given = self.options.reward_weights or {}
        unknown = next((name for name in given if name not in found), None)
        if unknown is not None:
            raise UnknownNameError(f"reward term of {self.env_id}", str(unknown), list(found))
        return {**found, **given}

    @property
    def step_limits(self) -> MotionLimits:
        """Motion limits with the joint speeds that steps can command."""
        scale = scale_of_steps(self.options.action_mode, self.options.action_scale)
        if self.options.action_mode != "joint_delta" or (scale == 1.0).all():
            return self.limits
        speed_rad_s = np.asarray(self.limits.speed_rad_s) * scale
        return dataclasses.replace(self.limits, speed_rad_s=tuple(speed_rad_s.tolist()))

    @property
    def contacts(self) -> bool:
        """True if bodies may touch in simulation: arms handle something, or differ from what the gate knows of them."""
        handles = self.requirements.equipment != Equipment()
        return handles or bool(self.randomization.varied) or self.config.perturbation != Perturbation()

    def make_task(self, n: int = 1) -> Task[Any, Any]:
        """Make the task for n cells.

        Raises:
            SettingsError: Or one of its kinds: the arms cannot do it in this cell.
        """
        task = self.task_type(self.settings, self.config, self.timing, n)
        if self.options.until is not None:
            cast("StagedTask[Any, Any, Any]", task).end_after(self.options.until)
        return task

    def make_clearance(self) -> Clearance:
        """Make the distances that the safety gate measures in this cell, as near as the task allows.

        Raises:
            SettingsError: Or one of its kinds: the task names no pair of this scene, or a value is not legal.
        """
        config = self.config
        return Clearance(
            config.measured_scene,
            minimum_m=config.minimum_clearance_m,
            closer=self.requirements.closer,
            uncertainty=config.uncertainty,
        )

    def make_adapter(self, n: int = 1, threads: int = 1) -> ServojAdapter:
        """Make the adapter from actions to targets for n cells, computed on some threads.

        Raises:
            SettingsError: Or one of its kinds: a value is not legal.
        """
        config, options, equipment = self.config, self.options, self.config.equipment
        mounts = (config.left, config.right)
        return ServojAdapter(
            config.servoj,
            self.limits,
            self.ticks,
            n=n,
            mode=options.action_mode,
            action_scale=options.action_scale,
            gripper=equipment.grippers and not equipment.welded,
            compensate_lag=options.compensate_lag,
            dh=[mount.dh for mount in mounts],
            tcp_m=[tool.tcp_m if equipment.grippers else 0.0 for tool in equipment.tools],
            stroke_m=[tool.stroke_m for tool in equipment.tools],
            yaw_rad=[mount.yaw_rad for mount in mounts],
            tilt_rad=[mount.tilt_rad for mount in mounts],
            speed_factor=config.speed_factor,
            lookahead_s=config.measured_lookahead_s,
            threads=threads,
        )


def _cell_of(options: EnvOptions) -> CellConfig:
    """Return the cell of an environment, with arms of the models that its keywords name.

    Raises:
        SettingsError: Or one of its kinds: there is no such cell, or its arms are of other models.
    """
    robots = options.robots
    if robots is not None and isinstance(options.cell, str) and options.cell == "mujoco":
        return CellConfig(left=default_mount(0, robots[0]), right=default_mount(1, robots[1]))
    config = resolve_cell(options.cell)
    if robots is not None and config.robots != robots:
        raise SettingsError(
            f"robot is {' and '.join(robots)}, the arms of the cell are {' and '.join(config.robots)}: leave robot "
            "out, or name the models in the cell, as robot of an ArmMount or model in a cell file"
        )
    return config


def check_for_controllers(
    config: CellConfig, n: int, *, autoreset: bool, randomized: bool, brakes: bool = False
) -> None:
    """Refuse requests that two controllers cannot serve. A simulated cell can serve all.

    Args:
        config: The cell.
        n: Number of environments.
        autoreset: Whether episodes begin without a call of `reset`.
        randomized: Whether something differs from episode to episode.
        brakes: Whether an episode continues after a refused motion.

    Raises:
        SettingsError: The cell is one of two controllers, and cannot serve this.
    """
    if not config.controllers:
        return
    if n > 1:
        raise SettingsError(f"{n} environments on one cell of controllers: there is one pair of arms. Use one")
    if autoreset:
        raise SettingsError(
            "episodes that begin by themselves, as in training, on a cell of controllers: arms move to the start of an "
            'episode only when somebody calls reset. Train in simulation, or set autoreset_mode to "Disabled"'
        )
    if randomized:
        raise SettingsError("randomization is for simulated cells: leave it out on controllers")
    if brakes:
        raise SettingsError(
            'on_refusal is "brake" on a cell of controllers: after a refused motion both arms stop, and a person '
            'decides. Use "terminate", or leave it out'
        )
    if config.perturbation != Perturbation():
        raise SettingsError("a perturbation is for simulated cells: leave it out on controllers")


def check_reset(*, begun: bool, consent: bool) -> None:
    """Refuse a reset that would move the arms of two controllers without consent.

    Wrappers that begin episodes by themselves call the same `reset` as a program. They pass no options, so that none of
    them leads arms to another start.

    Args:
        begun: An episode has begun before.
        consent: The caller consents to the motion.

    Raises:
        ResetRefusedError: An episode has begun before, and the caller does not consent.
    """
    if begun and not consent:
        raise ResetRefusedError(
            "reset was called again without consent, on a cell of two controllers: it would move both arms to where an "
            "episode begins, and nothing may do that by itself. Pass "
            f'reset(options={{"{MOVE_TO_START}": True}}) in your program, or make the environment with confirm=, which '
            "is asked before each such motion; train in simulation"
        )
