"""Dual-UR10 environments for learned and scripted policies, in MuJoCo, with the lag of real UR arms.

Importing the package registers the environments with Gymnasium and PettingZoo and loads nothing heavy:

    import gymnasium as gym
    import dual_ur10

    env = gym.make("DualUR10/SineTracking-v0")
"""

from dual_ur10 import loading  # noqa: F401  # first, so that Ctrl-C during what follows gives one line

# isort: split
import pettingzoo  # type: ignore[import-untyped]  # has no types
from gymnasium.envs.registration import register, registry

from dual_ur10.assets.scene import ArmMount
from dual_ur10.sim2real.cell import TYPICAL_PERTURBATION, CellConfig, Perturbation
from dual_ur10.sim2real.servoj import ServojProfile
from dual_ur10.ur10 import DHParameters

__version__ = "0.1.0"

ENV_IDS = ("DualUR10/SineTracking-v0", "DualUR10/SyncCarry-v0", "DualUR10/Handover-v0")
"""All registered ids. An id is a promise: what changes a result gets a new version."""

for _id in ENV_IDS:
    if _id not in registry:
        register(
            _id,
            entry_point="dual_ur10.envs.dual_arm_env:DualArmEnv",
            vector_entry_point="dual_ur10.envs.vector_env:DualArmVectorEnv",
            kwargs={"task": _id.split("/")[1].rsplit("-", 1)[0]},
        )
    # Their registries warn of an id that they know.
    if _id not in pettingzoo.parallel_registry:
        pettingzoo.register("parallel", _id, "dual_ur10.envs:parallel_env", kwargs={"task": _id})
    if _id not in pettingzoo.aec_registry:
        pettingzoo.register("aec", _id, "dual_ur10.envs:aec_env", kwargs={"task": _id})
del _id

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
