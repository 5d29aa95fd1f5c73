"""Distances of the arms from themselves, each other and all obstacles, for the safety gate.

MuJoCo computes them on a collision model of its own: no contacts, no dynamics.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from functools import lru_cache
from types import MappingProxyType
from typing import TYPE_CHECKING, Any, Final

import numpy as np
from numpy.typing import NDArray

from dual_ur10.assets.collision_model import (
    CLEARANCE_CUTOFF_M,
    build_collision_model,
    clearance_pairs,
    levers_m,
    reach_m,
)
from dual_ur10.assets.obstacles import geom_name
from dual_ur10.assets.settings import SceneSettings
from dual_ur10.errors import CollisionAtStartError, SettingsError, UnknownNameError
from dual_ur10.types import Array, Mask

if TYPE_CHECKING:
    import mujoco

Pair = tuple[str, str]
Uncertainty = Sequence[Sequence[float]]

MINIMUM_M = 0.02
"""Smallest distance at rest after braking: twice the scene distance at which MoveIt Servo begins to slow down."""

KNOWN: Final = ((0.0, 0.0), (0.0, 0.0))
"""No uncertainty: both bases stand exactly where the cell says."""


@lru_cache(maxsize=32)
def _levers_m(settings: SceneSettings) -> Array:
    """Return `levers_m` of the scene's collision model."""
    return levers_m(build_collision_model(settings))


@lru_cache(maxsize=32)
def _reaches_m(settings: SceneSettings) -> tuple[tuple[int, float], ...]:
    """Return `reach_m` of each geom of the scene's collision model."""
    model = build_collision_model(settings)
    return tuple(reach_m(model, settings, geom) for geom in range(model.ngeom))


