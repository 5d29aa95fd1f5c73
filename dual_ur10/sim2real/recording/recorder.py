"""Recorder process of a run on arms, seen from the program that moves them."""

from __future__ import annotations

import logging
import struct
from pathlib import Path
from typing import TYPE_CHECKING, Final

from dual_ur10.errors import RecordingError
from dual_ur10.sim2real.recording.recorder_process import (
    BLACK_BOX,
    CLOSE,
    DONE,
    FAILED,
    FRAME,
    READY,
    WROTE,
    main,
    take_frames,
)
from dual_ur10.sim2real.recording.rows import BeginRow, StepRow
from dual_ur10.sim2real.recording.run import Header, RunEvent
from dual_ur10.sim2real.recording.run_folder import LEAST_FREE_BYTES
from dual_ur10.sim2real.recording.schemas import EPISODE_TOPIC, EVENT, EVENT_TOPIC, STEP_TOPIC, TOPICS
from ur_core.processes.interrupts import interrupts_deferred
from ur_core.processes.system import LOCAL, Process, System

if TYPE_CHECKING:
    from dual_ur10.sim2real.cell.cell import TickTrace

_LOG: Final = logging.getLogger(__name__)

START_S: Final = 20.0
CLOSE_S: Final = 10.0
_POLL_S: Final = 0.05
_PIECE: Final = 65_536
_MOST_PENDING: Final = 64 * 2**20


class RecorderProcess:
    """Recorder of two arms and of their program, a `dual_ur10.sim2real.recording.rows.RunRecorder`.

    States and targets come from the shared memories of the arms, so that they are recorded even if this program is
    killed. Only `wait_until_ready` and `close` wait for a disk.

    Args:
        memories: Names of the memories of the left and the right arm.
        folder: Existing folder of the run. None: only the black box is kept.
        header: Header of the run.
        black_boxes: Existing folder of black boxes.
        begin_s: Zero of the run's clock on the system's clock; None: now.
        least_free_bytes: Free space required on the disk.
        system: Clock and processes.

    Attributes:
        begin_s: Zero of the run's clock.
        failure: Reason why something was not recorded; empty: none. Every call updates it.
        boxes: Black boxes that were written.
    """

    def __init__(
        self,
        memories: tuple[str, str],
        folder: Path | None,
        header: Header,
        black_boxes: Path,
        *,
        begin_s: float | None = None,
        least_free_bytes: int = LEAST_FREE_BYTES,
        system: System = LOCAL,
    ) -> None:
        self._clock = system.clock
        self.begin_s = self._clock.now_s() if begin_s is None else begin_s
        self.failure = ""
        self.boxes: list[Path] = []
        self._episode, self._step = -1, 0
        self._pending = bytearray()
        self._received = bytearray()
        self._ready = self._done = self._closed = False
        self._transport, theirs = system.channel()
        self._ended = False  # this end of the channel was closed
        arguments = (memories, folder, header, black_boxes, self.begin_s, system.pid, least_free_bytes)
        self.process: Process = system.spawn(main, *arguments, name="recorder", channel=theirs)

    def wait_until_ready(self, within_s: float = START_S) -> None:
        """Wait until the process records.

        Raises:
            RecordingError: It does not: no room, no permission, no such memory, or a timeout.
        """
        end = self._clock.now_s() + within_s
        while not (self._ready or self.failure) and self._clock.now_s() < end:
            self._clock.wait((self._transport.fileno(),), end)
            self._receive()
        if not self._ready:
            reason = self.failure or f"the recorder did not start within {within_s:g} s"
            self.kill()
            raise RecordingError(reason)

    @property
    def now_s(self) -> float:
        """Time on the run's clock."""
        return self._clock.now_s() - self.begin_s

    def begin_episode(self, row: BeginRow) -> None:
        """Record the beginning of an episode, now or at the time in the row."""
        self._episode, self._step = self._episode + 1, 0
        begin_s = self.now_s if row.begin_s is None else row.begin_s
        self._single(EPISODE_TOPIC, self.now_s, row.encode(self._episode, begin_s))

    def step(self, row: StepRow, trace: TickTrace | None = None) -> None:
        """Record a step. The arms record themselves what a trace would hold."""
        self._single(STEP_TOPIC, self.now_s, row.encode(self._episode, self._step))
        self._step += 1

    def event(self, kind: str, text: str, arm: str = "", time_s: float | None = None) -> None:
        """Record an event; `time_s` None: now."""
        time_s = self.now_s if time_s is None else time_s
        self._single(EVENT_TOPIC, time_s, EVENT.encode(vars(RunEvent(time_s, kind, text, arm))))

    def black_box(self, reason: str) -> None:
        """Write a black box, about a second from now, so that the stop itself is in it."""
        self._send(BLACK_BOX, self.now_s, reason.encode())

    def close(self, within_s: float = CLOSE_S) -> None:
        """Wait for the end of the record up to a timeout, and report problems in `failure`. May be called twice."""
        if self._closed:
            return
        self._closed = True
        self._send(CLOSE, self.now_s, b"")
        end = self._clock.now_s() + within_s
        while not self._done and self.process.is_alive and (now := self._clock.now_s()) < end:
            number = self._transport.fileno()
            self._clock.wait((number,), min(end, now + _POLL_S), (number,) if self._pending else ())
            self._push()
            self._receive()
        if self._done:
            self.process.wait(max(0.0, end - self._clock.now_s()))
        self._receive()
        if not self._done:
            self._fail(f"the recorder did not end within {within_s:g} s")
        self.kill()

    def kill(self) -> None:
        """End the process at once."""
        self._closed = True
        self.process.kill()
        self._ended = True
        self._transport.close()

    def _single(self, topic: str, time_s: float, data: bytes) -> None:
        self._send(TOPICS.index(topic), time_s, data)

    @interrupts_deferred()
    def _send(self, kind: int, time_s: float, data: bytes) -> None:
        # An interrupt between writing to the pipe and removing from the buffer would send the bytes twice.
        if self._ended:
            return
        if len(self._pending) > _MOST_PENDING:
            self._fail(f"the recorder is {_MOST_PENDING // 2**20} MiB behind: later messages are not recorded")
            return
        self._pending += struct.pack(FRAME, kind, len(data), time_s) + data
        self._push()
        self._receive()

    def _push(self) -> None:
        try:
            while self._pending and (sent := self._transport.send_now(self._pending[:_PIECE])):
                del self._pending[:sent]
        except OSError:
            self._pending.clear()
            self._fail("the recorder has ended")

    def _receive(self) -> None:
        if self._ended:
            return
        ended = False
        try:
            while piece := self._transport.receive_now(_PIECE):
                self._received += piece
            ended = piece is not None
        except OSError:
            ended = True
        self._parse()
        # Its last messages come first.
        if ended and not self._done:
            self._fail("the recorder has ended")

    def _parse(self) -> None:
        for kind, _, data in take_frames(self._received):
            text = data.decode()
            if kind == FAILED:
                self._fail(text)
            elif kind == WROTE:
                self.boxes.append(Path(text))
            self._ready |= kind == READY
            self._done |= kind == DONE

    def _fail(self, reason: str) -> None:
        if not self.failure:
            self.failure = reason
            _LOG.warning("%s", reason)
