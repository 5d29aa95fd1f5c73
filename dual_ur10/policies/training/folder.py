"""Folder of a training: its specification, state, checkpoints, logs and learning curve.

training.json          specification: `dual_ur10.policies.training.settings.Training`
lock                   held by the process that trains here
state/                 state from which --resume continues; see `dual_ur10.policies.training.state`
samples-0000.safetensors, ...
                       imitation: samples of each round, with their episodes
episodes/              DAgger with an operator: records of all episodes
steps-000102400/, ...  intermediate checkpoints
policy/                the resulting checkpoint
curve.png              success and return over steps
progress.csv, events*  logs of Stable-Baselines3's logger: a table, and TensorBoard's
"""

from __future__ import annotations

import contextlib
import dataclasses
import fcntl
import json
import logging
import os
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, BinaryIO

import numpy as np
from pydantic import Field

from dual_ur10.assets.visuals import cameras
from dual_ur10.errors import CheckpointError, MissingExtraError, SettingsError, TrainingError, UnknownNameError
from dual_ur10.policies.chunks.chunk_policy import CHUNK_MODES
from dual_ur10.policies.evaluation.evaluate import evaluate
from dual_ur10.policies.evaluation.results import Evaluation
from dual_ur10.policies.learned import checkpoint, schema
from dual_ur10.policies.learned.act_network import ActShape
from dual_ur10.policies.learned.act_policy import ActPolicy
from dual_ur10.policies.learned.checkpoint import Networks
from dual_ur10.policies.learned.learned_policy import LearnedPolicy
from dual_ur10.policies.learned.lerobot_files import image_keys
from dual_ur10.policies.learned.manifest import Manifest
from dual_ur10.policies.learned.network import NetworkShape
from dual_ur10.policies.learned.resnet import RESNET18
from dual_ur10.policies.learned.schema import StrictJson
from dual_ur10.policies.learned.signature import EnvironmentView
from dual_ur10.policies.training import state
from dual_ur10.policies.training.progress import Check, draw_curve
from dual_ur10.policies.training.settings import CHECK_SEED, ActSettings, Imitation, Training
from dual_ur10.policies.training.state import Tensors
from dual_ur10.sim2real.recording.header import plain
from ur_core.files import read_regular, write_text

log = logging.getLogger(__name__)

_TRAINING, _LOCK = "training.json", "lock"

_Count = Annotated[int, Field(ge=0)]

ManifestOf = Callable[[dict[str, object] | None], Manifest]


@dataclass(frozen=True, kw_only=True)
class Saved(StrictJson):
    """Values in a training's state, beside its tensors.

    Attributes:
        steps: Environment steps so far.
        rounds: Imitation: rounds of samples so far.
        longest: Imitation: steps of the longest episode so far.
        fitted: ACT: gradient steps so far.
        seconds: Training time so far.
        checks: Progress checks so far.
        best: Name of the best checkpoint so far; None: there is none.
    """

    steps: _Count
    rounds: _Count = 0
    longest: _Count = 1
    fitted: _Count = 0
    seconds: float
    checks: tuple[Check, ...]
    best: str | None


