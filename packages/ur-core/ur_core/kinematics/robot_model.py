"""Facts of one model of Universal Robots' arms, and estimates of what is not published.

All arms have the same chain: joints 2, 3 and 4 are parallel, and the twists are those of `ALPHA_RAD`. Lengths in m,
angles in rad, masses in kg, inertias in kg m². The figures stand in `ur_core.kinematics.robots`, with
their sources.

Not published by Universal Robots, and estimated in the same way for all:

- Inertia tensors of some links: those of the mechanically nearest model with published tensors (`inertia_from`),
  stretched along the link to its length and scaled to its mass.
- Reflected rotor inertia: `ARMATURE_KG_M2` on the UR10, a convention of public MuJoCo models of this robot family, and
  proportional to the largest torque of the joint on the others.
- Radii of the housings: those of the UR10, times the ratio of the joint's largest torque to a power that fits the three
  joint sizes of the UR10 (`RADIUS_EXPONENT`).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final, Literal

import numpy as np

from ur_core.types import Array, Vector3, constant

Family = Literal["cb3", "e-series"]
"""Controller families. UR8 Long, UR15, UR18, UR20 and UR30 have controllers of the e-Series' kind."""

TICK_S: Final[dict[str, float]] = {"cb3": 0.008, "e-series": 0.002}
"""Control period of each controller family: UR's real-time client guide."""

ALPHA_RAD: Final = constant([np.pi / 2, 0.0, 0.0, np.pi / 2, -np.pi / 2, 0.0])
"""Twists of all models: the same article as the lengths."""

JOINT_RANGE_RAD: Final = constant([2 * np.pi, 2 * np.pi, np.pi, 2 * np.pi, 2 * np.pi, 2 * np.pi])
"""Joint ranges of all models: `config/<model>/joint_limits.yaml` of Universal_Robots_ROS2_Description.

The elbow has ±360° on paper and is blocked by the arm itself; like those files, this project keeps it within ±180°.
Wrist 3 of UR3 and UR3e rotates without end; here it keeps the range of the others.
"""

Six = tuple[float, float, float, float, float, float]

REFERENCE_TORQUE_NM: Final[Six] = (330.0, 330.0, 150.0, 56.0, 56.0, 56.0)
"""Largest joint torques of the UR10, from which the estimates of the others follow."""

ARMATURE_KG_M2: Final = 0.1
"""Reflected rotor inertia of each joint of the UR10."""

RADIUS_EXPONENT: Final = 0.282
"""Radius of a housing by torque: on the UR10 330, 150 and 56 N·m go with 75, 60 and 45.5 mm."""

HARD_SPEED_RATIO: Final = 0.8
"""Largest speed of targets on the wire, relative to the data sheet's joint speed; this project's choice."""

HARD_ACCELERATION_RAD_S2: Final = 10.0
"""This project's hard limit, as UR's and Franka's client libraries use it; no figure of a UR is public."""

HARD_JERK_RAD_S3: Final = 2000.0
"""This project's hard limit; no figure of a UR is public."""

HARD_TCP_SPEED_M_S: Final = 1.5
"""Default safety limit for the tool speed of a UR controller."""


@dataclass(frozen=True)
class RobotModel:
    """Facts of one model.

    Attributes:
        name: Key in `ur_core.kinematics.robots.ROBOTS`.
        title: Name that Universal Robots prints on it.
        family: Family of its controller.
        robot_type: Number by which its controller's primary interface reports it. Models that share mechanics share it.
        lengths_m: d1, a2, a3, d4, d5 and d6 of the Denavit-Hartenberg parameters; all others are zero.
        mass_kg: (6,) masses of the moving links.
        com_m: (6, 3) centres of mass in the distal frame of each link.
        inertia_kg_m2: (6, 6) ixx, iyy, izz, ixy, ixz, iyz about the centre of mass, in the axes of the distal frame.
        joint_speed_deg_s: (6,) largest joint speeds of the data sheet.
        joint_torque_nm: (6,) largest joint torques.
        payload_kg: Largest payload of the data sheet.
        reach_m: Reach of the data sheet.
        tube_offsets_m: Distances of upper arm and forearm from the shoulder's plane, along the parallel axes; they
            place the drawn parts and the collision model.
        inertia_from: Name of the model whose tensors were scaled; None: the tensors are published.
        limits_from: Name of the model whose joint speeds and torques were taken; None: they are published.
        source: Origin of the figures that differ from those of the other models.
    """

    name: str
    title: str
    family: Family
    robot_type: int
    lengths_m: Six
    mass_kg: Six
    com_m: tuple[Vector3, ...]
    inertia_kg_m2: tuple[Six, ...]
    joint_speed_deg_s: Six
    joint_torque_nm: Six
    payload_kg: float
    reach_m: float
    tube_offsets_m: tuple[float, float]
    inertia_from: str | None = None
    limits_from: str | None = None
    source: str = ""

    @property
    def a_m(self) -> Six:
        """Denavit-Hartenberg link lengths."""
        _, a2, a3, *_ = self.lengths_m
        return 0.0, a2, a3, 0.0, 0.0, 0.0

    @property
    def d_m(self) -> Six:
        """Denavit-Hartenberg link offsets."""
        d1, _, _, d4, d5, d6 = self.lengths_m
        return d1, 0.0, 0.0, d4, d5, d6

    @property
    def tick_s(self) -> float:
        """Control period of its controller."""
        return TICK_S[self.family]

    @property
    def joint_speed_rad_s(self) -> Array:
        """(6,) largest joint speeds of the data sheet."""
        return constant(np.deg2rad(self.joint_speed_deg_s))

    @property
    def hard_speed_rad_s(self) -> Array:
        """(6,) this project's hard limits on the joint speeds of targets, to 0.01 rad/s."""
        return constant(np.round(HARD_SPEED_RATIO * self.joint_speed_rad_s, 2))

    @property
    def torque_ratio(self) -> Array:
        """(6,) largest joint torques relative to the UR10's."""
        return constant(np.divide(self.joint_torque_nm, REFERENCE_TORQUE_NM))

    @property
    def armature_kg_m2(self) -> Array:
        """(6,) estimated reflected rotor inertias."""
        return constant(ARMATURE_KG_M2 * self.torque_ratio)

    @property
    def radius_ratio(self) -> Vector3:
        """Estimated radii of the housings of shoulder, elbow and wrists relative to the UR10's."""
        shoulder, _, elbow, wrist, *_ = (self.torque_ratio**RADIUS_EXPONENT).tolist()
        return shoulder, elbow, wrist


def stretched_inertia(values: Six, mass_ratio: float, length_ratio: float) -> Six:
    """Return the tensor of a body that is stretched along x, and as many times heavier.

    Args:
        values: ixx, iyy, izz, ixy, ixz, iyz of the body.
        mass_ratio: New mass relative to the body's.
        length_ratio: New length along x relative to the body's.
    """
    xx, yy, zz, xy, xz, yz = values
    # Second moments about the planes stretch like products of coordinates; the tensor follows from them.
    x2, y2, z2 = (yy + zz - xx) / 2 * length_ratio**2, (xx + zz - yy) / 2, (xx + yy - zz) / 2
    xy, xz = xy * length_ratio, xz * length_ratio
    xx, yy, zz, xy, xz, yz = (mass_ratio * each for each in (y2 + z2, x2 + z2, x2 + y2, xy, xz, yz))
    return xx, yy, zz, xy, xz, yz
