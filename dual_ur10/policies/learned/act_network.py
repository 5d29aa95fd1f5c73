"""ACT: a small transformer that returns a chunk of actions for one observation, on NumPy alone.

T. Zhao et al., "Learning Fine-Grained Bimanual Manipulation with Low-Cost Hardware", RSS 2023, without its variational
encoder. Names and shapes of the weights are LeRobot's. With images it needs PyTorch; see
`dual_ur10.policies.learned.act_torch`.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from math import prod
from typing import Annotated, Final

import numpy as np

from dual_ur10.errors import CheckpointError
from dual_ur10.policies.chunks.chunk_policy import MOST_ACTIONS, ChunkMode
from dual_ur10.policies.learned.network import MOST_LAYERS, MOST_PARAMETERS, MOST_WIDTH, DenseLayer
from dual_ur10.policies.learned.resnet import CHANNELS, RESNET18, feature_size
from dual_ur10.policies.learned.schema import JsonList, StrictJson, Text, Whole, Wholes
from ur_core.types import Single

LATENT: Final = 1
"""Size of the style variable, which is 0: LeRobot's ACT has it with and without its variational encoder."""

EPSILON: Final = 1e-5
"""Constant added to the variance by which a token is normalised."""

MOST_WITH_IMAGES: Final = 64_000_000
"""Bound of the parameters of a network that sees images: LeRobot's usual one has 34 million."""

_MOST_TOKENS: Final = 4096  # of all images: attention takes as much memory as the square of it
_MOST_HEIGHT, _MOST_WIDTH = 1080, 1920

ActTensors = Mapping[str, Single]
"""Weights by their names in LeRobot's files, without their prefix "model."."""


