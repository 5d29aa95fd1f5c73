"""The folder of a training: what it was asked to do, its state, its checkpoints, logs and learning curve.

training.json          what it was asked to do
state/                 what it goes on from with --resume; see `dual_ur10.policies.training.state`
samples-0000.safetensors, ...
                       imitation: what was gathered in each round
steps-000102400/, ...  checkpoints on the way
policy/                the checkpoint that came of it
curve.png              success and return over steps
progress.csv, events*  logs of Stable-Baselines3's logger: a table, and TensorBoard's
"""

from __future__ import annotations

import dataclasses
import json
import os
from collections.abc import Callable
from pathlib import Path
from typing import Any, Final

import numpy as np

from dual_ur10.errors import DualUR10Error, MissingExtraError, TrainingError
from dual_ur10.files import write_text
from dual_ur10.policies.evaluation.evaluate import evaluate
from dual_ur10.policies.evaluation.results import Evaluation
from dual_ur10.policies.learned import checkpoint
from dual_ur10.policies.learned.checkpoint import Networks
from dual_ur10.policies.learned.learned_policy import LearnedPolicy
from dual_ur10.policies.learned.manifest import Manifest
from dual_ur10.policies.learned.signature import view_of
from dual_ur10.policies.training import seeds, state
from dual_ur10.policies.training.progress import Check, draw_curve
from dual_ur10.policies.training.settings import Imitation, Reinforcement, Training
from dual_ur10.policies.training.state import Tensors
from dual_ur10.sim2real.recording.header import plain

_ASKED: Final = "training.json"

ManifestOf = Callable[[dict[str, object] | None], Manifest]


