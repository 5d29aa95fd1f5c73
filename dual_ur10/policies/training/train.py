"""Begin and resume trainings by any algorithm."""

from __future__ import annotations

import importlib
import logging
import os
from collections.abc import Iterator
from contextlib import closing, contextmanager
from pathlib import Path
from typing import TYPE_CHECKING

from dual_ur10.errors import DualUR10Error, TrainingError
from dual_ur10.ids import received
from dual_ur10.policies.learned.signature import view_of
from dual_ur10.policies.training.dataset import read_dataset
from dual_ur10.policies.training.folder import Saved, TrainingFolder, initial_policy, network_shape, read_backbone
from dual_ur10.policies.training.progress import OnProgress, Progress
from dual_ur10.policies.training.settings import IMITATION, ActSettings, Training
from dual_ur10.policies.training.state import Tensors

if TYPE_CHECKING:
    from dual_ur10.policies.training.corrections import Meet, Person

__all__ = ["resume", "train"]

log = logging.getLogger(__name__)


def train(
    training: Training,
    out: str | os.PathLike[str],
    *,
    on_progress: OnProgress = lambda progress: None,
    threads: int | None = None,
    meet: Meet | None = None,
) -> Path:
    """Train a policy.

    Args:
        training: Specification; see `dual_ur10.policies.training.settings.defaults`.
        out: New or empty folder for all results; see `dual_ur10.policies.training.folder`.
        on_progress: Callback with the progress. The first call follows the check of all inputs.
        threads: Threads that step the cells; None: one per processor. The result does not depend on it.
        meet: Function that returns the person of a training with an operator; None:
            `dual_ur10.policies.training.corrections.meet`.

    Returns:
        Folder of the resulting checkpoint, for `dual_ur10.policies.load`.

    Raises:
        TrainingError: The folder is not empty, the network is too large or not that of the initial checkpoint, or
            something cannot be saved; whatever was saved before is unchanged.
        DatasetError: The dataset cannot be read or is of another environment.
        CheckpointError: The initial checkpoint cannot be read or is of another environment.
        DeviceError: The device of an operator cannot be opened or fails.
        MissingExtraError: Stable-Baselines3 is not installed.
        KeyboardInterrupt: The training was interrupted. `resume` continues it.
    """
    _check_installed(training)
    view = view_of(training.env_id, training.keywords)  # all inputs are checked before hours are spent
    network_shape(training, view)
    if isinstance(training.settings, ActSettings) and training.settings.backbone:
        read_backbone(training.settings.backbone)
    if training.init:
        initial_policy(training, view)
    if training.dataset:
        read_dataset(training.dataset, view_of(training.env_id, training.demonstrated))
    with _met(training, meet) as person, closing(TrainingFolder.create(out, training)) as folder:
        return _run(folder, None, on_progress, threads, person)


def resume(
    out: str | os.PathLike[str],
    *,
    steps: int | None = None,
    on_progress: OnProgress = lambda progress: None,
    threads: int | None = None,
    meet: Meet | None = None,
) -> Path:
    """Continue a training that was interrupted, or extend a finished one by more steps.

    A training that had saved nothing begins again. The result is a new checkpoint: `policy-2` beside a `policy`.

    Args:
        out: Folder of the training.
        steps: Total number of environment steps; None: as specified.
        on_progress: As for `train`.
        threads: As for `train`.
        meet: As for `train`.

    Returns:
        As `train`.

    Raises:
        TrainingError: There is no such training, another process trains in its folder, or its files cannot be read.
    """
    with received(f"the training {os.fspath(out)}"):
        folder, state = TrainingFolder.resume(out, steps)
        with closing(folder):
            _check_installed(folder.training)
            with _met(folder.training, meet) as person:
                return _run(folder, state, on_progress, threads, person)


def _check_installed(training: Training) -> None:
    module = "imitation" if training.algorithm in IMITATION else "reinforcement"
    importlib.import_module(f"dual_ur10.policies.training.{module}")


@contextmanager
def _met(training: Training, meet: Meet | None) -> Iterator[Person | None]:
    """Yield the person of a training, whose device is closed at the end; None: nobody corrects it."""
    if not training.operator:
        yield None
        return
    from dual_ur10.policies.training import corrections

    person = (meet or corrections.meet)(training)
    try:
        yield person
    finally:
        person.operator.close()


def _run(
    folder: TrainingFolder,
    state: tuple[Tensors, Saved] | None,
    on_progress: OnProgress,
    threads: int | None,
    person: Person | None,
) -> Path:
    on_progress(Progress(0 if state is None else state[1].steps, folder.training.steps, doing="loading PyTorch"))
    try:
        # Imported on use: they load torch and Stable-Baselines3.
        if folder.training.algorithm in IMITATION:
            saved = None if state is None else state[1]
            if folder.training.algorithm == "act":
                from dual_ur10.policies.training.act import ActImitator

                return ActImitator(None if state is None else state[0], folder, saved, on_progress, threads).run()
            if person is not None:
                from dual_ur10.policies.training.corrections import CorrectedImitator

                return CorrectedImitator(person, folder, saved, on_progress, threads).run()
            from dual_ur10.policies.training.imitation import Imitator

            return Imitator(folder, saved, on_progress, threads).run()
        from dual_ur10.policies.training.reinforcement import Reinforcer

        return Reinforcer(folder, state, on_progress, threads).run()
    except OSError as error:
        if isinstance(error, DualUR10Error):
            raise
        raise TrainingError(
            f"cannot write to {folder.path}: {error.strerror or error}. Whatever was saved before is unchanged: make "
            "room and continue with --resume"
        ) from error
    finally:
        try:
            folder.draw()
            folder.close()
        except (TrainingError, OSError) as error:  # must not hide the error that ended the training
            log.warning("the learning curve and the logs are not whole: %s", error)
