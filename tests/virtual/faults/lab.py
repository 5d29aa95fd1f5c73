"""Lab: two emulated controllers, an environment on them, and injected faults."""

import contextlib
import logging
import re

import gymnasium as gym
import numpy as np
import pytest

import dual_ur10  # noqa: F401  # registers the environments
from dual_ur10.errors import CellFaulted, StartError
from dual_ur10.sim2real.cell_file.cell_file import CellFile
from dual_ur10.testing import VirtualCell
from tests.virtual.faults.wire import Wire, demand, ramp_ticks
from ur_core.links.arm_status import ROW

ARMS = ("left", "right")
PROGRAM = re.compile(r"program .* ends:|program is refused|program stopped:|not started")
_MOST_STEPS = 250
_SEEN_TICKS = 3  # from a stop of one arm until both slow down, and packets in transit
_FAST_RAD_S = 0.1
_NOTED_S = 2.0
_REST_RAD_S = 0.01
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


class FaultLab:
    """Cell of two emulated controllers, and at most one environment on it.

    Args:
        cell: The cell.
        where: What names it to `gym.make`.
        system: Clock and network of the program.
        task: Name of the task.
    """

    wire = Wire
    least_steps = 15
    """Steps before faults, on a machine that begins in fits and starts."""
    asleep_ticks = 0
    """Further control periods for which a process may send on a busy machine before it counts as lost."""

    def __init__(self, cell, where, system, task):
        self.cell, self.where, self.system, self.task = cell, where, system, task
        self.clock = cell.clock
        self.env = None
        self.policy = Swing()
        self.first = [0, 0]
        self.tick_s = self.file.config().servoj.tick_s
        self.wires = [self.wire(self.cell, arm) for arm in ARMS]
        self._tick = None  # of the fault
        self._clients = []

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

    def play(self, arm, line):
        """Run a URScript line on an arm."""
        self.wires[ARMS.index(arm)].uploads_before += 1
        client = self.system.connect(getattr(self.cell, arm), 30003, 1.0)
        client.send_now(f"{line}\n".encode())
        self.cell.wait_until(arm, "runtime_state", 2)
        client.close()

    def replace(self, arm, line, port=30003):
        """Let another client replace an arm's program by a URScript line; return the time."""
        self.wires[ARMS.index(arm)].uploads_before += 1
        client = self.system.connect(getattr(self.cell, arm), port, 1.0)
        self.note()
        client.send_now(f"{line}\n".encode())
        self._clients.append(client)  # unread states would make closing it a reset
        return self.clock.now_s()

    def moved_until_s(self, arm):
        """Return when an arm moved last, by the states that its process saw; it saw the arm at rest."""
        rows = self.runner.arms[ARMS.index(arm)].states()[0]
        speed = np.abs(rows[:, _START["qd_rad_s"] : _START["qd_rad_s"] + 6]).max(axis=1)
        assert speed[-1] < _REST_RAD_S, f"{arm}: its process saw it move to the end"
        return float(rows[speed >= _REST_RAD_S, 0].max(initial=0.0))

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
        self.env = gym.make(f"DualUR10/{self.task}-v0", cell=self.where, disable_env_checker=True, **keywords)
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
            if steps is None and step >= self.least_steps and step % 4 == 3 and min(self.speeds_rad_s()) >= _FAST_RAD_S:
                break
        return observation

    def reset(self, **keywords):
        """Begin an episode and record all packets meanwhile, however long the approach is."""
        ended = self.system.event()

        def note():
            while not ended.wait(_NOTED_S):
                for wire in self.wires:
                    wire.note()

        thread = self.system.thread(note, "note")
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
        return min(float(clearance.measure(q.reshape(1, 12)).distances_m.min()) for q in self.measured()[0][::3])

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
        allowed = self.allowed(seen_ticks + ramp_ticks(speed, self.tick_s))
        for wire, ticks in zip(self.wires, packages, strict=True):
            after = int((ticks >= self._tick).sum())
            text = f"{wire.arm}: {after} targets came after the fault, allowed are {allowed} from {speed:.2f} rad/s"
            demand(after <= allowed + self.asleep_ticks, text)
            assert after <= allowed, text
            uploads = wire.uploads
            demand(uploads == 1, f"{wire.arm}: {uploads} programs were uploaded, allowed is one")

    def allowed(self, ticks):
        """Return the number of targets that may come after the fault, given how many control periods they take."""
        return ticks

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
            assert self.clearing in str(error), str(error)
        self.assert_at_rest(arms)
        self.assert_nothing_more(seen_ticks)
        for arm in ramped:
            self.wires[ARMS.index(arm)].assert_rested(self.fault_tick, self.tick_s)
        quiet = self.traffic()
        for again in (lambda: self.env.step(self.policy()), lambda: self.reset(seed=1)):
            with pytest.raises(CellFaulted, match=re.escape(self.clearing)) as found:
                again()
        for word in words:
            assert word in str(found.value), str(found.value)
        self.clock.sleep(0.25)
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
        end = self.clock.now_s() + 5.0
        while self.clock.now_s() < end:
            if all(np.abs(self.ask(arm, "actual_qd")[0]).max() < 1e-3 for arm in ARMS):
                return
            self.clock.sleep(0.02)
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

    def traffic(self):
        """Return what must not change after a fault: executed targets and programs."""
        counts = [self.cell.ask("setpoints", arm=arm)["count"] for arm in ARMS]
        for found in (wire.received() for wire in self.wires):
            counts += [found["motion"], found["uploads"]]
        return [*counts, *(self.ask(arm, "runtime_state")[0] for arm in ARMS), self.programs()]

    def close_env(self):
        """Close the environment."""
        env, self.env = self.env, None
        for wire in self.wires:
            wire.memory = None  # it ends with its process
        if env is not None:
            env.close()
        while self._clients:
            self._clients.pop().close()


