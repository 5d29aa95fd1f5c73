"""Small fully connected networks on NumPy alone."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Final, Literal

import numpy as np

from dual_ur10.errors import CheckpointError
from dual_ur10.policies.learned.schema import Numbers, StrictJson, Wholes
from ur_core.types import Array, Single

Layer = tuple[Single, Single]
"""Weight, (out, in), and bias, (out,): as PyTorch has them."""

Activation = Literal["tanh", "relu"]
Squashing = Literal["clip", "tanh"]

MOST_WIDTH: Final = 4096
MOST_LAYERS: Final = 8
MOST_PARAMETERS: Final = 4_000_000
"""Bounds of a network's size."""

# OpenBLAS computes products with a larger matrix on several threads. Waiting for them would delay the processes that
# send to two controllers, and the order of additions would depend on the machine.
_MOST_BLOCK: Final = 8192


@dataclass(frozen=True)
class Normaliser(StrictJson):
    """Mean and variance by which observations are normalised.

    Attributes:
        mean, var: (size,) mean and variance of each number.
        clip: Largest normalised deviation.
        epsilon: Constant added to the variance.

    Raises:
        CheckpointError: A value is not possible.
    """

    mean: Numbers
    var: Numbers
    clip: float = 10.0
    epsilon: float = 1e-8

    def __post_init__(self) -> None:
        if len(self.mean) != len(self.var):
            raise CheckpointError(f"the normaliser has {len(self.mean)} means and {len(self.var)} variances: one each")
        if not all(each >= 0 for each in self.var):
            raise CheckpointError(f"the normaliser has a variance of {min(self.var)}: it must be 0 or more")
        if not (self.clip > 0 and self.epsilon > 0):
            raise CheckpointError(f"clip {self.clip} and epsilon {self.epsilon} of the normaliser must be above 0")


@dataclass(frozen=True)
class NetworkShape(StrictJson):
    """Sizes and functions of a network.

    Attributes:
        layers: Number of inputs, units of each hidden layer, number of outputs.
        activation: Activation of the hidden layers.
        squashing: "clip": the output is the action, clipped to its bounds. "tanh": the output's hyperbolic tangent
            maps from [-1, 1] to the bounds of the action.

    Raises:
        CheckpointError: A size is not possible.
    """

    layers: Wholes
    activation: Activation
    squashing: Squashing

    def __post_init__(self) -> None:
        if not 2 <= len(self.layers) <= MOST_LAYERS + 1 or not all(1 <= each <= MOST_WIDTH for each in self.layers):
            raise CheckpointError(
                f"the network has sizes {self.layers!r:.80}: allowed are 1 to {MOST_LAYERS} layers of 1 to {MOST_WIDTH}"
            )
        if self.parameters > MOST_PARAMETERS:
            raise CheckpointError(f"the network has {self.parameters} numbers: allowed are {MOST_PARAMETERS}")

    @property
    def pairs(self) -> list[tuple[int, int]]:
        """Numbers of inputs and outputs of each layer."""
        return list(zip(self.layers[:-1], self.layers[1:], strict=True))

    @property
    def parameters(self) -> int:
        """Number of parameters."""
        return sum((inputs + 1) * outputs for inputs, outputs in self.pairs)

    @property
    def tensors(self) -> dict[str, tuple[int, ...]]:
        """Shapes of the weights, by their names in a file."""
        return {
            f"{k}.{kind}": shape
            for k, (inputs, outputs) in enumerate(self.pairs)
            for kind, shape in (("weight", (outputs, inputs)), ("bias", (outputs,)))
        }


class Network:
    """Function from observations to actions. A row of a batch gives the same bits as a single observation.

    Args:
        shape: Sizes and functions.
        layers: Weight and bias of each layer.
        low, high: (out,) bounds of the action.
        normaliser: Normaliser of observations; None: they enter as they are.
    """

    def __init__(
        self, shape: NetworkShape, layers: Sequence[Layer], low: Single, high: Single, normaliser: Normaliser | None
    ) -> None:
        self.shape = shape
        self._low, self._high = low.astype(np.float32), high.astype(np.float32)
        self._half = np.float32(0.5) * (self._high - self._low)
        self._squash = shape.squashing == "tanh"
        self._activation: Callable[[Single], Single] = np.tanh if shape.activation == "tanh" else _relu
        self._layers = [DenseLayer(weight, bias) for weight, bias in layers]
        self._mean: Array | None = None
        if normaliser is not None:
            self._mean = np.array(normaliser.mean)
            self._deviation = np.sqrt(np.array(normaliser.var) + normaliser.epsilon)
            self._clip = normaliser.clip

    def __call__(self, observation: Array) -> Single:
        """Return actions, (n, out), for observations, (n, in)."""
        if self._mean is not None:
            observation = (observation - self._mean) / self._deviation
            np.clip(observation, -self._clip, self._clip, out=observation)
        with np.errstate(over="ignore", invalid="ignore"):
            x: Single = observation.astype(np.float32)
            last = len(self._layers) - 1
            for k, layer in enumerate(self._layers):
                x = layer(x)
                if k < last:
                    x = self._activation(x)
            if self._squash:
                x = np.asarray(self._low + self._half * (np.tanh(x) + np.float32(1.0)), dtype=np.float32)
            result: Single = np.clip(x, self._low, self._high)
        return result


def _relu(x: Single) -> Single:
    result: Single = np.maximum(x, np.float32(0.0))
    return result


class DenseLayer:
    """Layer of a network. A row of a batch gives the same bits as a single one, on any number of threads.

    Args:
        weight: (out, in) weight.
        bias: (out,) bias.
    """

    def __init__(self, weight: Single, bias: Single) -> None:
        outputs, inputs = weight.shape
        # Each block is small enough for one thread.
        width = min(outputs, max(1, _MOST_BLOCK // inputs))
        count = -(-outputs // width)
        padded = np.zeros((count * width, inputs), dtype=np.float32)
        padded[:outputs] = weight
        self._weight = np.ascontiguousarray(padded.reshape(count, width, inputs).transpose(0, 2, 1))
        self._bias = bias.astype(np.float32)

    def __call__(self, x: Single) -> Single:
        """Return outputs, (n, out), for inputs, (n, in)."""
        # (n, 1, 1, in) and (blocks, in, width): one small product for each row and block.
        found: Single = (x[:, None, None, :] @ self._weight).reshape(len(x), -1)[:, : len(self._bias)] + self._bias
        return found
