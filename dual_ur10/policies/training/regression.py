"""Regression of networks on samples of observations and actions."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from itertools import pairwise
from typing import Any, Final

import numpy as np

from dual_ur10.errors import MissingExtraError
from dual_ur10.policies.learned.network import Layer, NetworkShape, Normaliser
from dual_ur10.policies.training.settings import Imitation
from ur_core.types import Array, Single

try:
    import torch
    from torch import nn
except ImportError as error:
    raise MissingExtraError("torch", "train", "training") from error

THREADS: Final = 1
"""Threads of torch on every machine: the last bits of sums depend on their number. Small networks gain little from more
threads, and lose much on a busy machine."""

_BLIND: Final = 1e24  # variance of a value that the network does not see
_LEAST_STD: Final = 2e-3  # of an observation, so that noise on a nearly constant value is not amplified (2 mm, 2 mrad)
_LEAST_ACTION_STD: Final = 1e-2
_LEAST_SPREAD: Final = 1e-3  # of a direction of normalised observations, above which it counts
_LEAST_GAIN: Final = 1e-2  # keeps the whitening invertible
_CLIP: Final = 10.0
_FAR: Final = 0.3  # of an action's spread, beyond which errors count linearly: large errors need no precision
_ACTIVATIONS: Final = {"tanh": nn.Tanh, "relu": nn.ReLU}


@contextmanager
def reproducible(seed: int) -> Iterator[None]:
    """Run torch with fixed threads, deterministic algorithms and a seed."""
    threads, strict = torch.get_num_threads(), torch.are_deterministic_algorithms_enabled()
    torch.set_num_threads(THREADS)
    torch.use_deterministic_algorithms(True, warn_only=torch.cuda.is_available())  # a GPU may lack one of them
    try:
        with torch.random.fork_rng(devices=[]):
            torch.manual_seed(seed)
            yield
    finally:
        torch.use_deterministic_algorithms(strict)
        torch.set_num_threads(threads)


def normaliser_of(observation: Single, unseen: Sequence[int] = ()) -> Normaliser:
    """Return mean and variance of observations, (k, size); unseen values get a huge variance."""
    mean, std = observation.mean(axis=0, dtype=np.float64), observation.std(axis=0, dtype=np.float64)
    var = np.maximum(std, _LEAST_STD) ** 2
    var[list(unseen)] = _BLIND
    return Normaliser(tuple(mean.tolist()), tuple(var.tolist()), _CLIP)


def whitening_of(normalised: Any) -> Any:
    """Return the matrix, (size, size), that whitens normalised observations, (k, size).

    The next command depends on differences of values that otherwise move together, such as commanded positions and the
    block's: a thousandth of their spread, which gradients would hardly ever resolve. Directions that vary still less
    are attenuated: the samples do not show their effect.
    """
    centred = normalised - normalised.mean(dim=0)
    values, vectors = torch.linalg.eigh(centred.T @ centred / len(centred))
    spread = values.clamp(min=0.0).sqrt()
    gain = (spread / (spread**2 + _LEAST_SPREAD**2)).clamp(min=_LEAST_GAIN)
    return (vectors * gain).T.contiguous()


@dataclass(frozen=True)
class Scatter:
    """Displacement of samples from the demonstrated path, with the action that leads back to it.

    A step of joints leads from the commanded positions, which are observed, to a goal. For other commanded positions
    the action that leads to the same goal is therefore known, and a few demonstrations show how to correct
    deviations (L. Ke et al., "CCIL: Continuity-based Data Augmentation for Corrective Imitation Learning", ICLR 2024).

    Args:
        std_rad: Largest standard deviation of a displacement. Each sample has its own, from 0 to this.
        observed: Indices of the commanded joint positions in an observation.
        actions: Indices of the same joints in an action.
        step_rad: Step of each of them for an action of 1.
    """

    std_rad: float
    observed: Sequence[int]
    actions: Sequence[int]
    step_rad: Sequence[float]

    def __call__(self, action: Single, rng: np.random.Generator) -> tuple[Array, Single]:
        """Return displacements, (k, joints), and the actions, (k, A), that belong to them."""
        count = len(action)
        off = self.std_rad * rng.random((count, 1)) * rng.standard_normal((count, len(self.observed)))
        off[: count // 2] = 0.0
        found = action.copy()
        found[:, self.actions] = np.clip(found[:, self.actions] - off / np.array(self.step_rad), -1.0, 1.0)
        return off, found


class Fit:
    """Network that each call fits to samples, from where the last fit ended.

    Its inputs and outputs are normalised by the samples of its first fit. During a fit the inputs are whitened;
    `layers` folds the whitening into the first layer.

    Args:
        settings: Settings of the imitation.
        layers: Initial layers; None: random ones.
        normaliser: Normaliser of the initial layers.
        unseen: Indices of the values of an observation that the network does not see.
        scatter: Displacement of the samples of each gradient step; None: the samples as they are.
    """

    def __init__(
        self,
        settings: Imitation,
        layers: Sequence[Layer] | None = None,
        normaliser: Normaliser | None = None,
        unseen: Sequence[int] = (),
        scatter: Scatter | None = None,
    ) -> None:
        self.settings, self.normaliser, self._unseen, self._scatter = settings, normaliser, unseen, scatter
        self._initial = layers
        self._net: Any = None

    def __call__(
        self,
        observation: Single,
        action: Single,
        steps: int,
        rng: np.random.Generator,
        on_step: Callable[[int, float], None] = lambda step, loss: None,
    ) -> float:
        """Fit to samples, (k, O) and (k, A).

        Args:
            observation: Observations.
            action: Actions.
            steps: Gradient steps.
            rng: Generator that selects the samples of each step.
            on_step: Callback with the number of steps and the recent loss.

        Returns:
            Recent Huber loss, in units of each action's spread.
        """
        if self.normaliser is None:
            self.normaliser = normaliser_of(observation, self._unseen)
        mean, std = np.array(self.normaliser.mean), np.sqrt(np.array(self.normaliser.var) + self.normaliser.epsilon)
        normalised = torch.from_numpy(np.clip((observation - mean) / std, -_CLIP, _CLIP))
        scatter = self._scatter
        if self._net is None:
            shown = normalised
            if scatter is not None:  # directions in which only displacements vary count, too
                shown = normalised.clone()
                seen = list(scatter.observed)
                shown[:, seen] += torch.from_numpy(scatter(action, rng)[0] / std[seen])
            self._whitening = whitening_of(shown)
            self._build(observation.shape[1], action)
        x = (normalised @ self._whitening.T).to(torch.float32)
        y = self._in_units(action)
        rate, size = self.settings.learning_rate, min(self.settings.batch_size, len(x))
        if scatter is not None:
            seen = list(scatter.observed)
            # A gripper acts where the arm has arrived: a displaced sample does not show its action.
            known = torch.zeros(size, action.shape[1], dtype=torch.bool)
            known[: size // 2], known[:, list(scatter.actions)] = True, True
            into_x = (self._whitening[:, seen].T / torch.from_numpy(std[seen, None])).to(torch.float32)
        optimizer = torch.optim.Adam(self._net.parameters(), lr=rate)
        recent = 0.0
        for step in range(steps):
            for group in optimizer.param_groups:
                group["lr"] = rate * (0.005 + 0.995 * 0.5 * (1.0 + math.cos(math.pi * step / steps)))
            rows = rng.integers(len(x), size=size)
            chosen = torch.from_numpy(rows)
            inputs, labels = x[chosen], y[chosen]
            if scatter is not None:
                off, corrected = scatter(action[rows], rng)
                inputs = inputs + torch.from_numpy(off.astype(np.float32)) @ into_x
                labels = self._in_units(corrected)
            found = self._net(inputs)
            if scatter is not None:
                found = torch.where(known, found, labels)
            loss = nn.functional.smooth_l1_loss(found, labels, beta=_FAR)
            optimizer.zero_grad()
            loss.backward()  # type: ignore[no-untyped-call]  # torch's
            nn.utils.clip_grad_norm_(self._net.parameters(), 1.0)
            optimizer.step()
            recent = float(loss.detach()) if step == 0 else 0.98 * recent + 0.02 * float(loss.detach())
            on_step(step + 1, recent)
        return recent

    def _in_units(self, action: Single) -> Any:
        """Return actions as a tensor in units of their spread."""
        return torch.from_numpy(((action - self._shift) / self._scale).astype(np.float32))

    def _build(self, inputs: int, action: Single) -> None:
        sizes = (inputs, *self.settings.hidden, action.shape[1])
        modules: list[Any] = []
        for into, out in pairwise(sizes):
            modules += [nn.Linear(into, out), _ACTIVATIONS[self.settings.activation]()]
        self._net = nn.Sequential(*modules[:-1])
        self._shift = action.mean(axis=0, dtype=np.float64)
        self._scale = np.maximum(action.std(axis=0, dtype=np.float64), _LEAST_ACTION_STD)
        if self._initial is not None:
            for module, (weight, bias) in zip(self._linear, self._initial, strict=True):
                with torch.no_grad():
                    module.weight.copy_(torch.from_numpy(weight))
                    module.bias.copy_(torch.from_numpy(bias))
            with torch.no_grad():  # inputs are whitened, outputs are in units of the actions' spread
                first = self._linear[0].weight
                first.copy_(torch.linalg.solve(self._whitening, first.to(torch.float64), left=False))
                self._linear[-1].weight /= torch.from_numpy(self._scale[:, None].astype(np.float32))
                self._linear[-1].bias -= torch.from_numpy(self._shift.astype(np.float32))
                self._linear[-1].bias /= torch.from_numpy(self._scale.astype(np.float32))

    @property
    def _linear(self) -> list[Any]:
        return [module for module in self._net if isinstance(module, nn.Linear)]

    def layers(self) -> list[Layer]:
        """Return weight and bias of each layer, from normalised observations to actions."""
        found = [
            (module.weight.detach().numpy().astype(np.float32), module.bias.detach().numpy().astype(np.float32))
            for module in self._linear
        ]
        found[0] = (found[0][0].astype(np.float64) @ self._whitening.numpy()).astype(np.float32), found[0][1]
        weight, bias = found[-1]
        scaled = weight * self._scale[:, None], bias * self._scale + self._shift
        found[-1] = (scaled[0].astype(np.float32), scaled[1].astype(np.float32))
        return [(weight.copy(), bias.copy()) for weight, bias in found]

    def shape(self) -> NetworkShape:
        """Return the shape of the network."""
        linear = self._linear
        sizes = (linear[0].in_features, *(each.out_features for each in linear))
        return NetworkShape(sizes, self.settings.activation, "clip")
