"""ACT on PyTorch: chunks for batches of observations, and from images."""

from __future__ import annotations

import math
import os
from collections.abc import Mapping
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from dual_ur10.errors import MissingExtraError
from dual_ur10.policies.learned.act_network import EPSILON, ActShape, ActTensors
from dual_ur10.policies.learned.resnet import IMAGE_MEAN, IMAGE_STD, WIDTHS, feature_size
from ur_core.types import Single

try:
    import torch
    from torch.nn import functional
except ImportError as error:
    raise MissingExtraError("torch", "train", "ACT on images") from error

_WAVELENGTH: Final = 10_000.0  # longest, of the places in an image
_LEAST: Final = 1e-6


def device() -> Any:
    """Return the device of networks that see images: the first GPU, or the processor."""
    if not torch.cuda.is_available():
        return torch.device("cpu")
    os.environ.setdefault("CUBLAS_WORKSPACE_CONFIG", ":4096:8")  # without it, its sums do not repeat
    return torch.device("cuda")


class ActImageNetwork:
    """Function from normalised positions and images to a normalised chunk.

    Args:
        shape: Its sizes, with cameras.
        tensors: Its weights.
    """

    def __init__(self, shape: ActShape, tensors: ActTensors) -> None:
        self.shape, self._device = shape, device()
        self._weights = {name: torch.from_numpy(np.array(each)).to(self._device) for name, each in tensors.items()}

    def __call__(self, state: Single, images: NDArray[np.uint8]) -> Single:
        """Return a chunk, (chunk_size, action).

        Args:
            state: (S,) normalised positions of one cell.
            images: (cameras, height, width, 3) its images.
        """
        given = (torch.from_numpy(each[None]).to(self._device) for each in (state, images))
        threads = torch.get_num_threads()
        torch.set_num_threads(1)  # the last bits of sums depend on their number
        try:
            with torch.inference_mode():
                numbers, pictures = given
                found: Single = chunks_of(self.shape, self._weights, numbers, images=pictures)[0].cpu().numpy()
        finally:
            torch.set_num_threads(threads)
        return found


def chunks_of(shape: ActShape, weights: Mapping[str, Any], *inputs: Any, images: Any = None) -> Any:
    """Return chunks, (n, chunk_size, action), as `dual_ur10.policies.learned.act_network.ActNetwork` does for one cell.

    Args:
        shape: Sizes of the network.
        weights: Its weights by name, tensors of torch.
        *inputs: Normalised numbers, (n, size), in the order of `shape.inputs`.
        images: (n, cameras, height, width, 3) uint8; None without cameras.
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

    latent = weights["encoder_latent_input_proj.bias"].expand(len(inputs[0]), -1)
    given = [dense(f"encoder_{name}_input_proj", each) for name, each in zip(shape.inputs, inputs, strict=True)]
    tokens, places = torch.stack([latent, *given], dim=1), weights["encoder_1d_feature_pos_embed.weight"]
    if images is not None:
        tokens = torch.cat([tokens, _image_tokens(weights, images)], dim=1)
        each = _places(*feature_size(shape.height, shape.width), shape.dim_model, places.device)
        places = torch.cat([places, each.repeat(len(shape.cameras), 1)])
    for k in range(shape.n_encoder_layers):
        name, placed = f"encoder.layers.{k}", tokens + places
        tokens = block(name, tokens, attention(f"{name}.self_attn", placed, placed, tokens), 1)
    name, queries = "decoder.layers.0", weights["decoder_pos_embed.weight"][None]
    x = norm(f"{name}.norm1", attention(f"{name}.self_attn", queries, queries, torch.zeros_like(queries)))
    x = x.expand(len(tokens), -1, -1)
    x = block(name, x, attention(f"{name}.multihead_attn", x + queries, tokens + places, tokens), 2)
    return dense("action_head", norm("decoder.norm", x))


def image_features(weights: Mapping[str, Any], images: Any, *, settle: bool = False) -> Any:
    """Return the maps of ResNet18, (m, 512, h, w), of images, (m, height, width, 3) uint8.

    Args:
        weights: Weights of the network by name, tensors of torch.
        images: The images.
        settle: Set mean and variance of each normalisation to those of these images first.
    """

    def convolution(name: str, x: Any, stride: int, padding: int) -> Any:
        return functional.conv2d(x, weights[f"backbone.{name}.weight"], stride=stride, padding=padding)

    def norm(name: str, x: Any) -> Any:
        mean, var = (weights[f"backbone.{name}.running_{each}"] for each in ("mean", "var"))
        weight, bias = (weights[f"backbone.{name}.{each}"] for each in ("weight", "bias"))
        return functional.batch_norm(x, mean, var, weight, bias, settle, momentum=1.0, eps=EPSILON)

    mean, std = (torch.tensor(each, device=images.device)[:, None, None] for each in (IMAGE_MEAN, IMAGE_STD))
    x = (images.movedim(-1, 1).float() / 255.0 - mean) / std
    x = functional.max_pool2d(norm("bn1", convolution("conv1", x, 2, 3)).relu(), 3, 2, 1)
    for stage in range(1, len(WIDTHS) + 1):
        for number in range(2):
            name, stride = f"layer{stage}.{number}", 2 if stage > 1 and number == 0 else 1
            beside = x if stride == 1 else norm(f"{name}.downsample.1", convolution(f"{name}.downsample.0", x, 2, 0))
            x = norm(f"{name}.bn1", convolution(f"{name}.conv1", x, stride, 1)).relu()
            x = (norm(f"{name}.bn2", convolution(f"{name}.conv2", x, 1, 1)) + beside).relu()
    return x


def _image_tokens(weights: Mapping[str, Any], images: Any) -> Any:
    """Return the tokens, (n, cameras * h * w, dim_model), of images, (n, cameras, height, width, 3)."""
    name = "encoder_img_feat_input_proj"
    features = image_features(weights, images.flatten(0, 1)).flatten(2).movedim(1, 2)
    found = functional.linear(features, weights[f"{name}.weight"].flatten(1), weights[f"{name}.bias"])
    return found.reshape(len(images), -1, found.shape[-1])


def _places(height: int, width: int, size: int, place: Any) -> Any:
    """Return the sinusoidal embeddings, (height * width, size), of the places in a map, as LeRobot has them."""
    quarter = torch.arange(size // 4, device=place)
    frequency = _WAVELENGTH ** (-4.0 * quarter / size)
    rows, columns = (
        torch.arange(1, count + 1, device=place) / (count + _LEAST) * 2.0 * math.pi for count in (height, width)
    )
    halves = []
    for along in (rows[:, None].expand(height, width), columns[None].expand(height, width)):
        angle = along[..., None] * frequency
        halves.append(torch.stack([angle.sin(), angle.cos()], dim=-1).flatten(2))
    return torch.cat(halves, dim=-1).flatten(0, 1)
