"""Trainings by any algorithm: begun, gone on with, and what comes of them."""

from __future__ import annotations

import importlib
import logging
import os
from pathlib import Path
from typing import Any

from dual_ur10.errors import DualUR10Error, TrainingError
from dual_ur10.policies.training.folder import TrainingFolder
from dual_ur10.policies.training.input_validation import check_given
from dual_ur10.policies.training.progress import OnProgress
from dual_ur10.policies.training.settings import Training
from dual_ur10.policies.training.state import Tensors

__all__ = ["resume", "train"]

log = logging.getLogger(__name__)


def train(
    training: Training,
    out: str | os.PathLike[str],
    *,
    on_progress: OnProgress = lambda progress: None,
    threads: int | None = None,
) -> Path:
    """Train a policy.

    Args:
        training: What is asked; see `dual_ur10.policies.training.settings.defaults`.
        out: Folder to be made, with everything in it; see `dual_ur10.policies.training.folder`.
        on_progress: Told how far it is.
        threads: Threads that cells are stepped on; None: as many as there are processors. No result depends on it.

    Returns:
        The checkpoint that came of it: a folder that `dual_ur10.policies.load` takes.

    Raises:
        TrainingError: The folder is not empty, or something cannot be saved; what was saved before is as it was.
        DatasetError: The dataset cannot be read or is of another environment.
        CheckpointError: So is the checkpoint to begin with.
        MissingExtraError: Stable-Baselines3 is not installed.
        KeyboardInterrupt: It was interrupted. `resume` goes on.
    """
    _needs(training)
    check_given(training)
    return _run(TrainingFolder.create(out, training), None, on_progress, threads)


def resume(
    out: str | os.PathLike[str],
    *,
    steps: int | None = None,
    on_progress: OnProgress = lambda progress: None,
    threads: int | None = None,
) -> Path:
    """Go on with a training that was interrupted, or with more steps than it had.

    One that had saved nothing yet begins. What comes of it is a checkpoint of its own: `policy-2` beside a `policy`.

    Args:
        out: Its folder.
        steps: Of the environment in all; None: as was asked.
        on_progress: As for `train`.
        threads: As for `train`.

    Returns:
        As `train`.

    Raises:
        TrainingError: There is no such training, or its files cannot be read.
    """
    folder, state = TrainingFolder.resume(out, steps)
    _needs(folder.training)
    return _run(folder, state, on_progress, threads)


def _needs(training: Training) -> None:
    """Raise MissingExtraError before anything is made."""
    importlib.import_module(
        f"dual_ur10.policies.training.{'imitation' if training.algorithm in ('bc', 'dagger') else 'reinforcement'}"
    )


def _run(
    folder: TrainingFolder, state: tuple[Tensors, dict[str, Any]] | None, on_progress: OnProgress, threads: int | None
) -> Path:
    try:
        # What needs torch and Stable-Baselines3 is imported when it is needed.
        if folder.training.algorithm in ("bc", "dagger"):
            from dual_ur10.policies.training.imitation import Imitator

            return Imitator(folder, None if state is None else state[1], on_progress, threads).run()
        from dual_ur10.policies.training.reinforcement import Reinforcer

        return Reinforcer(folder, state, on_progress, threads).run()
    except OSError as error:
        if isinstance(error, DualUR10Error):
            raise
        raise TrainingError(
            f"cannot write to {folder.path}: {error.strerror or error}. What was saved before is as it was: make room "
            "and go on with --resume"
        ) from error
    finally:
        try:
            folder.draw()
            folder.close()
        except (TrainingError, OSError) as error:  # what ended the training is to be told, not this
            log.warning("the learning curve and the logs are not whole: %s", error)
