"""Lines that `ur_rtde` prints on its own, from threads and without an arm's name, in the words of this package."""

from __future__ import annotations

import contextlib
import logging
import sys
from typing import Final

log = logging.getLogger(__name__)

_RECONNECTS: Final = "it wanted to connect again, which it must not: its script would restart without a watchdog"

# Prints of rtde_control_interface.cpp, version 1.6.5.
_KNOWN: Final = {
    "RTDEControlInterface: RTDE control script is not running!": "its control script no longer runs",
    "RTDEControlInterface: Robot closed the connection!": "the controller closed its connection",
    "RTDEControlInterface: Could not receive data from robot...": "it receives no data",
    "RTDEControlInterface: Lost connection to robot...": "it has lost the controller",
    "RTDEControlInterface: Robot is disconnected, reconnecting...": _RECONNECTS,
    "Reconnecting...": _RECONNECTS,
}
_DETAIL: Final = "RTDEControlInterface Exception: "
_BARRED: Final = "Too many open files"
_BEFORE_DETAIL: Final = "RTDEControlInterface: Lost connection to robot..."  # the next line is its exception


class UrRtdeOutput:
    """Receiver of the lines that the process of an arm prints. Lines that are not known to be `ur_rtde`'s pass on.

    What `ur_rtde` prints follows from a stop or a lost connection, which the process reports with its reason. So each
    fact is logged once, at level INFO.

    Args:
        arm: Name of the arm.
    """

    def __init__(self, arm: str) -> None:
        self._arm = arm
        self._reported: set[str] = set()
        self._detail_follows = False

    def __call__(self, line: str) -> None:
        """Process a line without its end."""
        detail_follows, self._detail_follows = self._detail_follows, line == _BEFORE_DETAIL
        if line in _KNOWN:
            self._report(_KNOWN[line])
        elif line.startswith(_DETAIL) or detail_follows:
            text = line.removeprefix(_DETAIL)
            self._report(_RECONNECTS if _BARRED in text else text)
        else:
            # There may be no standard error, or nobody who reads it.
            with contextlib.suppress(OSError, ValueError, AttributeError):
                sys.stderr.write(f"{line}\n")
                sys.stderr.flush()

    def _report(self, text: str) -> None:
        if text not in self._reported:
            self._reported.add(text)
            log.info("%s, ur_rtde: %s", self._arm, text)
