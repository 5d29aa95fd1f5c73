"""Distances of the arms from themselves, each other and all obstacles, for the safety gate.

The kernel computes them in closed form, on the shapes of a collision model of its own: no contacts, no dynamics.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from copy import copy
from functools import lru_cache
from types import MappingProxyType
from typing import TYPE_CHECKING, Any, Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from dual_ur10.assets.collision_model import (
    CLEARANCE_CUTOFF_M,
    HULL,
    build_collision_model,
    clearance_pairs,
    levers_m,
    reach_m,
)
from dual_ur10.assets.obstacles import geom_name
from dual_ur10.assets.settings import SceneSettings
from dual_ur10.errors import CollisionAtStartError, SettingsError, UnknownNameError
from ur_core.kernel import Struct, call
from ur_core.kinematics.rotations import quat_to_matrix
from ur_core.types import Array, Mask

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


@lru_cache(maxsize=32)
def _shapes(settings: SceneSettings) -> dict[str, Any]:
    """Return the kernel's description of the scene's collision model: its bodies, its geoms and the measured pairs.

    Raises:
        SettingsError: A shape has no closed form, or the bodies are not two chains of six joints.
    """
    import mujoco

    model = build_collision_model(settings)
    count = model.nbody
    if not (
        model.njnt == count - 1 == 12 and (model.body_jntadr[1:] == np.arange(12)).all() and not model.jnt_pos.any()
    ):
        raise SettingsError(f"a collision model must have 12 bodies with a joint each, found {count - 1}: report this")
    kinds = mujoco.mjtGeom
    numbers = {
        int(kinds.mjGEOM_CAPSULE): 0,
        int(kinds.mjGEOM_SPHERE): 0,
        int(kinds.mjGEOM_BOX): 1,
        int(kinds.mjGEOM_PLANE): 2,
    }
    names = [model.geom(geom).name for geom in range(model.ngeom)]
    # A box and its hull are one shape here.
    standing_for = np.array([names.index(name.removesuffix(HULL)) for name in names])
    first, second = standing_for[model.sensor_objid], standing_for[model.sensor_refid]
    for geom in {*first.tolist(), *second.tolist()}:
        if int(model.geom_type[geom]) not in numbers:
            raise SettingsError(f"{names[geom]} is no capsule, sphere, box or plane: its distances cannot be measured")
    size = model.geom_size.copy()
    size[model.geom_type == int(kinds.mjGEOM_SPHERE), 1:] = 0.0
    return {
        "geoms": model.ngeom,
        "pairs": len(first),
        "parent": model.body_parentid.astype(np.int64),
        "offset_m": model.body_pos.copy(),
        "turned": _matrices(model.body_quat),
        "axis": np.vstack([np.zeros(3), model.jnt_axis]),
        "body": model.geom_bodyid.astype(np.int64),
        "shape": np.array([numbers.get(int(kind), 1) for kind in model.geom_type]),
        "center_m": model.geom_pos.copy(),
        "axes": _matrices(model.geom_quat),
        "size_m": size,
        "radius_m": model.geom_rbound.copy(),
        "first": first.astype(np.int64),
        "second": second.astype(np.int64),
    }


def _matrices(quaternions: Array) -> Array:
    result: Array = np.ascontiguousarray(quat_to_matrix(np.asarray(quaternions, dtype=np.float64)))
    return result


class PairDistances(NamedTuple):
    """Distances at n configurations.

    Attributes:
        distances_m: (n, pairs) distances; those beyond 0.2 m as 0.2 m.
        allowed_m: (n, pairs) smallest legal distances, with the uncertainty of the bases added.
    """

    distances_m: Array
    allowed_m: Array


class Clearance:
    """Computes distances at configurations of a cell.

    Args:
        settings: The scene.
        minimum_m: Smallest legal distance of any pair.
        closer: Smallest legal distance in m of those pairs of `clearance_pairs(settings)` for which the task sets its
            own; frozen at construction.
        uncertainty: Largest error of each base pose, left and right: m of position, and rad of rotation about any axis.
            The resulting error of a part of an arm is added to its smallest legal distances from the other arm (with
            the errors of both) and from all obstacles; not from its own arm.

    Raises:
        UnknownNameError: A pair in `closer` is not one of this scene.
        SettingsError: A distance or a value of `uncertainty` is not finite or below 0, or a pair would have to stay
            0.2 m apart or more, beyond which distances are not measured.
    """

    def __init__(
        self,
        settings: SceneSettings,
        *,
        minimum_m: float = MINIMUM_M,
        closer: Mapping[Pair, float] = MappingProxyType({}),
        uncertainty: Uncertainty = KNOWN,
    ) -> None:
        self._settings = settings
        self.pairs = clearance_pairs(settings)
        for pair in closer:
            if pair not in self.pairs:
                raise UnknownNameError("contact pair", str(pair), [str(each) for each in self.pairs])
        self.minimum_m = minimum_m
        self._known = np.array([closer.get(pair, minimum_m) for pair in self.pairs])
        self._exempt = np.array([pair in closer for pair in self.pairs])
        model = build_collision_model(settings)
        self._uncertainty = BaseUncertainty(uncertainty, settings, model, self._exempt)
        most = self._known + self._uncertainty.most_m
        for row in np.flatnonzero(~((self._known >= 0.0) & (most < CLEARANCE_CUTOFF_M)))[:1]:
            raise SettingsError(
                f"{' and '.join(self.pairs[row])} must stay {self._known[row]:.4g} m apart, and up to "
                f"{self._uncertainty.most_m[row]:.4g} m more for the uncertainty of the base poses: together that must "
                f"be 0 or more, and below {CLEARANCE_CUTOFF_M} m, beyond which distances are not measured. Allow "
                "smaller distances, or measure where the bases stand and write smaller uncertainties"
            )
        self._granted: Array = np.zeros(len(self.pairs))
        self._connect()

    def _connect(self) -> None:
        uncertainty, shapes = self._uncertainty, _shapes(self._settings)
        self._struct = Struct(
            "Clearance",
            **shapes,
            cutoff_m=CLEARANCE_CUTOFF_M,
            base_m=uncertainty.base_m,
            known_m=self._known,
            granted_m=self._granted,
            shift_m=uncertainty.shift_m,
            first_rad=uncertainty.rotation_rad[0],
            second_rad=uncertainty.rotation_rad[1],
        )
        levers = _levers_m(self._settings) * (1.0 + uncertainty.per_m[:, None])
        self.kernel = Struct(
            "Distances",
            pairs=len(self.pairs),
            levers=levers,
            measure="clearance_spare",
            slopes="clearance_slopes",
            context=self._struct,
        )
        """Measures for the gate, beyond the cutoff a lower bound."""

    def granting(self, granted_m: Array) -> Clearance:
        """Return the same distances for which each pair may be closer than allowed by (pairs,) distances."""
        result = copy(self)
        result._granted = np.array(granted_m, dtype=np.float64)
        result._connect()
        return result

    @property
    def exempt(self) -> Mask:
        """(pairs,) mask of the pairs with a smallest legal distance of their own."""
        return self._exempt.copy()

    def spare_m(self, q_rad: Array) -> Array:
        """Return the distance above the legal minimum, (n, pairs), at configurations (n, 12); negative: too close."""
        distances, allowed = self.measure(q_rad)
        return distances + self._granted - allowed

    def measure(self, q_rad: Array) -> PairDistances:
        """Return the distances of all pairs, and the smallest legal ones, at configurations (n, 12).

        Raises:
            SettingsError: Not twelve joints.
        """
        q_rad = np.ascontiguousarray(q_rad, dtype=np.float64)
        if q_rad.shape[1:] != (12,):
            raise SettingsError(f"configurations must have the shape (n, 12), found {q_rad.shape}")
        distances, allowed = np.empty((2, len(q_rad), len(self.pairs)))
        call("clearance_distances", self._struct, q_rad, distances, allowed, len(q_rad))
        return PairDistances(distances, allowed)

    def is_clear(self, q_rad: Array) -> NDArray[np.bool_]:
        """Return an (n,) mask of the configurations, (n, 12), at which no pair is closer than allowed."""
        clear: NDArray[np.bool_] = np.all(self.spare_m(q_rad) >= 0.0, axis=1)
        return clear

    def worst(self, q_rad: Array) -> tuple[str, float, float]:
        """Return the pair with the smallest margin at a configuration, (12,), its distance and the legal minimum."""
        (distance,), (allowed,) = self.measure(q_rad[None])
        pair = int((distance + self._granted - allowed).argmin())
        return " and ".join(self.pairs[pair]), float(distance[pair]), float(allowed[pair])

    def check_start(self, q_rad: Array) -> None:
        """Refuse configurations, (n, 2, 6), from which episodes must not start.

        Raises:
            SettingsError: A configuration is not finite.
            CollisionAtStartError: A pair is closer than allowed.
        """
        if not np.isfinite(q_rad).all():
            raise SettingsError(f"a start configuration must be finite, found {np.asarray(q_rad).tolist()}")
        configurations = np.asarray(q_rad, dtype=np.float64).reshape(-1, 12)
        for row in np.flatnonzero(~self.is_clear(configurations)):
            pair, distance, allowed = self.worst(configurations[row])
            one, _, other = pair.partition(" and ")
            arm = one.partition("/")[0]
            away = "" if other.startswith(f"{arm}/") else "move the bases apart, rotate them, or "
            for each in self._settings.obstacles:
                if pair.endswith(f" and {geom_name(each)}"):
                    away = f"move the obstacle {each.name!r} or the bases, or "
            raise CollisionAtStartError(
                f"in the start configuration {pair} are {distance * 1e3:.1f} mm apart, allowed are "
                f"{allowed * 1e3:.1f} mm or more: {away}choose another start configuration"
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
        self.base_m: Array = np.array([mount.position_m for mount in settings.mounts] + [(0.0, 0.0, 0.0)])[arms]
        pairs = np.stack([model.sensor_objid, model.sensor_refid])
        # Both geoms of one arm move together.
        counts = arms[pairs[0]] != arms[pairs[1]]
        if exempt is not None:
            counts &= ~exempt
        shift, self.rotation_rad = (values[arms[pairs], k] * counts for k in (0, 1))
        self.shift_m: Array = shift.sum(axis=0)
        furthest = np.array([reach for _, reach in reaches])
        self.most_m: Array = self.shift_m + (furthest[pairs] * self.rotation_rad).sum(axis=0)
        """(pairs,) largest extra clearance at any configuration."""
        self.per_m: Array = self.rotation_rad.sum(axis=0)
        """(pairs,) largest change of it per metre of motion of both geoms of a pair."""
