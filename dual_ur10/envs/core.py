"""The one stepping core behind every environment: task, pipeline and cell, for n cells at once."""

from __future__ import annotations

import importlib
import os
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray

from dual_ur10.envs.mujoco_cell import MujocoCell
from dual_ur10.envs.task import Task, Timing, task_settings
from dual_ur10.errors import ClosedError, ResetNeededError, UnknownNameError
from dual_ur10.sim2real.adapter import ActionMode, ServojAdapter
from dual_ur10.sim2real.cell import CellState, resolve_cell
from dual_ur10.sim2real.clearance import Clearance
from dual_ur10.sim2real.gate import SafetyGate, Verdict
from dual_ur10.sim2real.pipeline import ServojPipeline

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]
Rows = NDArray[np.intp]

TASKS = {"SineTracking": "dual_ur10.envs.sine_tracking:SineTracking"}
"""Where each task's class is, by the task's name."""

DEFAULT_RATE_HZ = 25.0

PHYSICS_ERROR = "the simulation diverged: the observation is that of the last good instant"
"""Text of `info["physics_error"]`."""


class Step(NamedTuple):
    """What a step of n cells gives.

    Attributes:
        observation: (n, size).
        reward: (n,).
        terminated: (n,) refused by the gate, or diverged.
        truncated: (n,) the episode came to its natural end.
        info: Arrays (n, ...) by name.
        verdicts: Why the gate refused, by row.
        diverged: (n,) whether the physics diverged.
    """

    observation: Array
    reward: Array
    terminated: Mask
    truncated: Mask
    info: dict[str, NDArray[Any]]
    verdicts: dict[int, Verdict]
    diverged: Mask


def load_task(name: str) -> type[Task[Any, Any]]:
    """The class of a task.

    Raises:
        UnknownNameError: No task has this name.
    """
    if name not in TASKS:
        raise UnknownNameError("task", str(name), list(TASKS))
    module, attribute = TASKS[name].split(":")
    task: type[Task[Any, Any]] = getattr(importlib.import_module(module), attribute)
    return task


