"""Visual randomization: light, colours and cameras that differ from episode to episode in observed images."""

from __future__ import annotations

from typing import Any

import numpy as np

from dual_ur10.envs.core.randomization import Randomization
from ur_core.kinematics.rotations import quat_from_rotvec, quat_multiply


class Look:
    """Variation of what a model looks like, applied to one model that draws the rows of several cells in turn.

    Only values that MuJoCo reads while it draws are changed.

    Args:
        model: MuJoCo's model, as it looks nominally.
        randomization: Ranges.
    """

    def __init__(self, model: Any, randomization: Randomization) -> None:
        self._model, self._ranges = model, randomization
        head = model.vis.headlight
        self._materials, self._geoms = model.mat_rgba[:, :3].copy(), model.geom_rgba[:, :3].copy()
        self._lights, self._head = model.light_diffuse.copy(), np.array([head.ambient, head.diffuse])
        self._places, self._rotations = model.cam_pos.copy(), model.cam_quat.copy()
        self._seed = np.nan

    def apply(self, seed: float) -> None:
        """Give the model the look of an episode.

        Args:
            seed: Number of the episode, between -1 and 1.
        """
        if seed == self._seed:
            return
        self._seed = seed
        rng, model, ranges = np.random.default_rng(int(abs(seed) * 2**52)), self._model, self._ranges

        def spread(share: float, *shape: int) -> Any:
            return share * rng.uniform(-1.0, 1.0, shape)

        for colours, nominal in ((model.mat_rgba, self._materials), (model.geom_rgba, self._geoms)):
            colours[:, :3] = np.clip(nominal * (1.0 + spread(ranges.colour, *nominal.shape)), 0.0, 1.0)
        model.light_diffuse[:] = self._lights * (1.0 + spread(ranges.light, len(self._lights), 1))
        model.vis.headlight.ambient, model.vis.headlight.diffuse = self._head * (1.0 + spread(ranges.light, 2, 1))
        model.cam_pos[:] = self._places + spread(ranges.camera_shift_m, *self._places.shape)
        rotations = quat_from_rotvec(spread(ranges.camera_turn_rad, *self._places.shape))
        model.cam_quat[:] = quat_multiply(self._rotations, rotations)
