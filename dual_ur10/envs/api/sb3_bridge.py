"""Stable-Baselines3 views on the vector environment: a row for each cell, or one for each arm."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from typing import Any

import gymnasium as gym
import numpy as np
from numpy.typing import NDArray

from dual_ur10.envs.api.two_agents import AgentSplitter, agent_spaces, check_options
from dual_ur10.envs.api.vector_env import DualArmVectorEnv
from dual_ur10.envs.core.ends import early_end
from dual_ur10.envs.core.options import EnvOptions, check_count
from dual_ur10.envs.core.setup import REFUSAL, check_for_controllers
from dual_ur10.envs.tasks.task import FINISH
from dual_ur10.errors import ActionError, MissingExtraError, SettingsError
from dual_ur10.sim2real.cell.named_cell import resolve_cell
from ur_core.types import Array

try:
    import torch
    from stable_baselines3.common.base_class import BaseAlgorithm
    from stable_baselines3.common.running_mean_std import RunningMeanStd
    from stable_baselines3.common.vec_env import VecEnv, VecEnvWrapper, VecNormalize
except ImportError as error:
    raise MissingExtraError("stable-baselines3", "train", "the vector environment for it") from error

Indices = None | int | Iterable[int]


class CellsVecEnv(VecEnv):
    """n cells as n rows or more, stepped together as in `dual_ur10.envs.api.vector_env.DualArmVectorEnv`.

    The rows of a cell end together and begin again at once, so a cell of two controllers is refused. Infos hold
    `TimeLimit.truncated`, and at the end of an episode `terminal_observation`.

    Args:
        task: Id of the environment, or a shorter name.
        num_cells: Number of cells, n.
        rows: Number of rows of each cell.
        max_episode_steps: Steps after which episodes are truncated; None: only the task ends them.
        staggered: The episodes that `reset` begins are truncated after fewer steps, each after a random number. Cells
            then do not keep step, and every update of a learner sees all parts of the task.
        threads: Number of threads; None: one for each processor.
        render_mode: None or "rgb_array": one image per cell.
        **keywords: Keywords of every environment, `dual_ur10.envs.core.options.EnvOptions`, and of the task. Pixels are
            not observed.

    Raises:
        SettingsError: A value is not legal; or one of its subclasses.
        UnknownNameError: A task, keyword or other name does not exist.
    """

    def __init__(
        self,
        task: str,
        num_cells: int,
        rows: int,
        *,
        max_episode_steps: int | None = None,
        staggered: bool = False,
        threads: int | None = None,
        render_mode: str | None = None,
        **keywords: Any,
    ) -> None:
        if staggered and max_episode_steps is None:
            raise SettingsError("staggered episodes need max_episode_steps: pass the steps of those that follow")
        check_options("shared", keywords)
        check_count("num_cells", num_cells)
        # Steps of this class reset the cells: for two controllers that is autoreset.
        config = resolve_cell(keywords.get("cell", EnvOptions.cell))
        check_for_controllers(config, num_cells, autoreset=True, randomized=False)
        self.cells = DualArmVectorEnv(
            num_cells,
            task,
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
        self._rows_of_a_cell, self._most_steps = rows, (max_episode_steps if staggered else None)
        self._lengths = np.random.default_rng()  # of staggered episodes; a seed renews it
        self._actions: NDArray[Any] = np.zeros((rows * num_cells, *action.shape), dtype=np.float32)
        super().__init__(rows * num_cells, observation, action)

    def __repr__(self) -> str:
        return f"{type(self).__name__}({self.cells.num_envs} × {self.cells.core})"

    def _spaces(self) -> tuple[Any, Any]:
        """Return observation space and action space of a row."""
        raise NotImplementedError

    def _observations(self) -> Array:
        """Return the observations, (rows of all cells, size)."""
        raise NotImplementedError

    def _rewards(self, reward: Array) -> Array:
        """Return the rewards, (rows of all cells,), from those of the cells, (n,)."""
        raise NotImplementedError

    def _infos_of(self, info: dict[str, Any], terms: Array | None) -> list[dict[str, Any]]:
        """Return the infos of the rows of one cell."""
        raise NotImplementedError

    def seed(self, seed: int | None = None) -> list[int | None]:
        """Set the seeds of the next reset and return them by row: s gives all rows of cell k the seed s + k."""
        if seed is None:
            seed = int(np.random.default_rng().integers(2**32))
        self._seeds = [seed + row // self._rows_of_a_cell for row in range(self.num_envs)]
        return self._seeds

    def reset(self) -> Array:
        """Begin new episodes in all cells and return the observations, (rows, size).

        Raises:
            SettingsError: There are options.
        """
        options = [key for each in self._options for key in each]
        if options:
            raise SettingsError(f"reset takes no options, found {sorted(set(options))}: set keywords when making it")
        seeds = self._seeds[:: self._rows_of_a_cell]
        _, info = self.cells.reset(seed=seeds)
        if self._most_steps is not None:
            horizon = self.cells.core.task.horizon
            most = self._most_steps if horizon is None else min(self._most_steps, horizon)
            if seeds[0] is not None:
                self._lengths = np.random.default_rng(seeds[0])
            self.cells.elapsed_steps[:] = self._most_steps - most
            self.cells.elapsed_steps += self._lengths.integers(most, size=len(seeds))
        self._reset_seeds()
        self.reset_infos = self._infos(info, range(self.cells.num_envs), None)
        return self._observations()

    def _infos(self, info: dict[str, Any], cells: Iterable[int], terms: Array | None) -> list[dict[str, Any]]:
        """Return the infos of the rows of some cells, from Gymnasium's form for vectors."""
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
            ActionError: The actions have the wrong shape.
        """
        if np.shape(actions) != self._actions.shape:
            raise ActionError(
                f"actions must have shape {self._actions.shape}, one for each row, found {np.shape(actions)}"
            )
        self._actions = np.array(actions)

    def step_wait(self) -> tuple[Array, Array, NDArray[np.bool_], list[dict[str, Any]]]:
        """Advance all cells by one policy period.

        Returns:
            Observations (rows, size), rewards (rows,), mask of ended episodes (rows,), and infos.

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
        """Return one image per cell, (height, width, 3) each; none without a render mode.

        Raises:
            RenderError: No OpenGL backend was found.
        """
        return list(self.cells.render() or ())

    def get_attr(self, attr_name: str, indices: Indices = None) -> list[Any]:
        """Return an attribute of the vector environment, which all rows share, once for each row in `indices`."""
        return [getattr(self.cells, attr_name)] * len(self._rows(indices))

    def set_attr(self, attr_name: str, value: Any, indices: Indices = None) -> None:
        """Set an attribute of the vector environment, which all rows share.

        Raises:
            SettingsError: `indices` are not all rows.
        """
        self._all_rows(f"attribute {attr_name!r}", indices)
        setattr(self.cells, attr_name, value)

    def env_method(
        self, method_name: str, *method_args: Any, indices: Indices = None, **method_kwargs: Any
    ) -> list[Any]:
        """Call a method of the vector environment, which all rows share, once; return its result for each row.

        Raises:
            SettingsError: `indices` are not all rows.
        """
        self._all_rows(f"method {method_name!r}", indices)
        return [getattr(self.cells, method_name)(*method_args, **method_kwargs)] * self.num_envs

    def env_is_wrapped(
        self, wrapper_class: type[gym.Wrapper[Any, Any, Any, Any]], indices: Indices = None
    ) -> list[bool]:
        """Return False for each row: rows are never wrapped one by one."""
        return [False] * len(self._rows(indices))

    def columns(self, fields: Iterable[str]) -> list[int]:
        """Return the columns of fields in an observation of one row.

        Args:
            fields: Names of fields of an arm, as on the page of the task; with `JointVecEnv` those of both arms.

        Raises:
            UnknownNameError: There is no such field.
        """
        layout = self.cells.core.layout
        found, arms = layout.indices(fields), (self.observation_space.shape or (0,))[0] // layout.size
        return [arm * layout.size + index for arm in range(arms) for index in found]

    def _rows(self, indices: Indices) -> list[int]:
        return list(self._get_indices(indices))

    def _all_rows(self, what: str, indices: Indices) -> None:
        if sorted(self._rows(indices)) != list(range(self.num_envs)):
            raise SettingsError(f"{what} belongs to all rows, which share one core: pass indices=None")