class Core:
    """Task, pipeline and cell of n cells.

    Args:
        task: Name of the task.
        settings: The task's keywords.
        n: Number of cells.
        threads: Threads to step on; None: as many as there are processors.
        cell: "mujoco" or a `CellConfig`.
        policy_rate_hz: Actions per second; the period must be a whole number of controller ticks.
        action_mode: See `dual_ur10.sim2real.adapter.ServojAdapter`.
        action_latency_ticks: Ticks between an observation and the first target of its action.
        compensate_lag: Whether the adapter takes the lag of `servoj` out.

    Raises:
        SettingsError: Or one of its kinds: a value is not legal. Nothing is left behind.
    """

    def __init__(
        self,
        task: str,
        settings: Mapping[str, Any],
        *,
        n: int = 1,
        threads: int | None = None,
        cell: object = "mujoco",
        policy_rate_hz: float = DEFAULT_RATE_HZ,
        action_mode: ActionMode = "joint_delta",
        action_latency_ticks: int = 0,
        compensate_lag: bool = True,
    ) -> None:
        task_type = load_task(task)
        config = resolve_cell(cell)
        ticks = config.servoj.ticks_per_action(policy_rate_hz)
        mounts = (config.left, config.right)
        adapter = ServojAdapter(
            config.servoj,
            task_type.limits,
            ticks,
            n=n,
            mode=action_mode,
            compensate_lag=compensate_lag,
            latency_ticks=action_latency_ticks,
            dh=[mount.dh for mount in mounts],
            yaw_rad=[mount.yaw_rad for mount in mounts],
        )
        self.n, self.config = n, config
        threads = threads or min(n, os.cpu_count() or 1)
        clearance = Clearance(config.scene, n=n, threads=threads, minimum_m=config.minimum_clearance_m)
        gate = SafetyGate(task_type.limits, config.servoj.tick_s, ticks, clearance, n=n)
        self.pipeline = ServojPipeline(adapter, gate, action_latency_ticks)
        period_s = adapter.period_s
        timing = Timing(period_s, period_s + action_latency_ticks * config.servoj.tick_s)
        self.task = task_type(task_settings(task_type, settings), config, timing, n)
        self._clearance = clearance
        self._weights = np.array(list(task_type.weights.values()))
        self._terms = [f"reward/{name}" for name in task_type.weights]
        rows = np.arange(n)
        clearance.check_start(self.task.start(rows, [np.random.default_rng(0) for _ in rows]), rows)
        self.cell: MujocoCell | None = MujocoCell(config, ticks, n=n, threads=threads)
        self._state: CellState | None = None
        self.action_space = self._action_space()
        bound = self.task.observation_bound
        self.observation_space = spaces.Box(-bound, bound, dtype=np.float64)

    def _action_space(self) -> spaces.Box:
        low, high = self.pipeline.adapter.action_bounds
        return spaces.Box(low.reshape(-1).astype(np.float32), high.reshape(-1).astype(np.float32), dtype=np.float32)

    @property
    def timing(self) -> Timing:
        """Rate and latency of actions."""
        return self.task.timing

    def reset(
        self, rngs: Sequence[np.random.Generator], rows: Rows | None = None
    ) -> tuple[Array, dict[str, NDArray[Any]]]:
        """Begin new episodes.

        Args:
            rngs: One generator per cell to reset.
            rows: The cells to reset; None: all.

        Returns:
            Observations of all cells, (n, size), and `info`.
        """
        cell = self._open()
        rows = np.arange(self.n) if rows is None else rows
        self._state = None  # should anything fail from here on, the episode must be begun again
        q = self.task.start(rows, rngs)
        seeds = [int(rng.integers(2**31)) for rng in rngs]
        self._clearance.check_start(q, rows)
        self.pipeline.reset(q, rows)
        self._state = cell.reset(q, rows, seeds=seeds)
        measured = self.task.measure(self._state)
        observation = self.task.observe(self._state, measured, self.pipeline.adapter.commanded_q_rad)
        return observation, self._measurements(self._state)

    def step(self, action: object) -> Step:
        """One control period of all cells.

        Args:
            action: Numbers that fit (n, action size).

        Raises:
            ActionError: The action is malformed. Nothing has moved.
            ResetNeededError: There was no reset yet.
        """
        cell = self._open()
        if self._state is None:
            raise ResetNeededError("step was called before the first reset: call reset() first")
        command, verdicts = self.pipeline(action)
        self._state = state = cell.advance(command)
        measured = self.task.measure(state)
        outcome = self.task.evaluate(state, measured)
        reward: Array = np.add.reduce(outcome.terms * self._weights, axis=1)
        terminated, success = state.failed.copy(), outcome.success
        if verdicts:
            terminated[list(verdicts)] = True
        if np.logical_or.reduce(terminated):
            success = success & ~terminated
        info = self._measurements(state)
        info.update(outcome.info)
        info["is_success"] = success
        for k, name in enumerate(self._terms):
            info[name] = outcome.terms[:, k]
        observation = self.task.observe(state, measured, self.pipeline.adapter.commanded_q_rad)
        return Step(observation, reward, terminated, outcome.over, info, verdicts, state.failed)

    def _measurements(self, state: CellState) -> dict[str, NDArray[Any]]:
        return {"q_rad": state.q_rad.copy(), "flange_m": state.flange_m.copy()}

    def cell_data(self, row: int) -> tuple[Any, Any]:
        """MuJoCo's model and data of one cell, to be drawn."""
        return self._open().model_and_data(row)

    def close(self) -> None:
        """Release the simulation. May be called twice."""
        if self.cell is not None:
            self.cell.close()
        self.cell = None

    def _open(self) -> MujocoCell:
        if self.cell is None:
            raise ClosedError("the environment was closed: make a new one")
        return self.cell
