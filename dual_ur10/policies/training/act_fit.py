"""Fit of a transformer to chunks of demonstrations."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any, Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from dual_ur10.errors import MissingExtraError, TrainingError
from dual_ur10.policies.learned.act_network import ActShape
from dual_ur10.policies.learned.act_torch import chunks_of, device, image_features
from dual_ur10.policies.learned.network import Normaliser
from dual_ur10.policies.learned.resnet import FROZEN
from dual_ur10.policies.training.regression import normaliser_of, reproducible, whitening_of
from dual_ur10.policies.training.settings import ActSettings
from dual_ur10.policies.training.state import Tensors
from ur_core.types import Array, Single

try:
    import torch
except ImportError as error:
    raise MissingExtraError("torch", "train", "training") from error

_WARM: Final = 500  # gradient steps in which the learning rate grows: without them, attention settles on nothing
_DECAY: Final = 1e-4  # of the weights
_LARGEST: Final = 1.0  # norm of a gradient
_UNUSED: Final = "encoder_latent_input_proj.weight"  # what it is multiplied with is always 0
_SETTLING: Final = 64  # samples whose images give the first mean and variance of the normalisations


class Chunks(NamedTuple):
    """Samples from which chunks are taken.

    Attributes:
        observation: (k, O) observations.
        action: (k, A) action of each sample, as of a chunk.
        left: (k,) number of samples from each one to the end of its episode, itself included.
        images: (k, cameras, height, width, 3) images; None: there are none.
    """

    observation: Single
    action: Single
    left: NDArray[np.int64]
    images: NDArray[np.uint8] | None = None


class ActFit:
    """Transformer that is fitted to chunks step by step, and the mean of its recent weights.

    Inputs are whitened during the fit, as in `dual_ur10.policies.training.regression.Fit`; `tensors` folds the
    whitening into the weights. A network that sees images is fitted on a GPU, if there is one.

    Args:
        settings: Settings of the training.
        shape: Sizes of the network.
        chunks: Samples.
        unseen: Indices of the values of an observation that the network does not see.
        seed: Seed of the initial weights and of the selection of samples.
        backbone: Initial weights of ResNet18 by torchvision's names. None: random ones; mean and variance of each
            normalisation are then those of the first images, and stay.

    Attributes:
        done: Gradient steps so far.
        normalisers: Of each of `shape.inputs`, and of an action.
    """

    def __init__(
        self,
        settings: ActSettings,
        shape: ActShape,
        chunks: Chunks,
        unseen: list[int],
        seed: int,
        backbone: Tensors | None = None,
    ) -> None:
        self.settings, self.shape, self.done, self._seed = settings, shape, 0, seed
        indices, hidden = list(shape.state), {*unseen}
        blind = [k for k, index in enumerate(indices) if index in hidden]
        given = [(chunks.observation[:, indices], blind), (chunks.observation, unseen)][: len(shape.inputs)]
        normalisers = [normaliser_of(*each) for each in given]
        shown = [_scaled(values, each) for (values, _), each in zip(given, normalisers, strict=True)]
        self.normalisers = (*normalisers, normaliser_of(chunks.action))
        self._whitenings = [whitening_of(each) for each in shown]
        self._inputs = [(each @ matrix.T).float() for each, matrix in zip(shown, self._whitenings, strict=True)]
        self._labels = _scaled(chunks.action, self.normalisers[-1]).float()
        self._left = torch.from_numpy(chunks.left)
        self._images = None if chunks.images is None else torch.from_numpy(chunks.images)
        self._device = device() if shape.cameras else torch.device("cpu")
        with reproducible(seed):
            sizes = {name: size for name, size in shape.tensors.items() if name != _UNUSED}
            initial = {name: _initial(name, size) for name, size in sizes.items()}
            for name, each in (backbone or {}).items():
                initial[f"backbone.{name}"] = torch.from_numpy(np.array(each, dtype=np.float32))
            initial = {name: each.to(self._device) for name, each in initial.items()}
            if self._images is not None and backbone is None:
                rows = torch.randint(len(self._labels), (_SETTLING,))
                with torch.no_grad():
                    image_features(initial, self._images[rows].flatten(0, 1).to(self._device), settle=True)
        self._frozen = {name: each for name, each in initial.items() if name in FROZEN}
        self._weights = {name: each.requires_grad_() for name, each in initial.items() if name not in FROZEN}
        self._mean = {name: each.detach().clone() for name, each in self._weights.items()}
        self._optimizer = torch.optim.AdamW(
            self._weights.values(), lr=settings.learning_rate, weight_decay=_DECAY, fused=True
        )

    def __call__(self, steps: int, on_step: Callable[[int, float], None] = lambda step, loss: None) -> float:
        """Make further gradient steps.

        Args:
            steps: Their number.
            on_step: Callback with the number of steps so far and the recent loss.

        Returns:
            Recent mean deviation, in units of each number's spread.
        """
        recent, ahead = 0.0, torch.arange(self.shape.chunk_size)
        size, last = min(self.settings.batch_size, len(self._labels)), len(self._labels) - 1
        with reproducible(self._seed):
            rng = np.random.default_rng([self._seed, self.done])
            for step in range(steps):
                for group in self._optimizer.param_groups:
                    group["lr"] = self._rate()
                rows = torch.from_numpy(rng.integers(last + 1, size=size))
                known = (ahead < self._left[rows, None])[..., None]
                labels = self._labels[(rows[:, None] + ahead).clamp(max=last)]
                found = self._chunks(rows)
                known, labels = known.to(found.device), labels.to(found.device)
                loss = ((found - labels).abs() * known).sum() / (known.sum() * labels.shape[2])
                self._optimizer.zero_grad()
                loss.backward()
                torch.nn.utils.clip_grad_norm_(self._weights.values(), _LARGEST)
                self._optimizer.step()
                self.done += 1
                kept = min(self.settings.averaging, self.done / (self.done + 10.0))
                with torch.no_grad():
                    for name, each in self._weights.items():
                        self._mean[name].lerp_(each, 1.0 - kept)
                recent = float(loss.detach()) if step == 0 else 0.98 * recent + 0.02 * float(loss.detach())
                on_step(self.done, recent)
        return recent

    def _chunks(self, rows: Any) -> Any:
        """Return the normalised chunks, (n, chunk_size, action), of some samples."""
        inputs = [each[rows].to(self._device) for each in self._inputs]
        images = None if self._images is None else self._images[rows].to(self._device)
        return chunks_of(self.shape, {**self._weights, **self._frozen}, *inputs, images=images)

    def _rate(self) -> float:
        """Return the learning rate of the next step."""
        decay = 0.5 * (1.0 + math.cos(math.pi * min(1.0, self.done / self.settings.fit_steps)))
        return self.settings.learning_rate * min(1.0, (self.done + 1) / _WARM) * decay

    def tensors(self) -> Tensors:
        """Return the mean of the recent weights, for normalised inputs that are not whitened."""
        found = {name: _array(each) for name, each in {**self._mean, **self._frozen}.items()}
        for each, matrix in zip(self.shape.inputs, self._whitenings, strict=True):
            name = f"encoder_{each}_input_proj.weight"
            found[name] = (found[name].astype(np.float64) @ matrix.numpy()).astype(np.float32)
        found[_UNUSED] = np.zeros(self.shape.tensors[_UNUSED], dtype=np.float32)
        return found

    def state(self) -> Tensors:
        """Return all numbers from which the fit continues."""
        found: Tensors = {f"frozen.{name}": _array(each) for name, each in self._frozen.items()}
        moments = self._optimizer.state_dict()["state"]
        for k, (name, each) in enumerate(self._weights.items()):
            found |= {f"weight.{name}": _array(each), f"mean.{name}": _array(self._mean[name])}
            found |= {f"{key}.{name}": _array(value) for key, value in moments.get(k, {}).items()}
        return found

    def restore(self, tensors: Tensors, done: int) -> None:
        """Continue from a state.

        Args:
            tensors: As of `state`.
            done: Gradient steps that it has behind it.

        Raises:
            TrainingError: It is of another network.
        """
        kept: dict[int, dict[str, Any]] = {}
        try:
            for k, (name, each) in enumerate(self._weights.items()):
                if any(tensors[f"{kind}.{name}"].shape != each.shape for kind in ("weight", "mean")):
                    raise ValueError(f"{name} has another shape")
                with torch.no_grad():
                    each.copy_(torch.from_numpy(tensors[f"weight.{name}"]))
                    self._mean[name].copy_(torch.from_numpy(tensors[f"mean.{name}"]))
                names = ("step", "exp_avg", "exp_avg_sq")
                kept[k] = {key: torch.from_numpy(tensors[f"{key}.{name}"].copy()) for key in names}
            for name, each in self._frozen.items():
                each.copy_(torch.from_numpy(tensors[f"frozen.{name}"]))
            self._optimizer.load_state_dict({**self._optimizer.state_dict(), "state": kept})
        except (KeyError, ValueError, RuntimeError) as error:
            raise TrainingError(f"the state is not of this training: {type(error).__name__}: {error!s:.200}") from error
        self.done = done


def _scaled(values: Single, normaliser: Normaliser) -> Any:
    mean, std = np.array(normaliser.mean), np.sqrt(np.array(normaliser.var) + normaliser.epsilon)
    scaled: Array = np.clip((values - mean) / std, -normaliser.clip, normaliser.clip)
    return torch.from_numpy(scaled)


def _array(tensor: Any) -> NDArray[Any]:
    found: NDArray[Any] = tensor.detach().cpu().numpy().copy()
    return found


def _initial(name: str, size: tuple[int, ...]) -> Any:
    """Return random initial weights."""
    if "norm" in name or name in FROZEN:
        return torch.ones(size) if name.endswith(("weight", "var")) else torch.zeros(size)
    if name.startswith("backbone."):
        return torch.nn.init.kaiming_normal_(torch.empty(size), mode="fan_out", nonlinearity="relu")
    if "pos_embed" in name:
        return torch.randn(size)
    return torch.zeros(size) if len(size) == 1 else torch.nn.init.xavier_uniform_(torch.empty(size))