class Clearance:
    """Computes distances at configurations of n cells.

    Args:
        settings: The scene.
        n: Number of cells.
        threads: Threads to compute on.
        minimum_m: Smallest legal distance of any pair.
        closer: Smallest legal distance in m of those pairs of `assets.scene.clearance_pairs(settings)` for which the
            task sets its own; frozen at construction.
        uncertainty: Largest error of each base pose, left and right: m of position, and rad of rotation about any axis.
            The resulting error of a part of an arm is added to its smallest legal distances from the other arm (with
            the errors of both) and from all obstacles; not from its own arm.

    Raises:
        UnknownNameError: A pair in `closer` is not one of this scene.
        SettingsError: A distance in `closer` or a value of `uncertainty` is not finite or below 0, or they demand
            distances beyond those that are measured.
    """

    def __init__(
        self,
        settings: SceneSettings,
        *,
        n: int = 1,
        threads: int = 1,
        minimum_m: float = MINIMUM_M,
        closer: Mapping[Pair, float] = MappingProxyType({}),
        uncertainty: Uncertainty = KNOWN,
    ) -> None:
        self._arguments = (settings, n, threads)
        self.pairs = clearance_pairs(settings)
        for pair, distance in closer.items():
            if pair not in self.pairs:
                raise UnknownNameError("contact pair", str(pair), [str(each) for each in self.pairs])
            if not (math.isfinite(distance) and distance >= 0.0):
                raise SettingsError(
                    f"the smallest distance of {' and '.join(pair)} is {distance} m: it must be 0 or more"
                )
        self.minimum_m = minimum_m
        self._known = np.array([closer.get(pair, minimum_m) for pair in self.pairs])
        self._exempt = np.array([pair in closer for pair in self.pairs])
        model = build_collision_model(settings)
        self._uncertainty = BaseUncertainty(uncertainty, settings, model, self._exempt)
        self._levers = (_levers_m(settings) * (1.0 + self._uncertainty.per_m[:, None])).T.copy()
        self._allowed = self._known + self._uncertainty.most_m
        self._geoms = model.sensor_objid.copy(), model.sensor_refid.copy()
        radius = np.where(model.geom_rbound > 0.0, model.geom_rbound, np.inf)  # MuJoCo gives planes a radius of 0
        self._spheres: Array = radius[self._geoms[0]] + radius[self._geoms[1]] + self._allowed
        for row in np.flatnonzero((self._allowed >= CLEARANCE_CUTOFF_M) & (self._allowed > self._known))[:1]:
            raise SettingsError(
                f"{' and '.join(self.pairs[row])} must stay {self._known[row]:.4g} m apart, and up to "
                f"{self._uncertainty.most_m[row]:.4g} m more for the uncertainty of the base poses: "
                f"together that must be below {CLEARANCE_CUTOFF_M} m, beyond which distances are not measured. Measure "
                "where the bases stand, and write smaller uncertainties"
            )
        self._build()

    def _build(self) -> None:
        import mujoco
        from mujoco.batch import Batch

        settings, n, threads = self._arguments
        self._batch: Any = Batch(build_collision_model(settings), n, threads)
        self._stage = int(mujoco.mjtStage.mjSTAGE_POS)
        self._qpos: Array = self._batch.bind("qpos")
        self._distance: Array = self._batch.bind("sensordata")
        self._center: Array = self._batch.bind("geom_xpos").reshape(n, -1, 3)
        self._alone: Clearance | None = None

    def __getstate__(self) -> dict[str, Any]:
        state = self.__dict__.copy()
        for key in ("_batch", "_qpos", "_distance", "_center", "_alone"):
            del state[key]
        return state

    def __setstate__(self, state: dict[str, Any]) -> None:
        self.__dict__.update(state)
        self._build()

    @property
    def most_m(self) -> Array:
        """Largest legal minimum distance of each pair at any configuration, (pairs,)."""
        return self._allowed.copy()

    @property
    def exempt(self) -> Mask:
        """(pairs,) mask of the pairs with a smallest legal distance of their own."""
        return self._exempt.copy()

    def _allowed_here(self) -> Array:
        """Return the smallest legal distances, (n, pairs) or (pairs,), at the configurations measured last."""
        return self._known + self._uncertainty.at(self._center) if self._uncertainty.varies else self._allowed

    def allowed_m(self, q_rad: Array) -> Array:
        """Return the smallest legal distances, (n, pairs), at configurations (n, 12), with the uncertainty added."""
        self.distances_m(q_rad)
        return np.broadcast_to(self._allowed_here(), self._distance.shape).copy()

    def distances_m(self, q_rad: Array) -> Array:
        """Return distances, (n, pairs), at configurations (n, 12); those beyond 0.2 m as 0.2 m.

        The array belongs to this object and changes with its next call.
        """
        self._qpos[:] = q_rad
        self._batch.forward(stage=self._stage)
        return self._distance

    def spare_m(self, q_rad: Array) -> Array:
        """Return the distance above the legal minimum, (n, pairs), at configurations (n, 12); negative: too close."""
        spare: Array = self.distances_m(q_rad) - self._allowed_here()
        return spare

    def spare_of_spheres_m(self) -> Array:
        """Return a lower bound of `spare_m` at the last configurations, from bounding spheres and without cutoff."""
        first, second = self._geoms
        apart = self._center[:, first] - self._center[:, second]
        spare: Array = np.sqrt(np.einsum("npk,npk->np", apart, apart)) - self._spheres
        return spare

    def travel_m(self, path_rad: Array) -> Array:
        """Return the largest decrease of `spare_m`, (n, pairs), over joint travel (n, 12), not negative."""
        travel: Array = path_rad @ self._levers
        return travel

    def alone(self) -> Clearance:
        """Return the same model for one configuration at a time."""
        settings, n, _ = self._arguments
        if n == 1:
            return self
        if self._alone is None:
            self._alone = object.__new__(Clearance)
            self._alone.__setstate__({**self.__getstate__(), "_arguments": (settings, 1, 1)})
        return self._alone

    def is_clear(self, q_rad: Array) -> NDArray[np.bool_]:
        """Return an (n,) mask of the configurations, (n, 12), at which no pair is closer than allowed."""
        clear: NDArray[np.bool_] = np.all(self.spare_m(q_rad) >= 0.0, axis=1)
        return clear

    def shortfall_m(self, q_rad: Array) -> Array:
        """Return the missing distance of each pair, (pairs,), at a configuration, (12,); negative where legal."""
        configurations = np.broadcast_to(q_rad, self._qpos.shape)
        shortfall: Array = (self.allowed_m(configurations) - self._distance)[0]
        return shortfall

    def worst(self, q_rad: Array, granted_m: Array | float = 0.0) -> tuple[str, float, float]:
        """Return the pair with the smallest margin to its limit, its distance and the smallest legal one.

        Args:
            q_rad: (12,) configuration.
            granted_m: (pairs,) distance by which pairs may be closer than allowed.
        """
        allowed = self.allowed_m(np.broadcast_to(q_rad, self._qpos.shape))[0]
        distance = self._distance[0]
        pair = int((distance - allowed + granted_m).argmin())
        return " and ".join(self.pairs[pair]), float(distance[pair]), float(allowed[pair])

    def check_start(self, q_rad: Array, rows: NDArray[np.intp]) -> None:
        """Refuse configurations, (len(rows), 2, 6), from which episodes in `rows` must not start.

        Raises:
            SettingsError: A configuration is not finite; MuJoCo would measure the distances at another one.
            CollisionAtStartError: A pair is closer than allowed.
        """
        if not np.isfinite(q_rad).all():
            raise SettingsError(f"a start configuration must be finite, found {np.asarray(q_rad).tolist()}")
        configurations = self._qpos.copy()
        configurations[rows] = np.asarray(q_rad).reshape(-1, 12)
        for row in rows[~self.is_clear(configurations)[rows]]:
            pair, distance, allowed = self.worst(configurations[row])
            away = "move the bases apart, rotate them"
            for each in self._arguments[0].obstacles:
                if pair.endswith(f" and {geom_name(each)}"):
                    away = f"move the obstacle {each.name!r} or the bases"
            raise CollisionAtStartError(
                f"in the start configuration {pair} are {distance * 1e3:.1f} mm apart, allowed are "
                f"{allowed * 1e3:.1f} mm or more: {away}, or choose another start configuration"
            )


