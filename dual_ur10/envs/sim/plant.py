"""What differs in the simulated plant from what is believed of it, written into a batch of models."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from dual_ur10.assets.settings import SceneSettings
from dual_ur10.envs.sim.payload import write_masses
from dual_ur10.kinematics.rotations import quat_from_rotvec
from dual_ur10.kinematics.ur10 import ARMS
from dual_ur10.sim2real.config.cell import Perturbation
from dual_ur10.types import Array, Rows

_MASSES = ("mass_scale", "payload_kg", "declared_payload_kg")


class Plant:
    """Writes masses, friction and base poses of each cell.

    A model field gets values of its own for each cell, which costs a little, when a value first differs from what is
    believed; from then on it is kept up.

    Args:
        batch: A batch of models composed by `dual_ur10.assets.scene`.
        settings: The scene.
        arm_dofs: (12,) the arms' degrees of freedom.
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
        if self._settings.equipment.prop and self._differs("object", values, ("object_mass_scale",)):
            body = model.body(self._settings.equipment.prop).id
            scale = values["object_mass_scale"][rows]
            batch.expand("body_mass")[rows, body] = model.body_mass[body] * scale
            batch.expand("body_inertia")[rows, body] = model.body_inertia[body] * scale[:, None]
            constants = True
        if self._differs("base", values, ("base_shift_m", "base_turn_rad")):
            position, quat = batch.expand("body_pos"), batch.expand("body_quat")
            for arm, (body, mount) in enumerate(zip(_bases(model), self._settings.mounts, strict=True)):
                turn = np.zeros((len(rows), 3))
                turn[:, 2] = mount.yaw_rad + values["base_turn_rad"][rows, arm]
                position[rows, body] = model.body_pos[body] + values["base_shift_m"][rows, arm]
                quat[rows, body] = quat_from_rotvec(turn)
            constants = True
        if constants:
            batch.set_const(ids=rows)

    def place_bases(self, model: Any, row: int) -> None:
        """Put the bases of another model of the same scene where they are in one cell."""
        if "base" in self._own:
            position, quat = self._batch.expand("body_pos")[row], self._batch.expand("body_quat")[row]
            for own, other in zip(_bases(self._batch.model), _bases(model), strict=True):
                model.body_pos[other], model.body_quat[other] = position[own], quat[own]

    def _differs(self, group: str, values: Mapping[str, Array], names: tuple[str, ...]) -> bool:
        if group not in self._own and any((values[name] != self._nominal[name]).any() for name in names):
            self._own.add(group)
        return group in self._own


def _bases(model: Any) -> list[int]:
    """The bodies that carry the arms."""
    links = [model.body(f"{name}/base_link").id for name in ARMS]
    return [int(model.body_parentid[link]) or link for link in links]
