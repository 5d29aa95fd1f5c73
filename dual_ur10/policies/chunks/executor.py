"""Executor of chunks: an ordinary policy made of a chunk policy, which is asked beside the control loop."""

from __future__ import annotations

import math
import time
from collections import deque
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from dual_ur10.assets.settings import DEFAULT_TOOLS
from dual_ur10.envs.tasks.observation_layout import ARM_FIELDS, ConciseView, ObservationLayout
from dual_ur10.envs.tasks.task import Timing
from dual_ur10.errors import ActionError, ChunkError, SettingsError
from dual_ur10.policies.chunks.chunk_path import ChunkPath, SplicedPath, Splicer
from dual_ur10.policies.chunks.chunk_policy import CHUNK_MODES, ChunkPolicy
from dual_ur10.policies.chunks.inference import (
    ChildInference,
    ChunkAnswer,
    ChunkPlanner,
    Inference,
    ThreadInference,
    fill,
)
from dual_ur10.policies.policy import close_policy
from dual_ur10.sim2real.control.limits import MotionLimits
from ur_core.tools.tool import Tool, strokes_m
from ur_core.types import Array, Rows

if TYPE_CHECKING:
    from dual_ur10.envs.core.setup import EnvSetup

_LAYOUT: Final = ObservationLayout(*ARM_FIELDS)
_COMMANDED: Final = _LAYOUT.indices(["commanded_q_rad"])
_SPEEDS: Final = _LAYOUT.indices(["qd_rad_s"])
_APART_RAD: Final = 1e-4  # commanded positions so far from the last action are not those of this policy
_ROUNDING_S: Final = 1e-9
_KEPT: Final = 100  # latencies of which the largest counts
_SILENT_S: Final = 10.0
_MOST_LATE: Final = 10  # chunks in a row that come too late

Latency = float | Callable[[], float]


@dataclass
class _ChunkedCell:
    """One cell: its path, and what was asked for it.

    Attributes:
        time_s: Time of the last observation; -inf: there was none in the episode.
        speeds: (12,) measured joint speeds then; zeros: they are not observed.
        sent: (12,) joint positions of the last action; None: there was none.
        path: Path that both arms follow; None: no chunk has arrived yet.
        pending: Request whose answer is awaited.
        stamp_s: Time of the observation of the newest chunk.
        opening: (H, 2) openings of the grippers in that chunk.
        rest: (2,) openings before the first chunk.
        dt_s: Time between two of its actions.
        asked_s: Time of the last request.
        late: Number of chunks since the last one followed that came after all of their actions.
        error: Error that is raised once both arms have come to rest.
    """

    time_s: float = -math.inf
    speeds: Array = field(default_factory=lambda: np.zeros(12))
    sent: Array | None = None
    path: SplicedPath | None = None
    pending: ChunkAnswer | None = None
    stamp_s: float = -math.inf
    opening: Array | None = None
    rest: Array = field(default_factory=lambda: np.ones(2))
    dt_s: float = 1.0
    asked_s: float = -math.inf
    late: int = 0
    error: Exception | None = None