def checked_base_uncertainty(uncertainty: Uncertainty) -> Array:
    """Return the largest errors of both base poses as an array, (2, 2): m of position and rad of rotation.

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
    """Extra clearance required by the uncertainty of the base poses.

    A base shifted by m and rotated by rad about any axis moves a point of its arm at distance r by at most m + r rad.
    For r stands the distance of a geom's centre at the given configuration plus the radius of its bounding sphere.

    Args:
        uncertainty: Largest errors, m and rad, of the left and of the right base pose.
        settings: The scene.
        model: Its collision model.
        exempt: (pairs,) mask of pairs without extra clearance: those that a task brings together on purpose.

    Raises:
        SettingsError: A value is not finite or below 0.
    """

    def __init__(
        self, uncertainty: Uncertainty, settings: SceneSettings, model: mujoco.MjModel, exempt: Mask | None = None
    ) -> None:
        values = np.append(checked_base_uncertainty(uncertainty), [[0.0, 0.0]], axis=0)
        reaches = _reaches_m(settings)
        arms = np.array([arm for arm, _ in reaches])  # -1 is the last row of all
        self._base = np.array([mount.position_m for mount in settings.mounts] + [(0.0, 0.0, 0.0)])[arms]
        self._radius: Array = model.geom_rbound.copy()
        self._pairs = np.stack([model.sensor_objid, model.sensor_refid])
        # Both geoms of one arm move together.
        counts = arms[self._pairs[0]] != arms[self._pairs[1]]
        if exempt is not None:
            counts &= ~exempt
        shift, self._rotation = (values[arms[self._pairs], k] * counts for k in (0, 1))
        self._shift: Array = shift.sum(axis=0)
        furthest = np.array([reach for _, reach in reaches])
        self.most_m: Array = self._shift + (furthest[self._pairs] * self._rotation).sum(axis=0)
        """(pairs,) largest extra clearance at any configuration."""
        self.per_m: Array = self._rotation.sum(axis=0)
        """(pairs,) largest change of it per metre of motion of both geoms of a pair."""
        self.varies = bool(self._rotation.any())
        """True if it depends on the configuration."""

    def at(self, center_m: Array) -> Array:
        """Return the extra clearance, (n, pairs), with the geoms' centres at `center_m`, (n, geoms, 3)."""
        away = center_m - self._base
        reach = np.sqrt(np.einsum("ngk,ngk->ng", away, away)) + self._radius
        first, second = self._pairs
        allowance: Array = self._shift + reach[:, first] * self._rotation[0] + reach[:, second] * self._rotation[1]
        return allowance
