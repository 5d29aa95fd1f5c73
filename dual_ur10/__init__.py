"""Dual-UR10 environments for learned and scripted policies, in MuJoCo, with the lag of real UR arms.

Importing the package registers the environments with Gymnasium and PettingZoo and loads nothing heavy:

    import gymnasium as gym
    import dual_ur10

    env = gym.make("DualUR10/SineTracking-v0")
"""

from dual_ur10 import loading  # first, so that Ctrl-C during what follows gives one line

__version__ = "0.1.0"

ENV_IDS = ("DualUR10/SineTracking-v0", "DualUR10/SyncCarry-v0", "DualUR10/Handover-v0")
"""All registered ids. An id is a promise: what changes a result gets a new version."""

if not loading.is_child():  # what moves, stops or records arms has to be ready soon, and needs nothing of this
    from dual_ur10 import registration  # noqa: F401  # registers
    from dual_ur10.assets.scene import ArmMount
    from dual_ur10.sim2real.cell import TYPICAL_PERTURBATION, CellConfig, Perturbation
    from dual_ur10.sim2real.servoj import ServojProfile
    from dual_ur10.ur10 import DHParameters

__all__ = [
    "ENV_IDS",
    "TYPICAL_PERTURBATION",
    "ArmMount",
    "CellConfig",
    "DHParameters",
    "Perturbation",
    "ServojProfile",
    "__version__",
]
