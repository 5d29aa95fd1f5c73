"""The dm_env environment: a view on the Gymnasium environment, one agent for both arms."""

from __future__ import annotations

from types import SimpleNamespace
from typing import TYPE_CHECKING, Any, cast

import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray

from dual_ur10.envs.core.options import MOVE_TO_START
from dual_ur10.errors import MissingExtraError, ResetNeededError

try:
    from dm_env import (  # type: ignore[import-untyped]  # has no types
        Environment,
        TimeStep,
        restart,
        specs,
        termination,
        transition,
        truncation,
    )
except ImportError:
    raise MissingExtraError("dm-env", "dm", "dm_env's interface") from None


if TYPE_CHECKING:
    from dual_ur10.envs.api.dm_physics import DmPhysics


class DualArmDmEnv(Environment):  # type: ignore[misc]  # the package dm_env has no types
    """Two UR10s and a task behind dm_env's interface.

    An episode that the safety gate, the physics or the task ends has discount 0 at its last step; one whose time runs
    out keeps 1. A step after the last one begins the next episode, whatever its action; on two controllers it is an
    error, because a reset moves the arms and needs the consent of its caller. Steps equal those of
    `dual_ur10.envs.api.dual_arm_env.DualArmEnv` bit for bit.

    `dm_control.viewer` and the wrappers of `dm_control.suite` take it, for which it has `physics` and `task`.

    Attributes:
        env: The Gymnasium environment.
        info: `info` of its last step or reset.
        task: Has the generator `random`, by which dm_control's wrappers sample; episodes do not depend on it.

    Args:
        task: Id of the environment, or a shorter name.
        seed: Seed of all episodes; None: from entropy of the machine.
        **keywords: Keywords of `DualArmEnv`.

    Raises:
        SettingsError: A value is not legal; or one of its subclasses.
        UnknownNameError: A task, keyword or other name does not exist.
    """

    def __init__(self, task: str, *, seed: int | None = None, **keywords: Any) -> None:
        from dual_ur10.envs.api.dual_arm_env import DualArmEnv  # loads MuJoCo

        self.env = DualArmEnv(task, **keywords)
        self.info: dict[str, Any] = {}
        self.task = SimpleNamespace(random=np.random.RandomState(seed))
        self._physics: DmPhysics | None = None
        self._seed, self._over = seed, True

    def __repr__(self) -> str:
        return f"{type(self).__name__}({self.env.core})"

    def reset(self, *, move_to_start: bool = False) -> TimeStep:
        """Begin an episode. The first one is sampled from the seed, and later ones with the same generator.

        Args:
            move_to_start: Consent to the motion of the arms on two controllers, as for `DualArmEnv`.

        Raises:
            ResetRefusedError: On two controllers, a later reset was called without consent. Nothing has moved.
        """
        self._over = True  # after a failure from here on, the episode must begin again
        observation, self.info = self.env.reset(seed=self._seed, options={MOVE_TO_START: move_to_start})
        self._seed, self._over = None, False
        self._show()
        return restart(observation)

    def step(self, action: NDArray[Any]) -> TimeStep:
        """Advance one policy period, or begin an episode where none is running.

        Raises:
            ActionError: The action is malformed. Nothing has moved.
            ResetNeededError: No episode is running, on two controllers. Nothing has moved.
        """
        if self._over:
            if self.env.core.config.controllers:
                raise ResetNeededError(
                    "no episode is running, and on a cell of controllers none begins by itself: call reset() first"
                )
            return self.reset()
        observation, reward, terminated, truncated, self.info = self.env.step(action)
        self._over = terminated or truncated
        self._show()
        if terminated:
            return termination(reward, observation)
        return truncation(reward, observation) if truncated else transition(reward, observation)

    def observation_spec(self) -> Any:
        """Return a `BoundedArray`, or a dict of them by name where pixels are observed."""
        return _spec(self.env.observation_space, "observation")

    def action_spec(self) -> Any:
        """Return a `BoundedArray`: the numbers of the left arm, then those of the right one."""
        return _spec(self.env.action_space, "action")

    @property
    def physics(self) -> DmPhysics:
        """The scene as it is drawn, for dm_control's viewer and wrappers. Only the simulation changes it."""
        if self._physics is None:
            from dual_ur10.envs.api.dm_physics import DmPhysics  # loads what draws

            self._physics = DmPhysics(lambda: self.env.core.cell_data(0))
        return self._physics

    def _show(self) -> None:
        if self._physics is not None:
            self._physics.update()

    def close(self) -> None:
        """Release the simulation. May be called twice."""
        if self._physics is not None:
            self._physics.close()
        self.env.close()


def _spec(space: spaces.Space[Any], name: str) -> Any:
    if isinstance(space, spaces.Dict):
        return {key: _spec(each, key) for key, each in space.items()}
    box = cast("spaces.Box", space)
    return specs.BoundedArray(box.shape, box.dtype, box.low, box.high, name)


def dm_env(task: str, **keywords: Any) -> DualArmDmEnv:
    """Return an environment behind dm_env's interface.

    Args:
        task: Id of the environment, or a shorter name: "Handover", "Handover-v0" or "DualUR10/Handover-v0".
        **keywords: Keywords of `DualArmDmEnv`.

    Raises:
        UnknownNameError: There is no such environment, or no such keyword.
    """
    return DualArmDmEnv(task, **keywords)
