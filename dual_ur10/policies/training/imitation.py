"""Behaviour cloning and DAgger: a network imitates the scripted policy.

DAgger (S. Ross, G. Gordon, D. Bagnell, "A Reduction of Imitation Learning and Structured Prediction to No-Regret Online
Learning", AISTATS 2011): the learner drives, the expert labels every observation with its own action, and a network is
fitted to all labels so far. Behaviour cloning is the first round alone.
"""

from __future__ import annotations

import math
import time
from collections.abc import Iterable
from pathlib import Path
from typing import Any, Final

import numpy as np

from dual_ur10.envs.api.vector_env import DualArmVectorEnv
from dual_ur10.envs.core.options import AS_ON_CONTROLLERS
from dual_ur10.errors import SettingsError, TrainingError
from dual_ur10.policies.learned.act_network import ActShape
from dual_ur10.policies.learned.learned_policy import LearnedPolicy
from dual_ur10.policies.learned.manifest import Manifest
from dual_ur10.policies.learned.network import NetworkShape, Normaliser
from dual_ur10.policies.learned.signature import EnvironmentView, view_of
from dual_ur10.policies.training import state
from dual_ur10.policies.training.dataset import read_dataset
from dual_ur10.policies.training.folder import Saved, TrainingFolder, initial_policy
from dual_ur10.policies.training.gather import Expert, Samples, gather
from dual_ur10.policies.training.progress import OnProgress, Progress, TimeLeft
from dual_ur10.policies.training.regression import Fit, Scatter, reproducible
from dual_ur10.policies.training.settings import Demonstrated, Imitation, first_seed_of
from dual_ur10.policies.training.state import Tensors
from ur_core.types import Single

_GATHER, _FIT, _INIT = range(3)  # streams of random numbers
_SHOWN_S: Final = 0.2
_FEWEST: Final = 4  # times the episodes of a round of DAgger are as many as the cells, at least


