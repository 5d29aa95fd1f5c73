"""Whether an environment is made, or reset, by something that begins episodes by itself.

Gymnasium and Stable-Baselines3 call the same `reset` as a person's program, with the same arguments: only who calls
tells them apart. It is asked where arms would move.
"""

from __future__ import annotations

import sys
from types import FrameType
from typing import Final

from gymnasium.vector import AutoresetMode

_SB3: Final = "stable_baselines3.common.vec_env"
_CALLERS: Final = {
    ("gymnasium.vector.sync_vector_env", "__init__"),
    ("gymnasium.vector.sync_vector_env", "step"),
    ("gymnasium.vector.async_vector_env", "__init__"),
    ("gymnasium.vector.async_vector_env", "_async_worker"),
    ("gymnasium.wrappers.common", "step"),  # the wrapper `Autoreset`; others do not reset in a step
    (f"{_SB3}.dummy_vec_env", "__init__"),
    (f"{_SB3}.dummy_vec_env", "step_wait"),
    (f"{_SB3}.subproc_vec_env", "_worker"),
}


def is_by_itself() -> bool:
    """Whether one of them is among the callers, and not told to leave resets to others."""
    frame: FrameType | None = sys._getframe(1)
    while frame is not None:
        if (frame.f_globals.get("__name__"), frame.f_code.co_name) in _CALLERS:
            own, seen = frame.f_locals.get("autoreset_mode"), frame.f_locals.get("self")
            mode = getattr(seen, "autoreset_mode", own)
            return mode not in (AutoresetMode.DISABLED, AutoresetMode.DISABLED.value)
        frame = frame.f_back
    return False
