"""Lab: two emulated controllers, an environment on them, and injected faults."""

import contextlib
import math
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np

from dual_ur10.emulated.emulated_cell import EmulatedCell
from dual_ur10.errors import DualUR10Error
from dual_ur10.sim2real.cell_file.cell_file import load_cell_file
from dual_ur10.sim2real.runtime.arm_sender import STALE_S
from dual_ur10.sim2real.runtime.latch import Latch
from tests.live.faults.wire import SPARE_TICKS, Wire
from tests.virtual.faults.lab import ARMS, PROGRAM, FaultLab
from ur_core.processes.system import LOCAL


class Lab(FaultLab):
    """Lab on an emulated cell: real processes, in real time."""

    wire = Wire
    clearing = "cell clear"  # in the text of a latched stop

    def __init__(self, folder, task="SineTracking", **options):
        self.path = folder / f"lab-{task}-{options.get('family', 'cb3')}.toml"
        self._log = self.path.with_suffix(".log")
        cell = EmulatedCell(task=task, plant="nominal", cell=str(self.path), log=self._log, **options)
        super().__init__(cell, str(self.path), LOCAL, task)
        self.text = self.path.read_text()
        self.asleep_ticks = math.ceil(STALE_S / self.tick_s)
        self._home = [list(self.ask(arm, "actual_q")[0]) for arm in ARMS]
        self._undo = []

    @property
    def file(self):
        """Cell file."""
        return load_cell_file(self.path)

    @property
    def latch(self):
        """Latch of the cell."""
        return Latch(self.file)

    def turn(self, do, back, **values):
        """Inject a fault until the end of the test, which reverts it with `back`."""
        self._undo.append((do, {**values, **back}))
        self.do(do, **values)

    def allowed(self, ticks):
        """See `FaultLab`. Packets wait while the emulated controllers stall, and come at once."""
        most = ticks + SPARE_TICKS
        late = self.cell.ask("info")["late_ticks"]
        return most + sum(self._tick - 5 <= tick <= self._tick + most for tick in late)

    @property
    def pids(self):
        """Process ids of the runner: left arm, right arm, supervisor."""
        return [each.process.pid for each in (*self.runner.processes, self.runner.supervisor)]

    def programs(self):
        """Return the number of programs that ended or were refused, from the cell's log."""
        return sum(1 for line in self._log.read_text().splitlines() if PROGRAM.search(line))

    def suspend(self, *pids):
        """Suspend processes until `wake` or the end of the test."""
        for pid in pids:
            os.kill(pid, signal.SIGSTOP)
            self._undo.append((self.wake, pid))

    @staticmethod
    def wake(*pids):
        """Resume processes."""
        for pid in pids:
            with contextlib.suppress(ProcessLookupError):
                os.kill(pid, signal.SIGCONT)

    def program(self, *arguments, code=None):
        """A program of its own with the cell file: `python -m dual_ur10 ...`, or Python code to which the file's path
        is `sys.argv[1]`. Returns its process."""
        self.close_env()
        self.mark()
        what = ["-m", "dual_ur10", *arguments, "--cell"] if code is None else ["-c", code]
        process = subprocess.Popen(
            [sys.executable, *what, str(self.path)],
            stdin=subprocess.DEVNULL,
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            text=True,
            start_new_session=True,
        )
        self._undo.append((_end, process))
        return process

    def wait_until_moving(self, process, within_s=60.0):
        """Wait until a program's arms execute moving targets."""
        end = time.monotonic() + within_s
        while time.monotonic() < end:
            assert process.poll() is None, process.stdout.read()
            if all(np.abs(self.ask(arm, "target_qd")[0]).max() > 0.02 for arm in ARMS):
                return
            time.sleep(0.02)
        raise AssertionError("its arms do not move")

    def mend(self):
        """Restore the cell: no faults, no stops, arms powered and at rest."""
        self.path.write_text(self.text)
        while self._undo:
            what, values = self._undo.pop()
            what(values) if callable(what) else self.cell.ask(what, **values)
        self.close_env()
        self.latch.clear()
        for arm in ARMS:
            self.cell.ask("heal", arm=arm)
            for mode in (3, 4, 5, 6, 7, 8, 9, 13, 14, 21):
                self.cell.ask("release", arm=arm, mode=mode)
            self.cell.ask("slider", arm=arm, fraction=1.0)
            self.cell.ask("reduce", arm=arm, on=False)
            if self.ask(arm, "robot_mode") != [7]:
                self.cell.wait_until(arm, "safety_mode", 1)
                self.cell.ask("press", arm=arm, button="power_on")
                self.cell.wait_until(arm, "robot_mode", 5)
                self.cell.ask("press", arm=arm, button="release_brakes")
            self.cell.wait_until(arm, "robot_mode", 7)
            self.cell.wait_until(arm, "safety_mode", 1)
            self.cell.wait_until(arm, "runtime_state", 1)
        self._go_home()

    def _go_home(self):
        """Move the arms quickly to their first configuration if they are far from it."""
        for arm, home in zip(ARMS, self._home, strict=True):
            if np.abs(np.subtract(self.ask(arm, "actual_q")[0], home)).max() > 0.1:
                self.play(arm, f"movej({home}, a=4.0, v=2.0)")
        for arm in ARMS:
            self.cell.wait_until(arm, "runtime_state", 1)

    def starved(self):
        """Return how often a controller's watchdog was not fed, from the cell's log."""
        return self._log.read_text().count("was not fed for")

    def busy(self):
        """Return how often this machine was too slow: an unfed watchdog or a late action."""
        return self.starved() + (0 if self.env is None else self.env.unwrapped.core.late_actions)

    def close(self):
        """Close everything."""
        with contextlib.suppress(DualUR10Error):
            self.close_env()
        self.latch.clear()
        self.cell.close()


def _end(process):
    process.kill()
    process.wait()
    process.stdout.close()


def descendants(pid):
    """Return all descendants of a process."""
    parents = {}
    for each in Path("/proc").glob("[0-9]*/stat"):
        with contextlib.suppress(OSError):
            parents[int(each.parent.name)] = int(each.read_text().rpartition(")")[2].split()[1])
    found = [pid]
    for one in found:
        found += [child for child, parent in parents.items() if parent == one]
    return found[1:]


def assert_gone(pids, within_s=10.0):
    """Check that none of these processes is left."""
    end = time.monotonic() + within_s
    left = list(pids)
    while left and time.monotonic() < end:
        left = [pid for pid in left if _runs(pid)]
        time.sleep(0.02)
    assert not left


def _runs(pid):
    try:
        return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0] != "Z"
    except OSError:
        return False
