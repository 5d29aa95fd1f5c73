"""Files with which LeRobot loads the checkpoint of an ACT: its configuration, and the processors of its numbers.

`config.json`, `policy_preprocessor.json`, `policy_postprocessor.json` and two files of means and deviations stand
beside `model.safetensors`. They are made of the manifest, and nothing of this package reads them.
"""

from __future__ import annotations

import json
from collections.abc import Sequence
from typing import Any, Final

import numpy as np
from safetensors.numpy import save as _serialised

from dual_ur10.errors import DatasetError
from dual_ur10.policies.learned.act_network import LATENT, ActShape
from dual_ur10.policies.learned.manifest import Manifest
from dual_ur10.policies.learned.network import Normaliser
from dual_ur10.policies.learned.resnet import IMAGE_MEAN, IMAGE_STD
from ur_core.tools.tool import strokes_m, tools_of
from ur_core.types import Array, Single

_STATE: Final = "observation.state"
_ENVIRONMENT: Final = "observation.environment_state"
_ACTION: Final = "action"
_NAMES: Final = {"robot_state": (_STATE, "STATE"), "env_state": (_ENVIRONMENT, "ENV")}
_NORM: Final = {"VISUAL": "MEAN_STD", "STATE": "MEAN_STD", "ENV": "MEAN_STD", "ACTION": "MEAN_STD"}
_EPSILON: Final = 1e-8
_DEVICE: Final = {"registry_name": "device_processor", "config": {"device": "cpu", "float_dtype": None}}


IMAGES: Final = "observation.images."
"""Beginning of the names of images."""


def image_key(camera: str) -> str:
    """Return the name of the feature of a camera's images. LeRobot allows no "/" in it."""
    return IMAGES + camera.replace("/", "_")


def image_keys(cameras: Sequence[str]) -> list[str]:
    """Return the names of the features of several cameras.

    Raises:
        DatasetError: Two cameras would have one feature.
    """
    found: dict[str, str] = {}
    for camera in cameras:
        other = found.setdefault(image_key(camera), camera)
        if other != camera:
            raise DatasetError(
                f"images of the cameras {other!r} and {camera!r} would both be {image_key(camera)!r}: leave one out, "
                "or rename it"
            )
    return list(found)


def lerobot_files(manifest: Manifest) -> dict[str, bytes]:
    """Return the files that LeRobot needs beside the weights, by name.

    LeRobot's `observation.state` has the widths of grippers as fractions of their strokes, and its actions have them
    from 0, closed, to 1, open.

    Args:
        manifest: Manifest of a checkpoint, whose network is an `ActShape`.

    Raises:
        DatasetError: Two cameras would have one feature.
    """
    shape = manifest.network
    if not isinstance(shape, ActShape):
        return {}
    inputs = {_NAMES[name][0]: {"type": _NAMES[name][1], "shape": [size]} for name, size in shape.inputs.items()}
    image = {"type": "VISUAL", "shape": [3, shape.height, shape.width]}
    inputs |= dict.fromkeys(image_keys(shape.cameras), image)
    outputs = {_ACTION: {"type": "ACTION", "shape": [shape.action]}}
    config = {
        "type": "act",
        "n_obs_steps": 1,
        "input_features": inputs,
        "output_features": outputs,
        "device": "cpu",
        "push_to_hub": False,
        "normalization_mapping": _NORM,
        "chunk_size": shape.chunk_size,
        "n_action_steps": max(1, shape.chunk_size // 2),  # as often as a chunk follows another here
        "vision_backbone": "resnet18",
        "pretrained_backbone_weights": None,
        "pre_norm": False,
        "dim_model": shape.dim_model,
        "n_heads": shape.n_heads,
        "dim_feedforward": shape.dim_feedforward,
        "feedforward_activation": "relu",
        "n_encoder_layers": shape.n_encoder_layers,
        "n_decoder_layers": 1,
        "use_vae": False,
        "latent_dim": LATENT,
        "dropout": 0.0,
    }
    statistics = _serialised(_statistics(manifest, shape))
    before = "policy_preprocessor_step_3_normalizer_processor.safetensors"
    after = "policy_postprocessor_step_0_unnormalizer_processor.safetensors"
    normalizer = {"eps": _EPSILON, "features": {**inputs, **outputs}, "norm_map": _NORM}
    unnormalizer = {"eps": _EPSILON, "features": outputs, "norm_map": _NORM}
    preprocessor = [
        {"registry_name": "rename_observations_processor", "config": {"rename_map": {}}},
        {"registry_name": "to_batch_processor", "config": {}},
        _DEVICE,
        {"registry_name": "normalizer_processor", "config": normalizer, "state_file": before},
    ]
    postprocessor = [
        {"registry_name": "unnormalizer_processor", "config": unnormalizer, "state_file": after},
        _DEVICE,
    ]
    return {
        "config.json": _text(config),
        "policy_preprocessor.json": _text({"name": "policy_preprocessor", "steps": preprocessor}),
        "policy_postprocessor.json": _text({"name": "policy_postprocessor", "steps": postprocessor}),
        before: statistics,
        after: statistics,
    }


def _statistics(manifest: Manifest, shape: ActShape) -> dict[str, Single]:
    units = np.ones(manifest.signature.action.shape[0])
    if manifest.signature.actions.gripper:
        units[6::7] = strokes_m(tools_of(manifest.signature.robot.tools))
    found: dict[str, Single] = {}
    for camera in shape.cameras:
        for name, value in (("mean", IMAGE_MEAN), ("std", IMAGE_STD)):
            found[f"{image_key(camera)}.{name}"] = np.array(value, dtype=np.float32).reshape(3, 1, 1)
    names = [*(_NAMES[each][0] for each in shape.inputs), _ACTION]
    for name, each in zip(names, manifest.normalisers, strict=True):
        mean, std = _moments(each)
        unit = units if name == _STATE else 1.0
        found |= {f"{name}.mean": (mean / unit).astype(np.float32), f"{name}.std": (std / unit).astype(np.float32)}
    return found


def _moments(normaliser: Normaliser) -> tuple[Array, Array]:
    return np.array(normaliser.mean), np.sqrt(np.array(normaliser.var) + normaliser.epsilon)


def _text(value: Any) -> bytes:
    return (json.dumps(value, indent=1) + "\n").encode()
