"""Errors of both flanges from their references, all rows at once."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from ur_core.kernel import RowLoop, Struct
from ur_core.kinematics.frames import Frames
from ur_core.kinematics.poses import Poses
from ur_core.types import Array


class Tracked(NamedTuple):
    """Errors of both flanges from their references.

    Attributes:
        turn: (n, 2, 3) rotation from flange to reference in the frame of the quaternions: twice the vector part of its
            quaternion, which is the rotation vector as long as it is small.
        off_m: (n, 2) distance.
        chord: (n, 2) chord of the rotation.
        apart_m: (n,) error of the vector between the flanges.
        other_flange: (n, 2, 7) pose of the other flange in the `base` frame of each arm: position and quaternion.
    """

    turn: Array
    off_m: Array
    chord: Array
    apart_m: Array
    other_flange: Array


class Tracking:
    """Errors of n pairs of flanges from references.

    Args:
        n: Number of cells.
        frames: Frames of both arms.
        quat: (2, 4) orientations of both references in the arms' `base` frames.
    """

    def __init__(self, n: int, frames: Frames, quat: Array) -> None:
        self._flange_m, self._flange_base_m, self._reference_m = (np.zeros((n, 2, 3)) for _ in range(3))
        self._flange_quat: Array = np.zeros((n, 2, 4))
        shapes = (2, 3), (2,), (2,), (), (2, 7)
        self._found = Tracked(*[np.zeros((n, *shape)) for shape in shapes])
        struct = Struct(
            "Tracking",
            n=n,
            reference_quat=np.ascontiguousarray(quat),
            others=np.ascontiguousarray(frames.others_pose),
            flange_m=self._flange_m,
            flange_base_m=self._flange_base_m,
            flange_quat=self._flange_quat,
            reference_m=self._reference_m,
            **self._found._asdict(),
        )
        self._compute = RowLoop("track", struct, n, 1)

    def __call__(self, flange_m: Array, in_bases: Poses, reference_m: Array) -> Tracked:
        """Return the errors of flanges from references, (n, 2, 3) in the cell frame; orientations are in the bases."""
        self._flange_m[...], self._reference_m[...] = flange_m, reference_m
        self._flange_base_m[...], self._flange_quat[...] = in_bases
        self._compute()
        return Tracked(*[each.copy() for each in self._found])