class TrainingFolder:
    """Where a training keeps what it makes.

    Args:
        path: The folder, which exists.
        training: What is asked.

    Attributes:
        path: The folder.
        training: What is asked.
        checks: How good the policy was, in order.
        seconds: Of training in runs before this one.
        best: Name of the checkpoint that was the best at a look so far; None: there is none.
    """

    def __init__(self, path: Path, training: Training) -> None:
        self.path, self.training = path, training
        self.checks: list[Check] = []
        self.seconds = 0.0
        self.best: str | None = None
        self._logger: Any = None

    @classmethod
    def create(cls, path: str | os.PathLike[str], training: Training) -> TrainingFolder:
        """A new one.

        Raises:
            TrainingError: There is something already, or it cannot be made.
        """
        folder = Path(os.path.abspath(path))
        try:
            folder.mkdir(parents=True, exist_ok=True)
            taken = any(folder.iterdir())
        except OSError as error:
            raise TrainingError(f"cannot make {folder}: {error.strerror or error}") from error
        if taken:
            raise TrainingError(
                f"{folder} is not empty, and nothing is written over: choose another folder, or go on with --resume"
            )
        made = cls(folder, training)
        made._write_down()
        return made

    @classmethod
    def resume(
        cls, path: str | os.PathLike[str], steps: int | None = None
    ) -> tuple[TrainingFolder, tuple[Tensors, dict[str, Any]] | None]:
        """That of a training which was interrupted, with the tensors and values of its state; None: it has none yet.

        Args:
            path: The folder.
            steps: Of the environment in all; None: as was asked.

        Raises:
            TrainingError: There is none, or its files cannot be read.
        """
        folder = Path(os.path.abspath(path))
        training = _training_of(folder / _ASKED)
        made = cls(folder, training if steps is None else dataclasses.replace(training, steps=steps))
        if not state.exists(folder / "state"):
            made._write_down()
            return made, None
        tensors, values = state.load(folder / "state")
        try:
            made.checks = [Check(**each) for each in values.pop("checks")]
            made.seconds = float(values.pop("seconds"))
            best = values.pop("best")
            if best is not None:
                made.best = str(best)
        except (KeyError, TypeError, ValueError) as error:
            raise TrainingError(f"the state in {folder} is not of this version: {error!s:.200}") from error
        if steps is not None:
            made._write_down()
        return made, (tensors, values)

    def _write_down(self) -> None:
        try:
            text = json.dumps(plain(_as_dict(self.training)), indent=1, allow_nan=False) + "\n"
        except ValueError as error:
            raise TrainingError(f"what is asked cannot be written down: {error}") from error
        write_text(self.path / _ASKED, text)

    def save_state(self, tensors: Tensors, values: dict[str, Any], seconds: float) -> None:
        """Keep what is needed to go on.

        Raises:
            TrainingError: It cannot be written. The state before is as it was.
        """
        checks = [dataclasses.asdict(each) for each in self.checks]
        state.save(self.path / "state", tensors, {**values, "checks": checks, "seconds": seconds, "best": self.best})

    @property
    def logger(self) -> Any:
        """Stable-Baselines3's logger into this folder.

        Raises:
            MissingExtraError: It is not installed.
        """
        if self._logger is None:
            try:
                from stable_baselines3.common.logger import configure
            except ImportError:
                raise MissingExtraError("stable-baselines3", "train", "training") from None
            formats = ["csv"]
            try:
                import torch.utils.tensorboard  # noqa: F401

                formats.append("tensorboard")
            except ImportError:
                pass
            # A training that goes on has a table of its own: the logger writes over what is there.
            before = len(list(self.path.glob("progress*.csv")))
            kept = self.path / f"progress-{before}.csv"
            if (self.path / "progress.csv").exists():
                (self.path / "progress.csv").rename(kept)
            self._logger = configure(str(self.path), formats)
        return self._logger

    def log(self, steps: int) -> None:
        """Write down what was recorded since, at so many steps of the environment."""
        self.logger.record("time/steps", steps, exclude="tensorboard")  # which has them as its axis
        self.logger.dump(steps)

    def close(self) -> None:
        """Close the logs."""
        if self._logger is not None:
            self._logger.close()
            self._logger = None

    def policy_of(self, networks: Networks, manifest: Manifest) -> LearnedPolicy:
        """The policy of these weights, in the environment of the training."""
        view = view_of(self.training.env_id, self.training.keywords)
        layers = [[(np.asarray(w, np.float32), np.asarray(b, np.float32)) for w, b in each] for each in networks]
        return LearnedPolicy(manifest, layers, view)

    def _look(self, policy: LearnedPolicy) -> Evaluation:
        """Evaluate a policy on episodes that nothing is learned from."""
        return evaluate(
            self.training.env_id,
            policy,
            episodes=self.training.checks,
            seed=seeds.CHECKS,
            num_envs=min(self.training.envs, self.training.checks),
            env_kwargs=self.training.keywords,
        )

    def consider(self, networks: Networks, manifest_of: ManifestOf, steps: int, seconds: float) -> None:
        """Look at a policy, note how good it is, and keep it if none was better so far.

        Args:
            networks: Its weights.
            manifest_of: Its manifest with what an evaluation found; with None: without.
            steps: Of the environment so far.
            seconds: Of training so far.

        Raises:
            CheckpointError: It cannot be written.
        """
        found = self._look(self.policy_of(networks, manifest_of(None)))
        check = check_of(found, steps, seconds)
        before = max((each.rank for each in self.checks), default=(-1.0, 0.0))
        self._note(check)
        if check.rank > before or self.best is None:
            self.best = self.save(f"steps-{steps:09d}", networks, manifest_of(summary_of(found))).name

    def finish(self) -> Path:
        """Make the best one at a look what has come of the training. Returns its folder.

        Raises:
            CheckpointError: It cannot be read or written.
        """
        best = checkpoint.load(self.path / str(self.best))
        return self.save("policy", best.layers, best.manifest)

    def _note(self, check: Check) -> None:
        """Keep how good the policy is, in the logs, too."""
        self.checks.append(check)
        logger = self.logger
        for name in ("mean_return", "success_rate"):
            logger.record(f"check/{name}", getattr(check, name))
        logger.record("time/seconds", check.seconds)
        self.log(check.steps)

    def save(self, name: str, networks: Networks, manifest: Manifest) -> Path:
        """Write a checkpoint; with a number behind its name where there is one already.

        Raises:
            CheckpointError: It cannot be written.
        """
        path, number = self.path / name, 2
        while os.path.lexists(path):
            path, number = self.path / f"{name}-{number}", number + 1
        checkpoint.save(path, networks, manifest)
        return path

    def draw(self) -> Path | None:
        """Draw the learning curve; None: there is nothing to draw, or nothing to draw with."""
        if not self.checks:
            return None
        asked = self.training
        path = self.path / "curve.png"
        try:
            draw_curve(path, f"{asked.env_id}, {asked.algorithm}, {asked.agents}, seed {asked.seed}", self.checks)
        except MissingExtraError:
            return None
        return path

    def described(self) -> dict[str, object]:
        """What a manifest says of the training."""
        asked = _as_dict(self.training)
        del asked["env_id"], asked["keywords"], asked["seed"], asked["agents"]
        # Names of folders and datasets of whoever trains are nobody else's business.
        del asked["init"], asked["dataset"]
        began = {"from_checkpoint": bool(self.training.init), "from_dataset": bool(self.training.dataset)}
        result: dict[str, object] = plain({**asked, **began})
        return result


def summary_of(evaluation: Evaluation) -> dict[str, object]:
    """What a manifest says of an evaluation."""
    found = evaluation.summary()
    found.pop("spreads")
    return plain({"seed": evaluation.seed, "kwargs": dict(evaluation.kwargs), **found})  # type: ignore[no-any-return]


def check_of(evaluation: Evaluation, steps: int, seconds: float) -> Check:
    """A check from an evaluation."""
    low, high = evaluation.interval
    count = len(evaluation.episodes)
    return Check(steps, seconds, evaluation.mean_return, evaluation.success_rate, count, low, high)


def _as_dict(training: Training) -> dict[str, Any]:
    return dataclasses.asdict(training)


def _training_of(path: Path) -> Training:
    try:
        asked = json.loads(path.read_bytes())
        settings = asked.pop("settings")
        kind = Imitation if asked["algorithm"] in ("bc", "dagger") else Reinforcement
        settings = {key: tuple(value) if isinstance(value, list) else value for key, value in settings.items()}
        return Training(**asked, settings=kind(**settings))
    except FileNotFoundError:
        raise TrainingError(f"{path.parent} is no folder of a training: there is no {path.name}") from None
    except DualUR10Error as error:
        raise TrainingError(f"{path} asks for what is not possible: {error}") from error
    except (OSError, ValueError, KeyError, TypeError, AttributeError, RecursionError) as error:
        raise TrainingError(f"{path} cannot be read: {type(error).__name__}: {error!s:.200}") from error
