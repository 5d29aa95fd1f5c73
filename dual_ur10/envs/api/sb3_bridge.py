"""Views on the vector environment for Stable-Baselines3: a row for each cell, or one for each arm."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

import gymnasium as gym
import numpy as np
from numpy.typing import NDArray

from dual_ur10.envs.api.two_agents import Share, agent_spaces, check_count, check_options
from dual_ur10.envs.api.vector_env import DualArmVectorEnv
from dual_ur10.envs.core.options import EnvOptions
from dual_ur10.envs.core.setup import check_for_controllers
from dual_ur10.errors import ActionError, MissingExtraError, SettingsError
from dual_ur10.ids import env_id_of, task_name
from dual_ur10.sim2real.config.cell_file import resolve_cell
from dual_ur10.types import Array

try:
    from stable_baselines3.common.vec_env import VecEnv
except ImportError as error:
    raise MissingExtraError("stable-baselines3", "train", "the vector environment for it") from error

Indices = None | int | Iterable[int]


class CellsVecEnv(VecEnv):
    """n cells as n rows or more, stepped together as in `dual_ur10.envs.api.vector_env.DualArmVectorEnv`.

    The rows of a cell end together and begin anew at once, so a cell of two controllers is refused. Infos have
    `TimeLimit.truncated`, and at an end `terminal_observation`.

    Args:
        task: Name of the task, or an id.
        num_cells: n.
        rows: Rows of each cell.
        max_episode_steps: Truncate episodes after so many steps; None: only where the task ends.
        threads: Threads to step on; None: as many as there are processors.
        render_mode: None or "rgb_array": one image per cell.
        **keywords: Those of every environment, `dual_ur10.envs.core.options.EnvOptions`, and the task's own. Pixels are
            not observed.

    Raises:
        SettingsError: Or one of its kinds: a value is not legal.
        UnknownNameError: A name (task, keyword, ...) is none that exists.
    """

    def __init__(
        self,
        task: str,
        num_cells: int,
        rows: int,
        *,
        max_episode_steps: int | None = None,
        threads: int | None = None,
        render_mode: str | None = None,
        **keywords: Any,
    ) -> None:
        check_options("shared", keywords)
        check_count("num_cells", num_cells)
        # Its steps reset the cells, which are told that they will not by themselves.
        config = resolve_cell(keywords.get("cell", EnvOptions.cell))
        check_for_controllers(config, num_cells, autoreset=True, randomized=False)
        self.cells = DualArmVectorEnv(
            num_cells,
            task_name(env_id_of(task)),
            autoreset_mode="Disabled",
            max_episode_steps=max_episode_steps,
            threads=threads,
            render_mode=render_mode,
            **keywords,
        )
        try:
            observation, action = self._spaces()
        except BaseException:
            self.cells.close()
            raise
        self._rows_of_a_cell = rows
        self._actions: NDArray[Any] = np.zeros((rows * num_cells, *action.shape), dtype=np.float32)
        super().__init__(rows * num_cells, observation, action)

    def _spaces(self) -> tuple[Any, Any]:
        """What a row observes, and its actions."""
        raise NotImplementedError

    def _observations(self) -> Array:
        """(rows of all cells, size)."""
        raise NotImplementedError

    def _rewards(self, reward: Array) -> Array:
        """(rows of all cells,) from that of the cells, (n,)."""
        raise NotImplementedError

    def _infos_of(self, info: dict[str, Any], terms: Array | None) -> list[dict[str, Any]]:
        """Infos of the rows of one cell."""
        raise NotImplementedError

    def seed(self, seed: int | None = None) -> list[int | None]:
        """Seeds for the next reset: s gives cell k, and so all its rows, the seed s + k. Returned by row."""
        if seed is None:
            seed = int(np.random.default_rng().integers(2**32))
        self._seeds = [seed + row // self._rows_of_a_cell for row in range(self.num_envs)]
        return self._seeds

    def reset(self) -> Array:
        """Begin new episodes in all cells. Returns the observations, (rows, size).

        Raises:
            SettingsError: There are options, and none are taken.
        """
        options = [key for each in self._options for key in each]
        if options:
            raise SettingsError(f"reset takes no options, found {sorted(set(options))}: set keywords when making it")
        _, info = self.cells.reset(seed=self._seeds[:: self._rows_of_a_cell])
        self._reset_seeds()
        self.reset_infos = self._infos(info, range(self.cells.num_envs), None)
        return self._observations()

    def _infos(self, info: dict[str, Any], cells: Iterable[int], terms: Array | None) -> list[dict[str, Any]]:
        """Infos of the rows of each of the cells, from Gymnasium's form for vectors."""
        everyone = np.ones(self.cells.num_envs, dtype=bool)
        columns = [
            (name, value, info.get("_" + name, everyone)) for name, value in info.items() if not name.startswith("_")
        ]
        result: list[dict[str, Any]] = []
        for cell in cells:
            own = {name: _row(value, cell) for name, value, mask in columns if mask[cell]}
            result += self._infos_of(own, None if terms is None else terms[cell])
        return result

    def step_async(self, actions: NDArray[Any]) -> None:
        """Take the actions of all rows, (rows, size); the arms move with `step_wait`.

        Raises:
            ActionError: They have the wrong shape.
        """
        if np.shape(actions) != self._actions.shape:
            raise ActionError(
                f"actions must have shape {self._actions.shape}, one for each row, found {np.shape(actions)}"
            )
        self._actions = np.array(actions)

    def step_wait(self) -> tuple[Array, Array, NDArray[np.bool_], list[dict[str, Any]]]:
        """One control period of all cells.

        Returns:
            Observations (rows, size), rewards (rows,), whether an episode ended (rows,), and infos.

        Raises:
            ActionError: An action holds NaN, infinity or no numbers. Nothing has moved.
            ResetNeededError: There was no reset yet.
        """
        n, each = self.cells.num_envs, self._rows_of_a_cell
        _, reward, terminated, truncated, info = self.cells.step(self._actions.reshape(n, -1))
        observation, rewards = self._observations(), self._rewards(reward)
        infos = self._infos(info, range(n), self.cells.core.agents.terms)
        over = terminated | truncated
        for row, timeout in enumerate(np.repeat(truncated & ~terminated, each).tolist()):
            infos[row]["TimeLimit.truncated"] = timeout
        if over.any():
            ended = np.flatnonzero(over).tolist()
            rows = [each * cell + k for cell in ended for k in range(each)]
            for row in rows:
                infos[row]["terminal_observation"] = observation[row].copy()
            _, begun = self.cells.reset(options={"reset_mask": over})
            observation = self._observations()
            for row, info_of_row in zip(rows, self._infos(begun, ended, None), strict=True):
                self.reset_infos[row] = info_of_row
        return observation, rewards, np.repeat(over, each), infos

    def close(self) -> None:
        """Release simulation and images. May be called twice."""
        self.cells.close()

    def get_images(self) -> list[NDArray[np.uint8] | None]:
        """One image per cell, (height, width, 3) each; none without a render mode.

        Raises:
            RenderError: No OpenGL backend was found.
        """
        return list(self.cells.render() or ())

    def get_attr(self, attr_name: str, indices: Indices = None) -> list[Any]:
        """An attribute of the vector environment that all rows share, once for each row asked for."""
        return [getattr(self.cells, attr_name)] * len(self._rows(indices))

    def set_attr(self, attr_name: str, value: Any, indices: Indices = None) -> None:
        """Set an attribute of the vector environment that all rows share.

        Raises:
            SettingsError: It is to be set for some rows only.
        """
        self._all_rows(f"attribute {attr_name!r}", indices)
        setattr(self.cells, attr_name, value)

    def env_method(
        self, method_name: str, *method_args: Any, indices: Indices = None, **method_kwargs: Any
    ) -> list[Any]:
        """Call a method of the vector environment that all rows share, once. Returns its result for each row.

        Raises:
            SettingsError: It is to be called for some rows only.
        """
        self._all_rows(f"method {method_name!r}", indices)
        return [getattr(self.cells, method_name)(*method_args, **method_kwargs)] * self.num_envs

    def env_is_wrapped(
        self, wrapper_class: type[gym.Wrapper[Any, Any, Any, Any]], indices: Indices = None
    ) -> list[bool]:
        """Rows are never wrapped one by one."""
        return [False] * len(self._rows(indices))

    def _rows(self, indices: Indices) -> list[int]:
        return list(self._get_indices(indices))

    def _all_rows(self, what: str, indices: Indices) -> None:
        if sorted(self._rows(indices)) != list(range(self.num_envs)):
            raise SettingsError(f"{what} is one for all rows, for they share one core: pass indices=None")