@dataclass(frozen=True)
class ActShape(StrictJson):
    """Sizes of a transformer, by LeRobot's names, and the meaning of its numbers.

    Attributes:
        state: Indices, in an observation of both arms, of what LeRobot calls `observation.state`: the commanded joints
            of the left arm and its gripper's width, then those of the right one. There are as many as numbers of an
            action.
        environment_state: Size of an observation of both arms, which is `observation.environment_state`; 0 with
            images, which are in its place.
        chunk_size: Number of actions in a chunk.
        dim_model: Size of a token.
        n_heads: Number of heads of the attention.
        dim_feedforward: Units of the hidden layer behind an attention.
        n_encoder_layers: Number of layers of the encoder. The decoder has one.
        action_mode: Meaning of a chunk's actions; see `dual_ur10.policies.chunks.chunk_policy.ChunkPolicy`.
        cameras: Names of the cameras whose images it sees, in order; (): it sees none.
        height, width: Size of an image in pixels; 0 without images.

    Raises:
        CheckpointError: A size is not possible.
    """

    state: Wholes
    environment_state: Whole
    chunk_size: Whole
    dim_model: Whole
    n_heads: Whole
    dim_feedforward: Whole
    n_encoder_layers: Whole
    action_mode: ChunkMode
    cameras: Annotated[tuple[Text, ...], JsonList] = ()
    height: Whole = 0
    width: Whole = 0

    def __post_init__(self) -> None:
        for name, most in (
            *([("height", _MOST_HEIGHT), ("width", _MOST_WIDTH)] if self.cameras else []),
            *([] if self.cameras else [("environment_state", MOST_WIDTH)]),
            ("chunk_size", MOST_ACTIONS),
            ("dim_model", MOST_WIDTH),
            ("n_heads", MOST_WIDTH),
            ("dim_feedforward", MOST_WIDTH),
            ("n_encoder_layers", MOST_LAYERS),
        ):
            if not 1 <= getattr(self, name) <= most:
                raise CheckpointError(f"{name} is {getattr(self, name)!r:.80}: it must be 1 to {most}")
        if self.environment_state if self.cameras else self.height or self.width:
            raise CheckpointError(
                f"the network has {len(self.cameras)} cameras, images of {self.height} x {self.width} and "
                f"environment_state {self.environment_state}: it sees images, or else environment_state"
            )
        if not 1 <= len(self.state) <= MOST_WIDTH or not all(0 <= k < MOST_WIDTH for k in self.state):
            raise CheckpointError(f"state is {self.state!r:.80}: it must be indices of an observation")
        if self.dim_model % self.n_heads:
            raise CheckpointError(f"n_heads is {self.n_heads}: it must divide dim_model, {self.dim_model}")
        if self.cameras and self.dim_model % 4:
            raise CheckpointError(f"dim_model is {self.dim_model}: with images it must be a multiple of 4")
        tokens = len(self.cameras) * prod(feature_size(self.height, self.width))
        if tokens > _MOST_TOKENS:
            raise CheckpointError(f"the images have {tokens} tokens of 32 x 32 pixels: allowed are {_MOST_TOKENS}")
        most = MOST_WITH_IMAGES if self.cameras else MOST_PARAMETERS
        if self.parameters > most:
            raise CheckpointError(f"the network has {self.parameters} numbers: allowed are {most}")

    @property
    def action(self) -> int:
        """Numbers of an action."""
        return len(self.state)

    @property
    def inputs(self) -> dict[str, int]:
        """Sizes of the normalised numbers that it sees, by their names in the weights."""
        environment = {"env_state": self.environment_state} if self.environment_state else {}
        return {"robot_state": len(self.state), **environment}

    @property
    def parameters(self) -> int:
        """Number of parameters."""
        return sum(map(prod, self.tensors.values()))

    @property
    def tensors(self) -> dict[str, tuple[int, ...]]:
        """Shapes of the weights, by their names in a file."""
        size, wide = self.dim_model, self.dim_feedforward

        def dense(name: str, inputs: int, outputs: int) -> dict[str, tuple[int, ...]]:
            return {f"{name}.weight": (outputs, inputs), f"{name}.bias": (outputs,)}

        def norm(name: str) -> dict[str, tuple[int, ...]]:
            return {f"{name}.weight": (size,), f"{name}.bias": (size,)}

        def layer(name: str, *attentions: str) -> dict[str, tuple[int, ...]]:
            found = dense(f"{name}.linear1", size, wide) | dense(f"{name}.linear2", wide, size)
            for k, each in enumerate(attentions):
                found |= {f"{name}.{each}.in_proj_weight": (3 * size, size), f"{name}.{each}.in_proj_bias": (3 * size,)}
                found |= dense(f"{name}.{each}.out_proj", size, size) | norm(f"{name}.norm{k + 1}")
            return found | norm(f"{name}.norm{len(attentions) + 1}")

        found: dict[str, tuple[int, ...]] = {}
        for k in range(self.n_encoder_layers):
            found |= layer(f"encoder.layers.{k}", "self_attn")
        found |= layer("decoder.layers.0", "self_attn", "multihead_attn") | norm("decoder.norm")
        for name, inputs in {**self.inputs, "latent": LATENT}.items():
            found |= dense(f"encoder_{name}_input_proj", inputs, size)
        found |= {"encoder_1d_feature_pos_embed.weight": (1 + len(self.inputs), size)}
        if self.cameras:
            found |= {f"backbone.{name}": shape for name, shape in RESNET18.items()}
            found |= {"encoder_img_feat_input_proj.weight": (size, CHANNELS, 1, 1)}
            found |= {"encoder_img_feat_input_proj.bias": (size,)}
        found |= {"decoder_pos_embed.weight": (self.chunk_size, size)}
        return found | dense("action_head", size, self.action)


