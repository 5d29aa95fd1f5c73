"""Draw docs/images/calibration_residuals.png, a calibration with a touch that missed (needs the extra `plot`)."""

from __future__ import annotations

import sys
from pathlib import Path

import matplotlib

matplotlib.use("Agg")
import matplotlib.pyplot as plt
import numpy as np

sys.path.insert(0, str(Path(__file__).parents[1]))  # arms as built are those of the tests

from dual_ur10.assets.settings import SceneSettings
from dual_ur10.sim2real.calibration.estimate import estimate
from dual_ur10.sim2real.calibration.observations import Noise
from dual_ur10.sim2real.calibration.recording import touched
from dual_ur10.sim2real.calibration.suggestions import plan, touch_candidates
from dual_ur10.sim2real.calibration.transforms import right_in_left
from tests.sim2real.calibration.simulated import random_dh
from ur_core.kinematics.ur10 import NOMINAL_DH

TARGET = Path(__file__).parent / "images" / "calibration_residuals.png"
TIP_M = (0.0, 0.0, 0.17)
MISSED, MISSED_M = 5, 0.002


def main() -> None:
    """Draw both panels: arms known and arms thought to be nominal."""
    rng = np.random.default_rng(5)
    near = right_in_left(*SceneSettings().mounts)
    nominal, built = (NOMINAL_DH, NOMINAL_DH), (random_dh(rng), random_dh(rng))
    planned = [each.observation for each in plan(12, touch_candidates(nominal, near, (TIP_M, TIP_M)), nominal, near)]
    observed = [touched(each, built, near, Noise(), rng) for each in planned]  # type: ignore[arg-type]  # touches
    observed[MISSED] = touched(planned[MISSED], built, near, Noise(touch_m=MISSED_M), rng)  # type: ignore[arg-type]
    figure, axes = plt.subplots(1, 2, figsize=(8.0, 2.8), layout="constrained")
    for axis, arms, title in zip(axes, (built, nominal), ("calibrated kinematics", "nominal kinematics"), strict=True):
        found = estimate(observed, arms, near)
        heights = [1e3 * each.distance_m for each in found.residuals]
        colours = ["tab:red" if each.rejected else "tab:blue" for each in found.residuals]
        axis.bar(np.arange(1, len(heights) + 1), heights, color=colours)
        axis.set(title=f"{title}: noise {found.noise_scale:.1f} × stated", xlabel="touch", ylabel="residual, mm")
    figure.savefig(TARGET, dpi=90)


if __name__ == "__main__":
    main()
