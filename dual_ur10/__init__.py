"""Dual-UR10 environments for learned and scripted policies, in MuJoCo, with the lag of real UR arms.

Importing the package registers the environments with Gymnasium and PettingZoo. It loads neither MuJoCo nor torch:

    import gymnasium as gym
    import dual_ur10

    env = gym.make("DualUR10/SineTracking-v0")
"""

from importlib import import_module
from typing import TYPE_CHECKING, Any

import ur_core
from dual_ur10.ids import __version__
from ur_core.processes import interrupts  # first, so that Ctrl-C during what follows gives one line

if ur_core.__version__ != __version__:
    from ur_core.errors import MixedVersionsError

    raise MixedVersionsError("dual-ur10", __version__, "ur-core", ur_core.__version__)

if not interrupts.is_child():  # the processes that move, stop or record arms start faster without the rest
    from dual_ur10 import registration  # noqa: F401  # registers
    from dual_ur10.ids import ENV_IDS

if TYPE_CHECKING:
    from dual_ur10.sim2real.cell.cell_config import CellConfig
    from dual_ur10.sim2real.cell.perturbation import TYPICAL_PERTURBATION, Perturbation
    from ur_core.kinematics.frames import ArmMount
    from ur_core.kinematics.ur10 import DHParameters
    from ur_core.servoj import ServojProfile

_LATE = {
    "ArmMount": "ur_core.kinematics.frames",
    "CellConfig": "dual_ur10.sim2real.cell.cell_config",
    "DHParameters": "ur_core.kinematics.ur10",
    "Perturbation": "dual_ur10.sim2real.cell.perturbation",
    "ServojProfile": "ur_core.servoj",
    "TYPICAL_PERTURBATION": "dual_ur10.sim2real.cell.perturbation",
}
"""Modules of the names that are loaded on first use, which saves a third of the time of an import."""

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


def __getattr__(name: str) -> Any:
    if name not in _LATE:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    value = globals()[name] = getattr(import_module(_LATE[name]), name)
    return value


def __dir__() -> list[str]:
    # The public names, and the parts of the package that were imported.
    return sorted({*__all__, *({"envs", "errors", "follower", "policies", "tasks", "testing"} & globals().keys())})
