"""Small checkpoints of ACT."""

from __future__ import annotations

from typing import Any

import numpy as np

from dual_ur10.policies.learned.act_network import ActShape
from dual_ur10.policies.learned.manifest import Manifest
from dual_ur10.policies.learned.network import Normaliser
from dual_ur10.policies.learned.signature import view_of


def act_parts(env_id: str, **keywords: Any) -> tuple[list[Any], Manifest]:
    """Return random weights of a small transformer, and their manifest."""
    rng, view = np.random.default_rng(0), view_of(env_id, keywords)
    signature = view.signature
    fields = ["commanded_q_rad", *(["gripper_m"] if signature.actions.gripper else [])]
    shape = ActShape(
        state=tuple(view.indices(fields, joint=True)),
        environment_state=signature.observation.shape[0],
        chunk_size=6,
        dim_model=12,
        n_heads=3,
        dim_feedforward=20,
        n_encoder_layers=2,
        action_mode="joint_position",
    )
    tensors = {name: (rng.normal(size=size) / 2).astype(np.float32) for name, size in shape.tensors.items()}
    sizes = (shape.action, shape.environment_state, shape.action)
    normalisers = tuple(
        Normaliser(tuple(rng.normal(size=size).tolist()), tuple(rng.uniform(0.5, 2.0, size).tolist())) for size in sizes
    )
    return [tensors], Manifest(
        signature=signature, agents="joint", network=shape, normalisers=normalisers, training={}, seed=3
    )