class JointVecEnv(CellsVecEnv):
    """n cells as n rows, each with the observations and actions of both arms: the Gymnasium environment, n times.

    Row k with seed s equals, in every bit, the single environment with seed s + k.

    Args:
        task: Id of the environment, or a shorter name.
        num_cells: Number of cells, n.
        **keywords: Keywords of `CellsVecEnv`.

    Raises:
        SettingsError: A value is not legal; or one of its subclasses.
        UnknownNameError: A task, keyword or other name does not exist.
    """

    def __init__(self, task: str, num_cells: int = 1, **keywords: Any) -> None:
        super().__init__(task, num_cells, 1, **keywords)

    def _spaces(self) -> tuple[Any, Any]:
        return self.cells.core.observation_space, self.cells.core.action_space

    def _observations(self) -> Array:
        return self.cells.core.agents.joint

    def _rewards(self, reward: Array) -> Array:
        return reward

    def _infos_of(self, info: dict[str, Any], terms: Array | None) -> list[dict[str, Any]]:
        return [info]


class TwoAgentVecEnv(CellsVecEnv):
    """n cells as 2n rows: row 2k is the left arm of cell k, row 2k + 1 its right arm.

    The rows of a cell equal, in every bit, the agents of a `dual_ur10.envs.api.parallel_env.DualArmParallelEnv` with
    the seed of the cell. Infos are the agents', with `end_reason`, `safety` and `physics_error` as of `DualArmEnv`.

    Args:
        task: Id of the environment, or a shorter name.
        num_cells: Number of cells, n.
        reward: "shared", "individual" or "sparse", as for `DualArmParallelEnv`.
        **keywords: Keywords of `CellsVecEnv`.

    Raises:
        SettingsError: A value is not legal; or one of its subclasses.
        UnknownNameError: A task, keyword, reward or other name does not exist.
    """

    def __init__(self, task: str, num_cells: int = 1, *, reward: str = "shared", **keywords: Any) -> None:
        keywords = check_options(reward, keywords)
        super().__init__(task, num_cells, 2, **keywords)
        self._splitter = AgentSplitter(self.cells.core, reward)

    def _spaces(self) -> tuple[Any, Any]:
        (observation, other), (action, _) = agent_spaces(self.cells.core)
        if observation != other:
            raise SettingsError("the agents have different observation spaces: one policy cannot act for both")
        return observation, action

    def _observations(self) -> Array:
        agents = self.cells.core.agents.observations
        return agents.reshape(self.num_envs, agents.shape[-1])

    def _rewards(self, reward: Array) -> Array:
        return self.cells.core.agents.rewards.reshape(-1) if self._splitter.individual else np.repeat(reward, 2)

    def _infos_of(self, info: dict[str, Any], terms: Array | None) -> list[dict[str, Any]]:
        return list(self._splitter.infos(info, terms))


