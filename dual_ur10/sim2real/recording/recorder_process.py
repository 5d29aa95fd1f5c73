"""Main program of the recorder process."""

from __future__ import annotations

import contextlib
import struct
from collections.abc import Callable
from pathlib import Path
from typing import Final

import numpy as np

from dual_ur10.errors import MissingExtraError, RecordingError
from dual_ur10.sim2real.recording.black_box import BlackBox
from dual_ur10.sim2real.recording.cdr import check_extra
from dual_ur10.sim2real.recording.run import Header, RunEvent
from dual_ur10.sim2real.recording.run_folder import RunLog
from dual_ur10.sim2real.recording.schemas import EVENT, EVENT_TOPIC, TOPICS
from dual_ur10.sim2real.recording.writer import RunWriter
from dual_ur10.sim2real.runtime.arm_memory import RING, ArmMemory, Phase
from dual_ur10.sim2real.runtime.arm_sender import was_requested
from ur_core.kinematics.ur10 import ARMS
from ur_core.processes.clock import Clock
from ur_core.processes.system import LOCAL, System
from ur_core.processes.transport import Transport
from ur_core.types import Array

FRAME: Final = "<BId"
"""Frame on the pipe: kind, number of bytes that follow, and time on the run's clock. Smaller kinds are topics."""

BLACK_BOX, CLOSE, READY, FAILED, WROTE, DONE = range(100, 106)

POLL_S: Final = 0.05
SYNC_S: Final = 1.0
AFTER_STOP_S: Final = 1.0
"""Time from a stop to its black box, so that the box holds the stop itself."""

ORPHAN_S: Final = 3.0
"""Time limit of recording both arms to their stop after the program has ended without closing the record."""

_MOST_RECEIVED: Final = 64 * 2**20


def take_frames(buffer: bytearray) -> list[tuple[int, float, bytes]]:
    """Remove all whole frames from a buffer, and return kind, time and data of each."""
    found, at, size = [], 0, struct.calcsize(FRAME)
    while len(buffer) - at >= size:
        kind, length, time_s = struct.unpack_from(FRAME, buffer, at)
        if len(buffer) - at < size + length:
            break
        found.append((kind, time_s, bytes(buffer[at + size : at + size + length])))
        at += size + length
    del buffer[:at]
    return found


