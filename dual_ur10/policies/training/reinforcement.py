"""Reinforcement learning: PPO and SAC of Stable-Baselines3 on the vector environment."""

from __future__ import annotations

import dataclasses
import math
import time
from collections import deque
from pathlib import Path
from typing import Any, Final

import numpy as np

from dual_ur10.envs.api.sb3_bridge import CellsVecEnv, JointVecEnv, TwoAgentVecEnv
from dual_ur10.errors import MissingExtraError, TrainingError
from dual_ur10.policies.learned.from_sb3 import converted
from dual_ur10.policies.learned.manifest import Manifest
from dual_ur10.policies.learned.signature import view_of
from dual_ur10.policies.training import models
from dual_ur10.policies.training.alternating_learners import AlternatingLearners
from dual_ur10.policies.training.folder import Saved, TrainingFolder, initial_policy
from dual_ur10.policies.training.progress import OnProgress, Progress
from dual_ur10.policies.training.regression import reproducible
from dual_ur10.policies.training.settings import Reinforcement, first_seed_of
from dual_ur10.policies.training.state import Tensors

try:
    from stable_baselines3.common.callbacks import BaseCallback
except ImportError as error:
    raise MissingExtraError("stable-baselines3", "train", "training") from error

_SHOWN_S: Final = 0.5
_CHECKS: Final = 20  # of the progress, in a training
_RECENT: Final = 100  # episodes


