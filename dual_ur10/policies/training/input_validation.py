"""What a training is given: it is looked at before anything is made, and before hours are spent."""

from __future__ import annotations

from dual_ur10.errors import CheckpointError, TrainingError
from dual_ur10.policies.learned import checkpoint
from dual_ur10.policies.learned.learned_policy import LearnedPolicy
from dual_ur10.policies.learned.network import NetworkShape
from dual_ur10.policies.learned.signature import EnvironmentView, view_of
from dual_ur10.policies.training.dataset import read_dataset
from dual_ur10.policies.training.settings import Imitation, Training


def check_given(training: Training) -> None:
    """Refuse what cannot be learned from or begun with.

    Raises:
        TrainingError: The network is too large, or the checkpoint has another one.
        CheckpointError: The checkpoint cannot be read, or is of another environment.
        DatasetError: The dataset cannot be read, or is of another environment.
    """
    view = view_of(training.env_id, training.keywords)
    shape_of(training, view)
    if training.init:
        beginning(training, view)
    if training.dataset:
        read_dataset(training.dataset, view)


def shape_of(training: Training, view: EnvironmentView) -> NetworkShape:
    """The network that is trained.

    Raises:
        TrainingError: It is too large.
    """
    sees, acts = view.signature.observation.shape[0], view.signature.action.shape[0]
    if training.agents != "joint":
        sees, acts = view.agent_size, acts // 2
    settings = training.settings
    activation = settings.activation if isinstance(settings, Imitation) else "tanh"
    try:
        return NetworkShape((sees, *settings.hidden, acts), activation, "clip")
    except CheckpointError as error:
        raise TrainingError(f"hidden is {settings.hidden}: {error}") from error


def beginning(training: Training, view: EnvironmentView) -> LearnedPolicy:
    """The checkpoint to begin with.

    Raises:
        TrainingError: It has another network.
        CheckpointError: It cannot be read, or is of another environment.
    """
    policy = checkpoint.load(training.init, training.env_id, **training.keywords)
    wanted, found = shape_of(training, view), policy.manifest.network
    if (policy.manifest.agents, found) != (training.agents, wanted):
        raise TrainingError(
            f"{training.init} is {policy.manifest.agents}, {_text(found)}; this training makes {training.agents}, "
            f"{_text(wanted)}: both must be the same"
        )
    return policy


def _text(shape: NetworkShape) -> str:
    return f"{' - '.join(map(str, shape.layers))} {shape.activation} {shape.squashing}"
