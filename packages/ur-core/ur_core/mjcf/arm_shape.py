"""Arms of other models from the spec of `ur10.xml`: frames and inertias, drawn parts and collision capsules.

Housings keep their proportions, scaled by the estimated radius of their joint. Tubes stretch between them. Along the
axes of the parallel joints, upper arm and forearm lie where the model's `tube_offsets_m` put them.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Final

import numpy as np

from ur_core.kinematics.robot_model import RobotModel
from ur_core.kinematics.robots import ROBOTS
from ur_core.kinematics.ur10 import JOINTS, LINKS, nominal_dh
from ur_core.types import Array

_UR10: Final = ROBOTS["ur10"]

# Measures of the parts of ur10.xml in m. From the middle of a tube to the next housing, along the parallel axes: from
# the upper arm's to the shoulder, from the forearm's to the elbow and to wrist 1.
_SHOULDER_GAP: Final = 0.089
_ELBOW_GAP: Final = 0.066
_WRIST_GAP: Final = 0.063
# From joints 5 and 6 to the next housing.
_WRIST: Final = 0.062
# Lengths of the housings at both ends of upper arm and forearm.
_UPPER_ARM_ENDS: Final = (0.097, 0.074)
_FOREARM_ENDS: Final = (0.081, 0.0583)
# Radii of the housings at their far ends relative to their near ends.
_TAPER: Final = {"upper_arm_link": 60 / 75, "forearm_link": 45.5 / 60}


@dataclass(frozen=True)
class _Stretch:
    """Piecewise linear map of one coordinate.

    Attributes:
        knots: Pairs of an old and a new value, in rising order.
        before, after: Slopes below the first knot and above the last one.
    """

    knots: Sequence[tuple[float, float]]
    before: float
    after: float

    def __call__(self, values: Array) -> Array:
        old, new = np.array(self.knots).T
        low, high = np.minimum(values - old[0], 0.0), np.maximum(values - old[-1], 0.0)
        result: Array = np.interp(values, old, new) + self.before * low + self.after * high
        return result


def fit_bodies(arm: Any, model: RobotModel) -> None:
    """Set frames, inertias, torque limits and rotor inertias of a spec of `ur10.xml` to those of another model.

    Args:
        arm: `MjSpec` of one arm.
        model: Facts of the model.
    """
    dh, armature = nominal_dh(model.name), model.armature_kg_m2
    distal = [*(arm.body(link) for link in LINKS[1:]), arm.site("flange")]
    for i, link in enumerate(LINKS):
        end, cos, sin = np.array([dh.a_m[i], 0.0, dh.d_m[i]]), np.cos(dh.alpha_rad[i]), np.sin(dh.alpha_rad[i])
        turn = np.array([[1.0, 0.0, 0.0], [0.0, cos, -sin], [0.0, sin, cos]])
        xx, yy, zz, xy, xz, yz = model.inertia_kg_m2[i]
        inertia = turn @ np.array([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]]) @ turn.T
        body, joint, torque = arm.body(link), arm.joint(JOINTS[i]), model.joint_torque_nm[i]
        distal[i].pos = end
        body.mass, body.ipos = model.mass_kg[i], end + turn @ np.array(model.com_m[i])
        body.fullinertia = inertia[[0, 1, 2, 0, 0, 1], [0, 1, 2, 1, 2, 2]]
        joint.actfrcrange, joint.armature = (-torque, torque), armature[i]


def fit_shape(arm: Any, model: RobotModel) -> None:
    """Move and scale the geoms of a spec of `ur10.xml` to those of another model.

    Args:
        arm: `MjSpec` of one arm.
        model: Facts of the model.
    """
    shape = _Shape(model)
    for link in ("base_link", *LINKS):
        for geom in arm.body(link).geoms:
            both = not np.isnan(geom.fromto[0])
            points = np.reshape(geom.fromto if both else geom.pos, (-1, 3))
            geom.size = geom.size * shape.ratio(link, points, whole=geom.classname.name == "collision")
            moved = shape.moved(link, points)
            if both:
                geom.fromto = moved.ravel()
            else:
                geom.pos = moved[0]


class _Shape:
    """Maps of points in the bodies' frames from the UR10 to another model."""

    def __init__(self, model: RobotModel) -> None:
        self._shoulder, self._elbow, self._wrist = shoulder, elbow, wrist = model.radius_ratio
        (d1, a2, a3, d4, d5, d6), (own1, own2, own3, own4, own5, own6) = model.lengths_m, _UR10.lengths_m
        (upper, fore), (own_upper, own_fore) = model.tube_offsets_m, _UR10.tube_offsets_m
        self._half = {"upper_arm_link": own2 / 2, "forearm_link": own3 / 2}
        self._height = _Stretch(((0.0, 0.0), (own1, d1)), d1 / own1, shoulder)
        # Along the axes of the parallel joints, at both ends of the links.
        gap = own_upper - _SHOULDER_GAP, upper - _SHOULDER_GAP * shoulder
        self._at_shoulder = _Stretch(((0.0, 0.0), gap, (own_upper, upper)), shoulder, shoulder)
        gap = own_fore + _ELBOW_GAP, fore + _ELBOW_GAP * elbow
        self._at_elbow = _Stretch((gap, (own_upper, upper)), elbow, elbow)
        gap = own_fore + _WRIST_GAP, fore + _WRIST_GAP * wrist
        self._at_wrist = {
            "wrist_1_link": _Stretch((gap, (own4, d4)), wrist, wrist),
            "wrist_2_link": _Stretch(((_WRIST, _WRIST * wrist), (own5, d5)), wrist, wrist),
            "wrist_3_link": _Stretch(((_WRIST, _WRIST * wrist), (own6, d6)), wrist, wrist),
        }
        self._fore = own_fore, fore
        self._along = {
            "upper_arm_link": _between(own2, a2, _UPPER_ARM_ENDS, (shoulder, elbow)),
            "forearm_link": _between(own3, a3, _FOREARM_ENDS, (elbow, wrist)),
        }

    def moved(self, link: str, points: Array) -> Array:
        """Return points, (n, 3), of one body where they are on the model."""
        x, y, z = points.T
        near = x > self._half.get(link, -np.inf)
        if link == "base_link":
            return np.stack([x * self._shoulder, y * self._shoulder, self._height(z)], axis=1)
        if link == "shoulder_link":
            return np.stack([x * self._shoulder, -self._at_shoulder(-y), self._height(z)], axis=1)
        if link == "upper_arm_link":
            z = np.where(near, self._at_shoulder(z), self._at_elbow(z))
            return np.stack([self._along[link](x), y * self._shoulder, z], axis=1)
        if link == "forearm_link":
            own, fore = self._fore
            z = fore + (z - own) * np.where(near, self._elbow, self._wrist)
            return np.stack([self._along[link](x), y * self._elbow, z], axis=1)
        return np.stack([x * self._wrist, y * self._wrist, self._at_wrist[link](z)], axis=1)

    def ratio(self, link: str, points: Array, *, whole: bool) -> float:
        """Return the factor on the size of a geom at some points, (n, 3), of one body.

        Args:
            link: Name of the body.
            points: Ends of the geom, or its middle.
            whole: True for a capsule around a whole link, whose stouter end counts.
        """
        if link not in self._half:
            return self._wrist if link in self._at_wrist else self._shoulder
        first, last = (self._shoulder, self._elbow) if link == "upper_arm_link" else (self._elbow, self._wrist)
        if whole:
            return max(first, last * _TAPER[link])
        part = float(np.clip(points[:, 0].mean() / (2 * self._half[link]), 0.0, 1.0))
        return first + (last - first) * part


def _between(own: float, length: float, ends: tuple[float, float], ratios: tuple[float, float]) -> _Stretch:
    """Return the map along a link from 0 to `own`, which is negative, to one of another length."""
    (first, last), (near, far) = ends, ratios
    knots = ((own, length), (own + last, length + last * far), (-first, -first * near), (0.0, 0.0))
    return _Stretch(knots, far, near)
