"""Two emulated controllers and an environment on them, to which things happen."""

import contextlib
import os
import re
import signal
import socket
import subprocess
import sys
import time
from pathlib import Path

import gymnasium as gym
import numpy as np
import pytest

import dual_ur10  # noqa: F401  # registers the environments
from dual_ur10.errors import CellFaulted, DualUR10Error
from dual_ur10.sim2real.arm_memory import RING
from dual_ur10.sim2real.arm_status import ROW
from dual_ur10.sim2real.cell_file import load_cell_file
from dual_ur10.sim2real.controller.emulated_cell import EmulatedCell
from dual_ur10.sim2real.latch import Latch
from dual_ur10.ur10 import HARD_SPEED_RAD_S

ARMS = ("left", "right")
_MOST_STEPS = 250
_PROGRAM = re.compile(r"program .* ends:|program is refused|program stopped:|not started")
_START = dict(zip((name for name, _ in ROW), np.cumsum([0, *(size for _, size in ROW)]).tolist(), strict=False))


class Swing:
    """A policy whose arms never rest, within what every limit allows."""

    def __init__(self, size=12, share=0.3, period_s=2.0):
        self._size, self._share, self._period_s = size, share, period_s
        self._steps = 0

    def reset(self):
        """Begin again."""
        self._steps = 0

    def __call__(self, observation=None):
        """Joints 0, 3, 4 and 5 of each arm swing."""
        self._steps += 1
        action = np.zeros((2, self._size // 2), dtype=np.float32)
        action[:, [0, 3, 4, 5]] = self._share * np.cos(2 * np.pi * self._steps * 0.04 / self._period_s)
        return action.reshape(-1)


class Lab:
    """An emulated cell, its file, and at most one environment on it."""

    def __init__(self, folder, task="SineTracking", **options):
        self.task = task
        self.path = folder / f"lab-{task}-{options.get('family', 'cb3')}.toml"
        self._log = self.path.with_suffix(".log")
        self.cell = EmulatedCell(task=task, plant="nominal", cell=str(self.path), log=self._log, **options)
        self.text = self.path.read_text()
        self.env = None
        self.policy = Swing()
        self.first = [0, 0]
        self._home = [list(self.ask(arm, "actual_q")[0]) for arm in ARMS]
        self._undo = []

    @property
    def file(self):
        """The cell file, read."""
        return load_cell_file(self.path)

    @property
    def latch(self):
        """Its fault, if it has one."""
        return Latch(self.file)

    def rewrite(self, old, new):
        """Change the file."""
        text = self.path.read_text()
        assert old in text
        self.path.write_text(text.replace(old, new))

    def turn(self, do, back, **values):
        """Turn a knob of the cell until the end of the test, when it is turned `back`."""
        self._undo.append((do, {**values, **back}))
        self.cell.ask(do, **values)

    def override(self, arm, **values):
        """Clients of a controller are told these values until the end of the test."""
        self.turn("override", dict.fromkeys(values), arm=arm, **values)
        time.sleep(0.1)  # until all have heard of it

    def mark(self):
        """From here on `executed` counts."""
        self.first = [self.cell.ask("setpoints", arm=arm)["count"] for arm in ARMS]

    def make(self, **keywords):
        """An environment on the cell. A new one ends the one before."""
        self.close_env()
        self.mark()
        self.env = gym.make(f"DualUR10/{self.task}-v0", cell=str(self.path), disable_env_checker=True, **keywords)
        return self.env

    def begin(self, steps=15, **keywords):
        """Make, reset and move."""
        self.make(**keywords)
        self.policy.reset()
        observation, _ = self.env.reset(seed=0)
        for _ in range(steps):
            observation = self.env.step(self.policy(observation))[0]
        return observation

    @property
    def runner(self):
        """The processes."""
        return self.env.unwrapped.core.cell.runner

    @property
    def pids(self):
        """Processes of the runner: left arm, right arm, supervisor."""
        return [*(each.process.pid for each in self.runner.processes), self.runner.supervisor.process.pid]

    def step_until_faulted(self, most=_MOST_STEPS):
        """Go on until both arms are stopped. Returns the error."""
        try:
            for _ in range(most):
                self.env.step(self.policy())
        except CellFaulted as error:
            return error
        raise AssertionError(f"{most} steps and no fault")

    def executed(self, arm):
        """Targets that a controller has executed since `make`, (k, 6)."""
        rows = self.cell.setpoints(arm, self.first[ARMS.index(arm)])
        return np.array([row[1] for row in rows]).reshape(-1, 6)

    def ask(self, arm, *names):
        """Values by which a controller tells its state."""
        found = self.cell.ask("state", arm=arm, names=list(names))
        return [found[name] for name in names]

    def measured(self):
        """Where both arms were at the same times, as far as that can be, (k, 2, 6), and when."""
        left, right = (memory.states()[0] for memory in self.runner.arms)
        at = _START["q_rad"]
        row = np.clip(np.searchsorted(right[:, 0], left[:, 0]), 0, len(right) - 1)
        return np.stack([left[:, at : at + 6], right[row, at : at + 6]], axis=1), left[:, 0]

    def nearest_m(self):
        """The smallest distance of any two things that must not meet, over what was measured."""
        clearance = self.env.unwrapped.core.cell._clearance
        return min(float(clearance.distances_m(q.reshape(1, 12)).min()) for q in self.measured()[0][::3])

    def assert_within_limits(self):
        """What both arms were sent keeps to the limits of speed, acceleration and jerk, by divided differences: those
        of targets some of whose periods were left out are means of those of all targets. Nothing else was executed."""
        core = self.env.unwrapped.core
        limits, tick_s = core.pipeline.gate.limits, core.config.servoj.tick_s
        for arm, memory in zip(ARMS, self.runner.arms, strict=True):
            executed = self.executed(arm)
            sent, _ = memory.sent()
            if len(sent.target_rad) < RING // 2:
                assert {row.tobytes() for row in executed} <= {row.tobytes() for row in sent.target_rad}
            most = (limits.speed_rad_s, limits.acceleration_rad_s2, limits.jerk_rad_s3)
            for order, (name, limit) in enumerate(zip(("speed", "acceleration", "jerk"), most, strict=True), start=1):
                used = float((np.abs(derivative(sent, order, tick_s)) / limit).max(initial=0.0))
                assert used <= 1.0 + 1e-6, f"{arm}: {used:.4f} of the greatest {name}"

    def assert_within_hard_limits(self):
        """What both controllers have executed is within what an arm's process lets out, whoever asks. A target that
        came late is found two periods on."""
        tick_s = self.file.config().servoj.tick_s
        for arm in ARMS:
            targets = self.executed(arm)
            assert np.isfinite(targets).all()
            assert (np.abs(targets[2:] - targets[:-2]) <= 3 * tick_s * HARD_SPEED_RAD_S).all()

    def assert_stopped(self, error, *words, arms=ARMS):
        """Both stand, both programs have ended, nothing more is sent, and it stays so until a person clears it."""
        if isinstance(error, CellFaulted):
            for word in words:
                assert word in str(error), str(error)
            assert "cell clear" in str(error)
        self.assert_at_rest(arms)
        quiet = self._traffic()
        for again in (lambda: self.env.step(self.policy()), lambda: self.env.reset(seed=1)):
            with pytest.raises(CellFaulted, match="cell clear") as found:
                again()
        for word in words:
            assert word in str(found.value), str(found.value)
        time.sleep(0.25)
        assert self._traffic() == quiet, "something was sent after the fault"
        fault = self.latch.read()
        assert fault is not None
        assert fault.text in str(found.value) or str(found.value).startswith("both arms were stopped")
        self.close_env()
        assert self._traffic() == quiet, "closing sent something"
        self.assert_latched(*words)
        assert self._traffic() == quiet, "a new start sent something"

    def assert_latched(self, *words):
        """Nothing begins before a person clears the fault, which is told."""
        fault = self.latch.read()
        assert fault is not None
        for word in words:
            assert word in fault.text, fault.text
        with pytest.raises(CellFaulted, match=re.escape(fault.text[:40])):
            self.make()
        self.assert_at_rest()

    def assert_at_rest(self, arms=ARMS):
        """Programs have ended, and both arms come to stand and stay where they are."""
        for arm in arms:
            self.cell.wait_until(arm, "runtime_state", 1)
        end = time.monotonic() + 5.0
        while time.monotonic() < end:
            if all(np.abs(self.ask(arm, "actual_qd")[0]).max() < 1e-3 for arm in ARMS):
                return
            time.sleep(0.02)
        raise AssertionError("an arm still moves")

    def assert_nothing_executed(self):
        """No target since the last `make` or `mark`."""
        assert [len(self.executed(arm)) for arm in ARMS] == [0, 0]

    def assert_nothing_has_moved(self):
        """The same, and no program runs."""
        self.assert_nothing_executed()
        self.assert_at_rest()

    def programs(self):
        """How many programs have ended or were refused so far, by the log of the cell."""
        return sum(1 for line in self._log.read_text().splitlines() if _PROGRAM.search(line))

    def _traffic(self):
        """What must not change after a fault: executed targets, what programs do, and how many there were."""
        counts = [self.cell.ask("setpoints", arm=arm)["count"] for arm in ARMS]
        return [*counts, *(self.ask(arm, "runtime_state")[0] for arm in ARMS), self.programs()]

    def suspend(self, *pids):
        """Processes stand still from now on, until `wake` or the end of the test."""
        for pid in pids:
            os.kill(pid, signal.SIGSTOP)
            self._undo.append((self.wake, pid))

    @staticmethod
    def wake(*pids):
        """Processes go on."""
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
        """Wait until a program's arms execute targets that go somewhere."""
        end = time.monotonic() + within_s
        while time.monotonic() < end:
            assert process.poll() is None, process.stdout.read()
            if all(np.abs(self.ask(arm, "target_qd")[0]).max() > 0.02 for arm in ARMS):
                return
            time.sleep(0.02)
        raise AssertionError("its arms do not move")

    def close_env(self):
        """End the environment."""
        env, self.env = self.env, None
        if env is not None:
            env.close()

    def mend(self):
        """As it was: no faults, no stops, arms powered and at rest."""
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
        """Bring the arms to where they were at first, quickly, where they are far from it."""
        for arm, home in zip(ARMS, self._home, strict=True):
            if np.abs(np.subtract(self.ask(arm, "actual_q")[0], home)).max() > 0.1:
                with socket.create_connection((getattr(self.cell, arm), 30003)) as client:
                    client.sendall(f"movej({home}, a=4.0, v=2.0)\n".encode())
                    self.cell.wait_until(arm, "runtime_state", 2)
        for arm in ARMS:
            self.cell.wait_until(arm, "runtime_state", 1)

    def busy(self):
        """How often a watchdog in a controller was not fed, by the log of the cell."""
        return self._log.read_text().count("was not fed for")

    def close(self):
        """End everything."""
        with contextlib.suppress(DualUR10Error):
            self.close_env()
        self.latch.clear()
        self.cell.close()


def derivative(sent, order, tick_s):
    """Divided differences of what an arm was sent, (k, 6) in rad and s, whatever periods were left out."""
    time_s, level = sent.period * tick_s, sent.target_rad
    for each in range(1, order + 1):
        level = each * np.diff(level, axis=0) / (time_s[each:] - time_s[:-each])[:, None]
    return level


def _end(process):
    process.kill()
    process.wait()
    process.stdout.close()


def descendants(pid):
    """Processes that a process has started, and those that they have."""
    parents = {}
    for each in Path("/proc").glob("[0-9]*/stat"):
        with contextlib.suppress(OSError):
            parents[int(each.parent.name)] = int(each.read_text().rpartition(")")[2].split()[1])
    found = [pid]
    for one in found:
        found += [child for child, parent in parents.items() if parent == one]
    return found[1:]


def assert_gone(pids, within_s=10.0):
    """None of these processes is left."""
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