class ChunkExecutor:
    """Ordinary policy made of a chunk policy.

        executor = ChunkExecutor(source, timing=core.timing, limits=core.setup.step_limits)

    `dual_ur10.policies.make(source, env_id)` does so, too, with all that the environment has.

    - The chunk policy is asked beside the control loop, one request at a time. A chunk counts from the time of its
      observation and from the joint positions *commanded* then; measured ones lag behind.
    - Actions whose time has passed are dropped. Any rate is resampled, along cubics through the joint positions.
    - The difference to the motion before fades by a quintic, in the shortest time that is legal. Nothing is averaged.
    - A chunk that no other follows slows down and ends at rest on its own path, in its last part. The next one moves
      the arms again.
    - The gripper takes each opening as it is, from the time of the action before on.
    - If the chunk policy fails, both arms come to rest on the path of the last chunk. Only then its error is raised.

    Args:
        source: The chunk policy.
        timing: Rate and latency of actions of the environment.
        limits: Motion limits of the task, as far as the cell allows them, with the joint speeds that steps can command.
        action_mode: Mode of the environment, "joint_delta" or "joint_position".
        tools: Tools of both arms.
        grippers: An action has an opening for each gripper.
        layout: Fields of an observation, for the openings before the first chunk.
        view: Concise view that is observed; None: all numbers of the task are.
        latency_s: Time from an observation to its chunk where no time of day is kept, in simulation and on virtual
            cells, or a function that returns it for each request; infinity: the chunk is lost. None: the measured time
            of the call.
        replan_s: Time between two requests at least; None: half of a chunk, or less if chunks are late.
        silent_s: Time without an answer after which the chunk policy is given up.
        real_time: The time of day is kept. A thread asks the chunk policy; or, if it has a true attribute `portable`, a
            child process: it is pickled then, and closed here. `latency_s` does not apply.

    Attributes:
        source: As given.
        alone: One cell at a time, because the chunk policy does not declare that it is `stateless`.
        splices: Number of chunks that were followed.
        late: Number of chunks that came after all of their actions.

    Raises:
        SettingsError: The environment's actions are not of joints, or a value is not legal.
        ChunkError: The source is no chunk policy.
    """

    def __init__(
        self,
        source: ChunkPolicy,
        *,
        timing: Timing,
        limits: MotionLimits,
        action_mode: str = "joint_delta",
        tools: tuple[Tool, Tool] = DEFAULT_TOOLS,
        grippers: bool = False,
        layout: ObservationLayout | None = None,
        view: ConciseView | None = None,
        latency_s: Latency | None = None,
        replan_s: float | None = None,
        silent_s: float = _SILENT_S,
        real_time: bool = False,
    ) -> None:
        if not isinstance(source, ChunkPolicy) or isinstance(source, type):
            raise ChunkError(
                f"{source!r:.80} is no chunk policy: it needs reset(), chunk(observation, time_s), dt_s and action_mode"
            )
        if action_mode not in CHUNK_MODES:
            raise SettingsError(
                f"action_mode is {action_mode!r:.80}: chunks are executed as joint positions, so choose "
                f"{' or '.join(map(repr, CHUNK_MODES))}"
            )
        for name, value in (("latency_s", latency_s), ("replan_s", replan_s), ("silent_s", silent_s)):
            if isinstance(value, int | float) and not value >= 0.0:
                raise SettingsError(f"{name} is {value!r}: it must be a time of 0 s or more")
        self.source, self.latency_s = source, latency_s
        self.alone = not getattr(source, "stateless", False)
        self.__name__ = str(getattr(source, "__name__", type(source).__name__))  # in results and records
        self._mode, self._grippers, self._view = action_mode, grippers, view
        self._layout, self._strokes_m = layout, np.array(strokes_m(tools))
        self._replan_s, self._silent_s = replan_s, silent_s
        self._splicer = Splicer(limits, timing.period_s)
        self._period_s = timing.period_s
        self._settled_s = timing.ahead_s + 2 * timing.period_s  # from a path that rests to targets that do
        self._step_rad = self._splicer.speed_rad_s * timing.period_s
        self._planner = ChunkPlanner(self._splicer, grippers, self.__name__)
        self._inference: Inference | None = None
        if real_time:
            kind = ChildInference if getattr(source, "portable", False) else ThreadInference
            self._inference = kind(source, self._planner)
        self._offered: Array | None = None
        self._rows: list[_ChunkedCell] = []
        self._latencies: deque[float] = deque(maxlen=_KEPT)
        self.splices = self.late = 0

    def __repr__(self) -> str:
        return f"{type(self).__name__}({self.source!r})"

    def close(self) -> None:
        """Let the thread or process end, and close the chunk policy if it can be closed. May be called twice."""
        if self._inference is not None:
            self._inference.close()
        close_policy(self.source)

    def reset(self) -> None:
        """Begin an episode: both arms stay where they are until the first chunk."""
        self._rows, self._offered = [], None
        (self.source if self._inference is None else self._inference).reset()

    def begin(self, rows: Rows, seeds: Sequence[int]) -> None:
        """Begin episodes in some rows of a batch; see `dual_ur10.policies.policy.EpisodeAware`."""
        for row in rows if self._rows else ():
            self._rows[row] = _ChunkedCell()

    def observed_at(self, time_s: Array) -> None:
        """Take the time of the next observation; see `dual_ur10.policies.policy.TimeAware`."""
        self._offered = np.asarray(time_s, dtype=np.float64).reshape(-1)

    def __call__(self, observation: Any) -> Array:
        """Return the float32 action for an observation, or one for each row of a batch of observations.

        Without `observed_at`, an observation is one period after the one before.

        Raises:
            ActionError: Not an observation of both arms, or of another number of cells than before.
            ChunkError: The chunk policy returned something else than a chunk, or nothing; both arms have come to rest.
            Exception: As raised by the chunk policy; both arms have come to rest.
        """
        state = np.asarray(observation["state"] if isinstance(observation, Mapping) else observation, dtype=np.float64)
        size = (self._view.layout if self._view is not None else self._layout or _LAYOUT).size
        if state.ndim not in (1, 2) or state.shape[-1] % 2 or state.shape[-1] < 2 * size:
            raise ActionError(f"an observation is {2 * size} numbers or more, found an array of shape {state.shape}")
        batch = state.reshape(-1, state.shape[-1])
        n = len(batch)
        self._rows = self._rows or [_ChunkedCell() for _ in batch]
        if len(self._rows) != n:
            raise ActionError(f"{n} observations after {len(self._rows)}: call reset() before another number")
        if self._view is None:
            commanded, speeds = (batch.reshape(n, 2, -1)[..., part] for part in (_COMMANDED, _SPEEDS))
        else:
            commanded = self._view.commanded_q_rad(batch)
            speeds = np.zeros_like(commanded)
        offered, self._offered = self._offered, None
        actions = []
        for k, row in enumerate(self._rows):
            time_s = max(row.time_s + self._period_s, 0.0) if offered is None else float(offered[k])
            if time_s < row.time_s - _ROUNDING_S:  # an episode of this row has begun
                row = self._rows[k] = _ChunkedCell()
            if row.sent is None and self._grippers:
                row.rest = self._measured_openings(batch[k])
            one = observation if state.ndim == 1 else _row_of(observation, k)
            row.speeds = speeds[k].reshape(12)
            actions.append(self._act(row, time_s, commanded[k].reshape(12), one))
        return np.array(actions).reshape(*state.shape[:-1], -1).astype(np.float32)

    def _measured_openings(self, state: Array) -> Array:
        """Return the openings of the grippers that an observation shows, (2,); open if it shows none."""
        if self._view is not None or self._layout is None or "gripper_m" not in self._layout.names:
            return np.ones(2)
        widths_m = self._layout.split(state)["gripper_m"].reshape(2)
        openings: Array = np.clip(2.0 * widths_m / self._strokes_m - 1.0, -1.0, 1.0)
        return openings

    def _act(self, row: _ChunkedCell, time_s: float, commanded: Array, observation: Any) -> Array:
        """Return the action of one cell."""
        if row.path is not None and row.sent is not None and (np.abs(commanded - row.sent) > _APART_RAD).any():
            # A limit, a person or a stop has led the arms elsewhere.
            row.path = self._splicer.splice(row.path.path, time_s, self._state(row, time_s, commanded))
        self._collect(row, time_s, commanded)
        if row.pending is None and self._is_due(row, time_s):
            self._ask(row, time_s, commanded, observation)
            self._collect(row, time_s, commanded)
        if row.error is not None and (row.path is None or not row.path(np.array([time_s - self._settled_s]))[1].any()):
            raise row.error
        goal = commanded if row.path is None else row.path(np.array([time_s + self._period_s]))[0, 0]
        if self._mode == "joint_delta":
            joints = np.clip((goal - commanded) / self._step_rad, -1.0, 1.0)
            row.sent = commanded + joints * self._step_rad
        else:
            joints = row.sent = goal
        row.time_s = time_s
        if not self._grippers:
            return joints
        return np.concatenate([joints.reshape(2, 6), self._opening(row, time_s)[:, None]], axis=1).reshape(-1)

    def _opening(self, row: _ChunkedCell, time_s: float) -> Array:
        """Return the openings of the grippers, (2,), at the end of the period that begins."""
        if row.opening is None:
            return row.rest
        k = math.ceil((time_s + self._period_s - row.stamp_s) / row.dt_s - 1e-6) - 1
        opening: Array = row.opening[min(max(k, 0), len(row.opening) - 1)]
        return opening

    def _state(self, row: _ChunkedCell, time_s: float, commanded: Array) -> Array:
        """Return position, speed and acceleration of the motion at a time, (3, 12), of joints that may be led."""
        state = np.zeros((3, 12))
        state[0] = commanded
        if row.path is None:
            return state
        path = row.path(np.array([time_s]))[:3, 0]
        state[1] = np.clip(row.speeds, -self._splicer.speed_rad_s, self._splicer.speed_rad_s)
        return np.where(np.abs(commanded - path[0]) > _APART_RAD, state, path)

    def _is_due(self, row: _ChunkedCell, time_s: float) -> bool:
        """Return True if the next chunk should be asked for."""
        if row.error is not None:
            return False
        if row.path is None:
            return True
        path = row.path.path
        left_s = path.end_s - path.brake_s / 2 - time_s
        replan_s = path.duration_s / 2 if self._replan_s is None else self._replan_s
        is_short = left_s <= max(self._latencies, default=0.0) + 2 * self._period_s
        return is_short or time_s - row.asked_s >= replan_s - _ROUNDING_S

    def _ask(self, row: _ChunkedCell, time_s: float, commanded: Array, observation: Any) -> None:
        """Ask for a chunk, in the thread where the time of day is kept."""
        row.asked_s = time_s
        row.pending = answer = ChunkAnswer(time_s, commanded, ready_s=time_s)
        if self._inference is not None:
            self._inference.ask(answer, _copied(observation))
            return
        began_s = time.perf_counter()
        fill(answer, self.source, _copied(observation), self._planner)
        latency_s = self.latency_s() if callable(self.latency_s) else self.latency_s
        answer.ready_s += time.perf_counter() - began_s if latency_s is None else latency_s
        if answer.ready_s == math.inf:
            row.pending = None

    def _collect(self, row: _ChunkedCell, time_s: float, commanded: Array) -> None:
        """Follow the chunk of an answer that has arrived."""
        answer = row.pending
        if answer is None:
            return
        if self._inference is not None:
            self._inference.poll()
        if not answer.done and time_s - answer.time_s > self._silent_s:
            row.error = ChunkError(f"{self.__name__} has returned no chunk for {self._silent_s:g} s: is it running?")
        if not answer.done or time_s < answer.ready_s - _ROUNDING_S:
            return
        row.pending = None
        self._latencies.append(time_s - answer.time_s)
        if answer.plan is None:
            row.error = answer.error
            return
        path, dt_s, openings = answer.plan
        if path.end_s <= time_s + self._period_s + _ROUNDING_S:
            self._count_late(row, path, time_s - answer.time_s)
            return
        row.path = self._splicer.splice(path, time_s, self._state(row, time_s, commanded))
        row.stamp_s, row.dt_s, row.opening, row.late = answer.time_s, dt_s, openings, 0
        self.splices += 1

    def _count_late(self, row: _ChunkedCell, path: ChunkPath, latency_s: float) -> None:
        """Count a chunk that came after all of its actions; many in a row are an error."""
        self.late += 1
        row.late += 1
        if row.late >= _MOST_LATE:
            row.error = ChunkError(
                f"the last {row.late} chunks of {self.__name__} came after all of their actions, the last one "
                f"{latency_s:.3g} s after its observation: its {path.duration_s:.3g} s must be longer than that"
            )


