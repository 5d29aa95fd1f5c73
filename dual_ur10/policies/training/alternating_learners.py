"""Two independent learners in one environment: each has a view of its own arm, and they alternate."""

from __future__ import annotations

import threading
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from dual_ur10.envs.api.sb3_bridge import TwoAgentVecEnv
from dual_ur10.errors import MissingExtraError
from ur_core.kinematics.ur10 import ARMS

try:
    from stable_baselines3.common.vec_env import VecEnv
except ImportError as error:
    raise MissingExtraError("stable-baselines3", "train", "training") from error


class LearnersEnded(BaseException):
    """The other learner has ended, or the training was interrupted. Not an `Exception`: no learner handles it."""


class AlternatingLearners:
    """Scheduler that runs the learners of the left and the right arm alternately, each in a thread.

    Each learner steps a view of its own arm. The cells step when both have given their actions. Only one learner runs
    at any instant, so the result is reproducible.

    Args:
        env: Vector environment of both agents.

    Attributes:
        sides: Views of left and right.
    """

    def __init__(self, env: TwoAgentVecEnv) -> None:
        self.env = env
        self.sides = [ArmVecEnv(self, k) for k in (0, 1)]
        self._condition = threading.Condition()
        self._running, self._over = 0, False
        self._ended = [False, False]
        self._asked: list[Any] = [None, None]
        self._given: list[Any] = [None, None]

    def run(self, learners: Sequence[Callable[[], None]]) -> None:
        """Run both learners to their end.

        Raises:
            BaseException: As raised by a learner, or an interrupt of this thread. Both learners have ended then.
        """
        self._running, self._over, self._ended = 0, False, [False, False]
        self._asked, self._given = [None, None], [None, None]
        raised: list[BaseException] = []

        def work(side: int, learner: Callable[[], None]) -> None:
            try:
                self._wait(side)
                learner()
            except LearnersEnded:
                pass
            except BaseException as error:  # handed on below
                raised.append(error)
                self._end()
            finally:
                with self._condition:
                    self._ended[side] = True
                    self._running = 1 - side
                    self._condition.notify_all()

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
        with self._condition:
            self._over = True
            self._condition.notify_all()

    def _wait(self, side: int) -> None:
        with self._condition:
            self._condition.wait_for(lambda: self._over or self._running == side)
            if self._over:
                raise LearnersEnded

    def exchange(self, side: int, ask: NDArray[Any] | None) -> Any:
        """Step one side with these actions, or reset it (None), and return the result; the other runs meanwhile."""
        other = 1 - side
        self._asked[side] = ("reset",) if ask is None else ("step", ask)
        if self._ended[other]:
            raise LearnersEnded
        if self._asked[other] is not None:
            self._move()
        with self._condition:
            self._running = other
            self._condition.notify_all()
        self._wait(side)
        if self._given[side] is None:
            raise LearnersEnded  # the other has ended
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


class ArmVecEnv(VecEnv):
    """View of one arm's rows.

    Args:
        learners: Scheduler of both arms.
        index: 0 for left, 1 for right.
    """

    def __init__(self, learners: AlternatingLearners, index: int) -> None:
        self._learners, self._index = learners, index
        self._actions: NDArray[Any] | None = None
        env = learners.env
        super().__init__(env.num_envs // 2, env.observation_space, env.action_space)

    def reset(self) -> Any:
        """Begin new episodes as soon as the other side does."""
        return self._learners.exchange(self._index, None)

    def step_async(self, actions: NDArray[Any]) -> None:
        """Take the actions of this arm, (n, size)."""
        self._actions = np.array(actions)

    def step_wait(self) -> Any:
        """Wait for the other side's actions, and return observations, rewards, ends and infos of the step."""
        return self._learners.exchange(self._index, self._actions)

    def seed(self, seed: int | None = None) -> Sequence[int | None]:
        """Seed the cells. Both sides share their seeds: the first call counts."""
        return self._learners.env.seed(seed)[::2]

    def close(self) -> None:
        """Do nothing: the owner of the cells closes them."""

    def get_attr(self, attr_name: str, indices: Any = None) -> list[Any]:
        """Return an attribute that all rows share."""
        return self._learners.env.get_attr(attr_name, None)[: len(list(self._get_indices(indices)))]

    def set_attr(self, attr_name: str, value: Any, indices: Any = None) -> None:
        """Set an attribute that all rows share."""
        self._learners.env.set_attr(attr_name, value, None)

    def env_method(self, method_name: str, *method_args: Any, indices: Any = None, **method_kwargs: Any) -> list[Any]:
        """Call a method that all rows share, once."""
        return self._learners.env.env_method(method_name, *method_args, **method_kwargs)[::2]

    def env_is_wrapped(self, wrapper_class: Any, indices: Any = None) -> list[bool]:
        """Return False for each row: no single row is ever wrapped."""
        return [False] * len(list(self._get_indices(indices)))
