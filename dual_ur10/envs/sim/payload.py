"""Masses of a batch of models: scaled links, and a payload at each flange."""

from __future__ import annotations

from typing import Any

import numpy as np

from dual_ur10.kinematics.rotations import quat_to_matrix
from dual_ur10.kinematics.ur10 import ARMS, LINKS
from dual_ur10.types import Array, Rows


def write_masses(
    batch: Any, mass_scale: Array, payload_kg: Array, declared_kg: Array | None = None, *, rows: Rows | None = None
) -> None:
    """Write link masses and inertias, and the gravity compensation of a controller that believes the nominal arm.

    Always starts from the model's own values, so that it may be called again.

    Args:
        batch: A batch of models composed by `dual_ur10.assets.scene`.
        mass_scale: (n, 2) factor on every link's mass and inertia.
        payload_kg: (n, 2) point mass at each flange.
        declared_kg: (n, 2) payload that the controller compensates; None for a model without gravity.
        rows: The cells to write; None: all.
    """
    model = batch.model
    rows = np.arange(batch.nsim) if rows is None else rows
    mass_scale, payload_kg = mass_scale[rows], payload_kg[rows]
    mass, inertia, centre = (batch.expand(name) for name in ("body_mass", "body_inertia", "body_ipos"))
    for arm, name in enumerate(ARMS):
        bodies = np.array([model.body(f"{name}/{link}").id for link in LINKS])
        links = np.ix_(rows, bodies)
        mass[links] = model.body_mass[bodies] * mass_scale[:, arm, None]
        inertia[links] = model.body_inertia[bodies] * mass_scale[:, arm, None, None]
        last, lever = bodies[-1], model.site(f"{name}/flange").pos - model.body_ipos[bodies[-1]]
        share = (payload_kg[:, arm] / (mass[rows, last] + payload_kg[:, arm]))[:, None]
        # Two point masses about their common centre, along the axes in which the link's inertia is diagonal; its own
        # products stay zero because the lever is parallel to one of them.
        along = quat_to_matrix(model.body_iquat[last]).T @ lever
        inertia[rows, last] += mass[rows, last][:, None] * share * (lever @ lever - along**2)
        centre[rows, last] = model.body_ipos[last] + share * lever
        mass[rows, last] += payload_kg[:, arm]
        if declared_kg is not None:
            believed = np.repeat(model.body_mass[None, bodies], len(rows), axis=0)
            believed[:, -1] += declared_kg[rows, arm]
            batch.expand("body_gravcomp")[links] = believed / mass[links]
    batch.set_const(ids=rows)
