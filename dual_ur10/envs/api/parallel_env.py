"""The PettingZoo environments: views on the Gymnasium environment in which each arm is an agent."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any, cast

import gymnasium as gym
import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray
from pettingzoo import AECEnv, ParallelEnv  # type: ignore[import-untyped]  # has no types
from pettingzoo.utils.conversions import parallel_to_aec_wrapper  # type: ignore[import-untyped]  # as above
from pettingzoo.utils.wrappers import OrderEnforcingWrapper  # type: ignore[import-untyped]  # as above

from dual_ur10.envs.api.two_agents import AgentSplitter, agent_action, agent_spaces, check_options, joint_action
from dual_ur10.envs.core.ends import TIME
from dual_ur10.envs.core.options import MOVE_TO_START, check_count, take_consent
from dual_ur10.errors import ActionError, ResetNeededError
from ur_core.kinematics.ur10 import ARMS
from ur_core.types import Array

if TYPE_CHECKING:
    from dual_ur10.envs.core.core import Agents, Core, Step

_LEFT, _RIGHT = ARMS


class DualArmParallelEnv(ParallelEnv[str, Array, NDArray[Any]]):  # type: ignore[misc]  # PettingZoo has no types
    """Two UR10s and a task, for two agents, `left` and `right`, that act at the same time.

    Each agent observes its arm's half of the observation of both. Its action has 6 numbers, 7 where there are grippers.
    Both agents' episodes end together. The same seed and the same actions
    give the results of `dual_ur10.envs.api.dual_arm_env.DualArmEnv`, in every bit.

    Each agent's info holds the numbers of that of `DualArmEnv`; of a value of each arm (`q_rad`, `flange_m`, and those
    that `Task.per_arm` names) it is the agent's own part. `reward/<term>` are the terms of the agent's reward. After a
    reset the keys are the same, because libraries make tensors of them, and rewards are 0. All else, such as
    `end_reason`, `safety` and `randomization`, is in the attribute `info`.

    Args:
        task: Id of the environment, or a shorter name.
        render_mode: None, "rgb_array" or "human".
        reward: "shared": the reward of both together; "individual": each agent's own, whose mean that is;
            "sparse": that of the success of both.
        max_cycles: Steps after which episodes are truncated; None: only the task ends them.
        **keywords: Keywords of every environment, `dual_ur10.envs.core.options.EnvOptions`, and of the task. Pixels are
            not observed.

    Raises:
        SettingsError: A value is not legal; or one of its subclasses.
        UnknownNameError: A task, keyword, reward or other name does not exist.
    """

    metadata: dict[str, Any] = {  # noqa: RUF012  # as PettingZoo declares it
        "name": "DualUR10",
        "render_modes": ["rgb_array", "human"],
        "is_parallelizable": True,
        "render_fps": 25,
    }

    def __init__(
        self,
        task: str,
        *,
        render_mode: str | None = None,
        reward: str = "shared",
        max_cycles: int | None = None,
        **keywords: Any,
    ) -> None:
        from dual_ur10.envs.api.dual_arm_env import DualArmEnv, info_of, numbers_of  # loads MuJoCo

        keywords = check_options(reward, keywords)
        check_count("max_cycles", max_cycles, optional=True)
        self._env = DualArmEnv(task, render_mode=render_mode, **keywords)
        self._info_of, self._numbers_of = info_of, numbers_of
        self.render_mode, self.max_cycles = render_mode, max_cycles
        self.metadata = {**type(self).metadata, **self._env.metadata, "name": self._env.core.setup.env_id}
        self.possible_agents = list(ARMS)
        self.agents: list[str] = []
        core = self._env.core
        core.keeps_start = True  # the infos of a reset have all keys
        observation, action = agent_spaces(core)
        self.observation_spaces: dict[str, spaces.Space[Array]] = dict(zip(ARMS, observation, strict=True))
        self.action_spaces: dict[str, spaces.Space[NDArray[Any]]] = dict(zip(ARMS, action, strict=True))
        self.state_space: spaces.Box = core.observation_space
        self._shape = action[0].shape
        self._splitter = AgentSplitter(core, reward)
        self._agents: Agents | None = None
        self._cycles = 0
        self._begun: dict[str, Any] = {}
        self._step: Step | None = None

    def __repr__(self) -> str:
        return f"{type(self).__name__}({self.core})"

    @property
    def info(self) -> dict[str, Any]:
        """Info of the last step or reset as `dual_ur10.envs.api.dual_arm_env.DualArmEnv` returns it."""
        return dict(self._begun) if self._step is None else self._info_of(self._step)

    @property
    def core(self) -> Core:
        """Stepping core."""
        return self._env.core

    @property
    def task(self) -> Any:
        """Task object."""
        return self._env.task

    @property
    def viewer(self) -> Any:
        """Viewer of `render_mode="human"`; see `dual_ur10.envs.api.dual_arm_env.DualArmEnv.viewer`."""
        return self._env.viewer

    def observation_space(self, agent: str) -> spaces.Space[Array]:
        """Return the space of an agent's observations, `Box((size,), observation_dtype)`."""
        return self.observation_spaces[agent]

    def action_space(self, agent: str) -> spaces.Space[NDArray[Any]]:
        """Return the space of an agent's actions, `Box((6,), float32)`, or (7,) with a gripper."""
        return self.action_spaces[agent]

    def reset(
        self, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[dict[str, Array], dict[str, dict[str, Any]]]:
        """Begin an episode; see `pettingzoo.ParallelEnv.reset`.

        Args:
            seed: Seed of this and all following episodes; None: the generator continues.
            options: `{"move_to_start": True}` as for `DualArmEnv`. PettingZoo's own checks pass another one, hence only
                a warning of unknown ones.

        Returns:
            Observation and info of each agent.
        """
        others = dict(options or {})
        consent = take_consent(others)
        if others:
            gym.logger.warn(
                f"reset takes the option {MOVE_TO_START!r} alone, {sorted(others)} is ignored: set keywords "
                "when making the environment"
            )
        self.agents = []  # after a failed reset, the episode must begin again
        _, self._begun = self._env.reset(seed=seed, options={MOVE_TO_START: consent})
        self._cycles, self._step = 0, None
        self.agents = list(ARMS)
        info = {name: value.copy() for name, value in self._begun.items() if isinstance(value, np.ndarray)}
        left, right = self._splitter.infos(info | self._numbers_of(self.core.initial_info()))
        return self._observations(self._env.core.agents), {_LEFT: left, _RIGHT: right}

    def _observations(self, agents: Agents) -> dict[str, Array]:
        self._agents = agents
        own = agents.observations
        return {_LEFT: own[0, 0], _RIGHT: own[0, 1]}

    def step(
        self, actions: Mapping[str, NDArray[Any]]
    ) -> tuple[dict[str, Array], dict[str, float], dict[str, bool], dict[str, bool], dict[str, dict[str, Any]]]:
        """Advance one policy period; see `pettingzoo.ParallelEnv.step`.

        Args:
            actions: The action of each agent, in any order.

        Returns:
            Observation, reward, termination, truncation and info of each agent. After the end of an
            episode `agents` is empty.

        Raises:
            ActionError: An action is missing, belongs to no agent, is malformed, or holds NaN or infinity. Nothing has
                moved.
            ResetNeededError: There was no reset yet, or the episode has ended.
        """
        if not self.agents:
            raise ResetNeededError(
                "step was called without a running episode: call reset() first, and again when `agents` is empty"
            )
        try:
            joint = joint_action(actions, self._shape)
        except ActionError as error:
            self._env.core.stop(f"the policy's action was refused: {error}")
            raise
        step = self._env.advance(joint)
        terminated, truncated = bool(step.terminated[0]), bool(step.truncated[0])
        self._cycles += 1
        if self.max_cycles is not None and self._cycles >= self.max_cycles:
            truncated = True
            step = step._replace(ends={0: TIME, **step.ends})
            self._env.core.finish()
        if terminated or truncated:
            self.agents = []
        self._step, agents, info = step, step.agents, self._numbers_of(step.info)
        if self._splitter.individual:
            left, right = self._splitter.infos(info, cast("Array", agents.terms)[0])
            first, second = agents.rewards[0].tolist()
        else:
            left, right = self._splitter.infos(info)
            first = second = float(step.reward[0])
        return (
            self._observations(agents),
            {_LEFT: first, _RIGHT: second},
            {_LEFT: terminated, _RIGHT: terminated},
            {_LEFT: truncated, _RIGHT: truncated},
            {_LEFT: left, _RIGHT: right},
        )

    def check(self, arm: str, action: object) -> NDArray[Any]:
        """Return an agent's action as an array.

        Raises:
            ActionError: It has the wrong shape, or holds no numbers. `step` checks that they are finite.
        """
        return agent_action(arm, action, self._shape)

    def state(self) -> Array:
        """Return the state for a centralised critic: the observation of both arms together, in `state_space`.

        Raises:
            ResetNeededError: There was no reset yet.
        """
        if self._agents is None:
            raise ResetNeededError("state was called before the first reset: call reset() first")
        state: Array = self._agents.joint[0]
        return state

    def render(self) -> NDArray[np.uint8] | None:
        """Render the scene; see `dual_ur10.envs.api.dual_arm_env.DualArmEnv.render`.

        Raises:
            RenderError: No OpenGL backend was found, or for "human" neither a display nor MuJoCo's web viewer.
        """
        return self._env.render()

    def close(self) -> None:
        """Release simulation and viewer. May be called twice."""
        self._env.close()


class _CheckedAec(parallel_to_aec_wrapper[str, Array, NDArray[Any]]):  # type: ignore[misc]  # PettingZoo has no types
    """PettingZoo's conversion that refuses a malformed action when its agent acts; the agent may act again."""

    def step(self, action: NDArray[Any] | None) -> None:
        """Take the action of the selected agent, None where its episode has ended."""
        agent = self.agent_selection
        over = self.terminations[agent] or self.truncations[agent]
        if not over and not np.isfinite(self.env.check(agent, action)).all():
            raise ActionError(f"the action of {agent!r} must be finite, found {action}. Nothing was sent")
        super().step(action)


def parallel_env(task: str, **keywords: Any) -> DualArmParallelEnv:
    """Return a PettingZoo environment in which both agents act at the same time.

    Args:
        task: Id of the environment, or a shorter name: "Handover", "Handover-v0" or "DualUR10/Handover-v0".
        **keywords: Keywords of `DualArmParallelEnv`.

    Raises:
        UnknownNameError: There is no such environment, or no such keyword.
    """
    return DualArmParallelEnv(task, **keywords)


def aec_env(task: str, **keywords: Any) -> AECEnv[str, Array, NDArray[Any] | None]:
    """Return a PettingZoo environment in which the agents alternate, `left` first; the arms move once both have acted.

    Args:
        task: As for `parallel_env`.
        **keywords: Keywords of `DualArmParallelEnv`.

    Raises:
        UnknownNameError: There is no such environment, or no such keyword.
    """
    return OrderEnforcingWrapper(_CheckedAec(parallel_env(task, **keywords)))