class DemonstrationLearner:
    """Learner of the scripted policy's actions, or of a dataset's. A subclass fits networks to the samples.

    Args:
        folder: Folder of the training.
        saved: Values of the state to continue from; None: begin.
        on_progress: Callback with the progress.
        threads: Threads that step the cells.
    """

    def __init__(
        self,
        folder: TrainingFolder,
        saved: Saved | None = None,
        on_progress: OnProgress = lambda progress: None,
        threads: int | None = None,
    ) -> None:
        self._folder, self._asked = folder, folder.training
        if not isinstance(self._asked.settings, Demonstrated):
            raise TrainingError(f"{self._asked.algorithm} does not imitate")
        self._demonstrated: Demonstrated = self._asked.settings
        self._threads = threads
        self._view: EnvironmentView = view_of(self._asked.env_id, self._asked.keywords)
        self._demonstrated_view = view_of(self._asked.env_id, self._asked.demonstrated)
        self._blind = self._indices(self._demonstrated.unseen)
        self._on_progress, self._shown_s = on_progress, 0.0
        self._progress = Progress(0, self._asked.steps)
        self._rounds, self._longest, self._gradient_steps = 0, 1, 0
        self._time_left = TimeLeft()
        self._samples: list[Samples] = []
        if saved is not None:
            self._rounds, self._longest, self._progress.steps = saved.rounds, saved.longest, saved.steps
            self._gradient_steps = saved.fitted
            self._samples = [self._load_samples(k) for k in range(self._rounds)]

    def run(self) -> Path:
        """Train, and return the folder of the resulting checkpoint.

        Raises:
            TrainingError: Something cannot be saved, or there is nothing to learn from.
            DatasetError: The dataset cannot be read or is of another environment.
            KeyboardInterrupt: The training was interrupted. Earlier rounds are saved.
        """
        begun = time.monotonic() - self._folder.seconds
        if self._asked.dataset and not self._samples:
            self._add(read_dataset(self._asked.dataset, self._demonstrated_view), begun)
        env = None
        try:
            while not self._has_all:
                if env is None:
                    env = DualArmVectorEnv(
                        self._asked.envs,
                        self._asked.env_id,
                        autoreset_mode="Disabled",
                        threads=self._threads,
                        **{**AS_ON_CONTROLLERS, **self._asked.demonstrated},
                    )
                if self._is_rest(env.task.horizon):
                    break
                self._round(env, begun)
        finally:
            if env is not None:
                env.close()
        self._fit(self._rounds, begun)
        return self._folder.finish()

    @property
    def _patience(self) -> float:
        return 0.0

    @property
    def _has_all(self) -> bool:
        """True if no more samples are needed. Only DAgger needs an expert beside a dataset."""
        if self._asked.algorithm != "dagger" and self._asked.dataset:
            return True
        if self._demonstrations:
            return self._rounds * self._asked.envs >= self._demonstrations
        return self._progress.steps >= self._asked.steps

    @property
    def _demonstrations(self) -> int:
        return 0 if self._asked.algorithm == "dagger" else self._demonstrated.demonstrations

    def _round(self, env: Any, begun: float) -> None:
        number, asked = self._rounds, self._asked
        learner, ratio = self._driver(number, begun)
        low, high = env.core.action_space.low, env.core.action_space.high
        before, start = self._progress.steps, time.monotonic()

        def on_step(steps: int) -> None:
            self._progress.steps = before + steps
            took_s = time.monotonic() - start
            self._progress.rate = steps / max(1e-9, took_s)
            self._time_left.gathered(steps, took_s)
            self._tell("gathering")

        first = first_seed_of(asked.seed) + number * asked.envs
        found = gather(
            env,
            Expert(asked.env_id, asked.envs, low, high, **asked.demonstrated),
            learner,
            range(first, first + asked.envs),
            expert_ratio=ratio,
            within=self._longest,
            noise=self._demonstrated.noise,
            patience=self._patience,
            rng=np.random.default_rng([asked.seed, number, _GATHER]),
            rows=self._rows_of_round(env.task.horizon),
            on_step=on_step,
        )
        if not len(found.observation):
            raise TrainingError("the scripted policy had no action in any step: there is nothing to learn from")
        self._longest = max(self._longest, found.longest)
        self._progress.mean_return = float(found.returns.mean())
        self._progress.success_rate = float(found.successes.mean())
        self._add(Samples(found.observation, found.action, found.episode, found.images), begun)

    def _driver(self, number: int, begun: float) -> tuple[LearnedPolicy | None, float]:
        """Return the policy that drives a round, None: the expert, and the ratio of episodes that the expert begins."""
        return None, 1.0

    def _rows_of_round(self, horizon: int | None) -> int:
        """Return the number of episodes of the next round: no more than are asked for, or the steps left allow."""
        if self._demonstrations:
            return min(self._asked.envs, self._demonstrations - self._rounds * self._asked.envs)
        left = self._asked.steps - self._progress.steps
        return self._asked.envs if horizon is None else min(self._asked.envs, math.ceil(left / horizon))

    def _is_rest(self, horizon: int | None) -> bool:
        """Return True if the steps that are left are not worth another fit of DAgger.

        Successes end episodes early, so that ever fewer steps are left for the next round, and never none.
        """
        few = _FEWEST * self._rows_of_round(horizon) < self._asked.envs
        return few and self._rounds > 0 and self._asked.algorithm == "dagger"

    def _add(self, samples: Samples, begun: float) -> None:
        kept = {name: each for name, each in samples._asdict().items() if each is not None}
        state.save_tensors(self._path(self._rounds), kept)
        self._samples.append(samples)
        self._rounds += 1
        self._save(begun)

    def _save(self, begun: float, tensors: Tensors | None = None) -> None:
        self._folder.save_state(
            tensors or {},
            time.monotonic() - begun,
            steps=self._progress.steps,
            rounds=self._rounds,
            longest=self._longest,
            fitted=self._gradient_steps,
        )

    def _path(self, number: int) -> Path:
        return self._folder.path / f"samples-{number:04d}.safetensors"

    def _load_samples(self, number: int) -> Samples:
        found = state.load_tensors(self._path(number))
        view = self._demonstrated_view
        sizes = (view.signature.observation.shape[0], view.signature.action.shape[0])
        options = view.setup.options
        try:
            samples = Samples(**{name: found[name] for name in Samples._fields if name != "images" or options.pictured})
        except KeyError as error:
            raise TrainingError(f"{self._path(number)} has no {error}") from None
        count = samples.episode.size
        expected: list[tuple[int, ...]] = [*((count, size) for size in sizes), (count,)]
        if options.pictured:
            expected.append((count, len(options.camera_names), options.height, options.width, 3))
        if [each.shape for each in samples if each is not None] != expected:
            raise TrainingError(f"{self._path(number)} has samples of another environment")
        return samples

    def _fit(self, number: int, begun: float) -> Any:
        """Fit networks to all samples, and save their policy if it is the best so far."""
        raise NotImplementedError

    def _indices(self, names: Iterable[str]) -> list[int]:
        return self._view.indices(names, joint=self._asked.agents == "joint")

    @property
    def _count(self) -> int:
        return sum(len(each.observation) for each in self._samples)

    def _stated(
        self,
        network: NetworkShape | ActShape,
        normalisers: tuple[Normaliser, ...],
        evaluation: dict[str, object] | None,
        **counted: int,
    ) -> Manifest:
        counted |= {"steps": self._progress.steps, "samples": self._count}
        return Manifest(
            signature=self._view.signature,
            agents=self._asked.agents,  # type: ignore[arg-type]  # checked
            network=network,
            normalisers=normalisers,
            training={**self._folder.summary(), **counted},
            seed=self._asked.seed,
            evaluation=evaluation,
        )

    def _tell(self, doing: str) -> None:
        now = time.monotonic()
        if now - self._shown_s < _SHOWN_S:
            return
        self._shown_s, self._progress.doing = now, doing
        done, asked = self._progress.steps, self._asked
        rounds = self._rounds - bool(asked.dataset)
        if rounds > 0:
            left, refits = max(0, asked.steps - done), asked.algorithm == "dagger"
            self._progress.seconds_left = self._time_left(left, done / rounds, refits=refits)
        self._on_progress(self._progress)


