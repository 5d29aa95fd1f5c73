"""Recorder of a simulated run."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Final

import numpy as np

from dual_ur10.errors import ResetNeededError
from dual_ur10.sim2real.recording.header import mounts_of
from dual_ur10.sim2real.recording.rows import BeginRow, StepRow
from dual_ur10.sim2real.recording.run import Header, RunEvent
from dual_ur10.sim2real.recording.run_folder import LEAST_FREE_BYTES, RunLog
from dual_ur10.sim2real.recording.schemas import EPISODE_TOPIC, SIMULATED_COLUMNS, STEP_TOPIC
from dual_ur10.sim2real.recording.writer import RunWriter
from ur_core.kinematics import flange_pose_quat
from ur_core.kinematics.rotations import quat_to_rotvec
from ur_core.processes.interrupts import interrupts_deferred

if TYPE_CHECKING:
    from dual_ur10.sim2real.cell.cell import TickTrace

_ROW: Final = sum(size for _, size in SIMULATED_COLUMNS)


class SimulationRecord:
    """Recorder of one simulated cell, a `dual_ur10.sim2real.recording.rows.RunRecorder`.

    The run's clock is the simulated time of its episodes, one after the other. Ctrl-C waits until each write is
    complete: a message that is half in the file, or missing from its checksum, would make the file unreadable.

    Args:
        folder: Existing folder of the run.
        header: Header of the run.
        least_free_bytes: Free space required on the disk.

    Attributes:
        writer: Writer of the file.

    Raises:
        RecordingError: The file cannot be created.
    """

    failure = ""  # failures of a simulation are raised

    def __init__(self, folder: Path, header: Header, *, least_free_bytes: int = LEAST_FREE_BYTES) -> None:
        self._tick_s, self._latency_ticks = header.tick_s, header.latency_ticks
        self._dh = [mount.dh for mount in mounts_of(header)]
        self._begin_s = 0.0
        self._ticks = self._step = 0
        self._episode = self._sent = -1
        self.writer = RunWriter(folder, header, columns=SIMULATED_COLUMNS, least_free_bytes=least_free_bytes)
        self._log = RunLog(folder, header)

    @property
    def now_s(self) -> float:
        """Time on the run's clock."""
        return self._begin_s + self._ticks * self._tick_s

    @interrupts_deferred()
    def begin_episode(self, row: BeginRow) -> None:
        """Record the beginning of an episode, at the end of the one before.

        Raises:
            RecordingError: The file cannot be written.
        """
        self._begin_s, self._ticks, self._step = self.now_s, 0, 0
        self._episode += 1
        self.writer.single(EPISODE_TOPIC, self._begin_s, row.encode(self._episode, self._begin_s))
        self.writer.flush()

    @interrupts_deferred()
    def step(self, row: StepRow, trace: TickTrace | None = None) -> None:
        """Record a step. Of a step whose physics diverged, the finite ticks are kept.

        Raises:
            RecordingError: The file cannot be written.
            ResetNeededError: No episode has begun.
        """
        if self._episode < 0:
            raise ResetNeededError("a step was to be recorded before the first episode: call begin_episode first")
        ticks = len(row.targets_rad)
        row = replace(row, first_target=self._sent + 1 + self._latency_ticks)
        if trace is not None:
            self._trace(trace)
        self._ticks += ticks
        self.writer.single(STEP_TOPIC, self.now_s, row.encode(self._episode, self._step))
        self._step += 1
        self.writer.flush()

    def _trace(self, trace: TickTrace) -> None:
        ticks = len(trace.sent_rad)
        numbers = self._ticks + np.arange(ticks)
        sent_s, end_s = self._begin_s + numbers * self._tick_s, self._begin_s + (numbers + 1) * self._tick_s
        first = self._sent + 1
        self._sent += ticks
        finite = np.isfinite(trace.q_rad).all(axis=(1, 2)) & np.isfinite(trace.qd_rad_s).all(axis=(1, 2))
        good = ticks if finite.all() else int(finite.argmin())
        for arm in range(2):
            rows = np.empty((ticks, _ROW))
            rows[:, 0] = rows[:, 1] = end_s
            rows[:, 2:8], rows[:, 8:14], rows[:, 14:20] = (
                each[:, arm] for each in (trace.q_rad, trace.qd_rad_s, trace.reference_rad)
            )
            rows = rows[:good]
            position, quat = flange_pose_quat(rows[:, 2:8], self._dh[arm])
            rows[:, 20:23], rows[:, 23:] = position, quat_to_rotvec(quat)
            self.writer.states(arm, rows)
            sent = np.zeros((ticks, 10))
            sent[:, 0] = sent[:, 1] = first + np.arange(ticks)
            sent[:, 2], sent[:, 4:] = sent_s, trace.sent_rad[:, arm]
            self.writer.sent(arm, sent)

    @interrupts_deferred()
    def event(self, kind: str, text: str, arm: str = "", time_s: float | None = None) -> None:
        """Record an event.

        Raises:
            RecordingError: The file cannot be written.
        """
        event = RunEvent(self.now_s if time_s is None else time_s, kind, text, arm)
        self.writer.event(event)
        self.writer.flush()
        self._log(event)

    @interrupts_deferred()
    def close(self) -> None:
        """End the record. May be called twice.

        Raises:
            RecordingError: The file cannot be written.
        """
        self._log.close()
        self.writer.close()