class ActNetwork:
    """Function from a normalised observation to a normalised chunk.

    Args:
        shape: Its sizes.
        tensors: Its weights.
    """

    def __init__(self, shape: ActShape, tensors: ActTensors) -> None:
        self.shape = shape
        self._state = _dense(tensors, "encoder_robot_state_input_proj")
        self._environment = _dense(tensors, "encoder_env_state_input_proj")
        self._latent = tensors["encoder_latent_input_proj.bias"]
        self._places = tensors["encoder_1d_feature_pos_embed.weight"]
        self._encoder = [_AttentionBlock(shape, tensors, f"encoder.layers.{k}") for k in range(shape.n_encoder_layers)]
        decoder = "decoder.layers.0"
        self._queries = tensors["decoder_pos_embed.weight"]
        # The decoder begins with zeros, so that what its queries find in each other depends on no observation.
        empty = np.zeros((shape.chunk_size, shape.dim_model), dtype=np.float32)
        own = _Attention(shape, tensors, f"{decoder}.self_attn")(self._queries, self._queries, empty)
        self._begin = _Norm(tensors, f"{decoder}.norm1")(own)
        self._decoder = _AttentionBlock(shape, tensors, decoder, "multihead_attn", first_norm=2)
        self._norm = _Norm(tensors, "decoder.norm")
        self._head = _dense(tensors, "action_head")

    def __call__(self, state: Single, observation: Single) -> Single:
        """Return a chunk, (chunk_size, action), for the normalised state, (S,), and observation, (O,), of one cell."""
        with np.errstate(over="ignore", invalid="ignore"):
            tokens = np.stack([self._latent, self._state(state[None])[0], self._environment(observation[None])[0]])
            for block in self._encoder:
                placed = tokens + self._places
                tokens = block(tokens, placed, placed, tokens)
            found = self._decoder(self._begin, self._begin + self._queries, tokens + self._places, tokens)
            return self._head(self._norm(found))


class _Norm:
    def __init__(self, tensors: ActTensors, name: str) -> None:
        self._weight, self._bias = tensors[f"{name}.weight"], tensors[f"{name}.bias"]

    def __call__(self, x: Single) -> Single:
        centred = x - x.mean(axis=1, keepdims=True)
        std = np.sqrt((centred * centred).mean(axis=1, keepdims=True) + np.float32(EPSILON))
        found: Single = centred / std * self._weight + self._bias
        return found


class _Attention:
    """Attention of several heads.

    Args:
        shape: Sizes of the network.
        tensors: Its weights.
        name: Beginning of the names of the weights.
    """

    def __init__(self, shape: ActShape, tensors: ActTensors, name: str) -> None:
        weights = np.split(tensors[f"{name}.in_proj_weight"], 3)
        biases = np.split(tensors[f"{name}.in_proj_bias"], 3)
        self._query, self._key, self._value = map(DenseLayer, weights, biases)
        self._out = _dense(tensors, f"{name}.out_proj")
        self._heads, self._scale = shape.n_heads, np.float32((shape.dim_model // shape.n_heads) ** -0.5)

    def __call__(self, query: Single, key: Single, value: Single) -> Single:
        """Return tokens, (q, dim_model), for queries, (q, dim_model), keys and values, (k, dim_model)."""
        asked, keys = self._split(self._query(query) * self._scale), self._split(self._key(key))
        scores = asked @ keys.transpose(0, 2, 1)
        weights = np.exp(scores - scores.max(axis=2, keepdims=True))
        weights /= weights.sum(axis=2, keepdims=True)
        return self._out((weights @ self._split(self._value(value))).transpose(1, 0, 2).reshape(len(query), -1))

    def _split(self, x: Single) -> Single:
        return x.reshape(len(x), self._heads, -1).transpose(1, 0, 2)


class _AttentionBlock:
    """Attention and the layers behind it, each added to its input and normalised.

    Args:
        shape: Sizes of the network.
        tensors: Its weights.
        name: Beginning of the names of the weights.
        attention: Name of the attention.
        first_norm: Number in the name of the first normalisation.
    """

    def __init__(
        self, shape: ActShape, tensors: ActTensors, name: str, attention: str = "self_attn", first_norm: int = 1
    ) -> None:
        self._attention = _Attention(shape, tensors, f"{name}.{attention}")
        self._norms = [_Norm(tensors, f"{name}.norm{k}") for k in (first_norm, first_norm + 1)]
        self._linear1, self._linear2 = _dense(tensors, f"{name}.linear1"), _dense(tensors, f"{name}.linear2")

    def __call__(self, x: Single, query: Single, key: Single, value: Single) -> Single:
        """Return tokens, (q, dim_model), of the same number as `x` and queries."""
        x = self._norms[0](x + self._attention(query, key, value))
        hidden: Single = np.maximum(self._linear1(x), np.float32(0.0))
        return self._norms[1](x + self._linear2(hidden))


def _dense(tensors: ActTensors, name: str) -> DenseLayer:
    return DenseLayer(tensors[f"{name}.weight"], tensors[f"{name}.bias"])
