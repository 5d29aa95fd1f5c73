"""ResNet18 without its classifier: names and shapes of its weights, which are torchvision's."""

from __future__ import annotations

from typing import Final

CHANNELS: Final = 512
"""Features of each cell of its map."""

WIDTHS: Final = (64, 128, 256, CHANNELS)
"""Channels of each of its stages, which are two blocks. All but the first halve height and width."""

IMAGE_MEAN: Final = (0.485, 0.456, 0.406)
IMAGE_STD: Final = (0.229, 0.224, 0.225)
"""Mean and deviation of red, green and blue, 0 to 1, by which images are normalised: those of ImageNet, as LeRobot's
default and the published weights have them."""

_NORM: Final = ("weight", "bias", "running_mean", "running_var")


def _shapes() -> dict[str, tuple[int, ...]]:
    found: dict[str, tuple[int, ...]] = {}

    def layer(convolution: str, norm: str, inputs: int, outputs: int, size: int) -> None:
        found[f"{convolution}.weight"] = (outputs, inputs, size, size)
        found.update({f"{norm}.{each}": (outputs,) for each in _NORM})

    layer("conv1", "bn1", 3, WIDTHS[0], 7)
    inputs = WIDTHS[0]
    for stage, outputs in enumerate(WIDTHS, 1):
        for block in range(2):
            name = f"layer{stage}.{block}"
            layer(f"{name}.conv1", f"{name}.bn1", inputs, outputs, 3)
            layer(f"{name}.conv2", f"{name}.bn2", outputs, outputs, 3)
            if inputs != outputs:
                layer(f"{name}.downsample.0", f"{name}.downsample.1", inputs, outputs, 1)
            inputs = outputs
    return found


RESNET18: Final = _shapes()
"""Shapes of the weights by name. Normalisations are frozen: none depends on the batch."""


FROZEN: Final = frozenset(f"backbone.{name}" for name, shape in RESNET18.items() if len(shape) == 1)
"""Names in a checkpoint of the weights that no training changes: those of its normalisations."""


def feature_size(height: int, width: int) -> tuple[int, int]:
    """Return height and width of the map of an image: each cell is of 32 x 32 pixels."""
    return -(-height // 32), -(-width // 32)
