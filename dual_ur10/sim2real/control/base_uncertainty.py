"""How much nearer than measured two bodies may be, for how little is known of where the bases stand."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np

from dual_ur10.assets.reach import reach_m
from dual_ur10.assets.scene import SceneSettings
from dual_ur10.errors import SettingsError
from dual_ur10.types import Array

if TYPE_CHECKING:
    import mujoco

Uncertainty = Sequence[Sequence[float]]


def checked(uncertainty: Uncertainty) -> Array:
    """(2, 2) of left and right: m by which a base may be shifted, rad by which it may be turned.

    Raises:
        SettingsError: They are not four finite numbers of 0 or more.
    """
    try:
        values = np.asarray(uncertainty, dtype=np.float64)
    except (TypeError, ValueError):
        values = np.empty(0)
    if values.shape != (2, 2) or not (np.isfinite(values).all() and (values >= 0.0).all()):
        raise SettingsError(
            f"the uncertainty of the bases is {uncertainty!r}: it must be (m, rad) of the left and of the right one, "
            "all of them 0 or more"
        )
    return values


class BaseUncertainty:
    """What the distances of a model may be off by.

    A base that is shifted by m, and turned by rad about whatever axis, moves a point of its arm that is r away from it
    by m + r rad at most. For r stands the distance of a geom's centre at the posture in question, and the radius of the
    ball around the geom.

    Args:
        uncertainty: m and rad of the left and of the right base.
        settings: The cell.
        model: Its twin that measures distances.
        exempt: (pairs,) of which pairs nothing is to be said: those that a task brings together on purpose.

    Raises:
        SettingsError: A value is not finite or below 0.
    """

    def __init__(
        self, uncertainty: Uncertainty, settings: SceneSettings, model: mujoco.MjModel, exempt: Sequence[bool] = ()
    ) -> None:
        values = np.append(checked(uncertainty), [[0.0, 0.0]], axis=0)
        reaches = [reach_m(model, settings, geom) for geom in range(model.ngeom)]
        arms = np.array([arm for arm, _ in reaches])  # -1 is the last row of all
        self._base = np.array([mount.position_m for mount in settings.mounts] + [(0.0, 0.0, 0.0)])[arms]
        self._radius: Array = model.geom_rbound.copy()
        self._pairs = np.stack([model.sensor_objid, model.sensor_refid])
        # Both of one arm are moved together.
        counts = arms[self._pairs[0]] != arms[self._pairs[1]]
        if exempt:
            counts &= ~np.asarray(exempt)
        shift, self._turn = (values[arms[self._pairs], k] * counts for k in (0, 1))
        self._shift: Array = shift.sum(axis=0)
        furthest = np.array([reach for _, reach in reaches])
        self.most_m: Array = self._shift + (furthest[self._pairs] * self._turn).sum(axis=0)
        """(pairs,) what it is at most, at any posture."""
        self.per_m: Array = self._turn.sum(axis=0)
        """(pairs,) how much it changes at most where the geoms of a pair move by a metre in all."""
        self.turns = bool(self._turn.any())
        """Whether it depends on the posture."""

    def at(self, center_m: Array) -> Array:
        """What it is at the postures at which the geoms' centres are `center_m`, (n, geoms, 3): (n, pairs)."""
        away = center_m - self._base
        reach = np.sqrt(np.einsum("ngk,ngk->ng", away, away)) + self._radius
        first, second = self._pairs
        allowance: Array = self._shift + reach[:, first] * self._turn[0] + reach[:, second] * self._turn[1]
        return allowance
