"""The one stepping core behind every environment: task, pipeline and cell, for n cells at once."""

from __future__ import annotations

import copy
import logging
import math
import os
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final, NamedTuple, NoReturn, cast

import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray

from dual_ur10.envs.core.cells import RECORDING, StepHook, request_for
from dual_ur10.envs.core.ends import BRAKED, DIVERGED, SUCCESS, TIME, early_end, refusal
from dual_ur10.envs.core.options import EnvOptions
from dual_ur10.envs.core.randomization import VISUAL_SEED, apply_sample
from dual_ur10.envs.core.sensing import Sensing
from dual_ur10.envs.core.setup import EnvSetup, check_for_controllers, check_reset
from dual_ur10.envs.tasks.observation_layout import ConciseView
from dual_ur10.envs.tasks.task import FINISH, Outcome, Timing
from dual_ur10.errors import (
    ActionError,
    CellFaulted,
    ClosedError,
    DualUR10Error,
    ResetNeededError,
    TaskError,
)
from dual_ur10.sim2real.cell.cell import Cell, CellState, CellStep, Start
from dual_ur10.sim2real.cell.cell_config import CellConfig
from dual_ur10.sim2real.cell.named_cell import make_cell
from dual_ur10.sim2real.control.adapter import Command
from dual_ur10.sim2real.control.gate import SafetyGate, Verdict
from dual_ur10.sim2real.control.pipeline import ServojPipeline
from dual_ur10.sim2real.control.proximity import ProximityScaling
from ur_core.kinematics.ur10 import ARMS
from ur_core.objects import load_object
from ur_core.types import Array, Mask, Rows

if TYPE_CHECKING:
    from dual_ur10.envs.core.starts import MixedStarts
    from dual_ur10.envs.tasks.staged import StagedTask
    from dual_ur10.sim2real.control.coupling import Coupling

log = logging.getLogger(__name__)

PHYSICS_ERROR = "the simulation diverged: the observation is that of the last good instant"
"""Text of `info["physics_error"]`."""

_PER_ARM: Final = ("q_rad", "flange_m", "held_arm")


class Agents(NamedTuple):
    """Observations and rewards of the agents `left` and `right`, computed on demand.

    Attributes:
        view: View of the task's fields; None: they are observed as they are.
        both: (n, size) the task's observations of both agents together.
        terms: (n, 2, terms) reward terms of each agent, that of refusals included; None after a reset.
        weights: (terms,) weights of the reward terms.
        dtype: Type of observed numbers.
    """

    view: ConciseView | None
    both: Array
    terms: Array | None
    weights: Array
    dtype: np.dtype[Any]

    @property
    def joint(self) -> Array:
        """Copy of the observations of both agents together, (n, size), in the type of observations."""
        found: Any = self.both if self.view is None else self.view(self.both)
        joint: Array = found.astype(self.dtype, copy=self.view is None)
        return joint

    @property
    def observations(self) -> Array:
        """Each agent's own observation, (n, 2, size), its half of that of both."""
        return self.joint.reshape(len(self.both), 2, -1)

    @property
    def rewards(self) -> Array:
        """Each agent's own reward, (n, 2); their mean is the reward of both."""
        if self.terms is None:
            return np.zeros((len(self.both), 2))
        rewards: Array = np.add.reduce(self.terms * self.weights, axis=2)
        return rewards


class Step(NamedTuple):
    """Result of a step of n cells.

    Attributes:
        observation: (n, size).
        reward: (n,).
        terminated: (n,) True if the physics diverged, the task reached a terminal state, or the gate refused and
            refusals end episodes.
        truncated: (n,) True if the time of the episode has run out.
        info: Arrays (n, ...) by name.
        verdicts: Reasons of the gate's refusals, by row.
        diverged: (n,) True if the physics diverged.
        ends: Reasons of the ends of episodes, by row; see `dual_ur10.envs.core.ends`.
        led_by: Pairs of bodies with the smallest spare distance where motion was led, by row.
        agents: Observations and rewards of the two agents.
    """

    observation: Array
    reward: Array
    terminated: Mask
    truncated: Mask
    info: dict[str, NDArray[Any]]
    verdicts: dict[int, Verdict]
    diverged: Mask
    ends: dict[int, str]
    led_by: dict[int, str]
    agents: Agents

    def details(self, row: int) -> dict[str, Any]:
        """Return the part of a cell's info that is no number and that most steps do not have."""
        found: dict[str, Any] = {}
        if row in self.verdicts:
            found["safety"] = self.verdicts[row]
        if self.diverged[row]:
            found["physics_error"] = PHYSICS_ERROR
        if row in self.ends:
            found["end_reason"] = self.ends[row]
        if row in self.led_by:
            found["led_by"] = self.led_by[row]
        return found


