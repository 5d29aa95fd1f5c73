"""Notes of what the processes of a virtual cell do."""

from __future__ import annotations

import contextlib
import errno
import math
from collections.abc import Iterator
from dataclasses import dataclass, field
from datetime import timedelta
from typing import Any
from unittest import mock

import numpy as np

from dual_ur10.sim2real.control.gate import SafetyGate
from dual_ur10.sim2real.recording import run_folder
from dual_ur10.sim2real.recording.writer import RunWriter
from dual_ur10.sim2real.runtime.arm_memory import ArmMemory, Phase
from dual_ur10.sim2real.runtime.cell_memory import CellMemory
from dual_ur10.sim2real.runtime.runner import Runner
from ur_emulator.virtual.scheduler import VirtualClock


@dataclass
class Episode:
    """Notes of one runner, from its first target on."""

    runner: Runner
    names: list[str]
    begun_s: float
    wire: list[int]  # number of the first package of each controller
    limits: Any = None
    puts: list[tuple[float, int, np.ndarray]] = field(default_factory=list)
    sent: list[list[tuple[float, int, float, float, np.ndarray, bool]]] = field(default_factory=lambda: [[], []])
    phases: list[list[tuple[float, int, str]]] = field(default_factory=lambda: [[], []])
    begin_s: float = math.inf
    slowed: bool = False
    fault_s: float = math.inf
    fault: str = ""
    ending_s: float = math.inf

    @property
    def known_s(self) -> float:
        """Time of the first note of a stop, in order or not."""
        stopping = [at for arm in self.phases for at, phase, _ in arm if phase >= Phase.STOPPING]
        return min([self.fault_s, self.ending_s, *stopping])


class Observer:
    """Notes of what the processes of a cell do, taken where they do it."""

    def __init__(self) -> None:
        self.cell: Any = None
        self.episodes: list[Episode] = []
        self.released: set[bytes] = set()
        self.on_stop: Any = lambda: None
        self.disk_full = False
        self.wall_s = 0.0

    @property
    def now_s(self) -> float:
        return float(self.cell.clock.now_s())

    def _of(self, name: str) -> tuple[Episode, int] | None:
        if self.episodes and name in self.episodes[-1].names:
            return self.episodes[-1], self.episodes[-1].names.index(name)
        return None

    @contextlib.contextmanager
    def installed(self) -> Iterator[None]:
        """Observe all cells meanwhile."""
        note_sent, enter, put = ArmMemory.note_sent, ArmMemory.enter, Runner._put
        enter_fault, end, begin, gate = CellMemory.enter_fault, CellMemory.end, Runner.begin, SafetyGate.__call__
        set_begin, set_scaling = CellMemory.begin, CellMemory.set_time_scaling
        write, utc, usage = RunWriter._write, VirtualClock.utc, run_folder.shutil.disk_usage
        observer = self

        def noted_sent(self: Any, period: int, index: float, at_s: float, late_s: float, target: Any) -> None:
            if found := observer._of(self.name):
                stopping = self.phase >= Phase.STOPPING
                found[0].sent[found[1]].append((at_s, period, index, late_s, np.array(target), stopping))
            note_sent(self, period, index, at_s, late_s, target)

        def entered(self: Any, phase: Phase, text: str = "") -> None:
            earlier = self.phase < phase
            enter(self, phase, text)
            if earlier and (found := observer._of(self.name)):
                found[0].phases[found[1]].append((observer.now_s, int(phase), text))
                if phase >= Phase.STOPPING:
                    observer.on_stop()

        def fault_entered(self: Any, reason: str) -> None:
            if observer.episodes and observer.episodes[-1].runner.cell.name == self.name:
                episode = observer.episodes[-1]
                if episode.fault_s == math.inf:
                    episode.fault_s, episode.fault = observer.now_s, reason
                observer.on_stop()
            enter_fault(self, reason)

        def ended(self: Any) -> None:
            if observer.episodes and observer.episodes[-1].runner.cell.name == self.name:
                observer.episodes[-1].ending_s = min(observer.episodes[-1].ending_s, observer.now_s)
            end(self)

        def begun(self: Any, q_rad: Any) -> None:
            wire = [observer.controller(arm).received.motion_count for arm in range(2)]
            observer.episodes.append(Episode(self, [each.name for each in self.arms], observer.now_s, wire))
            begin(self, q_rad)

        def starting(self: Any, at_s: float) -> None:
            observer.episodes[-1].begin_s = at_s
            set_begin(self, at_s)

        def scaled(self: Any, scaling: Any) -> None:
            if observer.episodes and observer.episodes[-1].runner.cell.name == self.name:
                observer.episodes[-1].slowed |= observer.now_s > observer.episodes[-1].begun_s
            set_scaling(self, scaling)

        def putting(self: Any, first: int, targets: Any) -> None:
            observer.episodes[-1].puts.append((observer.now_s, first, np.array(targets)))
            put(self, first, targets)

        def released(self: Any, targets: Any) -> Any:
            result = gate(self, targets)
            observer.released.update(row.tobytes() for row in result.targets_rad.reshape(-1, 12))
            return result

        def written(self: Any, data: bytes) -> None:
            if observer.disk_full:
                with mock.patch("os.write", side_effect=OSError(errno.ENOSPC, "No space left on device")):
                    return write(self, data)
            return write(self, data)

        def wall(self: Any) -> Any:
            return utc(self) + timedelta(seconds=observer.wall_s)

        def room(path: Any) -> Any:
            return usage(path)._replace(free=0) if observer.disk_full else usage(path)

        with contextlib.ExitStack() as stack:
            for owner, name, function in (
                (ArmMemory, "note_sent", noted_sent),
                (ArmMemory, "enter", entered),
                (CellMemory, "enter_fault", fault_entered),
                (CellMemory, "end", ended),
                (CellMemory, "begin", starting),
                (CellMemory, "set_time_scaling", scaled),
                (Runner, "begin", begun),
                (Runner, "_put", putting),
                (SafetyGate, "__call__", released),
                (RunWriter, "_write", written),
                (VirtualClock, "utc", wall),
                (run_folder.shutil, "disk_usage", room),
            ):
                stack.enter_context(mock.patch.object(owner, name, function))
            yield

    def controller(self, arm: int) -> Any:
        """Return the controller of an arm."""
        return self.cell.emulators[arm].servers[arm].controller
