"""Fit of a transformer to chunks of demonstrations."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any, Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from dual_ur10.errors import MissingExtraError, TrainingError
from dual_ur10.policies.learned.act_network import EPSILON, ActShape
from dual_ur10.policies.learned.network import Normaliser
from dual_ur10.policies.training.regression import normaliser_of, reproducible, whitening_of
from dual_ur10.policies.training.settings import ActSettings
from dual_ur10.policies.training.state import Tensors
from ur_core.types import Array, Single

try:
    import torch
    from torch.nn import functional
except ImportError as error:
    raise MissingExtraError("torch", "train", "training") from error

_WARM: Final = 500  # gradient steps in which the learning rate grows: without them, attention settles on nothing
_DECAY: Final = 1e-4  # of the weights
_LARGEST: Final = 1.0  # norm of a gradient
_UNUSED: Final = "encoder_latent_input_proj.weight"  # what it is multiplied with is always 0
_INPUTS: Final = ("encoder_robot_state_input_proj.weight", "encoder_env_state_input_proj.weight")


class Chunks(NamedTuple):
    """Samples from which chunks are taken.

    Attributes:
        observation: (k, O) observations.
        action: (k, A) action of each sample, as of a chunk.
        left: (k,) number of samples from each one to the end of its episode, itself included.
    """

    observation: Single
    action: Single
    left: NDArray[np.int64]


class ActFit:
    """Transformer that is fitted to chunks step by step, and the mean of its recent weights.

    Inputs are whitened during the fit, as in `dual_ur10.policies.training.regression.Fit`; `tensors` folds the
    whitening into the weights.

    Args:
        settings: Settings of the training.
        shape: Sizes of the network.
        chunks: Samples.
        unseen: Indices of the values of an observation that the network does not see.
        seed: Seed of the initial weights and of the selection of samples.

    Attributes:
        done: Gradient steps so far.
        normalisers: Of the positions of both arms, of the observation and of an action.
    """

    def __init__(self, settings: ActSettings, shape: ActShape, chunks: Chunks, unseen: list[int], seed: int) -> None:
        self.settings, self.shape, self.done, self._seed = settings, shape, 0, seed
        indices, hidden = list(shape.state), {*unseen}
        blind = [k for k, index in enumerate(indices) if index in hidden]
        self.normalisers = (
            normaliser_of(chunks.observation[:, indices], blind),
            normaliser_of(chunks.observation, unseen),
            normaliser_of(chunks.action),
        )
        shown = [_scaled(chunks.observation[:, indices], self.normalisers[0])]
        shown.append(_scaled(chunks.observation, self.normalisers[1]))
        self._whitenings = [whitening_of(each) for each in shown]
        self._inputs = [(each @ matrix.T).float() for each, matrix in zip(shown, self._whitenings, strict=True)]
        self._labels = _scaled(chunks.action, self.normalisers[2]).float()
        self._left = torch.from_numpy(chunks.left)
        with reproducible(seed):
            sizes = {name: size for name, size in shape.tensors.items() if name != _UNUSED}
            self._weights = {name: _initial(name, size).requires_grad_() for name, size in sizes.items()}
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
                found = chunks_of(self.shape, self._weights, *(each[rows] for each in self._inputs))
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

    def _rate(self) -> float:
        """Return the learning rate of the next step."""
        decay = 0.5 * (1.0 + math.cos(math.pi * min(1.0, self.done / self.settings.fit_steps)))
        return self.settings.learning_rate * min(1.0, (self.done + 1) / _WARM) * decay

    def tensors(self) -> Tensors:
        """Return the mean of the recent weights, for normalised inputs that are not whitened."""
        found = {name: each.numpy().copy() for name, each in self._mean.items()}
        for name, matrix in zip(_INPUTS, self._whitenings, strict=True):
            found[name] = (found[name].astype(np.float64) @ matrix.numpy()).astype(np.float32)
        found[_UNUSED] = np.zeros(self.shape.tensors[_UNUSED], dtype=np.float32)
        return found

    def state(self) -> Tensors:
        """Return all numbers from which the fit continues."""
        found: Tensors = {}
        moments = self._optimizer.state_dict()["state"]
        for k, (name, each) in enumerate(self._weights.items()):
            found |= {f"weight.{name}": each.detach().numpy().copy(), f"mean.{name}": self._mean[name].numpy().copy()}
            found |= {f"{key}.{name}": value.numpy().copy() for key, value in moments.get(k, {}).items()}
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
            self._optimizer.load_state_dict({**self._optimizer.state_dict(), "state": kept})
        except (KeyError, ValueError, RuntimeError) as error:
            raise TrainingError(f"the state is not of this training: {type(error).__name__}: {error!s:.200}") from error
        self.done = done


def chunks_of(shape: ActShape, weights: dict[str, Any], state: Any, observation: Any) -> Any:
    """Return chunks, (n, chunk_size, action), as `ActNetwork` does for one cell.

    Args:
        shape: Sizes of the network.
        weights: Its weights by name, tensors of torch.
        state: (n, S) normalised positions of both arms.
        observation: (n, O) normalised observations.
    """

    def dense(name: str, x: Any) -> Any:
        return functional.linear(x, weights[f"{name}.weight"], weights[f"{name}.bias"])

    def norm(name: str, x: Any) -> Any:
        return functional.layer_norm(x, x.shape[-1:], weights[f"{name}.weight"], weights[f"{name}.bias"], EPSILON)

    def attention(name: str, *inputs: Any) -> Any:
        weight, bias = weights[f"{name}.in_proj_weight"].chunk(3), weights[f"{name}.in_proj_bias"].chunk(3)
        heads: list[Any] = list(map(functional.linear, inputs, weight, bias))
        split = [each.unflatten(-1, (shape.n_heads, -1)).transpose(-3, -2) for each in heads]
        found: Any = functional.scaled_dot_product_attention(*split)
        return dense(f"{name}.out_proj", found.transpose(-3, -2).flatten(-2))

    def block(name: str, x: Any, attended: Any, first: int) -> Any:
        x = norm(f"{name}.norm{first}", x + attended)
        return norm(f"{name}.norm{first + 1}", x + dense(f"{name}.linear2", dense(f"{name}.linear1", x).relu()))

    latent = weights["encoder_latent_input_proj.bias"].expand(len(state), -1)
    given = dense("encoder_robot_state_input_proj", state), dense("encoder_env_state_input_proj", observation)
    tokens, places = torch.stack([latent, *given], dim=1), weights["encoder_1d_feature_pos_embed.weight"]
    for k in range(shape.n_encoder_layers):
        name, placed = f"encoder.layers.{k}", tokens + places
        tokens = block(name, tokens, attention(f"{name}.self_attn", placed, placed, tokens), 1)
    name, queries = "decoder.layers.0", weights["decoder_pos_embed.weight"][None]
    x = norm(f"{name}.norm1", attention(f"{name}.self_attn", queries, queries, torch.zeros_like(queries)))
    x = x.expand(len(state), -1, -1)
    x = block(name, x, attention(f"{name}.multihead_attn", x + queries, tokens + places, tokens), 2)
    return dense("action_head", norm("decoder.norm", x))


def _scaled(values: Single, normaliser: Normaliser) -> Any:
    mean, std = np.array(normaliser.mean), np.sqrt(np.array(normaliser.var) + normaliser.epsilon)
    scaled: Array = np.clip((values - mean) / std, -normaliser.clip, normaliser.clip)
    return torch.from_numpy(scaled)


def _initial(name: str, size: tuple[int, ...]) -> Any:
    """Return random initial weights."""
    if "norm" in name:
        return torch.ones(size) if name.endswith("weight") else torch.zeros(size)
    if "pos_embed" in name:
        return torch.randn(size)
    return torch.zeros(size) if len(size) == 1 else torch.nn.init.xavier_uniform_(torch.empty(size))