class RewardDifferences(VecEnvWrapper):
    """Rewards for what a step has changed.

    The terms of a state, added up to s, are replaced by their change since the step before. With the discount g the
    return of the changes is 1 - g times that of s, less what the first state earns. The same policy is best, but for
    two exceptions. A finish, multiplied by 1 - g, counts for no more than a state with s = 1 that lasts for ever. A
    refused motion costs the time in which nothing changes, and 1 - g times a part of its own term: all of it from the
    beginning would keep the tools away from the table long before they can grasp. An end without success takes back
    what was earned.

    Args:
        env: Vector environment of the package.
        gamma: Discount of the learner, below 1.
        refusals: Function that returns the ratio of a refused motion's term that counts now.

    Raises:
        SettingsError: `gamma` is not from 0 to below 1, at which differences leave nothing to learn.
    """

    def __init__(self, env: VecEnv, gamma: float, refusals: Callable[[], float] = lambda: 0.0) -> None:
        if not 0.0 <= gamma < 1.0:
            raise SettingsError(f"gamma is {gamma}: differences of the reward need a discount from 0 to below 1")
        super().__init__(env)
        self._refusals = refusals
        weights = env.get_attr("core")[0].weights
        self._finish, self._refusal = weights.get(FINISH, 0.0), weights.get(REFUSAL, 0.0)
        self._gamma, self._before = gamma, np.full(env.num_envs, np.nan)

    def reset(self) -> Any:
        """Begin new episodes in all cells and return the observations, (rows, size)."""
        self._before[:] = np.nan
        return self.venv.reset()

    def step_wait(self) -> tuple[Any, Array, NDArray[np.bool_], list[dict[str, Any]]]:
        """Advance all cells by one policy period, as the environment does, with other rewards."""
        observation, reward, over, infos = self.venv.step_wait()
        named = f"reward/{FINISH}", f"reward/{REFUSAL}"
        finish, refusal = np.array([[info.get(name, 0.0) for name in named] for info in infos]).T
        finish *= self._finish
        refusal *= self._refusal
        state = reward - finish - refusal
        lost = [bool(each) and early_end(info) != "" for each, info in zip(over, infos, strict=True)]
        change = np.where(np.isnan(self._before), 0.0, state - self._before) - np.where(lost, self._gamma * state, 0.0)
        self._before = np.where(over, np.nan, state)
        once = np.minimum((1.0 - self._gamma) * finish, 1.0) + (1.0 - self._gamma) * self._refusals() * refusal
        return observation, change + once, over, infos


