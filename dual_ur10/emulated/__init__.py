"""Cells of emulated controllers: the world of a task behind them, their processes, and the virtual clock.

It joins the suite to `ur_emulator`, which knows of neither cells nor tasks. Nothing that moves real arms is here.
"""

from dual_ur10.errors import MissingExtraError
from dual_ur10.ids import __version__
from ur_core.errors import MixedVersionsError

try:
    import ur_emulator
except ModuleNotFoundError:
    raise MissingExtraError("ur-emulator", "emulator", "an emulated controller") from None

if ur_emulator.__version__ != __version__:
    raise MixedVersionsError("dual-ur10", __version__, "ur-emulator", ur_emulator.__version__)
