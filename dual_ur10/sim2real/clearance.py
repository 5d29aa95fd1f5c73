"""Distances between the arms, themselves and the table at a posture, for the safety gate.

MuJoCo computes them, in a batch of their own that holds the collision geometry only: no contacts, no dynamics.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from types import MappingProxyType
from typing import Any

import numpy as np
from numpy.typing import NDArray

from dual_ur10.assets.scene import SceneSettings, build_clearance_model, clearance_pairs
from dual_ur10.errors import CollisionAtStartError, SettingsError, UnknownNameError

Array = NDArray[np.float64]
Pair = tuple[str, str]

MINIMUM_M = 0.02
"""Smallest distance at rest after braking: twice the scene distance at which MoveIt Servo begins to slow down."""


class Clearance:
    """Measures distances at postures of n cells.

    Args:
        settings: The scene.
        n: Number of cells.
        threads: Threads to compute on.
        minimum_m: Smallest legal distance of any pair.
        closer: Smallest legal distance in m of those pairs of `assets.scene.clearance_pairs(settings)` that have one of
            their own in this task; frozen at construction.

    Raises:
        UnknownNameError: A pair in `closer` is none of this scene.
        SettingsError: A distance in `closer` is not finite or below 0.
    """

    def __init__(
        self,
        settings: SceneSettings,
        *,
        n: int = 1,
        threads: int = 1,
        minimum_m: float = MINIMUM_M,
        closer: Mapping[Pair, float] = MappingProxyType({}),
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
        self._threshold = np.array([closer.get(pair, minimum_m) for pair in self.pairs])
        self._build()

    def _build(self) -> None:
        import mujoco
        from mujoco.batch import Batch

        settings, n, threads = self._arguments
        self._batch: Any = Batch(build_clearance_model(settings), n, threads)
        self._stage = int(mujoco.mjtStage.mjSTAGE_POS)
        self._qpos: Array = self._batch.bind("qpos")
        self._distance: Array = self._batch.bind("sensordata")

    def __getstate__(self) -> dict[str, Any]:
        state = self.__dict__.copy()
        for key in ("_batch", "_qpos", "_distance"):
            del state[key]
        return state

    def __setstate__(self, state: dict[str, Any]) -> None:
        self.__dict__.update(state)
        self._build()

    def distances_m(self, q_rad: Array) -> Array:
        """(n, pairs) distances at the postures `q_rad`, (n, 12); those beyond 0.2 m are given as 0.2 m.

        The array is this object's own and changes with its next call.
        """
        self._qpos[:] = q_rad
        self._batch.forward(stage=self._stage)
        return self._distance

    def is_clear(self, q_rad: Array) -> NDArray[np.bool_]:
        """(n,) mask of the postures, (n, 12), at which no pair is closer than allowed."""
        clear: NDArray[np.bool_] = np.all(self.distances_m(q_rad) >= self._threshold, axis=1)
        return clear

    def worst(self, q_rad: Array) -> tuple[str, float, float]:
        """The pair that is nearest to its limit or furthest beyond it, its distance and the smallest legal one.

        Args:
            q_rad: (12,) posture.
        """
        distance = self.distances_m(np.broadcast_to(q_rad, self._qpos.shape))[0]
        pair = int((distance - self._threshold).argmin())
        return " and ".join(self.pairs[pair]), float(distance[pair]), float(self._threshold[pair])

    def check_start(self, q_rad: Array, rows: NDArray[np.intp]) -> None:
        """Refuse postures, (len(rows), 2, 6), that episodes in `rows` must not start from.

        Raises:
            SettingsError: A posture is not finite; MuJoCo would measure the distances at another one.
            CollisionAtStartError: A pair is closer than allowed.
        """
        if not np.isfinite(q_rad).all():
            raise SettingsError(f"a start posture must be finite, found {np.asarray(q_rad).tolist()}")
        postures = self._qpos.copy()
        postures[rows] = np.asarray(q_rad).reshape(-1, 12)
        for row in rows[~self.is_clear(postures)[rows]]:
            pair, distance, allowed = self.worst(postures[row])
            raise CollisionAtStartError(
                f"in the start posture {pair} are {distance * 1e3:.1f} mm apart, allowed are {allowed * 1e3:.1f} mm or "
                "more: move the bases apart, turn them, or choose another start posture"
            )
