"""The vector environment: many cells in one batch, on a thread pool inside MuJoCo."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from copy import deepcopy
from typing import Any

import numpy as np
from gymnasium.utils import seeding
from gymnasium.vector import AutoresetMode, VectorEnv
from gymnasium.vector.utils import batch_space
from numpy.typing import NDArray

from dual_ur10.envs.core.core import Core, Step
from dual_ur10.envs.core.ends import TIME
from dual_ur10.envs.core.options import DEFAULT_RATE_HZ, MOVE_TO_START, check_count, take_consent
from dual_ur10.envs.rendering.pixels import Observer, row_of
from dual_ur10.errors import ResetNeededError, SettingsError, UnknownNameError
from ur_core.types import Array, Mask, Rows


class DualArmVectorEnv(VectorEnv[Any, Array, Array]):
    """n cells behind Gymnasium's vector interface. Row k with seed s equals a single env with seed s + k in every bit.

    Observations are those of `dual_ur10.envs.api.dual_arm_env.DualArmEnv`, each array with a leading axis of n cells.

    `gym.make_vec` forbids `vector_kwargs` and wrappers with an environment of this kind: pass keywords.

    Args:
        num_envs: Number of cells.
        task: Id of the environment, or a shorter name; `gym.make` sets it.
        autoreset_mode: `gymnasium.vector.AutoresetMode` or its value: "NextStep" (default), "SameStep", "Disabled".
        max_episode_steps: Steps after which episodes are truncated; None: only the task ends them.
        threads: Number of threads; None: one for each processor.
        render_mode: None or "rgb_array": one image per cell.
        **keywords: Keywords of every environment, `dual_ur10.envs.core.options.EnvOptions`, and of the task.

    Attributes:
        elapsed_steps: (n,) steps of the present episodes, which `max_episode_steps` limits. They may be set.
    """

    metadata: dict[str, Any] = {  # noqa: RUF012  # as Gymnasium declares it
        "render_modes": ["rgb_array"],
        "render_fps": round(DEFAULT_RATE_HZ),
        "autoreset_mode": AutoresetMode.NEXT_STEP,
    }

    def __init__(
        self,
        num_envs: int,
        task: str,
        *,
        autoreset_mode: str | AutoresetMode = AutoresetMode.NEXT_STEP,
        max_episode_steps: int | None = None,
        threads: int | None = None,
        render_mode: str | None = None,
        **keywords: Any,
    ) -> None:
        self.closed = True  # Gymnasium closes the remains of a failed construction
        check_count("num_envs", num_envs)
        check_count("max_episode_steps", max_episode_steps, optional=True)
        check_count("threads", threads, optional=True)
        if render_mode not in (None, "rgb_array"):
            raise UnknownNameError("render mode of a vector env", str(render_mode), ["rgb_array", "None"])
        values = [mode.value for mode in AutoresetMode]
        if not isinstance(autoreset_mode, AutoresetMode) and autoreset_mode not in values:
            raise UnknownNameError("autoreset mode", str(autoreset_mode), values)
        self.num_envs, self.render_mode = num_envs, render_mode
        self.autoreset_mode, self._max_steps = AutoresetMode(autoreset_mode), max_episode_steps
        autoreset = self.autoreset_mode != AutoresetMode.DISABLED
        try:
            self.core = Core(task, keywords, n=num_envs, threads=threads, autoreset=autoreset)
        except MemoryError as error:
            raise SettingsError(f"num_envs is {num_envs}, too many for the memory: {error}. Use fewer") from error
        try:
            self._observer = Observer(self.core)
        except BaseException:
            self.core.close()
            raise
        self.single_action_space, self.single_observation_space = self.core.action_space, self._observer.space
        self.action_space = batch_space(self.single_action_space, num_envs)
        self.observation_space = batch_space(self.single_observation_space, num_envs)
        self.metadata = {
            **type(self).metadata,
            "render_fps": round(1 / self.core.timing.period_s),
            "autoreset_mode": self.autoreset_mode,
        }
        self._rngs: list[np.random.Generator] = []
        self.elapsed_steps = np.zeros(num_envs, dtype=np.int64)
        self._done = np.zeros(num_envs, dtype=bool)
        self.closed = False

    def reset(
        self,
        *,
        seed: int | Sequence[int | None] | None = None,
        options: dict[str, Any] | None = None,
    ) -> tuple[Any, dict[str, Any]]:
        """Begin new episodes.

        Args:
            seed: As for `gymnasium.vector.SyncVectorEnv`: s gives row k the seed s + k; or one per row.
            options: `"reset_mask"`, a boolean mask, (num_envs,), of the rows to reset; and `"move_to_start"` as for
                `DualArmEnv`.

        Raises:
            SettingsError: Seeds or mask do not fit.
            ResetNeededError: The first reset is not of all rows.
            ResetRefusedError: On two controllers, a later reset was called without consent. Nothing has moved.
            RenderError: Images are observed, and no OpenGL backend was found.
        """
        seeds: list[int | None] = [None] * self.num_envs
        if seed is not None:
            seeds = [int(seed) + k for k in range(self.num_envs)] if isinstance(seed, int | np.integer) else list(seed)
        if len(seeds) != self.num_envs:
            raise SettingsError(f"{len(seeds)} seeds for {self.num_envs} environments: pass one per row, or one number")
        others = dict(options or {})
        consent = take_consent(others)
        rows = self._masked_rows(others)
        if not self._rngs:
            if len(rows) < self.num_envs:
                raise ResetNeededError("the first reset must be of all rows: call reset() without a reset_mask first")
            self._rngs = [seeding.np_random(each)[0] for each in seeds]
        else:
            seeded = {row: seeding.np_random(seeds[row])[0] for row in rows.tolist() if seeds[row] is not None}
            self._rngs = [seeded.get(row, rng) for row, rng in enumerate(self._rngs)]
        observation, info = self._begin(rows, seeds[0], move_to_start=consent)
        mask = np.zeros(self.num_envs, dtype=bool)
        mask[rows] = True
        return observation, _masked(info, mask)

    def _masked_rows(self, options: dict[str, Any]) -> Rows:
        mask = options.pop("reset_mask", None)
        if options:
            raise UnknownNameError("reset option", str(next(iter(options))), ["reset_mask", MOVE_TO_START])
        if mask is None:
            return np.arange(self.num_envs)
        if not (isinstance(mask, np.ndarray) and mask.dtype == bool and mask.shape == (self.num_envs,) and mask.any()):
            raise SettingsError(
                f"reset_mask must be a boolean array of shape ({self.num_envs},) with at least one True, found {mask!r}"
            )
        return np.flatnonzero(mask)

    def _begin(
        self, rows: Rows, seed: int | None = None, *, move_to_start: bool = False
    ) -> tuple[Any, dict[str, NDArray[Any]]]:
        """Begin episodes in some rows. The seed is that of the first row, for the record."""
        rngs = [self._rngs[row] for row in rows.tolist()]
        state, info = self.core.reset(rngs, rows, seed=seed, move_to_start=move_to_start)
        self.elapsed_steps[rows] = 0
        self._done[rows] = False
        observation = self._observer.begin(state, rows)
        return observation, {**info, **self._observer.ages}

    def step(  # type: ignore[override]  # Gymnasium types the flags as it types rewards
        self, actions: Array
    ) -> tuple[Any, Array, Mask, Mask, dict[str, Any]]:
        """Advance all cells by one policy period; see `gymnasium.vector.VectorEnv.step`.

        Raises:
            ActionError: The actions are malformed. Nothing has moved.
            SettingsError: With "Disabled", a row that ended was not reset.
        """
        if self.autoreset_mode is AutoresetMode.DISABLED and self._done.any():
            rows = np.flatnonzero(self._done).tolist()
            raise SettingsError(f"rows {rows} have ended: reset them with options={{'reset_mask': ...}} first")
        if self._done.any() and self.autoreset_mode is AutoresetMode.NEXT_STEP:
            actions = np.array(actions)
            if actions.shape[:1] == (self.num_envs,):
                actions[self._done] = 0  # these rows begin new episodes and ignore their actions
        step = self.core.step(actions)
        self.elapsed_steps += 1
        reward, terminated, truncated = step.reward, step.terminated, step.truncated
        if self._max_steps is not None:
            stopped = self.elapsed_steps >= self._max_steps
            if stopped.any():
                step = step._replace(ends={**dict.fromkeys(np.flatnonzero(stopped).tolist(), TIME), **step.ends})
            truncated = truncated | stopped
            if truncated.all():
                self.core.finish()
        info = self._info(step)
        if self.autoreset_mode is AutoresetMode.NEXT_STEP and self._done.any():
            fresh = self._done.copy()
            self._observer.advance(step.observation, np.flatnonzero(~fresh))
            observation, begun = self._begin(np.flatnonzero(fresh))
            reward[fresh], terminated[fresh], truncated[fresh] = 0.0, False, False
            info = _restarted(info, fresh, begun)
        else:
            observation = self._observer.advance(step.observation)
            info.update(_masked(self._observer.ages, np.ones(self.num_envs, dtype=bool)))
        self._done = terminated | truncated
        if self.autoreset_mode is AutoresetMode.SAME_STEP and self._done.any():
            ended = self._done.copy()
            final = np.full(self.num_envs, None, dtype=object)
            for row in np.flatnonzero(ended).tolist():
                final[row] = deepcopy(row_of(observation, row))
            final_info = {name: value & ended if name.startswith("_") else value for name, value in info.items()}
            observation, begun = self._begin(np.flatnonzero(ended))
            info = _restarted(info, ended, begun)
            info.update(
                {"final_obs": final, "_final_obs": ended, "final_info": final_info, "_final_info": ended.copy()}
            )
            self._done = np.zeros(self.num_envs, dtype=bool)
        return observation, reward, terminated, truncated, info

    def _info(self, step: Step) -> dict[str, Any]:
        everyone = np.ones(self.num_envs, dtype=bool)
        info = _masked(step.info, everyone)
        for row in {*step.verdicts, *step.ends, *step.led_by}:
            for name, value in step.details(row).items():
                if name not in info:
                    info[name] = np.full(self.num_envs, None, dtype=object)
                    info["_" + name] = np.zeros(self.num_envs, dtype=bool)
                info[name][row], info["_" + name][row] = value, True
        return info

    def call(self, name: str, *args: Any, **kwargs: Any) -> tuple[Any, ...]:
        """Call a method or read an attribute for every row, as `gymnasium.vector.SyncVectorEnv` does.

        The rows share one core and have no environments of their own. "render" and "np_random" differ from row to row,
        and the spaces are those of a row; anything else belongs to all rows and is called or read once.

        Args:
            name: Method or attribute of this environment.
            *args: Arguments of the method.
            **kwargs: Keywords of the method.

        Returns:
            One result for each row.

        Raises:
            SettingsError: `reset`, `step` and `close` act on all rows: call them directly.
            AttributeError: There is no such method or attribute.
        """
        if name in ("reset", "step", "close"):
            raise SettingsError(f"call({name!r}) would {name} all rows once for each: call {name}() instead")
        if name == "np_random" and self._rngs:
            return tuple(self._rngs)
        value = getattr(self, f"single_{name}" if name in ("observation_space", "action_space") else name)
        if callable(value):
            value = value(*args, **kwargs)
        return value if name == "render" and value is not None else (value,) * self.num_envs

    def get_attr(self, name: str) -> tuple[Any, ...]:
        """Return an attribute for every row; see `call`.

        Raises:
            AttributeError: There is no such attribute.
        """
        return self.call(name)

    def set_attr(self, name: str, values: list[Any] | tuple[Any, ...] | Any) -> None:
        """Set an attribute of all rows.

        Args:
            name: Attribute of this environment.
            values: One value, or a list or tuple of one for each row, which must be the same.

        Raises:
            SettingsError: The values differ, or their number is not that of the rows.
        """
        each = list(values) if isinstance(values, list | tuple) else [values] * self.num_envs
        if len(each) != self.num_envs:
            raise SettingsError(f"{len(each)} values of {name} for {self.num_envs} rows: pass one, or one per row")
        if any(value is not each[0] and not np.array_equal(value, each[0]) for value in each):
            raise SettingsError(f"{name} belongs to all rows, which share one core: pass one value, found {each!r:.99}")
        setattr(self, name, each[0])

    def __repr__(self) -> str:
        return f"{type(self).__name__}({self.num_envs} × {self.core})"

    @property
    def task(self) -> Any:
        """Task object of all rows."""
        return self.core.task

    def render(self) -> tuple[NDArray[np.uint8], ...] | None:
        """Return one image per cell, (height, width, 3) each, or None without a render mode.

        Raises:
            RenderError: No OpenGL backend was found.
        """
        if self.render_mode is None:
            return None
        return tuple(self._observer.renderer.image(*self.core.cell_data(row)) for row in range(self.num_envs))

    def close_extras(self, **kwargs: Any) -> None:
        """Release simulation and images."""
        self._observer.close()
        self.core.close()


def _masked(info: Mapping[str, Any], mask: Mask) -> dict[str, Any]:
    """Return `info` as Gymnasium's vector environments do: each array with a mask of its rows under "_" + name."""
    result: dict[str, Any] = {}
    for name, value in info.items():
        result[name] = _masked(value, mask) if isinstance(value, dict) else value
        result["_" + name] = mask.copy()
    return result


def _restarted(info: Mapping[str, Any], rows: Mask, begun: Mapping[str, Any]) -> dict[str, Any]:
    """Return the masked `info` of a step, with that of a reset in some rows; values of no row are left out.

    Args:
        info: Masked `info` of the step.
        rows: (n,) rows that were reset.
        begun: `info` of the reset, not masked; arrays that both have are those of all rows.
    """
    result: dict[str, Any] = {}
    for name, value in info.items():
        if name.startswith("_"):
            continue
        mask = info["_" + name] if name in begun else info["_" + name] & ~rows
        if mask.any():
            result[name], result["_" + name] = begun.get(name, value), mask
    result.update(_masked({name: value for name, value in begun.items() if name not in info}, rows))
    return result