class Recorder:
    """Recorder of the rows in the arms' memories and of the messages of the program.

    See `dual_ur10.sim2real.recording.recorder.RecorderProcess` for the arguments.

    Attributes:
        failures: Write errors in order.
        boxes: Black boxes that were written.

    Raises:
        RecordingError: A file cannot be created.
    """

    def __init__(
        self,
        memories: tuple[ArmMemory, ArmMemory],
        folder: Path | None,
        header: Header,
        black_boxes: Path,
        begin_s: float,
        least_free_bytes: int,
        clock: Clock | None = None,
    ) -> None:
        self._memories, self._begin_s, self._clock = memories, begin_s, clock or LOCAL.clock
        self.failures: list[str] = []
        self.boxes: list[Path] = []
        self._writer: RunWriter | None = None
        self._log: RunLog | None = None
        self.black_box = BlackBox(black_boxes, header)
        if folder is not None:
            self._writer = RunWriter(folder, header, least_free_bytes=least_free_bytes)
            self._log = RunLog(folder, header)
        # Rows from before the run do not belong to it.
        self._states = [memory.states(2**62)[1] for memory in memories]
        self._sent = [memory.sent(2**62)[1] for memory in memories]
        self._phases = [memory.phase for memory in memories]
        self._stop = ""
        self._stop_s = 0.0

    @property
    def now_s(self) -> float:
        """Time on the run's clock."""
        return self._clock.now_s() - self._begin_s

    @property
    def stopped(self) -> bool:
        """True if both arms have stopped."""
        return all(memory.phase >= Phase.STOPPED for memory in self._memories)

    def add(self, topic: str, time_s: float, data: bytes) -> None:
        """Record a message of the program."""
        self.black_box.single(topic, time_s, data)
        if self._writer is not None:
            self._writer.single(topic, time_s, data)
        if topic == EVENT_TOPIC and self._log is not None:
            self._guarded(self._log, RunEvent(**EVENT.decode(data)))

    def event(self, kind: str, text: str, arm: str = "") -> None:
        """Record an event of the present instant."""
        event = RunEvent(self.now_s, kind, text, arm)
        self.add(EVENT_TOPIC, event.time_s, EVENT.encode(vars(event)))

    def ask_black_box(self, reason: str) -> None:
        """Request a black box, to be written soon."""
        if not self._stop:
            self._stop, self._stop_s = reason, self.now_s

    def poll(self, *, last: bool = False) -> None:
        """Take all new rows, and hand them to the system."""
        for arm in range(2):
            self._take(arm)
        self.black_box.forget(self._stop_s if self._stop else self.now_s)
        if self._stop and (last or self.now_s > self._stop_s + AFTER_STOP_S):
            reason, self._stop = self._stop, ""
            try:
                self.boxes.append(self.black_box.write(self.now_s, reason))
            except RecordingError as error:
                self.failures.append(f"no black box: {error}")
        if self._writer is not None:
            try:
                self._writer.flush()
            except RecordingError as error:
                self.failures.append(str(error))
                self._writer = None

    def _take(self, arm: int) -> None:
        memory = self._memories[arm]
        rows, count = memory.states(self._states[arm])
        rows = self._whole(arm, "states", rows, self._states[arm], count, memory.states(count)[1])
        self._states[arm] = count
        if len(rows):
            rows[:, 0] -= self._begin_s
            self.black_box.states(arm, rows)
            if self._writer is not None:
                self._writer.states(arm, rows)
        sent, count = memory.sent(self._sent[arm])
        rows = np.column_stack([sent.period, sent.index, sent.sent_s - self._begin_s, sent.late_s, sent.target_rad])
        rows = self._whole(arm, "targets", rows, self._sent[arm], count, memory.sent(count)[1])
        self._sent[arm] = count
        if len(rows):
            self.black_box.sent(arm, rows)
            if self._writer is not None:
                self._writer.sent(arm, rows)
        phase = memory.phase
        if phase != self._phases[arm]:
            text = memory.text if phase >= Phase.STOPPING else ""
            self._phases[arm] = phase
            self.event("phase", f"{phase.name.lower()}{': ' if text else ''}{text}", ARMS[arm])
            if phase >= Phase.STOPPING and not was_requested(text):
                self.ask_black_box(text)

    def _whole(self, arm: int, what: str, rows: Array, since: int, count: int, now: int) -> Array:
        """Return the rows that have not been overwritten since; record the number of lost rows as an event."""
        first = count - len(rows)
        torn = min(max(0, now - RING + 1 - first), len(rows))
        lost = first - since + torn
        if lost:
            self.event("lost", f"{lost} {what}: this machine is too busy", ARMS[arm])
        return rows[torn:]

    def sync(self) -> bool:
        """Wait in another thread until the disk has all that was written. Return False if the record has ended."""
        writer = self._writer
        return writer is not None and self._guarded(RunWriter.sync, writer)

    def close(self) -> None:
        """End the record."""
        self.poll(last=True)
        writer, log, self._writer, self._log = self._writer, self._log, None, None
        if writer is not None:
            self._guarded(writer.close)
        if log is not None:
            log.close()

    def _guarded(self, action: Callable[..., None], *arguments: object) -> bool:
        """Perform an action, and note its failure. Return True if it succeeded."""
        try:
            action(*arguments)
        except RecordingError as error:
            self.failures.append(str(error))
            return False
        return True