class Reinforcer:
    """Learner by trial and error.

    Args:
        folder: Folder of the training.
        state: Tensors and values to continue from; None: begin.
        on_progress: Callback with the progress.
        threads: Threads that step the cells.

    Attributes:
        steps: Environment steps so far.
    """

    def __init__(
        self,
        folder: TrainingFolder,
        state: tuple[Tensors, Saved] | None = None,
        on_progress: OnProgress = lambda progress: None,
        threads: int | None = None,
    ) -> None:
        self._folder, self._asked, self._threads = folder, folder.training, threads
        if not isinstance(self._asked.settings, Reinforcement):
            raise TrainingError(f"{self._asked.algorithm} is no reinforcement learning")
        # An update is no longer than the training, and PPO needs two samples.
        most = max(math.ceil(self._asked.steps / self._asked.envs), math.ceil(2 / self._asked.envs))
        per_update = min(self._asked.settings.steps_per_update, most)
        self._settings: Reinforcement = dataclasses.replace(self._asked.settings, steps_per_update=per_update)
        view = view_of(self._asked.env_id, self._asked.keywords)
        self._grippers = view.signature.actions.gripper * (view.signature.action.shape[0] // 2)
        self._blind = view.indices(self._settings.unseen, joint=self._asked.agents == "joint")
        self._state, self._on_progress = state, on_progress
        self.steps = 0 if state is None else state[1].steps
        self._models: list[tuple[Any, Any]] = []
        self._begun = time.monotonic() - folder.seconds
        self._first_steps, self._first_s = self.steps, time.monotonic()
        self._returns: deque[float] = deque(maxlen=_RECENT)
        self._successes: deque[float] = deque(maxlen=_RECENT)
        self._shown_s, self._due = 0.0, self._next_check()

    def run(self) -> Path:
        """Train, and return the folder of the resulting checkpoint: the best one of all progress checks.

        Raises:
            TrainingError: Something cannot be saved or restored, or the training diverged.
            KeyboardInterrupt: The training was interrupted. Everything learned so far is saved.
        """
        asked = self._asked
        task, given = asked.env_id, {"max_episode_steps": self._settings.episode_steps, **asked.keywords}
        given["staggered"] = given["max_episode_steps"] is not None
        env: CellsVecEnv
        if asked.agents == "joint":
            env = JointVecEnv(task, asked.envs, threads=self._threads, **given)
        else:
            # "reward" of a keyword is the environment's, dense or sparse; that of the settings is an arm's.
            reward = "sparse" if given.pop("reward", None) == "sparse" else self._settings.reward
            env = TwoAgentVecEnv(task, asked.envs, reward=reward, threads=self._threads, **given)
        try:
            # A resumed training samples new episodes.
            seed = int(np.random.SeedSequence([asked.seed, self.steps]).generate_state(1)[0])
            env.seed(first_seed_of(asked.seed) + self.steps)
            with reproducible(seed):
                self._learn(env, seed)
        finally:
            env.close()
        return self._finish()

    def _learn(self, env: CellsVecEnv, seed: int) -> None:
        asked = self._asked
        alternating = (
            AlternatingLearners(env) if asked.agents == "independent" and isinstance(env, TwoAgentVecEnv) else None
        )
        rows = [env] if alternating is None else alternating.sides
        self._models = [
            models.make(asked.algorithm, each, self._settings, seed % 2**31, self._share, self._blind) for each in rows
        ]
        # `make` seeds the environment with the model's seed, but episodes have their own.
        env.seed(first_seed_of(asked.seed) + self.steps)
        if self._state is not None:
            for k, (model, around) in enumerate(self._models):
                models.restore(model, around, f"{k}.", self._state[0])
        elif asked.init:
            models.begin_with(self._models, initial_policy(asked, view_of(asked.env_id, asked.keywords)))
            # What it began with is the result unless it becomes better.
            self._check()
        for k, (model, _) in enumerate(self._models):
            model.set_logger(self._folder.logger if k == 0 else _silent())
        per_step = 1 if asked.agents == "joint" or alternating is not None else 2
        left = (asked.steps - self.steps) * per_step

        def learner(k: int) -> None:
            callback = _Watcher(self, per_step) if k == 0 else _Explorer(self)
            self._models[k][0].learn(left, callback=callback, reset_num_timesteps=True)

        try:
            if alternating is None:
                learner(0)
            else:
                alternating.run([lambda: learner(0), lambda: learner(1)])
        except KeyboardInterrupt:
            self.save()
            raise
        except ValueError as error:  # of torch, which refuses distributions with NaN
            if self._finite:
                raise
            raise TrainingError(
                f"the training diverged after {self.steps} steps; whatever was saved before is unchanged. Try a "
                f"smaller learning_rate, found {self._settings.learning_rate:g}"
            ) from error
        self.save()

    def _share(self) -> float:
        return min(1.0, self.steps / self._asked.steps)

    def explore(self, model: Any) -> None:
        """Set the width of a model's exploration; called before each rollout."""
        models.explore(model, self._settings, self._share(), self._grippers)

    def save(self) -> None:
        """Save a state from which the training can continue."""
        self._folder.save_state(self._tensors, time.monotonic() - self._begun, steps=self.steps)

    @property
    def _tensors(self) -> Tensors:
        found: Tensors = {}
        for k, (model, around) in enumerate(self._models):
            found.update(models.tensors_of(model, around, f"{k}."))
        return found

    @property
    def _finite(self) -> bool:
        return all(bool(np.isfinite(each).all()) for each in self._tensors.values())

    def _next_check(self) -> int:
        return self.steps + max(1, self._asked.steps // _CHECKS)

    def watch(self, infos: list[dict[str, Any]], steps: int) -> None:
        """Take the infos of a step of all cells; called by the first model."""
        self.steps = self._first_steps + steps
        for info in infos:
            episode = info.get("episode")
            if episode is not None:
                self._returns.append(float(episode["r"]))
                self._successes.append(float(info["is_success"]))
        now = time.monotonic()
        if now - self._shown_s > _SHOWN_S:
            self._shown_s = now
            rate = (self.steps - self._first_steps) / max(1e-9, now - self._first_s)
            self._on_progress(
                Progress(
                    self.steps,
                    self._asked.steps,
                    rate,
                    max(0.0, (self._asked.steps - self.steps) / rate) if rate else None,
                    float(np.mean(self._returns)) if self._returns else None,
                    float(np.mean(self._successes)) if self._successes else None,
                    "learning",
                )
            )

    def check_if_due(self) -> None:
        """Check the progress now and then, and save the state; called between rollout and update."""
        if self.steps < self._due:
            return
        self._due = self._next_check()
        self._check()
        self.save()

    def _check(self) -> None:
        networks = self._converted()[0]
        seconds = time.monotonic() - self._begun
        self._folder.check_progress(networks, lambda found: self._converted(found)[1], self.steps, seconds)

    def _converted(self, evaluation: dict[str, object] | None = None) -> tuple[Any, Manifest]:
        several = self._asked.agents == "independent"
        return converted(
            [model for model, _ in self._models] if several else self._models[0][0],
            self._asked.env_id,
            agents=self._asked.agents,  # type: ignore[arg-type]  # checked
            vec_normalize=[around for _, around in self._models] if several else self._models[0][1],
            training={**self._folder.summary(), "steps": self.steps},
            seed=self._asked.seed,
            evaluation=evaluation,
            **self._asked.keywords,
        )

    def _finish(self) -> Path:
        if not self._folder.checks or self._folder.checks[-1].steps < self.steps:
            self._check()
            self.save()
        return self._folder.finish()


class _Explorer(BaseCallback):
    """Callback of every model."""

    def __init__(self, reinforcer: Reinforcer) -> None:
        super().__init__()
        self._reinforcer = reinforcer

    def _on_rollout_start(self) -> None:
        self._reinforcer.explore(self.model)

    def _on_step(self) -> bool:
        return True


class _Watcher(_Explorer):
    """Callback of the first model."""

    def __init__(self, reinforcer: Reinforcer, per_step: int) -> None:
        super().__init__(reinforcer)
        self._per_step = per_step

    def _on_step(self) -> bool:
        self._reinforcer.watch(self.locals["infos"], self.num_timesteps // self._per_step)
        return True

    def _on_rollout_end(self) -> None:
        self._reinforcer.check_if_due()


def _silent() -> Any:
    from stable_baselines3.common.logger import Logger

    return Logger(None, [])
