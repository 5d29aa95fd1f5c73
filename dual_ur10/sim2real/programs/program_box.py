"""Black box of arms that run programs of ours: the program that watches them keeps it, without a recorder process."""

from __future__ import annotations

import logging
from pathlib import Path
from typing import Final

import numpy as np

from dual_ur10.errors import RecordingError
from dual_ur10.sim2real.cell_file.cell_file import CellFile
from dual_ur10.sim2real.recording.black_box import BlackBox
from dual_ur10.sim2real.recording.header import describe
from ur_core.links.arm_status import ArmStatus
from ur_core.processes.system import LOCAL, System
from ur_core.types import Array

_LOG: Final = logging.getLogger(__name__)


class ProgramBox:
    """Keeper of the last seconds, a `dual_ur10.sim2real.programs.program_link.MotionObserver`.

    It writes to a disk only after a stop, when the arms rest or stop by themselves.

    Args:
        file: Cell file of the arms.
        name: Name of the run, such as "points".
        system: Clock and state folder.

    Attributes:
        boxes: Black boxes that were written.

    Raises:
        RecordingError: The folder of black boxes cannot be made.
    """

    def __init__(self, file: CellFile, name: str, *, system: System = LOCAL) -> None:
        folder = system.state_folder() / "black_boxes"
        try:
            folder.mkdir(mode=0o700, exist_ok=True)
        except OSError as error:
            raise RecordingError(f"no black box can be kept in {folder}: {error}") from error
        config = file.config()
        header = describe(
            name,
            {},
            config,
            period_ticks=1,
            latency_ticks=0,
            source=config.kind,
            speed_factor=config.speed_factor,
            cell_file=file.text(),
            started=system.clock.utc(),
        )
        self.boxes: list[Path] = []
        self._clock, self._begin_s = system.clock, system.clock.now_s()
        self._box = BlackBox(folder, header)

    def state(self, arm: int, status: ArmStatus) -> None:
        """Keep a state of an arm."""
        self._box.states(arm, np.array([status._replace(arrival_s=status.arrival_s - self._begin_s).row()]))
        self._box.forget(self._clock.now_s() - self._begin_s)

    def sent(self, arm: int, number: int, q_rad: Array) -> None:
        """Keep a point that is sent to an arm now."""
        self._box.sent(arm, np.array([[number, number, self._clock.now_s() - self._begin_s, 0.0, *q_rad]]))

    def stopped(self, reason: str) -> None:
        """Write a black box. A failure is logged, as the stop itself counts."""
        try:
            self.boxes.append(self._box.write(self._clock.now_s() - self._begin_s, reason))
        except RecordingError as error:
            _LOG.warning("no black box: %s", error)
        else:
            _LOG.info("the last seconds are in %s", self.boxes[-1])