def _spread(values: Array, rows: Rows, n: int) -> Array:
    """Return an array of all rows, (n, ...), with the values of some, (len(rows), ...), and NaN in the others."""
    result = np.full((n, *values.shape[1:]), np.nan)
    result[rows] = values
    return result


def _recording(name: str) -> Any:
    """Return a function of the module that records runs."""
    return load_object(f"{RECORDING}:{name}", "the recording of runs", registered=True)


class Core:
    """Stepping loop of n cells: task, pipeline and cell.

    Args:
        task: Id of the environment, or a shorter name.
        keywords: Those of every environment, `dual_ur10.envs.core.options.EnvOptions`, and the task's own.
        n: Number of cells.
        threads: Threads to step on; None: one per processor, at most n.
        autoreset: Episodes will begin without a call of `reset`.

    Raises:
        SettingsError: Or one of its kinds: a value is not legal. Nothing is left open.

    Attributes:
        weights: Weight of each reward term by its name, that of refusals included.
        threads: Number of threads that step, and that draw observed images.
        late_actions: Number of actions that missed their deadline, so that both arms stopped.
        commander: (2,) True for an arm that a person commands in the next step, for the record.
        visual_seed: (n,) number from which the look of each cell's episode follows; NaN: it is nominal.
        keeps_start: Keep what `initial_info` needs of each reset; False, unless an interface asks for it.
        per_arm: Names of those values of `info` whose second axis is for the left and the right arm.
    """

    def __init__(
        self, task: str, keywords: Mapping[str, Any], *, n: int = 1, threads: int | None = None, autoreset: bool = False
    ) -> None:
        self.setup = setup = EnvSetup.resolve(task, keywords)
        config = setup.config
        self._randomization = setup.randomization
        self.n = n
        self._brakes = setup.brakes
        randomized = not self._randomization.is_none
        check_for_controllers(config, n, autoreset=autoreset, randomized=randomized, brakes=self._brakes)
        self.threads = threads = threads or min(n, os.cpu_count() or 1)
        adapter = setup.make_adapter(n, threads)
        clearance = setup.make_clearance()
        gate = SafetyGate(setup.limits, config.servoj.tick_s, setup.ticks, clearance, n=n, threads=threads)
        proximity = ProximityScaling(clearance, adapter.period_s) if config.controllers else None
        self.pipeline = ServojPipeline(
            adapter,
            gate,
            held=setup.options.held_arm,
            leads=setup.options.at_limits == "lead",
            proximity=proximity,
        )
        self.task = setup.make_task(n)
        self._mixed: MixedStarts | None = None
        if setup.options.starts:
            from dual_ur10.envs.core.starts import MixedStarts

            self._mixed = MixedStarts(setup)
        self._clearance = clearance
        self._coupling: Coupling | None = None
        if self.task.couples:
            from dual_ur10.sim2real.control.coupling import Coupling

            self._coupling = Coupling((config.left, config.right))
        self.weights = setup.weights
        self._is_sparse = setup.options.reward == "sparse"
        self._weights = np.array(list(self.weights.values()))
        self._best: Array | None = None  # (n, 2) largest income of each arm so far; NaN before the first step
        if setup.options.progress_weight:
            self._best = np.full((n, 2), np.nan)
        self._lasting = np.array([self.weights[name] * (name != FINISH) for name in setup.task_type.weights])
        self._terms = [f"reward/{name}" for name in self.weights]
        self._refused = np.zeros(n, dtype=bool)  # since the reset
        self._braking: set[int] = set()  # rows refused in the step before
        rows = np.arange(n)
        clearance.check_start(self.task.start(rows, [np.random.default_rng(0) for _ in rows]).q_rad)
        self._state: CellState | None = None
        self._begun = False  # whether an episode ever has
        self.late_actions = 0
        self.keeps_start = False
        self.visual_seed: Array = np.full(n, np.nan)
        self._started: tuple[Rows, list[np.random.Generator]] | None = None
        self.per_arm = (*_PER_ARM, *self.task.per_arm)
        self.commander: Mask = np.zeros(2, dtype=bool)
        self._sensing = Sensing(config, self._randomization, setup.timing.period_s, n)
        self._plant = config.perturbation.expanded(n)
        record = setup.options.record
        self._observation: Array = np.zeros((n, 2 * self.task.layout.size))
        self._view = self.task.concise_view() if setup.options.concise else None
        self.action_space = self._action_space()
        self._held: Mask | None = None
        if setup.options.held_arm is not None:
            self._held = np.arange(2) == np.full((n, 1), setup.options.held_arm)
            if not config.controllers:
                log.warning(
                    "arm=%r: the %s arm does not move in this simulation, whatever its actions are. Leave `arm` out "
                    "to move both",
                    setup.options.arm,
                    ARMS[setup.options.held_arm],
                )
        self._dtype = setup.options.dtype
        self.layout = layout = self.task.layout if self._view is None else self._view.layout
        low, high = layout.low.astype(self._dtype), layout.high.astype(self._dtype)
        self.observation_space = spaces.Box(low, high, dtype=self._dtype.type)
        if record is not None:
            _recording("prepare")(Path(record))  # before anything is connected
        request = request_for(setup, n, threads=threads, clearance=clearance)
        self.cell: Cell | None = make_cell(request)
        self._hook: StepHook | None = None
        if record is not None or config.file is not None:
            try:
                self._hook = _recording("record_env")(setup.env_id, keywords, request, self.cell)
            except BaseException:
                self.cell.close()
                raise

    def __repr__(self) -> str:
        return f"{type(self).__name__}({self})"

    def __str__(self) -> str:
        rate = f"{self.setup.options.action_mode} at {1.0 / self.timing.period_s:g} Hz"
        return f"{self.setup.env_id}, {self.task!r}, {rate}, {self.config.kind} cell"

    def _action_space(self) -> spaces.Box:
        low, high = self.pipeline.adapter.action_bounds
        return spaces.Box(low.reshape(-1).astype(np.float32), high.reshape(-1).astype(np.float32), dtype=np.float32)

    @property
    def options(self) -> EnvOptions:
        """Keywords of every environment."""
        return self.setup.options

    @property
    def config(self) -> CellConfig:
        """The cell, with the task's equipment."""
        return self.setup.config

    @property
    def time_s(self) -> Array:
        """Time of the last observation since the reset of each row, (n,), in task time.

        Raises:
            ResetNeededError: There was no reset yet.
        """
        return self.state.time_s.copy()

    @property
    def state(self) -> CellState:
        """True state of all cells at the last observation, in arrays that belong to the cell.

        Raises:
            ResetNeededError: There was no reset yet.
        """
        if self._state is None:
            raise ResetNeededError("there is no observation before the first reset: call reset() first")
        return self._state

    @property
    def timing(self) -> Timing:
        """Rate and latency of actions."""
        return self.setup.timing

    def reset(
        self,
        rngs: Sequence[np.random.Generator],
        rows: Rows | None = None,
        *,
        seed: int | None = None,
        move_to_start: bool = False,
    ) -> tuple[Array, dict[str, NDArray[Any]]]:
        """Begin new episodes.

        Args:
            rngs: One generator per cell to reset.
            rows: The cells to reset; None: all.
            seed: Seed of the generator, for the record; None: the generator continues.
            move_to_start: Consent to the motion to the start, see `check_reset`.

        Returns:
            Observations of all cells, (n, size), and `info`.

        Raises:
            ResetRefusedError: It would move the arms of two controllers without consent. Nothing has changed.
            TaskError: The task's observation is not finite, or, at the first reset, not in its bounds.
        """
        cell = self._open()
        if self.config.controllers:
            check_reset(begun=self._begun, consent=move_to_start or self.options.confirm is not None)
        rows = np.arange(self.n) if rows is None else rows
        self._state = None  # if anything fails from here on, a reset is needed
        if self._hook is not None:
            self._hook.resetting(rngs, seed)
        self._started = (rows, copy.deepcopy(list(rngs))) if self.keeps_start else None
        start = self._begin(rows, rngs)
        sampled = {} if self._randomization.is_none else self._randomization.sample(rngs, len(self._sensing.tracked))
        if VISUAL_SEED in sampled:
            self.visual_seed[rows] = sampled[VISUAL_SEED]
        seeds = [int(rng.integers(2**31)) for rng in rngs]
        self._clearance.check_start(start.q_rad)
        self.pipeline.reset(start.q_rad, rows, start.widths_m)
        self._refused[rows] = False
        if self._best is not None:
            self._best[rows] = np.nan
        self._braking -= set(rows.tolist())
        plant = apply_sample({name: value[rows] for name, value in self._plant.items()}, sampled)
        try:
            begun = cell.reset(start, rows, seeds=seeds, perturbation=plant)
        except DualUR10Error as error:
            self.note("fault" if isinstance(error, CellFaulted) else "not begun", str(error))
            raise
        self._continue_from_stop(begun, start.widths_m)
        state = begun.state
        self._sensing.reset(state, rows, seeds, sampled)
        sensed = state if self._sensing.is_exact else self._sensing.begun(state)
        observation = self.task.observe(sensed, self.task.measure(sensed), self.pipeline.adapter.commanded_q_rad)
        # The other rows continue with their last observations.
        self._observation = self._observation.copy()
        self._observation[rows] = observation[rows]
        self._check_finite(self._observation)
        if not self._begun:
            self.check_observation()
        self._state, self._begun = state, True
        self.agents = Agents(self._view, self._observation, None, self._weights, self._dtype)
        info: dict[str, Any] = self._measurements(state)
        randomized = {**start.sampled, **sampled}
        if randomized:
            info["randomization"] = {name: _spread(value, rows, self.n) for name, value in randomized.items()}
        if self._hook is not None:
            self._hook.reset(self.agents.joint, state, info.get("randomization", {}))
        return self.agents.joint, info

    def _begin(self, rows: Rows, rngs: Sequence[np.random.Generator]) -> Start:
        """Begin episodes of the task, and return their starts."""
        self.task.forget_load(rows)
        if self._mixed is None:
            return self.task.start(rows, rngs)
        return self._mixed.begin(cast("StagedTask[Any, Any, Any]", self.task), rows, rngs)

    def step(self, action: object) -> Step:
        """Advance all cells by one policy period.

        Args:
            action: Numbers of a shape that fits (n, action size).

        Raises:
            ActionError: The action is malformed. Nothing has moved.
            TaskError: The task returned a reward or an observation that is not finite, or another number of terms than
                it has weights. Arms of two controllers have a latched stop.
            ResetNeededError: There was no reset yet.
        """
        cell = self._open()
        if self._state is None:
            raise ResetNeededError(
                "step was called before the first reset, or after a step that failed: call reset() first"
            )
        # If anything fails from here on, pipeline and cell disagree, and a reset is needed.
        before, self._state, self._started = self._state, None, None
        try:
            coupled = None if self._coupling is None else self.task.coupled().copy()
            command, verdicts = self.pipeline(action, coupled)
        except ActionError as error:
            self._state = before  # nothing has moved
            cell.stop(f"the policy's action was refused: {error}")
            raise
        try:
            command = self._with_load(command, coupled)
            period = self._advance(cell, command)
        except CellFaulted:
            self._state = before  # a fault persists, and the next step reports it again
            raise
        self._continue_from_stop(period, None if command.gripper_m is None else command.gripper_m[:, -1])
        state = true = period.state
        self.late_actions += period.late
        measured = self.task.measure(state)
        outcome = self.task.evaluate(state, measured)
        refused = list(verdicts)
        newly = [row for row in refused if row not in self._braking]
        self._braking = set(refused)
        terminated, success = state.failed.copy(), outcome.success
        if refused:
            self._refused[refused] = True
            if self._brakes:
                self.pipeline.resume(refused)
            else:
                terminated[refused] = True
        if np.count_nonzero(terminated | self._refused):
            success = success & ~(terminated | self._refused)
        if outcome.terminal is not None:
            terminated |= outcome.terminal
        terms_of_arms = self._all_terms(outcome.terms, newly, success)
        terms = (terms_of_arms[:, 0] + terms_of_arms[:, 1]) / 2
        reward: Array = np.vecdot(terms, self._weights)
        if not math.isfinite(np.vdot(reward, reward)):
            self._refuse_terms(terms_of_arms)
        info = self._measurements(state)
        if self._coupling is not None and coupled is not None:
            info.update(self._coupling.values(state.q_rad, period.target_q_rad, coupled))
        # A task may change its own arrays in place at the next reset.
        info.update({name: np.array(value) for name, value in outcome.info.items()})
        info["is_success"] = success
        info["led"] = self.pipeline.led
        info.update(zip(self._terms, terms.T, strict=True))
        if not self._sensing.is_exact:
            state = self._sensing(state)
            measured = measured if self._sensing.keeps_poses else self.task.measure(state)
        self._observation = observation = self.task.observe(state, measured, self.pipeline.adapter.commanded_q_rad)
        self._check_finite(observation)
        self.agents = agents = Agents(self._view, observation, terms_of_arms, self._weights, self._dtype)
        ended, ends = terminated | outcome.over, {}
        if np.count_nonzero(ended):
            cell.finish()
            ends = {row: self._end(row, true, verdicts, outcome, success) for row in np.flatnonzero(ended).tolist()}
        led_by = self._led_by() if np.count_nonzero(self.pipeline.led) else {}
        step = Step(agents.joint, reward, terminated, outcome.over, info, verdicts, state.failed, ends, led_by, agents)
        self._state = true
        if self._hook is not None:
            self._hook.step(action, command, step, period, early_end(step.details(0)), self.commander)
        return step

    def _led_by(self) -> dict[int, str]:
        """Return the pair of bodies that is nearest to its smallest legal distance, by row whose motion was led."""
        rows = np.flatnonzero(self.pipeline.led)
        nearest = self.pipeline.gate.spare_m[rows].argmin(axis=1)
        return {row: " and ".join(self._clearance.pairs[k]) for row, k in zip(rows.tolist(), nearest, strict=True)}

    def _with_load(self, command: Command, coupled: Mask | None) -> Command:
        """Return a command with the payload that the task declares and, on controllers, the coupling of the arms."""
        payload_kg = self.task.payload_kg()
        if payload_kg is not None:
            command = command._replace(payload_kg=payload_kg)
        if coupled is None or not self.config.controllers:
            return command
        return command._replace(coupled=bool(coupled[0]))

    def _all_terms(self, terms: Array, refused: Sequence[int], success: Mask) -> Array:
        """Return the terms of the arms with those that are no task's, as far as there are weights for them."""
        count = len(self.task.weights)
        if terms.shape[2] != count:
            found, allowed = (
                f"{terms.shape[2]} terms",
                f"{count}, one for each of its weights: {', '.join(self.task.weights)}",
            )
            self._refuse(f"evaluate of {type(self.task).__name__} returned {found}: return {allowed}")
        if count == len(self._weights):
            return terms
        result = np.zeros((self.n, 2, len(self._weights)))
        result[..., :count] = terms
        if self._brakes and refused:
            result[refused, :, count] = 1.0
        if self._best is not None:
            income = terms @ self._lasting
            result[..., -1] = np.nan_to_num(np.maximum(income - self._best, 0.0))
            self._best = np.fmax(self._best, income)
        if self._is_sparse:
            result[..., -1] = success[:, None]
        return result

    def _check_finite(self, observation: Array) -> None:
        """Refuse observations of the task that are not finite; one product finds them."""
        if not math.isfinite(np.vdot(observation, observation)):
            self._check_within(observation, np.float64(-np.inf), np.float64(np.inf))

    def check_observation(self) -> None:
        """Check the task's last observations against the bounds of its layout.

        Raises:
            TaskError: A number is outside. Arms of two controllers have a latched stop.
        """
        self._check_within(self._observation, self.task.layout.low, self.task.layout.high)

    def _check_within(self, observation: Array, low: Any, high: Any) -> None:
        within: Any = np.isfinite(observation) & (observation >= low) & (observation <= high)
        fields: dict[str, Any] = self.task.layout.split(within)
        for field in self.task.layout.fields:
            if not fields[field.name].all():
                row, arm, _ = np.argwhere(~fields[field.name])[0].tolist()
                found = self.task.layout.split(observation)[field.name][row, arm].tolist()
                self._refuse(
                    f"the field {field.name!r} of the {ARMS[arm]} arm's observation is {found} (cell {row}): "
                    f"{type(self.task).__name__} states {field.low:g} to {field.high:g}. Mend its `observe`, or the "
                    "bounds in its layout"
                )

    def _refuse_terms(self, terms: Array) -> None:
        """Refuse reward terms of the arms, (n, 2, terms), that are not finite."""
        for row, arm, number in np.argwhere(~np.isfinite(terms))[:1].tolist():
            self._refuse(
                f"the reward term {list(self.weights)[number]!r} of the {ARMS[arm]} arm is "
                f"{terms[row, arm, number]} (cell {row}): `evaluate` of {type(self.task).__name__} must return finite "
                "terms"
            )

    def _refuse(self, reason: str) -> NoReturn:
        """Refuse what the task returned."""
        self._open().stop(f"the task failed: {reason}")
        raise TaskError(reason)

    def _end(self, row: int, state: CellState, verdicts: dict[int, Verdict], outcome: Outcome, success: Mask) -> str:
        """Return the reason of the end of an episode."""
        if state.failed[row]:
            return DIVERGED
        if row in verdicts and not self._brakes:
            return refusal(verdicts[row])
        if success[row]:
            return SUCCESS
        if self._refused[row] and outcome.success[row]:
            return BRAKED
        terminal = outcome.terminal is not None and outcome.terminal[row]
        return self.task.failure(row, outcome) if terminal else TIME

    def _continue_from_stop(self, period: CellStep, gripper_m: Array | None) -> None:
        """Restart the pipeline from where the arms stand, if they did not follow it."""
        if period.stopped_q_rad is not None:
            self.pipeline.reset(period.stopped_q_rad, gripper_m=gripper_m)

    def finish(self) -> None:
        """End the episode for a reason that the task does not know; moving arms stop."""
        self._open().finish()

    def stop(self, reason: str) -> str:
        """Latch a stop of both arms, for a reason on the side of the policy.

        Returns:
            What the operator has to do now; "" in a simulation, which has nothing to stop.
        """
        return "" if self.cell is None else self.cell.stop(reason)

    def _measurements(self, state: CellState) -> dict[str, NDArray[Any]]:
        found: dict[str, NDArray[Any]] = {"q_rad": state.q_rad.copy(), "flange_m": state.flange_m.copy()}
        if self._held is not None:
            found["held_arm"] = self._held.copy()
        if self.config.state_is_commanded:
            found["state_is_commanded"] = np.ones(self.n, dtype=bool)
        return found

    def initial_info(self) -> dict[str, NDArray[Any]]:
        """Return the info that a step would add, for the state after a reset of all cells; rewards are 0.

        Raises:
            ResetNeededError: No reset of all cells came before that kept its start (`keeps_start`), or a step followed.
            TaskError: The task states a value of each arm that its info does not have.
        """
        if self._state is None or self._started is None or len(self._started[0]) < self.n:
            raise ResetNeededError("the initial info is that of a reset: call reset() first, and ask before a step")
        info = self.task.evaluate(self._state, self.task.measure(self._state)).info
        # An evaluation counts as a step, so that the episode begins again, with the same random numbers.
        rows, rngs = self._started
        self._begin(rows, copy.deepcopy(rngs))
        for name in self.task.per_arm:
            shape = info[name].shape if name in info else None
            if shape is None or shape[1:2] != (2,):
                self._refuse(
                    f"{type(self.task).__name__} states the value {name!r} of each arm, and its info has "
                    f"{shape or 'none'}: it must be (n, 2, ...)"
                )
        nothing = {name: np.zeros(self.n) for name in self._terms}
        if self._coupling is not None:
            info = self._coupling.values(self._state.q_rad, None, np.zeros(self.n, dtype=bool)) | info
        return {**info, "is_success": np.zeros(self.n, dtype=bool), "led": np.zeros(self.n, dtype=bool), **nothing}

    def cell_data(self, row: int) -> tuple[Any, Any]:
        """Return MuJoCo's model and data of one cell, for a viewer: the same objects at every call, updated."""
        return self._open().model_and_data(row)

    def copy_state(self, row: int, model: Any, data: Any) -> None:
        """Copy the state of one cell to another model of its scene; see `dual_ur10.sim2real.cell.cell.Cell`."""
        self._open().copy_state(row, model, data)

    def _advance(self, cell: Cell, command: Command) -> CellStep:
        """Advance the cell by a policy period, and record a fault."""
        hook = self._hook
        if hook is not None and hook.failure and self.options.record_failure == "stop":
            cell.stop(f"the run is not recorded any more: {hook.failure}")
        try:
            return cell.advance(command)
        except DualUR10Error as error:
            self.note("fault", str(error))
            raise

    def note(self, kind: str, text: str) -> None:
        """Write an event into the record of this run, if there is one."""
        if self._hook is not None:
            self._hook.event(kind, text)

    @property
    def clipped_actions(self) -> int:
        """Number of actions so far, of all cells, that were clipped to the action space."""
        return self.pipeline.clipped_actions

    def attach(self, hook: StepHook) -> None:
        """Call a hook in place of the present one, from the next reset on until this core closes."""
        self._hook = hook

    def close(self) -> None:
        """Release the cell, and end the record. May be called twice."""
        try:
            if self.cell is not None:
                self.cell.close()
        finally:
            self.cell = None
            hook, self._hook = self._hook, None
            if hook is not None:
                hook.close()

    def _open(self) -> Cell:
        if self.cell is None:
            raise ClosedError("the environment was closed: make a new one")
        return self.cell
