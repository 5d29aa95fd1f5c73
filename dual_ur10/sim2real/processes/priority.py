"""Lets processes that must be in time go before others, where the system allows it."""

from __future__ import annotations

import contextlib
import os
from typing import Final

from dual_ur10.errors import SettingsError

NICE: Final = -15
"""Of a process that sends or watches. Users may be denied it; then it is as nice as others are."""


def hasten(rt_priority: int = 0) -> None:
    """Let this process go before others.

    Args:
        rt_priority: Among those that run in real time; 0: it does not, and is only preferred, where that is allowed.

    Raises:
        SettingsError: A real-time priority is wanted, and the system refuses it.
    """
    if not rt_priority:
        with contextlib.suppress(OSError):
            os.setpriority(os.PRIO_PROCESS, 0, NICE)
        return
    try:
        os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(rt_priority))
    except OSError as error:
        reason = f"rt_priority {rt_priority} was refused by the system ({error})"
        raise SettingsError(f"{reason}: allow it (rtprio in limits.conf), or set it to 0") from error
