"""Small checkpoints of ACT."""

from __future__ import annotations

from typing import Any

import numpy as np

from dual_ur10.policies.learned.act_network import ActShape
from dual_ur10.policies.learned.manifest import Manifest
from dual_ur10.policies.learned.network import Normaliser
from dual_ur10.policies.learned.signature import view_of
from ur_core.types import Single


def act_parts(env_id: str, **keywords: Any) -> tuple[list[Any], Manifest]:
    """Return random weights of a small transformer, and their manifest."""
    rng, view = np.random.default_rng(0), view_of(env_id, keywords)
    signature, options = view.signature, view.setup.options
    fields = ["commanded_q_rad", *(["gripper_m"] if signature.actions.gripper else [])]
    shape = ActShape(
        state=tuple(view.indices(fields, joint=True)),
        environment_state=0 if options.pictured else signature.observation.shape[0],
        chunk_size=6,
        dim_model=12,
        n_heads=3,
        dim_feedforward=20,
        n_encoder_layers=2,
        action_mode="joint_position",
        cameras=options.camera_names if options.pictured else (),
        height=options.height if options.pictured else 0,
        width=options.width if options.pictured else 0,
    )
    tensors = {name: _random(rng, name, size) for name, size in shape.tensors.items()}
    sizes = (*shape.inputs.values(), shape.action)
    normalisers = tuple(
        Normaliser(tuple(rng.normal(size=size).tolist()), tuple(rng.uniform(0.5, 2.0, size).tolist())) for size in sizes
    )
    return [tensors], Manifest(
        signature=signature, agents="joint", network=shape, normalisers=normalisers, training={}, seed=3
    )


def _random(rng: np.random.Generator, name: str, size: tuple[int, ...]) -> Single:
    if name.endswith("running_var"):
        return rng.uniform(0.5, 2.0, size).astype(np.float32)
    scale = 0.5 if len(size) < 4 or name.startswith("encoder") else (2.0 / np.prod(size[1:])) ** 0.5
    return (scale * rng.standard_normal(size)).astype(np.float32)