class Imitator(DemonstrationLearner):
    """Learner of single actions, by behaviour cloning or DAgger.

    Args:
        *args: As for `DemonstrationLearner`.
    """

    def __init__(self, *args: Any) -> None:
        super().__init__(*args)
        if not isinstance(self._asked.settings, Imitation):
            raise TrainingError(f"{self._asked.algorithm} does not imitate single actions")
        self._settings: Imitation = self._asked.settings
        self._scatter = self._scattering() if self._settings.scatter_rad else None

    @property
    def _patience(self) -> float:
        return self._settings.patience

    def _driver(self, number: int, begun: float) -> tuple[LearnedPolicy | None, float]:
        asked = self._asked
        if not number or asked.algorithm != "dagger":
            return None, 1.0
        learner = self._fit(number, begun)
        behind = self._progress.steps / asked.steps
        return learner, self._settings.expert_share * max(0.0, 1.0 - behind / 0.75)

    def _fit(self, number: int, begun: float) -> LearnedPolicy:
        """Fit networks to all samples, from scratch, and save their policy if it is the best so far.

        The last one need not be the best: a network that also learns to recover learns the task itself less well.
        """
        asked, steps = self._asked, self._settings.fit_steps
        self._time_left.fit_begins()
        observation, action = (np.concatenate([each[k] for each in self._samples]) for k in (0, 1))
        parts = self._split(observation, action)
        with reproducible(seed_of(asked.seed, number)):
            fits = [
                Fit(self._settings, *initial, unseen=self._blind, scatter=self._scatter)
                for initial in self._initial(len(parts))
            ]
            for k, (fit, part) in enumerate(zip(fits, parts, strict=True)):
                rng = np.random.default_rng([asked.seed, number, _FIT, k])
                text = "fitting" if len(parts) == 1 else f"fitting {('left', 'right')[k]}"

                def on_step(step: int, loss: float, text: str = text) -> None:
                    self._tell(f"{text}, {100 * step // steps} %, loss {loss:.4f}")

                loss = fit(*part, steps, rng, on_step)
                self._folder.logger.record(f"fit/loss{k or ''}", loss)
        self._folder.logger.record("fit/samples", len(observation))
        self._folder.log(self._progress.steps)
        networks = [fit.layers() for fit in fits]
        self._tell("checking")
        seconds = time.monotonic() - begun
        self._folder.check_progress(networks, lambda found: self._manifest(fits, found), self._progress.steps, seconds)
        self._time_left.fit_ends()
        return LearnedPolicy(self._manifest(fits), networks)

    def _split(self, observation: Single, action: Single) -> list[tuple[Single, Single]]:
        if self._asked.agents == "joint":
            return [(observation, action)]
        own = observation.reshape(len(observation), 2, -1)
        arms = action.reshape(len(action), 2, -1)
        if self._asked.agents == "shared":
            return [(own.reshape(2 * len(own), -1), arms.reshape(2 * len(arms), -1))]
        return [(np.ascontiguousarray(own[:, k]), np.ascontiguousarray(arms[:, k])) for k in (0, 1)]

    def _scattering(self) -> Scatter:
        """Return the displacement of samples.

        Raises:
            SettingsError: An action is no step of joints.
        """
        actions = self._view.signature.actions
        if actions.mode != "joint_delta":
            raise SettingsError(
                f"scatter_rad is {self._settings.scatter_rad:g}, and action_mode {actions.mode!r}: only the correction "
                "of a step of joints is known; use action_mode='joint_delta', or scatter_rad=0"
            )
        arms, step = (2 if self._asked.agents == "joint" else 1), actions.joint_step_rad
        each = self._view.signature.action.shape[0] // 2
        joints = [arm * each + joint for arm in range(arms) for joint in range(len(step))]
        return Scatter(self._settings.scatter_rad, self._indices(["commanded_q_rad"]), joints, step * arms)

    def _initial(self, count: int) -> list[tuple[Any, Any]]:
        if not self._asked.init:
            return [(None, None)] * count
        policy = initial_policy(self._asked, self._view)
        normalisers = policy.manifest.normalisers or (None,) * count
        return list(zip(policy.layers, normalisers, strict=True))

    def _manifest(self, fits: list[Fit], evaluation: dict[str, object] | None = None) -> Manifest:
        normalisers = tuple(fit.normaliser for fit in fits if fit.normaliser is not None)
        return self._stated(fits[0].shape(), normalisers, evaluation)


def seed_of(seed: int, number: int) -> int:
    """Return the seed of the networks of a round."""
    return int(np.random.SeedSequence([seed, number, _INIT]).generate_state(1)[0])
