"""Common parts of the interfaces for two agents: spaces, actions, rewards and infos as views on the core."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any, Literal, get_args

import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray

from dual_ur10.errors import ActionError, SettingsError, UnknownNameError
from ur_core.kinematics.ur10 import ARMS
from ur_core.types import Array

if TYPE_CHECKING:
    from dual_ur10.envs.core.core import Core

_LEFT, _RIGHT = ARMS

RewardKind = Literal["shared", "individual", "sparse"]
"""Reward of an agent: "shared", that of both together; "individual", its own, whose mean that is; or
"sparse", that of the environment's `reward="sparse"`, shared."""


def check_options(reward: str, keywords: Mapping[str, Any]) -> dict[str, Any]:
    """Check the options of an environment of two agents, and return the keywords of its cells.

    Raises:
        UnknownNameError: `reward` is no `RewardKind`.
        SettingsError: The keywords ask for pixels.
    """
    if reward not in get_args(RewardKind):
        raise UnknownNameError("reward", str(reward), get_args(RewardKind))
    if keywords.get("observation") in ("pixels", "both", "flat"):
        raise SettingsError(
            f"observation is {keywords['observation']!r}: two agents observe numbers only, observation='state' or "
            "'goals'. For pixel observations use gym.make, for images of the scene render_mode='rgb_array'"
        )
    return {**keywords, **({"reward": reward} if reward == "sparse" else {})}


def agent_spaces(core: Core) -> tuple[list[Any], list[Any]]:
    """Return the observation spaces and the action spaces of the agents, each a `gymnasium.spaces.Box`."""
    observation, action = map(_halves, (core.observation_space, core.action_space))
    return observation, action


def _halves(both: spaces.Box) -> list[Any]:
    """Return the space of each arm's half of an array."""
    dtype: Any = both.dtype
    bounds = zip(both.low.reshape(2, -1), both.high.reshape(2, -1), strict=True)
    return [spaces.Box(low, high, dtype=dtype.type) for low, high in bounds]


def joint_action(actions: object, shape: tuple[int, ...]) -> NDArray[Any]:
    """Return the action of both arms from those of the agents, each of a shape.

    Raises:
        ActionError: One is missing, belongs to no agent, or is malformed.
    """
    if type(actions) is not dict and not isinstance(actions, Mapping):
        raise ActionError(
            f"actions must be a dict with an action for each of {list(ARMS)}, found {type(actions).__name__}"
        )
    if len(actions) != 2 or _LEFT not in actions or _RIGHT not in actions:
        missing = [arm for arm in ARMS if arm not in actions]
        extra = [agent for agent in actions if agent not in ARMS]
        faults = [f"{what} {names}" for what, names in (("without", missing), ("with unknown", extra)) if names]
        raise ActionError(
            f"actions must hold one for each of {list(ARMS)}, found them {' and '.join(faults)}. Nothing was sent"
        )
    return np.concatenate([agent_action(arm, actions[arm], shape) for arm in ARMS])


def agent_action(arm: str, action: object, shape: tuple[int, ...]) -> NDArray[Any]:
    """Return an agent's action as an array of a shape.

    Raises:
        ActionError: It has another shape, or holds no numbers.
    """
    try:
        array = np.asarray(action)
    except (TypeError, ValueError) as error:
        raise ActionError(f"the action of {arm!r} must be numbers: {error}. Nothing was sent") from None
    if array.dtype.kind not in "fiu" or array.shape != shape:
        raise ActionError(
            f"the action of {arm!r} must be numbers of shape {shape}, found {array.dtype} of shape {array.shape}. "
            "Nothing was sent"
        )
    return array


class AgentSplitter:
    """Splitter of a cell's reward and info into those of its two agents.

    Args:
        core: Core of the environment.
        reward: A `RewardKind`.
    """

    def __init__(self, core: Core, reward: str) -> None:
        self.individual = reward == "individual"
        self._terms = [f"reward/{name}" for name in core.weights]
        self._per_arm = core.per_arm

    def infos(self, info: dict[str, Any], terms: Array | None = None) -> tuple[dict[str, Any], dict[str, Any]]:
        """Return each agent's info, from that of its cell.

        Of a value that the task states for each arm, each agent gets its own part; other values go to both.

        Args:
            info: As `dual_ur10.envs.api.dual_arm_env.DualArmEnv` returns it. It becomes that of the left agent.
            terms: (2, terms) reward terms of each agent: with "individual" they replace those of both together, so
                that `reward/<term>` are always the terms of the agent's reward. None: there was no step.
        """
        left, right = info, info.copy()
        for name in self._per_arm:
            if name in info:
                value = info[name]
                left[name], right[name] = value[0], value[1]
        if self.individual and terms is not None:
            for agent, values in zip((left, right), terms.tolist(), strict=True):
                agent.update(zip(self._terms, values, strict=True))
        return left, right
