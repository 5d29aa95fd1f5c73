"""Facts of the UR10 (CB3): geometry, masses, limits.

Everything here is a published figure of the robot, with its source beside it. Lengths in m, angles in rad, masses in
kg, inertias in kg m². Nothing here is tuned.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final, Literal

import numpy as np

from dual_ur10.errors import SettingsError
from dual_ur10.types import constant

Family = Literal["cb3", "e-series"]
"""Controller families."""

TICK_S: Final[dict[str, float]] = {"cb3": 0.008, "e-series": 0.002}
"""Control period of each controller family: UR's real-time client guide."""

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


# Denavit-Hartenberg parameters: Universal_Robots_ROS2_Description, config/ur10/default_kinematics.yaml, and Universal
# Robots' article "DH Parameters for calculations of kinematics and dynamics". The table in the CB3 manual ("UR10
# series 1": d1 0.118, a2 -0.6127, a3 -0.5716) describes other hardware and is 10.7 mm off.
DH_A_M: Final = constant([0.0, -0.612, -0.5723, 0.0, 0.0, 0.0])
DH_D_M: Final = constant([0.1273, 0.0, 0.0, 0.163941, 0.1157, 0.0922])
DH_ALPHA_RAD: Final = constant([np.pi / 2, 0.0, 0.0, np.pi / 2, -np.pi / 2, 0.0])

# Masses, centres of mass and inertias about the centre of mass, in the distal DH frame of each link: the same article;
# Universal_Robots_ROS2_Description, config/ur10/physical_parameters.yaml, holds the same figures ("extracted from
# URSim") with the centres of mass in link frames. The base's mass is marked there as doubtful; it never moves.
BASE_MASS_KG: Final = 4.0
LINK_MASS_KG: Final = constant([7.1, 12.7, 4.27, 2.0, 2.0, 0.365])
LINK_COM_M: Final = constant(
    [
        [0.021, 0.0, 0.027],
        [0.38, 0.0, 0.158],
        [0.24, 0.0, 0.068],
        [0.0, 0.007, 0.018],
        [0.0, 0.007, 0.018],
        [0.0, 0.0, -0.026],
    ]
)
# ixx, iyy, izz, ixy, ixz, iyz
LINK_INERTIA_KG_M2: Final = constant(
    [
        [0.03408, 0.03529, 0.02156, 0.00002, -0.00425, 0.00008],
        [0.02814, 0.77068, 0.76943, 0.00005, -0.01561, 0.00002],
        [0.01014, 0.30928, 0.30646, 0.00008, 0.00916, 0.0],
        [0.00296, 0.00222, 0.00258, -0.00001, 0.0, -0.00024],
        [0.00296, 0.00222, 0.00258, -0.00001, 0.0, -0.00024],
        [0.00040, 0.00041, 0.00034, 0.0, 0.0, 0.0],
    ]
)

# Joint limits: config/ur10/joint_limits.yaml. The elbow has ±360° on paper and is blocked by the arm itself; like
# that file, this project keeps it within ±180°.
JOINT_RANGE_RAD: Final = constant([2 * np.pi, 2 * np.pi, np.pi, 2 * np.pi, 2 * np.pi, 2 * np.pi])
JOINT_SPEED_RAD_S: Final = constant(np.deg2rad([120.0, 120.0, 180.0, 180.0, 180.0, 180.0]))
JOINT_TORQUE_NM: Final = constant([330.0, 330.0, 150.0, 56.0, 56.0, 56.0])

PAYLOAD_KG: Final = 10.0  # UR10 data sheet
REACH_M: Final = 1.3  # UR10 data sheet

# Reflected rotor inertia is not published; 0.1 kg m² is the convention of public MuJoCo models of this robot family.
ARMATURE_KG_M2: Final = 0.1

# This project's hard limits on what goes on the wire: 80 % of the data sheet's speeds; acceleration as UR's and
# Franka's client libraries use it; no public figure exists for a UR10's acceleration or jerk. 1.5 m/s is UR's own
# default safety limit for the tool speed of a CB3.
HARD_SPEED_RAD_S: Final = constant([1.68, 1.68, 2.51, 2.51, 2.51, 2.51])
HARD_ACCELERATION_RAD_S2: Final = 10.0
HARD_JERK_RAD_S3: Final = 2000.0
HARD_TCP_SPEED_M_S: Final = 1.5


@dataclass(frozen=True)
class DHParameters:
    """Denavit-Hartenberg parameters of one arm, nominal or as measured by the controller's calibration.

    Attributes:
        a_m: (6,) link lengths.
        d_m: (6,) link offsets.
        alpha_rad: (6,) link twists.
        theta_rad: (6,) offsets added to the joint angles; zero on the nominal arm.

    Raises:
        SettingsError: A row is not six finite numbers, or differs from the nominal arm by more than a calibration
            can (50 mm, 0.05 rad), which means the parameters of another robot. The lengths of the upper arm's and
            forearm's parallel axes, d2 and d3, may shift freely against each other in a UR calibration.
    """

    a_m: tuple[float, ...] = tuple(DH_A_M.tolist())
    d_m: tuple[float, ...] = tuple(DH_D_M.tolist())
    alpha_rad: tuple[float, ...] = tuple(DH_ALPHA_RAD.tolist())
    theta_rad: tuple[float, ...] = (0.0,) * 6

    def __post_init__(self) -> None:
        for name, nominal, tolerance in (
            ("a_m", DH_A_M, 0.05),
            ("d_m", DH_D_M, 0.05),
            ("alpha_rad", DH_ALPHA_RAD, 0.05),
            ("theta_rad", np.zeros(6), 0.05),
        ):
            values = np.asarray(getattr(self, name), dtype=np.float64)
            if values.shape != (6,) or not np.isfinite(values).all():
                raise SettingsError(f"DH parameter {name} must be six finite numbers, found {getattr(self, name)!r}")
            object.__setattr__(self, name, tuple(values.tolist()))
            off = np.abs(values - nominal)
            if name == "d_m":
                # Joints 2, 3 and 4 are nearly parallel: only the sum of d2, d3 and d4 is observable.
                off = np.array([off[0], abs(values[1:4].sum() - nominal[1:4].sum()), 0.0, 0.0, off[4], off[5]])
            if (off > tolerance).any():
                row = int(off.argmax())
                raise SettingsError(
                    f"DH parameter {name}[{row}] is {values[row]:.6g}, {off[row]:.3g} from the UR10's "
                    f"{nominal[row]:.6g}; a calibration differs by at most {tolerance}. These may be the parameters "
                    f"of another robot"
                )

    @property
    def is_nominal(self) -> bool:
        """True for the nominal parameters of the UR10."""
        return self == NOMINAL_DH


NOMINAL_DH: Final = DHParameters()
