"""Deviations of the simulated plant from the nominal model, written into a batch of MuJoCo models."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from dual_ur10.assets.settings import SceneSettings
from dual_ur10.sim2real.cell.perturbation import Perturbation
from ur_core.kinematics.rotations import quat_from_rotvec, quat_multiply, quat_to_matrix
from ur_core.kinematics.ur10 import ARMS, LINKS
from ur_core.types import Array, Rows

_MASSES = ("mass_scale", "payload_kg", "declared_payload_kg")


class Plant:
    """Writer of masses, friction and base poses of each cell.

    A model field gets separate values for each cell, which costs some time, once a value first differs from the nominal
    one; from then on it is kept up to date.

    Args:
        batch: A batch of models composed by `dual_ur10.assets.scene`.
        settings: Settings of the scene.
        arm_dofs: (12,) degrees of freedom of the arms.
    """

    def __init__(self, batch: Any, settings: SceneSettings, arm_dofs: Rows) -> None:
        self._batch, self._settings, self._arm_dofs = batch, settings, arm_dofs
        self._own: set[str] = set()
        self._nominal = Perturbation().expanded(1)

    def write(self, values: Mapping[str, Array], rows: Rows) -> None:
        """Write the values of `rows`, given (n, ...) for all cells as `Perturbation.expanded` does."""
        batch, model = self._batch, self._batch.model
        if self._differs("masses", values, _MASSES):
            write_masses(batch, *(values[name] for name in _MASSES), rows=rows)
        if self._differs("friction", values, ("friction_nm",)):
            batch.expand("dof_frictionloss")[np.ix_(rows, self._arm_dofs)] = values["friction_nm"][rows].reshape(-1, 12)
        if self._settings.equipment.grippers and self._differs("grip", values, ("grip_friction_scale",)):
            friction = batch.expand("geom_friction")
            for arm, name in enumerate(ARMS):
                for pad in ("pad_1", "pad_2"):
                    geom = model.geom(f"{name}/{pad}").id
                    friction[rows, geom] = model.geom_friction[geom] * values["grip_friction_scale"][rows, arm, None]
        constants = False
        objects = [each for each in self._settings.equipment.props if each.free]
        if objects and self._differs("object", values, ("object_mass_scale",)):
            mass, inertia = batch.expand("body_mass"), batch.expand("body_inertia")
            for prop in objects:
                scale = values["object_mass_scale"][rows]
                scale = scale if prop.mass == 1.0 else 1.0 + prop.mass * (scale - 1.0)
                for body in _bodies_of(model, prop.name):
                    mass[rows, body] = model.body_mass[body] * scale
                    inertia[rows, body] = model.body_inertia[body] * scale[:, None]
            constants = True
        if self._differs("base", values, ("base_shift_m", "base_turn_rad")):
            position, quat = batch.expand("body_pos"), batch.expand("body_quat")
            for arm, (body, mount) in enumerate(zip(_bases(model), self._settings.mounts, strict=True)):
                turn = np.zeros((len(rows), 3))
                turn[:, 2] = mount.yaw_rad + values["base_turn_rad"][rows, arm]
                position[rows, body] = model.body_pos[body] + values["base_shift_m"][rows, arm]
                quat[rows, body] = quat_multiply(mount.tilt_quat, quat_from_rotvec(turn))
            constants = True
        if constants:
            batch.set_const(ids=rows)

    def place_bases(self, model: Any, row: int) -> None:
        """Copy the base poses of one cell into another model of the same scene."""
        if "base" in self._own:
            position, quat = self._batch.expand("body_pos")[row], self._batch.expand("body_quat")[row]
            for own, other in zip(_bases(self._batch.model), _bases(model), strict=True):
                model.body_pos[other], model.body_quat[other] = position[own], quat[own]

    def _differs(self, group: str, values: Mapping[str, Array], names: tuple[str, ...]) -> bool:
        if group not in self._own and any((values[name] != self._nominal[name]).any() for name in names):
            self._own.add(group)
        return group in self._own


def _bodies_of(model: Any, prop: str) -> list[int]:
    """Return the bodies of a prop."""
    return [body for body in range(model.nbody) if model.body(body).name.startswith(f"{prop}/")]


def _bases(model: Any) -> list[int]:
    """Return the bodies that carry the arms."""
    links = [model.body(f"{name}/base_link").id for name in ARMS]
    return [int(model.body_parentid[link]) or link for link in links]


def write_masses(
    batch: Any, mass_scale: Array, payload_kg: Array, declared_kg: Array | None = None, *, rows: Rows | None = None
) -> None:
    """Write link masses and inertias, and the gravity compensation of a controller with the nominal model.

    It starts from the values of the model, so that it may be called again.

    Args:
        batch: A batch of models composed by `dual_ur10.assets.scene`.
        mass_scale: (n, 2) factor on every link's mass and inertia.
        payload_kg: (n, 2) point mass at each flange.
        declared_kg: (n, 2) payload that the controller compensates; None for a model without gravity.
        rows: Cells to write; None: all.
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
        ratio = (payload_kg[:, arm] / (mass[rows, last] + payload_kg[:, arm]))[:, None]
        # Two point masses about their common centre, along the axes in which the link's inertia is diagonal; its own
        # products stay zero because the lever is parallel to one of them.
        along = quat_to_matrix(model.body_iquat[last]).T @ lever
        inertia[rows, last] += mass[rows, last][:, None] * ratio * (lever @ lever - along**2)
        centre[rows, last] = model.body_ipos[last] + ratio * lever
        mass[rows, last] += payload_kg[:, arm]
        if declared_kg is not None:
            nominal = np.repeat(model.body_mass[None, bodies], len(rows), axis=0)
            nominal[:, -1] += declared_kg[rows, arm]
            batch.expand("body_gravcomp")[links] = nominal / mass[links]
    batch.set_const(ids=rows)
