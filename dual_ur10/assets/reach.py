"""How far parts of an arm can get from its base, whatever its joints do."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from dual_ur10.assets.settings import SceneSettings
from dual_ur10.ur10 import ARMS

if TYPE_CHECKING:
    import mujoco  # type: ignore[import-untyped, unused-ignore]  # has no types of its own


def reach_m(model: mujoco.MjModel, settings: SceneSettings, geom: int) -> tuple[int, float]:
    """Arm that a geom is part of, and bound on the distance of all its points from the arm's base.

    The bound is the length of the chain of bodies up to the geom, stretched out in a line: up to a fifth more than the
    joints allow.

    Args:
        model: The cell's twin that measures distances.
        settings: The cell.
        geom: Index of the geom.

    Returns:
        Its row in `ARMS` and the bound in m; -1 and 0 for what is part of no arm.
    """
    for arm, mount in enumerate(settings.mounts):
        if model.geom(geom).name.startswith(f"{ARMS[arm]}/"):
            # The bases are parts of the world here, so that what is fixed in it is given in the cell frame.
            chain: list[Any] = [model.geom_pos[geom]]
            body = int(model.geom_bodyid[geom])
            while body != 0:
                chain.append(model.body_pos[body])
                body = int(model.body_parentid[body])
            chain[-1] = chain[-1] - np.asarray(mount.position_m)
            return arm, float(sum(map(np.linalg.norm, chain)) + model.geom_rbound[geom])
    return -1, 0.0