class TrainingFolder:
    """Folder with everything that a training writes. It is locked until `close`.

    Args:
        path: The folder, which exists.
        training: Specification.

    Attributes:
        path: The folder.
        training: Specification.
        checks: Progress checks, in order.
        seconds: Training time of earlier runs.
        best: Name of the best checkpoint so far; None: there is none.
    """

    def __init__(self, path: Path, training: Training) -> None:
        self.path, self.training = path, training
        self.checks: list[Check] = []
        self.seconds = 0.0
        self.best: str | None = None
        self._logger: Any = None
        self._lock: BinaryIO | None = None

    @classmethod
    def create(cls, path: str | os.PathLike[str], training: Training) -> TrainingFolder:
        """Make a new folder.

        Raises:
            TrainingError: The folder is not empty, or cannot be made.
        """
        folder = Path(os.path.abspath(path))
        try:
            folder.mkdir(parents=True, exist_ok=True)
            taken = any(folder.iterdir())
        except OSError as error:
            raise TrainingError(f"cannot make {folder}: {error.strerror or error}") from error
        if taken:
            raise TrainingError(
                f"{folder} is not empty, and nothing is overwritten: choose another folder, or continue with --resume"
            )
        made = cls(folder, training)
        made._lock = _locked(folder)
        made._write_down()
        return made

    @classmethod
    def resume(
        cls, path: str | os.PathLike[str], steps: int | None = None
    ) -> tuple[TrainingFolder, tuple[Tensors, Saved] | None]:
        """Open the folder of an interrupted training, with its state; None: nothing was saved yet.

        Args:
            path: The folder.
            steps: Total number of environment steps; None: as specified.

        Raises:
            TrainingError: It is no folder of a training, another process trains in it, or its files cannot be read.
        """
        folder = Path(os.path.abspath(path))
        training = _training_of(folder / _TRAINING)
        made = cls(folder, training if steps is None else dataclasses.replace(training, steps=steps))
        made._lock = _locked(folder)
        if not state.exists(folder / "state"):
            made._write_down()
            return made, None
        tensors, values = state.load(folder / "state")
        saved = schema.read(Saved, values, f"the state in {folder}", TrainingError)
        made.checks, made.seconds, made.best = list(saved.checks), saved.seconds, saved.best
        if steps is not None:
            made._write_down()
        return made, (tensors, saved)

    def _write_down(self) -> None:
        try:
            text = json.dumps(plain(dataclasses.asdict(self.training)), indent=1, allow_nan=False) + "\n"
        except ValueError as error:
            raise TrainingError(f"the specification cannot be written: {error}") from error
        write_text(self.path / _TRAINING, text)

    def save_state(self, tensors: Tensors, seconds: float, **values: int) -> None:
        """Save a state from which the training can continue.

        Args:
            tensors: Arrays by name.
            seconds: Training time so far.
            **values: Counters of `Saved`.

        Raises:
            TrainingError: It cannot be written. The previous state is unchanged.
        """
        saved = Saved(**values, seconds=seconds, checks=tuple(self.checks), best=self.best)
        state.save(self.path / "state", tensors, dataclasses.asdict(saved))

    @property
    def logger(self) -> Any:
        """Logger of Stable-Baselines3 that writes into this folder.

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
            # A resumed training has a table of its own: the logger overwrites what is there.
            if (self.path / "progress.csv").exists():
                numbers = (each.stem.removeprefix("progress-") for each in self.path.glob("progress-*.csv"))
                last = max((int(each) for each in numbers if each.isdecimal()), default=0)
                (self.path / "progress.csv").rename(self.path / f"progress-{last + 1}.csv")
            self._logger = configure(str(self.path), formats)
        return self._logger

    def log(self, steps: int) -> None:
        """Write the values recorded since the last call, at this number of environment steps."""
        self.logger.record("time/steps", steps, exclude="tensorboard")  # its axis
        self.logger.dump(steps)

    def close(self) -> None:
        """Close the logs, and unlock the folder. May be called twice."""
        logger, self._logger = self._logger, None
        lock, self._lock = self._lock, None
        try:
            if logger is not None:
                logger.close()
        finally:
            if lock is not None:
                with lock, contextlib.suppress(OSError):  # a file system without locks
                    fcntl.flock(lock, fcntl.LOCK_UN)  # a forked process has the file open, too

    def policy_of(self, networks: Networks, manifest: Manifest) -> LearnedPolicy | ActPolicy:
        """Return the policy with these weights, in the environment of the training."""
        return checkpoint.policy_of(manifest, networks)

    def check_progress(self, networks: Networks, manifest_of: ManifestOf, steps: int, seconds: float) -> None:
        """Evaluate a policy on episodes that nothing is learned from, and save it if it is the best so far.

        Args:
            networks: Weights of the policy.
            manifest_of: Function from the results of an evaluation, or None, to the policy's manifest.
            steps: Environment steps so far.
            seconds: Training time so far.

        Raises:
            CheckpointError: It cannot be written.
        """
        found = evaluate(
            self.training.env_id,
            self.policy_of(networks, manifest_of(None)),
            episodes=self.training.checks,
            seed=CHECK_SEED,
            num_envs=min(self.training.envs, self.training.checks),
            # A policy is judged from the normal start alone.
            env_kwargs={name: value for name, value in self.training.keywords.items() if name != "starts"},
        )
        check = check_of(found, steps, seconds)
        before = max((each.rank for each in self.checks), default=(-1.0, 0.0))
        self._note(check)
        if check.rank > before or self.best is None:
            self.best = self.save(f"steps-{steps:09d}", networks, manifest_of(summary_of(found))).name

    def finish(self) -> Path:
        """Save the best policy as the result of the training, and return its folder.

        Raises:
            CheckpointError: It cannot be read or written.
        """
        manifest, networks = checkpoint.read(self.path / str(self.best))
        return self.save("policy", networks, manifest)

    def _note(self, check: Check) -> None:
        self.checks.append(check)
        logger = self.logger
        for name in ("mean_return", "success_rate"):
            logger.record(f"check/{name}", getattr(check, name))
        logger.record("time/seconds", check.seconds)
        self.log(check.steps)

    def save(self, name: str, networks: Networks, manifest: Manifest) -> Path:
        """Write a checkpoint, with a number after its name if the name is taken.

        Raises:
            CheckpointError: It cannot be written.
        """
        path, number = self.path / name, 2
        while os.path.lexists(path):
            path, number = self.path / f"{name}-{number}", number + 1
        checkpoint.save(path, networks, manifest)
        return path

    def draw(self) -> Path | None:
        """Draw the learning curve and return its path; None: no check was made, or Matplotlib is missing."""
        if not self.checks:
            return None
        of, path = self.training, self.path / "curve.png"
        try:
            draw_curve(path, f"{of.env_id}, {of.algorithm}, {of.agents}, seed {of.seed}", self.checks)
        except MissingExtraError:
            return None
        return path

    def summary(self) -> dict[str, object]:
        """Return the settings of the training for a manifest."""
        asked = dataclasses.asdict(self.training)
        # The manifest holds four of these; the names of folders and datasets are private.
        for name in ("env_id", "keywords", "seed", "agents", "init", "dataset", "operator"):
            del asked[name]
        backbone = asked["settings"].pop("backbone", "")
        began = {
            **({"from_backbone": True} if backbone else {}),
            "from_checkpoint": bool(self.training.init),
            "from_dataset": bool(self.training.dataset),
            "from_operator": bool(self.training.operator),
        }
        result: dict[str, object] = plain({**asked, **began})
        return result


def summary_of(evaluation: Evaluation) -> dict[str, object]:
    """Return the results of an evaluation for a manifest."""
    found = evaluation.summary()
    for name in ("spreads", "end_reasons"):  # keys of a manifest are not any text
        del found[name]
    return plain({"seed": evaluation.seed, "kwargs": dict(evaluation.kwargs), **found})  # type: ignore[no-any-return]


def check_of(evaluation: Evaluation, steps: int, seconds: float) -> Check:
    """Return a progress check from an evaluation."""
    low, high = evaluation.interval
    count = len(evaluation.episodes)
    return Check(steps, seconds, evaluation.mean_return, evaluation.success_rate, count, low, high)


def _locked(folder: Path) -> BinaryIO:
    """Return the file that keeps the folder locked while it is open.

    Raises:
        TrainingError: Another process trains in this folder, or it cannot be written.
    """
    try:
        file = (folder / _LOCK).open("ab")
    except OSError as error:
        raise TrainingError(f"cannot write to {folder}: {error.strerror or error}") from error
    try:
        fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        file.close()
        raise TrainingError(
            f"another process trains in {folder}: wait until it has ended, or stop it with Ctrl-C first"
        ) from None
    except OSError as error:  # a file system without locks
        log.warning("%s cannot be locked: %s; do not train in it twice at a time", folder, error.strerror)
    return file


def _training_of(path: Path) -> Training:
    try:
        text = read_regular(path, schema.MOST_BYTES)
    except FileNotFoundError:
        raise TrainingError(f"{path.parent} is no folder of a training: there is no {path.name}") from None
    except OSError as error:
        raise TrainingError(f"{path} cannot be read: {error.strerror or error}") from error
    return schema.read(Training, schema.loads(text, str(path), TrainingError), str(path), TrainingError)


def network_shape(training: Training, view: EnvironmentView) -> NetworkShape | ActShape:
    """Return the shape of the networks to train.

    Raises:
        TrainingError: They are too large, or see nothing.
        SettingsError: An ACT cannot be trained in this environment.
    """
    inputs, outputs = view.signature.observation.shape[0], view.signature.action.shape[0]
    if training.agents != "joint":
        inputs, outputs = view.layout.size, outputs // 2
    settings = training.settings
    if len(view.indices(settings.unseen, joint=training.agents == "joint")) == inputs:
        raise TrainingError(
            f"agents is {training.agents!r}, whose observation has no field but those of unseen: choose other agents, "
            "or hide fewer fields"
        )
    if isinstance(settings, ActSettings):
        return act_shape(settings, view)
    activation = settings.activation if isinstance(settings, Imitation) else "tanh"
    try:
        return NetworkShape((inputs, *settings.hidden, outputs), activation, "clip")
    except CheckpointError as error:
        raise TrainingError(f"hidden is {settings.hidden}: {error}") from error


def act_shape(settings: ActSettings, view: EnvironmentView) -> ActShape:
    """Return the shape of a transformer to train.

    Raises:
        TrainingError: It is too large.
        SettingsError: Its actions or observations are not those of chunks.
        UnknownNameError: The scene has no such camera.
        DatasetError: Two cameras would have one name for LeRobot.
    """
    signature, fields = view.signature, ["commanded_q_rad", *(["gripper_m"] if view.signature.actions.gripper else [])]
    if signature.actions.mode not in CHUNK_MODES:
        raise SettingsError(
            f"action_mode is {signature.actions.mode!r}: act learns joint positions, so choose "
            f"{' or '.join(map(repr, CHUNK_MODES))}"
        )
    if view.setup.options.observation not in ("state", "both") or not {*fields} <= {*view.layout.names}:
        raise SettingsError(
            f"act needs observations with {' and '.join(fields)}: use observation='state', or 'both' for images beside "
            "them, and a task that has them"
        )
    own, size, options = view.layout.indices(fields), view.layout.size, view.setup.options
    known = cameras(view.setup.config.scene) if options.pictured else ()
    names = options.camera_names if options.pictured else ()
    for name in names:
        if name not in known:
            raise UnknownNameError("camera", name, list(known))
    image_keys(names)
    if settings.backbone and not options.pictured:
        raise SettingsError("backbone is for images, and there are none: use observation='both', or leave it out")
    try:
        return ActShape(
            state=tuple(arm * size + index for arm in range(2) for index in own),
            environment_state=0 if options.pictured else signature.observation.shape[0],
            chunk_size=settings.chunk_size,
            dim_model=settings.dim_model,
            n_heads=settings.n_heads,
            dim_feedforward=settings.dim_feedforward,
            n_encoder_layers=settings.n_encoder_layers,
            action_mode=settings.chunk_mode,
            cameras=names,
            height=options.height if options.pictured else 0,
            width=options.width if options.pictured else 0,
        )
    except CheckpointError as error:
        raise TrainingError(str(error)) from error


def read_backbone(path: str) -> Tensors:
    """Return the weights of a ResNet18 by torchvision's names, from a file of safetensors.

    Those of its classifier and counts of batches are left out.

    Raises:
        TrainingError: It cannot be read, or lacks a weight.
    """
    found = state.load_tensors(Path(path))
    for name, shape in RESNET18.items():
        if name not in found or found[name].shape != shape:
            was = f"has shape {found[name].shape}" if name in found else "is missing"
            raise TrainingError(
                f"{path} is no ResNet18: {name} {was}, expected {shape}. Save torchvision's state_dict as safetensors"
            )
    return {name: found[name].astype(np.float32) for name in RESNET18}


def initial_policy(training: Training, view: EnvironmentView) -> LearnedPolicy:
    """Load the checkpoint whose network a training begins with.

    Raises:
        TrainingError: It has another network.
        CheckpointError: It cannot be read, or is of another environment.
    """
    policy = checkpoint.load(training.init, training.env_id, **training.keywords)
    wanted, found = network_shape(training, view), policy.manifest.network
    if not isinstance(policy, LearnedPolicy) or (policy.manifest.agents, found) != (training.agents, wanted):
        raise TrainingError(
            f"{training.init} is {policy.manifest.agents}, {_text(found)}; this training makes {training.agents}, "
            f"{_text(wanted)}: both must be the same"
        )
    return policy


def _text(shape: NetworkShape | ActShape) -> str:
    if isinstance(shape, ActShape):
        return "act"
    return f"{' - '.join(map(str, shape.layers))} {shape.activation} {shape.squashing}"