def hide(model: BaseAlgorithm, columns: Iterable[int]) -> None:
    """Hide columns of the observation from a policy of Stable-Baselines3, and not from its value functions.

    With fewer values a policy is found in fewer steps, but what an arm will earn depends on the phase of the task, too
    (L. Pinto et al., "Asymmetric Actor Critic for Image-Based Robot Learning", RSS 2018). The weights of these inputs
    become zero, and stay so.

    Args:
        model: PPO, SAC or TD3 with an `MlpPolicy`, before its training.
        columns: Columns, as of `CellsVecEnv.columns`.

    Raises:
        SettingsError: The policy has no network of linear layers of its own.
    """
    try:
        layers = _first_layers(model.policy)
    except (AttributeError, IndexError):
        raise SettingsError(
            f"{type(model.policy).__name__} has no layers to hide columns from: use MlpPolicy"
        ) from None
    mask = torch.ones_like(layers[0].weight)
    mask[:, list(columns)] = 0.0
    for layer in layers:
        with torch.no_grad():
            layer.weight.mul_(mask)
        layer.weight.register_hook(lambda gradient: gradient * mask)


def scale(env: VecNormalize, columns: Iterable[int]) -> None:
    """Let a normaliser of Stable-Baselines3 scale columns of the observation alone, and leave the others as they are.

    Fields that are made for learners (`observation="goals"`) have their scale. A deviation of early training is small
    where the arms have hardly been, and would move them about.

    Args:
        env: Normaliser with `norm_obs`, before its first reset.
        columns: Columns, as of `CellsVecEnv.columns`.
    """
    moments: Any = _Moments(env.observation_space.shape or (0,), columns)
    env.obs_rms = moments


class _Moments(RunningMeanStd):
    """Running mean and variance of some columns. Those of the others stay 0 and 1."""

    def __init__(self, shape: tuple[int, ...], columns: Iterable[int]) -> None:
        super().__init__(shape=shape)
        self._others = np.setdiff1d(np.arange(shape[0]), list(columns))

    def update_from_moments(self, batch_mean: Any, batch_var: Any, batch_count: float) -> None:
        """Take the moments of further observations."""
        super().update_from_moments(batch_mean, batch_var, batch_count)
        self.mean[self._others], self.var[self._others] = 0.0, 1.0


def _first_layers(policy: Any) -> list[Any]:
    """Return the layers of a policy that get the observation: of PPO, SAC, or TD3, which has a target of its actor."""
    if not hasattr(policy, "actor"):
        return [policy.mlp_extractor.policy_net[0]]
    if hasattr(policy.actor, "latent_pi"):
        return [policy.actor.latent_pi[0]]
    return [policy.actor.mu[0], policy.actor_target.mu[0]]


def _row(value: Any, row: int) -> Any:
    """Return one row of a value of Gymnasium's infos for vectors, which may be a nested dict."""
    if isinstance(value, dict):
        return {
            name: _row(each, row)
            for name, each in value.items()
            if not name.startswith("_") and ("_" + name not in value or value["_" + name][row])
        }
    return value[row]