class _Messages(logging.Handler):
    """Messages of the emulated controllers."""

    def __init__(self):
        super().__init__(logging.INFO)
        self.texts = []

    def emit(self, record):
        self.texts.append(record.getMessage())


class VirtualLab(FaultLab):
    """Lab on a virtual cell: the same to the bit each time, and used by one test.

    Args:
        task: Name of the task.
        file: Keys of the cell file.
        options: Options of the cell.
    """

    clearing = ".clear()"  # in the text of a latched stop

    least_steps = 7

    def __init__(self, task="SineTracking", file=None, **options):
        self._messages = _Messages()
        self._log = logging.getLogger("ur_emulator")
        self._level = self._log.level
        self._log.setLevel(logging.INFO)
        self._log.addHandler(self._messages)
        cell = VirtualCell(task=task, plant="nominal", file=file, **options)
        super().__init__(cell, cell, cell.system, task)

    @property
    def file(self):
        """Cell file."""
        return self.cell.file

    @property
    def latch(self):
        """Latch of the cell."""
        return self.cell.latch

    def configure(self, **keys):
        """Change keys of the cell file; those of a table are merged with it."""
        data = dict(self.cell.description)
        for key, value in keys.items():
            data[key] = {**data[key], **value} if isinstance(data.get(key), dict) else value
        self.cell.file = CellFile.read(data, "the virtual cell")

    def override(self, arm, **values):
        """Override values that a controller reports."""
        self.do("override", arm=arm, **values)

    def step(self, count=1):
        """Act by the policy."""
        for _ in range(count):
            self.env.step(self.policy())

    def programs(self):
        """Return the number of programs that ended or were refused."""
        return sum(1 for text in self._messages.texts if PROGRAM.search(text))

    def starved(self):
        """Return how often a controller's watchdog was not fed."""
        return sum("was not fed for" in text for text in self._messages.texts)

    def close(self):
        """Close everything."""
        try:
            with contextlib.suppress(CellFaulted):
                self.close_env()
            self.audit()
        finally:
            self.cell.close()
            self._log.removeHandler(self._messages)
            self._log.setLevel(self._level)
