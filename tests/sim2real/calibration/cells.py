"""Simulated cells for tests of the calibration."""

import numpy as np

from dual_ur10.assets.settings import SceneSettings
from dual_ur10.sim2real.calibration.observations import Noise
from dual_ur10.sim2real.calibration.recording import touched
from dual_ur10.sim2real.calibration.suggestions import plan, touch_candidates
from dual_ur10.sim2real.calibration.transforms import right_in_left, rotation_of, rotvec_of
from ur_core.kinematics.ur10 import NOMINAL_DH

MOUNTS = SceneSettings().mounts
NEAR = right_in_left(*MOUNTS)
NOMINAL = (NOMINAL_DH, NOMINAL_DH)
NOISE = Noise()
TIP_M = (0.0, 0.0, 0.17)
CANDIDATES = touch_candidates(NOMINAL, NEAR, (TIP_M, TIP_M))
PLANNED = [each.observation for each in plan(8, CANDIDATES, NOMINAL, NEAR)]


def shifted(shift_m=(0.004, -0.003, 0.002), rotation_rad=(0.0, 0.0, 0.008)):
    """Return a right base beside the place in the cell file."""
    base = NEAR.copy()
    base[:3, 3] += shift_m
    base[:3, :3] = rotation_of(rotation_rad) @ base[:3, :3]
    return base


def touches(base, rng, planned=None, dh=NOMINAL, noise=NOISE):
    return [touched(each, dh, base, noise, rng) for each in planned or PLANNED]


def error_of(found, base):
    """Return position error in mm and rotation error in degrees."""
    rotation = rotvec_of(found.pose[:3, :3] @ base[:3, :3].T)
    return 1e3 * np.linalg.norm(found.position_m - base[:3, 3]), np.degrees(np.linalg.norm(rotation))