class JointVecEnv(CellsVecEnv):
    """n cells as n rows, each with the observations and actions of both arms: the Gymnasium environment, n times.

    Row k with seed s is, bit for bit, the single environment with seed s + k.

    Args:
        task: Name of the task, or an id.
        num_cells: n.
        **keywords: As of `CellsVecEnv`.

    Raises:
        SettingsError: Or one of its kinds: a value is not legal.
        UnknownNameError: A name (task, keyword, ...) is none that exists.
    """

    def __init__(self, task: str, num_cells: int = 1, **keywords: Any) -> None:
        super().__init__(task, num_cells, 1, **keywords)

    def _spaces(self) -> tuple[Any, Any]:
        return self.cells.core.observation_space, self.cells.core.action_space

    def _observations(self) -> Array:
        return self.cells.core.agents.both.copy()

    def _rewards(self, reward: Array) -> Array:
        return reward

    def _infos_of(self, info: dict[str, Any], terms: Array | None) -> list[dict[str, Any]]:
        return [info]


class TwoAgentVecEnv(CellsVecEnv):
    """n cells as 2n rows: row 2k is the left arm of cell k, row 2k + 1 its right arm.

    The rows of a cell are, bit for bit, the agents of a `dual_ur10.envs.api.parallel_env.DualArmParallelEnv` with the
    cell's seed. Infos are the agents'.

    Args:
        task: Name of the task, or an id.
        num_cells: n.
        reward: "shared" or "individual", as for `DualArmParallelEnv`.
        **keywords: As of `CellsVecEnv`.

    Raises:
        SettingsError: Or one of its kinds: a value is not legal.
        UnknownNameError: A name (task, keyword, reward, ...) is none that exists.
    """

    def __init__(self, task: str, num_cells: int = 1, *, reward: str = "shared", **keywords: Any) -> None:
        check_options(reward, keywords)
        super().__init__(task, num_cells, 2, **keywords)
        self._share = Share(self.cells.core, reward)

    def _spaces(self) -> tuple[Any, Any]:
        (observation, other), (action, _) = agent_spaces(self.cells.core)
        if observation != other:
            raise SettingsError("the two agents observe differently, one policy cannot act for both")
        return observation, action

    def _observations(self) -> Array:
        agents = self.cells.core.agents.observations
        return agents.reshape(self.num_envs, agents.shape[-1])

    def _rewards(self, reward: Array) -> Array:
        return self.cells.core.agents.rewards.reshape(-1) if self._share.individual else np.repeat(reward, 2)

    def _infos_of(self, info: dict[str, Any], terms: Array | None) -> list[dict[str, Any]]:
        return list(self._share.infos(info, terms))


def _row(value: Any, row: int) -> Any:
    """One row of a value of Gymnasium's infos for vectors, which may hold others by name."""
    if isinstance(value, dict):
        return {
            name: _row(each, row)
            for name, each in value.items()
            if not name.startswith("_") and ("_" + name not in value or value["_" + name][row])
        }
    return value[row]
