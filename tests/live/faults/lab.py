"""Lab: two emulated controllers, an environment on them, and injected faults."""

import contextlib
import math
import os
import re
import signal
import socket
import subprocess
import sys
import threading
import time
from pathlib import Path

import gymnasium as gym
import numpy as np
import pytest

import dual_ur10  # noqa: F401  # registers the environments
from dual_ur10.errors import CellFaulted, DualUR10Error, StartError
from dual_ur10.sim2real.config.cell_file import load_cell_file
from dual_ur10.sim2real.emulator.emulated_cell import EmulatedCell
from dual_ur10.sim2real.links.arm_status import ROW
from dual_ur10.sim2real.runtime.arm_sender import STALE_S
from dual_ur10.sim2real.runtime.latch import Latch
from tests.live.faults.wire import SPARE_TICKS, Wire, demand, ramp_ticks

ARMS = ("left", "right")
_MOST_STEPS = 250
_SEEN_TICKS = 3  # from a stop of one arm until both slow down, and packets in transit
_FAST_RAD_S = 0.1
_NOTED_S = 2.0
_PROGRAM = re.compile(r"program .* ends:|program is refused|program stopped:|not started")
_START = dict(zip((name for name, _ in ROW), np.cumsum([0, *(size for _, size in ROW)]).tolist(), strict=False))


