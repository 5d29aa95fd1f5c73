"""Names of arms, joints and links; Denavit-Hartenberg parameters of one arm; facts of the UR10 as arrays.

The facts of all models stand in `ur_core.kinematics.robots`. Lengths in m, angles in rad, masses in kg, inertias in
kg m².
"""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import lru_cache
from typing import Final

import numpy as np

from ur_core.errors import SettingsError
from ur_core.kinematics.robot_model import (
    ALPHA_RAD,
    ARMATURE_KG_M2,
    HARD_ACCELERATION_RAD_S2,
    HARD_JERK_RAD_S3,
    HARD_TCP_SPEED_M_S,
    JOINT_RANGE_RAD,
    TICK_S,
    Family,
)
from ur_core.kinematics.robots import ROBOTS, robot_model
from ur_core.types import constant

ARMS: Final = ("left", "right")
"""Agents and name prefixes, in the order of every array axis of size 2."""

JOINTS: Final = (
    "shoulder_pan_joint",
    "shoulder_lift_joint",
    "elbow_joint",
    "wrist_1_joint",
    "wrist_2_joint",
    "wrist_3_joint",
)
LINKS: Final = (
    "shoulder_link",
    "upper_arm_link",
    "forearm_link",
    "wrist_1_link",
    "wrist_2_link",
    "wrist_3_link",
)


__all__ = [
    "ARMATURE_KG_M2",
    "ARMS",
    "BASE_MASS_KG",
    "DH_ALPHA_RAD",
    "DH_A_M",
    "DH_D_M",
    "HARD_ACCELERATION_RAD_S2",
    "HARD_JERK_RAD_S3",
    "HARD_SPEED_RAD_S",
    "HARD_TCP_SPEED_M_S",
    "JOINTS",
    "JOINT_RANGE_RAD",
    "JOINT_SPEED_RAD_S",
    "JOINT_TORQUE_NM",
    "LINKS",
    "LINK_COM_M",
    "LINK_INERTIA_KG_M2",
    "LINK_MASS_KG",
    "NOMINAL_DH",
    "PAYLOAD_KG",
    "REACH_M",
    "TICK_S",
    "DHParameters",
    "Family",
    "nominal_dh",
]

_UR10: Final = ROBOTS["ur10"]
DH_A_M: Final = constant(_UR10.a_m)
DH_D_M: Final = constant(_UR10.d_m)
DH_ALPHA_RAD: Final = ALPHA_RAD

# The base's mass is marked as doubtful in Universal_Robots_ROS2_Description; it never moves.
BASE_MASS_KG: Final = 4.0
LINK_MASS_KG: Final = constant(_UR10.mass_kg)
LINK_COM_M: Final = constant(_UR10.com_m)
LINK_INERTIA_KG_M2: Final = constant(_UR10.inertia_kg_m2)

JOINT_SPEED_RAD_S: Final = _UR10.joint_speed_rad_s
JOINT_TORQUE_NM: Final = constant(_UR10.joint_torque_nm)

PAYLOAD_KG: Final = _UR10.payload_kg
REACH_M: Final = _UR10.reach_m

HARD_SPEED_RAD_S: Final = _UR10.hard_speed_rad_s


@dataclass(frozen=True)
class DHParameters:
    """Denavit-Hartenberg parameters of one arm, nominal or as measured by the controller's calibration.

    Attributes:
        a_m: (6,) link lengths.
        d_m: (6,) link offsets.
        alpha_rad: (6,) link twists.
        theta_rad: (6,) offsets added to the joint angles; zero on the nominal arm.
        robot: Model of the arm, a name in `ur_core.kinematics.robots.ROBOTS`.

    Raises:
        UnknownNameError: There is no such model.
        SettingsError: A row is not six finite numbers, or differs from the nominal arm of this model by more than a
            calibration can (50 mm, 0.05 rad), which means the parameters of another robot. The lengths of the upper
            arm's and forearm's parallel axes, d2 and d3, may shift freely against each other in a UR calibration.
    """

    a_m: tuple[float, ...]
    d_m: tuple[float, ...]
    alpha_rad: tuple[float, ...] = tuple(ALPHA_RAD.tolist())
    theta_rad: tuple[float, ...] = (0.0,) * 6
    robot: str = field(kw_only=True)

    def __post_init__(self) -> None:
        model = robot_model(self.robot)
        for name, nominal in (
            ("a_m", np.array(model.a_m)),
            ("d_m", np.array(model.d_m)),
            ("alpha_rad", ALPHA_RAD),
            ("theta_rad", np.zeros(6)),
        ):
            values = np.asarray(getattr(self, name), dtype=np.float64)
            if values.shape != (6,) or not np.isfinite(values).all():
                raise SettingsError(f"DH parameter {name} must be six finite numbers, found {getattr(self, name)!r}")
            object.__setattr__(self, name, tuple(values.tolist()))
            off = np.abs(values - nominal)
            if name == "d_m":
                # Joints 2, 3 and 4 are nearly parallel: only the sum of d2, d3 and d4 is observable.
                off = np.array([off[0], abs(values[1:4].sum() - nominal[1:4].sum()), 0.0, 0.0, off[4], off[5]])
            if (off > _CALIBRATION).any():
                row = int(off.argmax())
                raise SettingsError(
                    f"DH parameter {name}[{row}] is {values[row]:.6g}, {off[row]:.3g} from the {model.title}'s "
                    f"{nominal[row]:.6g}; a calibration differs by at most {_CALIBRATION}. These may be the parameters "
                    f"of another robot"
                )

    @property
    def is_nominal(self) -> bool:
        """True for the nominal parameters of its model."""
        nominal = nominal_dh(self.robot)
        return self is nominal or self == nominal


_CALIBRATION: Final = 0.05
"""Largest difference, m or rad, between the parameters of a calibrated arm and those of its model."""


@lru_cache(maxsize=len(ROBOTS))
def nominal_dh(robot: str) -> DHParameters:
    """Return the nominal parameters of a model, the same object at every call.

    Raises:
        UnknownNameError: There is no such model.
    """
    model = robot_model(robot)
    return DHParameters(model.a_m, model.d_m, robot=robot)


NOMINAL_DH: Final = nominal_dh("ur10")