def executor_for(source: ChunkPolicy, setup: EnvSetup, **options: Any) -> ChunkExecutor:
    """Return the executor of a chunk policy in an environment.

    Args:
        source: The chunk policy. It may have an attribute `latency_s`, which then is the default of the option.
        setup: The environment, such as `env.unwrapped.core.setup`.
        **options: `latency_s`, `replan_s` and `silent_s` of `ChunkExecutor`.

    Raises:
        SettingsError: The environment's actions are not of joints, its observations have images alone, or an option is
            not legal.
        ChunkError: The source is no chunk policy.
    """
    if setup.options.observation == "pixels":
        raise SettingsError(
            "observation is 'pixels', and a chunk counts from the joint positions of its observation: choose 'both'"
        )
    task = setup.make_task()
    options.setdefault("latency_s", getattr(source, "latency_s", None))
    return ChunkExecutor(
        source,
        timing=setup.timing,
        limits=setup.step_limits,
        action_mode=setup.options.action_mode,
        tools=setup.config.equipment.tools,
        grippers=setup.config.equipment.grippers and not setup.config.equipment.welded,
        layout=task.layout,
        view=task.concise_view() if setup.options.concise else None,
        real_time=setup.keeps_time,
        **options,
    )


def _row_of(observation: Any, row: int) -> Any:
    """Return the observation of one cell out of a batch."""
    if isinstance(observation, Mapping):
        return {name: _row_of(values, row) for name, values in observation.items()}
    return observation[row]


def _copied(observation: Any) -> Any:
    """Return a copy of the observation of one cell, since environments may reuse theirs."""
    if isinstance(observation, Mapping):
        return {name: _copied(values) for name, values in observation.items()}
    return np.array(observation)
