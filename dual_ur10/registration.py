"""Registration of the environments with Gymnasium and PettingZoo, done when `dual_ur10` is imported."""

import pettingzoo  # type: ignore[import-untyped]  # has no types
from gymnasium.envs.registration import register, registry

from dual_ur10.ids import ENV_IDS, task_name

for _id in ENV_IDS:
    if _id not in registry:
        register(
            _id,
            entry_point="dual_ur10.envs.api.dual_arm_env:DualArmEnv",
            vector_entry_point="dual_ur10.envs.api.vector_env:DualArmVectorEnv",
            kwargs={"task": task_name(_id)},
        )
    # Their registries warn of an id that they know.
    if _id not in pettingzoo.parallel_registry:
        pettingzoo.register("parallel", _id, "dual_ur10.envs:parallel_env", kwargs={"task": _id})
    if _id not in pettingzoo.aec_registry:
        pettingzoo.register("aec", _id, "dual_ur10.envs:aec_env", kwargs={"task": _id})