def main(
    transport: Transport,
    names: tuple[str, str],
    folder: Path | None,
    header: Header,
    black_boxes: Path,
    begin_s: float,
    parent: int,
    least_free_bytes: int,
    *,
    system: System = LOCAL,
) -> None:
    """Run the recorder until the program closes it or has ended."""
    system.ignore_interrupts()  # the program handles them, and closes the recorder
    pipe = _Pipe(transport)
    try:
        check_extra()  # the black box decodes messages
        memories = ArmMemory(names[0]), ArmMemory(names[1])
        recorder = Recorder(memories, folder, header, black_boxes, begin_s, least_free_bytes, system.clock)
    except (MissingExtraError, RecordingError, OSError, ValueError) as error:
        pipe.send(FAILED, f"nothing is recorded: {error}")
        return
    pipe.send(READY)
    _Loop(recorder, pipe, parent, system).run()
    for memory in memories:
        memory.close()


class _Loop:
    """Loop that polls until the program closes the recorder or has ended."""

    def __init__(self, recorder: Recorder, pipe: _Pipe, parent: int, system: System) -> None:
        self._recorder, self._pipe, self._parent = recorder, pipe, parent
        self._system, self._clock = system, system.clock
        self._terminated = system.terminated()
        self._failures = 0  # failures and boxes that were reported to the program
        self._boxes = 0
        self._over = system.event()

    def run(self) -> None:
        recorder, clock = self._recorder, self._clock
        syncing = self._system.thread(self._sync, "recorder sync")
        due = clock.now_s()
        while True:
            closed = self._receive()
            recorder.poll()
            self._report()
            if closed or self._terminated.is_set():
                break
            if self._pipe.ended or self._system.is_orphan(self._parent):
                self._drain()
                break
            due = max(due + POLL_S, clock.now_s() - POLL_S)
            clock.sleep(due - clock.now_s())
        self._over.set()
        self._receive()
        syncing.join(SYNC_S)
        recorder.close()
        self._report()
        self._pipe.send(DONE)

    def _drain(self) -> None:
        """Record the stop of the arms after the program has ended without closing the record."""
        recorder, end = self._recorder, self._clock.now_s() + ORPHAN_S
        recorder.event("orphaned", "the program that moved the arms has ended without closing its record")
        recorder.ask_black_box("the program that moved the arms has ended")
        while self._clock.now_s() < end and not recorder.stopped:
            self._clock.sleep(POLL_S)
            recorder.poll()

    def _receive(self) -> bool:
        """Handle the messages of the program. Return True if it closes the recorder."""
        for kind, time_s, data in self._pipe.receive():
            if kind == CLOSE:
                return True
            if kind == BLACK_BOX:
                reason = data.decode()
                self._recorder.event("stop", reason)
                self._recorder.ask_black_box(reason)
            else:
                self._recorder.add(TOPICS[kind], time_s, data)
        return False

    def _report(self) -> None:
        for text in self._recorder.failures[self._failures :]:
            self._pipe.send(FAILED, text)
        for path in self._recorder.boxes[self._boxes :]:
            self._pipe.send(WROTE, str(path))
        self._failures, self._boxes = len(self._recorder.failures), len(self._recorder.boxes)

    def _sync(self) -> None:
        while not self._over.wait(SYNC_S) and self._recorder.sync():
            pass


class _Pipe:
    """Connection to the program."""

    def __init__(self, transport: Transport) -> None:
        self._transport = transport
        self._received = bytearray()
        self.ended = False

    def send(self, kind: int, text: str = "") -> None:
        """Send a message, unless the program has ended."""
        line = text.encode()[:4096]
        with contextlib.suppress(OSError):
            self._transport.send_now(struct.pack(FRAME, kind, len(line), 0.0) + line)

    def receive(self) -> list[tuple[int, float, bytes]]:
        """Return kind, time and data of each new message."""
        try:
            while len(self._received) < _MOST_RECEIVED:
                piece = self._transport.receive_now(2**20)
                if not piece:
                    self.ended |= piece is not None
                    break
                self._received += piece
        except OSError:
            self.ended = True
        return take_frames(self._received)