class Swing:
    """Policy whose arms never rest, within all limits."""

    def __init__(self, size=12, share=0.3, period_s=2.0):
        self._size, self._share, self._period_s = size, share, period_s
        self._steps = 0

    def reset(self):
        """Begin again."""
        self._steps = 0

    def __call__(self, observation=None):
        """Swing joints 0, 3, 4 and 5 of each arm."""
        self._steps += 1
        action = np.zeros((2, self._size // 2), dtype=np.float32)
        action[:, [0, 3, 4, 5]] = self._share * np.cos(2 * np.pi * self._steps * 0.04 / self._period_s)
        return action.reshape(-1)


class Lab:
    """Emulated cell, its file, and at most one environment on it."""

    def __init__(self, folder, task="SineTracking", **options):
        self.task = task
        self.path = folder / f"lab-{task}-{options.get('family', 'cb3')}.toml"
        self._log = self.path.with_suffix(".log")
        self.cell = EmulatedCell(task=task, plant="nominal", cell=str(self.path), log=self._log, **options)
        self.text = self.path.read_text()
        self.env = None
        self.policy = Swing()
        self.first = [0, 0]
        self.tick_s = self.file.config().servoj.tick_s
        self.wires = [Wire(self.cell, arm) for arm in ARMS]
        self._home = [list(self.ask(arm, "actual_q")[0]) for arm in ARMS]
        self._tick = None  # of the fault
        self._undo = []

    @property
    def file(self):
        """Cell file."""
        return load_cell_file(self.path)

    @property
    def latch(self):
        """Latch of the cell."""
        return Latch(self.file)

    def rewrite(self, old, new):
        """Change the cell file."""
        text = self.path.read_text()
        assert old in text
        self.path.write_text(text.replace(old, new))

    def note(self):
        """Mark the instant of the fault; return the control periods so far."""
        self._tick = self.now
        return self._tick

    @property
    def now(self):
        """Return the number of control periods so far."""
        return self.cell.ask("received", arm="left", since=1 << 40)["tick"]

    @property
    def fault_tick(self):
        """Control period of the fault."""
        assert self._tick is not None, "the test does not say when it went wrong: see `note`"
        return self._tick

    def do(self, do, **values):
        """Inject a fault into the cell."""
        self.note()
        self.cell.ask(do, **values)
        if do == "stop":
            self._tick = self.cell.ask("received", arm=values["arm"])["stop_tick"]

    def turn(self, do, back, **values):
        """Inject a fault until the end of the test, which reverts it with `back`."""
        self._undo.append((do, {**values, **back}))
        self.do(do, **values)

    def play(self, arm, line):
        """Run a URScript line on an arm."""
        self.wires[ARMS.index(arm)].uploads_before += 1
        with socket.create_connection((getattr(self.cell, arm), 30003)) as client:
            client.sendall(f"{line}\n".encode())
            self.cell.wait_until(arm, "runtime_state", 2)

    def override(self, arm, **values):
        """Override values that a controller reports until the end of the test."""
        self.turn("override", dict.fromkeys(values), arm=arm, **values)
        time.sleep(0.1)  # until all have heard of it

    def mark(self):
        """Count `executed` from here on."""
        self.first = [self.cell.ask("setpoints", arm=arm)["count"] for arm in ARMS]
        for wire in self.wires:
            wire.begin()
        self._tick = None

    def make(self, **keywords):
        """Return a new environment on the cell; the previous one is closed."""
        self.close_env()
        self.mark()
        self.env = gym.make(f"DualUR10/{self.task}-v0", cell=str(self.path), disable_env_checker=True, **keywords)
        for wire, memory in zip(self.wires, self.runner.arms, strict=True):
            wire.memory = memory
        return self.env

    def begin(self, steps=None, **keywords):
        """Make, reset and step, for `steps` or until both arms are fast enough for a visible ramp."""
        self.make(**keywords)
        self.policy.reset()
        observation, _ = self.env.reset(seed=0)
        self.assert_watched()
        for step in range(_MOST_STEPS if steps is None else steps):
            observation = self.env.step(self.policy(observation))[0]
            # Looked at now and then only: it takes time, and actions must not be late.
            if steps is None and step >= 15 and step % 4 == 3 and min(self.speeds_rad_s()) >= _FAST_RAD_S:
                break
        return observation

    def reset(self, **keywords):
        """Begin an episode and record all packets meanwhile, however long the approach is."""
        ended = threading.Event()

        def note():
            while not ended.wait(_NOTED_S):
                for wire in self.wires:
                    wire.note()

        thread = threading.Thread(target=note, name="note", daemon=True)
        thread.start()
        try:
            return self.env.reset(options={"move_to_start": True}, **keywords)
        finally:
            ended.set()
            thread.join()

    def speeds_rad_s(self):
        """Return the last commanded joint speed of both controllers."""
        return [float(wire.speeds_rad_s(self.tick_s)[-1:].max(initial=0.0)) for wire in self.wires]

    @property
    def runner(self):
        """Runner of the environment."""
        return self.env.unwrapped.core.cell.runner

    @property
    def pids(self):
        """Process ids of the runner: left arm, right arm, supervisor."""
        return [each.process.pid for each in (*self.runner.processes, self.runner.supervisor)]

    def step_until_faulted(self, most=_MOST_STEPS):
        """Step until both arms are stopped and return the error."""
        try:
            for _ in range(most):
                self.env.step(self.policy())
        except CellFaulted as error:
            return error
        raise AssertionError(f"{most} steps and no fault")

    def executed(self, arm):
        """Return the targets that a controller executed since `make`, (k, 6)."""
        rows = self.cell.setpoints(arm, self.first[ARMS.index(arm)])
        return np.array([row[1] for row in rows]).reshape(-1, 6)

    def ask(self, arm, *names):
        """Return values of a controller's state."""
        found = self.cell.ask("state", arm=arm, names=list(names))
        return [found[name] for name in names]

    def measured(self):
        """Return joint angles of both arms at common times, (k, 2, 6), and the times."""
        left, right = (memory.states()[0] for memory in self.runner.arms)
        at = _START["q_rad"]
        row = np.clip(np.searchsorted(right[:, 0], left[:, 0]), 0, len(right) - 1)
        return np.stack([left[:, at : at + 6], right[row, at : at + 6]], axis=1), left[:, 0]

    def nearest_m(self):
        """Return the smallest measured distance of any checked pair."""
        clearance = self.env.unwrapped.core.cell._clearance
        return min(float(clearance.distances_m(q.reshape(1, 12)).min()) for q in self.measured()[0][::3])

    def assert_within_limits(self):
        """Check received targets against the limits of speed, acceleration and jerk, and that no others were executed.

        Divided differences of targets some of whose periods were left out are means of those of all targets.
        """
        limits = self.env.unwrapped.core.pipeline.gate.limits
        return [wire.assert_limits(limits, self.tick_s, self.executed(wire.arm)) for wire in self.wires]

    def assert_within_hard_limits(self):
        """Check received targets against the hard limits of an arm's process."""
        for wire in self.wires:
            wire.assert_hard_limits(self.tick_s)

    def assert_watched(self):
        """Check that both controllers had a watchdog of 0.1 s before anything moved."""
        for wire in self.wires:
            found = wire.received()["watchdog"]
            demand(found is not None and found[1:] == [10.0, "stop"], f"{wire.arm}: watchdog {found}")
            ticks, _ = wire.packages()
            demand(not len(ticks) or found[0] <= ticks[0], f"{wire.arm}: it moved before its watchdog was set")

    def audit(self):
        """Check the invariants of every test."""
        self.assert_within_hard_limits()
        for wire in self.wires:
            demand(wire.uploads <= 1, f"{wire.arm}: {wire.uploads} programs were uploaded, one is needed")

    def assert_nothing_more(self, seen_ticks=_SEEN_TICKS):
        """Check that after the fault both controllers received at most the targets of a ramp, and no program.

        Args:
            seen_ticks: Control periods within which the fault is to be seen, and what was on its way has come.
        """
        packages = [wire.packages()[0] for wire in self.wires]
        around = self.fault_tick - 5, self.fault_tick + seen_ticks
        speed = 0.0
        for wire, ticks in zip(self.wires, packages, strict=True):
            near = (ticks >= around[0]) & (ticks <= around[1])
            speed = max(speed, float(wire.speeds_rad_s(self.tick_s)[near].max(initial=0.0)))
        allowed = seen_ticks + ramp_ticks(speed, self.tick_s) + SPARE_TICKS
        # Packets wait while the emulated controllers stall, and come at once.
        allowed += sum(self._tick - 5 <= tick <= self._tick + allowed for tick in self.cell.ask("info")["late_ticks"])
        asleep = math.ceil(STALE_S / self.tick_s)  # a process may be, on a busy machine, before it counts as lost
        for wire, ticks in zip(self.wires, packages, strict=True):
            after = int((ticks >= self._tick).sum())
            text = f"{wire.arm}: {after} targets came after the fault, allowed are {allowed} from {speed:.2f} rad/s"
            demand(after <= allowed + asleep, text)
            assert after <= allowed, text
            uploads = wire.uploads
            demand(uploads == 1, f"{wire.arm}: {uploads} programs were uploaded, allowed is one")

    def assert_stopped(self, error, *words, arms=ARMS, seen_ticks=_SEEN_TICKS, ramped=()):
        """Check that both arms rest, both programs ended, and nothing is sent until a person clears the fault.

        Args:
            error: What was raised.
            words: That it and the latch must have.
            arms: Whose programs must have ended.
            seen_ticks: As in `assert_nothing_more`.
            ramped: Arms that must have been led to rest.
        """
        if isinstance(error, CellFaulted):
            for word in words:
                assert word in str(error), str(error)
            assert "cell clear" in str(error)
        self.assert_at_rest(arms)
        self.assert_nothing_more(seen_ticks)
        for arm in ramped:
            self.wires[ARMS.index(arm)].assert_rested(self.fault_tick, self.tick_s)
        quiet = self.traffic()
        for again in (lambda: self.env.step(self.policy()), lambda: self.reset(seed=1)):
            with pytest.raises(CellFaulted, match="cell clear") as found:
                again()
        for word in words:
            assert word in str(found.value), str(found.value)
        time.sleep(0.25)
        demand(self.traffic() == quiet, "something was sent after the fault")
        fault = self.latch.read()
        assert fault is not None
        assert fault.text in str(found.value) or str(found.value).startswith("both arms were stopped")
        self.close_env()
        demand(self.traffic() == quiet, "closing sent something")
        self.assert_latched(*words)

    def assert_latched(self, *words):
        """Check that nothing starts before a person clears the reported fault."""
        fault = self.latch.read()
        assert fault is not None
        for word in words:
            assert word in fault.text, fault.text
        quiet = self.traffic()
        with pytest.raises(CellFaulted, match=re.escape(fault.text[:40])):
            self.make()
        self.assert_at_rest()
        demand(self.traffic() == quiet, "a new start sent something")

    def assert_at_rest(self, arms=ARMS):
        """Check that both programs ended and both arms rest."""
        for arm in arms:
            self.cell.wait_until(arm, "runtime_state", 1)
        end = time.monotonic() + 5.0
        while time.monotonic() < end:
            if all(np.abs(self.ask(arm, "actual_qd")[0]).max() < 1e-3 for arm in ARMS):
                return
            time.sleep(0.02)
        raise AssertionError("an arm still moves")

    def assert_nothing_executed(self):
        """Check that no target came since the last `make` or `mark`."""
        demand([len(self.executed(arm)) for arm in ARMS] == [0, 0], "targets were executed")
        demand([len(wire.packages()[0]) for wire in self.wires] == [0, 0], "targets were sent")

    def assert_nothing_has_moved(self, uploads=(0, 0)):
        """Check that no target came, no program runs, and at most `uploads` were uploaded."""
        self.assert_nothing_executed()
        self.assert_at_rest()
        found = tuple(wire.uploads for wire in self.wires)
        demand(found == uploads, f"{found} programs were uploaded to the left and the right arm, allowed are {uploads}")

    def assert_refused(self, *words, **keywords):
        """Check that `make` raises with these words and moves nothing."""
        with pytest.raises(StartError) as found:
            self.make(**keywords)
        for word in words:
            assert word in str(found.value), str(found.value)
        self.assert_nothing_has_moved()

    def programs(self):
        """Return the number of programs that ended or were refused, from the cell's log."""
        return sum(1 for line in self._log.read_text().splitlines() if _PROGRAM.search(line))

    def traffic(self):
        """Return what must not change after a fault: executed targets and programs."""
        counts = [self.cell.ask("setpoints", arm=arm)["count"] for arm in ARMS]
        for found in (wire.received() for wire in self.wires):
            counts += [found["motion"], found["uploads"]]
        return [*counts, *(self.ask(arm, "runtime_state")[0] for arm in ARMS), self.programs()]

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

    def close_env(self):
        """Close the environment."""
        env, self.env = self.env, None
        for wire in self.wires:
            wire.memory = None  # it ends with its process
        if env is not None:
            env.close()

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
                with socket.create_connection((getattr(self.cell, arm), 30003)) as client:
                    client.sendall(f"movej({home}, a=4.0, v=2.0)\n".encode())
                    self.cell.wait_until(arm, "runtime_state", 2)
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
