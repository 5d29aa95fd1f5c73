"""Two learners in one environment, which know nothing of each other: each has its own view, and they take turns."""

from __future__ import annotations

import threading
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from dual_ur10.envs.api.sb3_bridge import TwoAgentVecEnv
from dual_ur10.errors import MissingExtraError
from dual_ur10.kinematics.ur10 import ARMS

try:
    from stable_baselines3.common.vec_env import VecEnv
except ImportError as error:
    raise MissingExtraError("stable-baselines3", "train", "training") from error


class TurnsOver(BaseException):
    """The other learner has ended, or the training was interrupted. Not an `Exception`: no learner handles it."""


class Turns:
    """Lets the learners of the left and of the right arm run in turns, one at a time.

    Each thinks that it steps an environment of its own. The cells move when both have said what to do, and only one of
    them runs at any instant, so what comes out is the same every time.

    Args:
        env: The cells.

    Attributes:
        sides: Views of left and right, `stable_baselines3.common.vec_env.VecEnv` each.
    """

    def __init__(self, env: TwoAgentVecEnv) -> None:
        self.env = env
        self.sides = [Side(self, k) for k in (0, 1)]
        self._turn = threading.Condition()
        self._whose, self._over = 0, False
        self._ended = [False, False]
        self._asked: list[Any] = [None, None]
        self._given: list[Any] = [None, None]

    def run(self, learners: Sequence[Callable[[], None]]) -> None:
        """Run both learners to their end.

        Raises:
            BaseException: What a learner raises, or what interrupts this one. Both have ended then.
        """
        self._whose, self._over, self._ended = 0, False, [False, False]
        self._asked, self._given = [None, None], [None, None]
        raised: list[BaseException] = []

        def work(side: int, learner: Callable[[], None]) -> None:
            try:
                self._wait(side)
                learner()
            except TurnsOver:
                pass
            except BaseException as error:  # handed on below
                raised.append(error)
                self._end()
            finally:
                with self._turn:
                    self._ended[side] = True
                    self._whose = 1 - side
                    self._turn.notify_all()

        threads = [
            threading.Thread(target=work, args=(k, learner), name=f"learner-{ARMS[k]}", daemon=True)
            for k, learner in enumerate(learners)
        ]
        for thread in threads:
            thread.start()
        try:
            for thread in threads:
                while thread.is_alive():
                    thread.join(0.1)  # so that Ctrl-C is noticed
        finally:
            self._end()
            for thread in threads:
                thread.join()
        if raised:
            raise raised[0]

    def _end(self) -> None:
        with self._turn:
            self._over = True
            self._turn.notify_all()

    def _wait(self, side: int) -> None:
        with self._turn:
            self._turn.wait_for(lambda: self._over or self._whose == side)
            if self._over:
                raise TurnsOver

    def exchange(self, side: int, ask: NDArray[Any] | None) -> Any:
        """What comes of a step with these actions, or of a reset (None), for one side; the other runs meanwhile."""
        other = 1 - side
        self._asked[side] = ("reset",) if ask is None else ("step", ask)
        if self._ended[other]:
            raise TurnsOver
        if self._asked[other] is not None:
            self._move()
        with self._turn:
            self._whose = other
            self._turn.notify_all()
        self._wait(side)
        if self._given[side] is None:
            raise TurnsOver  # the other has ended without a word
        given, self._given[side] = self._given[side], None
        return given

    def _move(self) -> None:
        kinds = {each[0] for each in self._asked}
        if kinds == {"reset"}:
            observation = self.env.reset()
            self._given = [observation[0::2], observation[1::2]]
            for k, side in enumerate(self.sides):
                side.reset_infos = self.env.reset_infos[k::2]
        elif kinds == {"step"}:
            actions = np.stack([self._asked[0][1], self._asked[1][1]], axis=1)
            self.env.step_async(actions.reshape(-1, actions.shape[-1]))
            observation, reward, over, infos = self.env.step_wait()
            self._given = [(observation[k::2], reward[k::2], over[k::2], infos[k::2]) for k in (0, 1)]
            for k, side in enumerate(self.sides):
                side.reset_infos = self.env.reset_infos[k::2]
        else:
            raise RuntimeError("one learner resets where the other one steps: they must have the same settings")
        self._asked = [None, None]


class Side(VecEnv):
    """The rows of one arm.

    Args:
        turns: That it belongs to.
        index: 0 left, 1 right.
    """

    def __init__(self, turns: Turns, index: int) -> None:
        self._turns, self._index = turns, index
        self._actions: NDArray[Any] | None = None
        env = turns.env
        super().__init__(env.num_envs // 2, env.observation_space, env.action_space)

    def reset(self) -> Any:
        """Begin new episodes, as soon as the other side wants to."""
        return self._turns.exchange(self._index, None)

    def step_async(self, actions: NDArray[Any]) -> None:
        """Take the actions of this arm, (n, size)."""
        self._actions = np.array(actions)

    def step_wait(self) -> Any:
        """One control period, as soon as the other side wants it: observations, rewards, ends and infos."""
        return self._turns.exchange(self._index, self._actions)

    def seed(self, seed: int | None = None) -> Sequence[int | None]:
        """Both sides share the seeds of their cells: the first one given counts."""
        return self._turns.env.seed(seed)[::2]

    def close(self) -> None:
        """The cells belong to both sides: whoever made them closes them."""

    def get_attr(self, attr_name: str, indices: Any = None) -> list[Any]:
        """An attribute that all rows share."""
        return self._turns.env.get_attr(attr_name, None)[: len(list(self._get_indices(indices)))]

    def set_attr(self, attr_name: str, value: Any, indices: Any = None) -> None:
        """Set an attribute that all rows share."""
        self._turns.env.set_attr(attr_name, value, None)

    def env_method(self, method_name: str, *method_args: Any, indices: Any = None, **method_kwargs: Any) -> list[Any]:
        """Call a method that all rows share, once."""
        return self._turns.env.env_method(method_name, *method_args, **method_kwargs)[::2]

    def env_is_wrapped(self, wrapper_class: Any, indices: Any = None) -> list[bool]:
        """Rows are never wrapped one by one."""
        return [False] * len(list(self._get_indices(indices)))
