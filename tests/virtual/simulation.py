"""Run of one schedule on a virtual cell, and the invariants that it must keep."""

from __future__ import annotations

import contextlib
import errno
import json
import logging
import math
import tempfile
import time
from collections.abc import Iterator
from dataclasses import dataclass, field
from datetime import timedelta
from pathlib import Path
from typing import Any, Final
from unittest import mock

import gymnasium as gym
import numpy as np

import dual_ur10  # noqa: F401  # registers the environments
from dual_ur10.errors import (
    ActionError,
    CellBusyError,
    CellFaulted,
    ClosedError,
    DualUR10Error,
    LinkError,
    RecordingError,
    StartError,
    UnknownNameError,
    VirtualCellError,
)
from dual_ur10.kinematics.ur10 import ARMS, HARD_ACCELERATION_RAD_S2, HARD_SPEED_RAD_S, JOINT_RANGE_RAD, TICK_S
from dual_ur10.policies import load
from dual_ur10.sim2real.control.gate import SafetyGate
from dual_ur10.sim2real.protocol.modes import RuntimeState
from dual_ur10.sim2real.recording import run_folder
from dual_ur10.sim2real.recording.reader import read_run
from dual_ur10.sim2real.recording.writer import RunWriter
from dual_ur10.sim2real.runtime.arm_memory import ArmMemory, Phase
from dual_ur10.sim2real.runtime.cell_memory import CellMemory
from dual_ur10.sim2real.runtime.runner import Runner
from dual_ur10.sim2real.virtual.scheduler import VirtualClock
from dual_ur10.testing import VirtualCell
from tests.virtual.schedule import Schedule

SERVOJ: Final = 11
STOP_S: Final = 0.9
"""Longest time from the first note of a stop to the last target: the ramp from the largest speed, 0.65 s, and spare."""

END_S: Final = 6.0
"""Longest time to the end of both programs: ramp, limit of the supervisor, dashboard."""

BUDGET_S: Final = 60.0
"""Longest virtual time of a schedule. The longest waits are 15 s for a start, and timeouts of connections."""

_EXPECTED: Final = (CellFaulted, LinkError, StartError, CellBusyError, ClosedError, RecordingError)
_TOLERANCE: Final = 1.0 + 1e-6


class Interrupt(BaseException):
    """Ctrl-C, or an exception of a policy."""


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


# Faults.

_PERMANENT_OVERRIDES: Final = ("payload",)


class Injector:
    """Faults of a schedule on a cell: each waits for its phase in an actor of its own.

    Attributes:
        fired: Time of each injected fault by its number in the schedule.
    """

    def __init__(self, schedule: Schedule, cell: VirtualCell, observer: Observer) -> None:
        self._schedule, self._cell, self._observer = schedule, cell, observer
        self.fired: dict[int, float] = {}
        self.phases: dict[str, float] = {}
        self.policy: list[Any] = []  # faults of the policy that are due
        self.second = False
        self._undo: list[Any] = []
        self._healed = False

    def enter(self, phase: str) -> None:
        """Start the actors of a phase, once."""
        if phase in self.phases:
            return
        self.phases[phase] = self._cell.now_s
        for number, fault in enumerate(self._schedule.faults):
            if fault.when == phase:
                self._cell.system.thread(lambda n=number, f=fault: self._run(n, f), f"fault {number}")

    def _run(self, number: int, fault: Any) -> None:
        clock = self._cell.clock
        clock.sleep(fault.at_s)
        if self._healed:
            return
        self.fired[number] = clock.now_s()
        undo = self._begin(fault)
        if undo is not None:
            self._undo.append(undo)
            if fault.duration_s:
                clock.sleep(fault.duration_s)
                undo()

    def heal(self) -> None:
        """Remove all faults, and cancel those that wait."""
        self._healed = True
        for undo in self._undo:
            undo()
        for arm in ARMS:
            self._ask(arm, do="heal")
            for button in ("power_on", "release_brakes"):
                self._ask(arm, do="press", button=button)

    def _ask(self, arm: str, do: str, **values: Any) -> bool:
        emulator = self._cell.emulators[ARMS.index(arm)]
        answer = json.loads(emulator._injection.answer(json.dumps({"do": do, "arm": arm, **values})))
        return bool(answer["ok"])

    def _begin(self, fault: Any) -> Any:
        """Inject a fault; return the function that ends it."""
        ask, observer = self._ask, self._observer
        match fault.kind:
            case "safety":
                ask(fault.arm, "stop", mode=fault.mode)
                return lambda: ask(fault.arm, "release", mode=fault.mode)
            case "press":
                ask(fault.arm, "press", button=fault.button)
                return (lambda: ask(fault.arm, "press", button=fault.then)) if fault.then else None
            case "slider":
                ask(fault.arm, "slider", fraction=fault.fraction)
                return lambda: ask(fault.arm, "slider", fraction=1.0)
            case "reduced":
                ask(fault.arm, "reduce", on=True)
                return lambda: ask(fault.arm, "reduce", on=False)
            case "local":
                ask(fault.arm, "remote", on=False)
                return lambda: ask(fault.arm, "remote", on=True)
            case "override":
                values = self._override(fault)
                ask(fault.arm, "override", **values)
                return lambda: ask(fault.arm, "override", **dict.fromkeys(values))
            case "pretend":
                if fault.what == "calibration":
                    ask(fault.arm, "calibration", error_m=0.02)
                    return lambda: ask(fault.arm, "calibration", error_m=0.0)
                values = {
                    "version": {"version": [5, 12, 0, 0] if self._schedule.cell.family == "cb3" else [3, 15, 0, 0]},
                    "type": {"robot_type": 1},
                    "serial number": {"serial_number": "1"},
                }[fault.what]
                ask(fault.arm, "pretend", **values)
                return None
            case "link":
                flag = fault.effect in ("mute", "frozen", "half_open")
                whole = fault.effect not in ("delay_s", "jitter_s")
                amount: Any = True if flag else int(fault.amount) if whole else fault.amount
                self._link(fault, amount)
                return lambda: self._link(fault, False if flag else 0 if whole else 0.0)
            case "drop":
                ask(fault.arm, "drop", port=fault.port, reset=fault.reset, writers=fault.writers)
            case "refuse":
                ask(fault.arm, "refuse", port=fault.port)
                return lambda: ask(fault.arm, "heal", port=fault.port)
            case "script_delay":
                ask(fault.arm, "script_delay", seconds=fault.seconds)
                return lambda: ask(fault.arm, "script_delay", seconds=0.0)
            case "stall":
                with contextlib.suppress(UnknownNameError):
                    self._cell.stall(_process(fault.process), fault.duration_s)
            case "death":
                with contextlib.suppress(UnknownNameError):
                    self._cell.end(_process(fault.process))
            case "policy":
                self.policy.append(fault)
            case "disk":
                observer.disk_full = True
                return lambda: setattr(observer, "disk_full", False)
            case "second":
                self.second = True
            case "wall_clock":
                observer.wall_s += 3600.0
        return None

    def _link(self, fault: Any, amount: Any) -> None:
        if not self._cell.emulators[ARMS.index(fault.arm)].ended:
            self._ask(fault.arm, "link", port=fault.port, **{fault.effect: amount})

    def _override(self, fault: Any) -> dict[str, Any]:
        values = self._observer.controller(ARMS.index(fault.arm)).values
        off = [each + 0.3 for each in values["actual_q"]]
        return {
            "tracking": {"actual_q": off},
            "hot": {"joint_temperatures": [85.0] * 6},
            "moving": {"actual_qd": [0.1] * 6},
            "clock stands": {"timestamp": float(values["timestamp"])},
            "clock back": {"timestamp": 1.0},
            "robot mode": {"robot_mode": 5},
            "program": {"runtime_state": 1},
            "payload": {"payload": 7.0},
            "nan": {"actual_q": [math.nan] * 6},
        }[fault.what]


def _process(name: str) -> str:
    return "emulated cell" if name == "controllers" else name


# Policies.


def _policy(schedule: Schedule, env: Any) -> Any:
    rng = np.random.default_rng(schedule.seed + 1)
    size, name = env.action_space.shape[0], schedule.cell.policy
    if name == "scripted":
        policy = load("scripted", f"DualUR10/{schedule.cell.task}-v0")
        policy.reset()
        return policy
    steps = iter(range(1_000_000))

    def act(observation: Any) -> Any:
        step = next(steps)
        if name == "swing":
            action = np.zeros((2, size // 2), dtype=np.float32)
            action[:, [0, 3, 4, 5]] = 0.4 * np.cos(2 * np.pi * step * 0.04 / 2.0)
            return action.reshape(-1)
        if name == "random":
            return rng.uniform(env.action_space.low, env.action_space.high).astype(np.float32)
        if name == "bounds":
            return np.where(rng.random(size) < 0.5, env.action_space.low, env.action_space.high)
        return np.zeros(size, dtype=np.float32)

    return act


def _wrong(how: str, action: Any) -> Any:
    action = np.array(action)
    if how in ("nan", "inf"):
        action[2] = math.nan if how == "nan" else math.inf
        return action
    return {"shape": action[:-1], "text": "left", "huge": np.full_like(action, 1e30)}[how]


# A run.


@dataclass
class Outcome:
    """Result of a run.

    Attributes:
        violations: Broken invariants; none in a good run.
        error: What the program was told, or "".
        latched: Reason of the latched stop, or "".
        moved: Targets were sent.
        fired: Number of injected faults.
        virtual_s: Virtual time.
        cpu_s: Processor time.
    """

    violations: list[str]
    error: str = ""
    latched: str = ""
    moved: bool = False
    fired: int = 0
    virtual_s: float = 0.0
    cpu_s: float = 0.0


class Run:
    """One schedule on one virtual cell."""

    def __init__(self, schedule: Schedule) -> None:
        self.schedule = schedule
        self.violations: list[str] = []
        self.observer = Observer()
        self.error: BaseException | None = None
        self.env: Any = None
        self.starts = 0
        self.ended_early = False  # by the episode's own end

    def demand(self, holds: bool, text: str) -> None:
        """Note a violation unless this holds."""
        if not holds and text not in self.violations:
            self.violations.append(text)

    def __call__(self) -> Outcome:
        """Run it."""
        outcome = Outcome(self.violations)
        with self.observer.installed(), tempfile.TemporaryDirectory() as folder:
            self.folder = Path(folder)
            self.cell = cell = self._make_cell()
            self.observer.cell = cell
            self.injector = Injector(self.schedule, cell, self.observer)
            self.observer.on_stop = lambda: self.injector.enter("stop")
            begun_s = cell.now_s
            self._guard(begun_s + BUDGET_S)
            try:
                self._episode()
                self._aftermath()
            except VirtualCellError as error:
                self.demand(False, f"stuck: {error}")
            except DualUR10Error as error:
                self.demand(False, f"unexpected {type(error).__name__}: {error}")
            outcome.virtual_s = cell.now_s - begun_s
            with contextlib.suppress(Exception):
                outcome.latched = cell.fault
            try:
                cell.close()
            except VirtualCellError as error:
                self.demand(False, f"an actor failed: {error}")
            outcome.error = "" if self.error is None else f"{type(self.error).__name__}: {self.error}"
            outcome.moved = any(any(each.sent) for each in self.observer.episodes)
            outcome.fired = len(self.injector.fired)
        return outcome

    def _make_cell(self) -> VirtualCell:
        made = self.schedule.cell
        right = None
        options: dict[str, Any] = {}
        if made.right_phase_s >= 0.0:
            right = {"phase_s": made.right_phase_s, "drift_ppm": made.right_drift_ppm}
            options["phase_s"] = 0.0
        file: dict[str, Any] = {}
        if made.speed_factor != 1.0:
            file["speed_factor"] = made.speed_factor
        if made.allow_reduced_mode:
            file["allow_reduced_mode"] = True
        return VirtualCell(
            task=made.task,
            family=made.family,
            plant=made.plant,
            seed=made.seed,
            drift_ppm=made.drift_ppm,
            right=right,
            file=file,
            **options,
        )

    def _guard(self, until_s: float) -> None:
        cell, scheduler = self.cell, self.cell._world.scheduler

        def guard() -> None:
            cell.clock.sleep(until_s - cell.now_s)
            scheduler._fail(f"{BUDGET_S:g} s of virtual time have passed: something waits for ever")

        cell.system.thread(guard, "guard")

    # The program.

    def _make(self) -> Any:
        self.starts += 1
        cell = self.schedule.cell
        record = {"record": self.folder, "record_failure": cell.record} if cell.record else {}
        return gym.make(f"DualUR10/{cell.task}-v0", cell=self.cell, disable_env_checker=True, **record)

    def _episode(self) -> None:
        """Make an environment, run an episode, and close it."""
        try:
            self.injector.enter("start")
            self.env = self._make()
            self.injector.enter("approach")
            observation, _ = self.env.reset(seed=self.schedule.cell.seed + 100 * self.schedule.cell.far)
            self.injector.enter("motion")
            self._steps(observation)
        except (*_EXPECTED, ActionError, Interrupt) as error:
            self.error = error
        if isinstance(self.error, CellFaulted):
            self._still_refused()
        self.injector.enter("end")
        if self.env is not None:
            self._keep_limits()
            self.env.close()
            self.env.close()

    def _keep_limits(self) -> None:
        for each in self.observer.episodes:
            each.limits = each.limits or self.env.unwrapped.core.pipeline.gate.limits

    def _steps(self, observation: Any) -> None:
        policy = _policy(self.schedule, self.env)
        faults = [each for each in self.schedule.faults if each.when == "motion"]
        needed_s = max([self.schedule.cell.motion_s, *(each.at_s + 0.7 for each in faults if each.kind != "policy")])
        needed_s = max([needed_s, *(each.at_s + 0.1 for each in faults if each.kind == "policy")])
        end_s = self.cell.now_s + needed_s
        while self.cell.now_s < end_s:
            action = policy(observation)
            while self.injector.policy:
                fault = self.injector.policy.pop(0)
                if fault.how == "late":
                    self.cell.clock.sleep(fault.duration_s)
                elif fault.how in ("raise", "interrupt"):
                    raise Interrupt(fault.how)
                else:
                    action = _wrong(fault.how, action)
            if self.injector.second:
                self.injector.second = False
                self._second()
            observation, _, terminated, truncated, _ = self.env.step(action)
            if terminated or truncated:
                self.ended_early = True
                return

    def _second(self) -> None:
        try:
            self._make().close()
        except (CellBusyError, CellFaulted):
            return
        except RecordingError:
            return
        self.demand(False, "a second program got the arms that the first one moves")

    def _still_refused(self) -> None:
        if self.env is None:
            return
        before = self._traffic()
        for again in (lambda: self.env.step(self.env.action_space.sample() * 0), lambda: self.env.reset(seed=1)):
            try:
                again()
            except DualUR10Error:
                continue
            self.demand(False, "a stopped environment continued")
        self.demand(self._traffic() == before, "a stopped environment sent something when it was used again")

    def _traffic(self) -> list[int]:
        received = [self.observer.controller(arm).received for arm in range(2)]
        return [*(each.motion_count for each in received), *(each.uploads for each in received)]

    # Afterwards.

    def _dead(self, arm: int) -> bool:
        """Return True if the emulation of an arm has ended: its state is not known."""
        return any(
            fault.kind == "death" and fault.process in ("controllers", f"{ARMS[arm]} controller")
            for fault in self.schedule.faults
        )

    def _aftermath(self) -> None:
        self._wait_for_rest()
        for number, episode in enumerate(self.observer.episodes):
            Checks(self, episode, number).all()
        self._check_processes()
        self._check_latch()
        self._check_record()
        if self.schedule.cell.again:
            self._again()

    def _wait_for_rest(self) -> None:
        known_s = min([each.known_s for each in self.observer.episodes], default=math.inf)
        if known_s == math.inf:
            return
        end_s = max(known_s + END_S, self.cell.now_s + 0.5) + self._slack_s()
        while self.cell.now_s < end_s and not all(self._rests(arm) for arm in range(2)):
            self.cell.clock.sleep(0.02)
        for arm, name in enumerate(ARMS):
            controller = self.observer.controller(arm)
            if not self._dead(arm):
                state = _runtime(controller)
                self.demand(
                    state == RuntimeState.STOPPED or self._is_played(arm),
                    f"{name}: its program has not ended: runtime state {state}",
                )
                speed = self._speed(arm)
                self.demand(speed < 0.01, f"{name}: it still moves at {speed:.3f} rad/s")
        self.cell.clock.sleep(max(0.0, self._held_until_s() - self.cell.now_s))
        before = self._traffic(), [self._position(arm) for arm in range(2)]
        self.cell.clock.sleep(0.1)
        self.demand(self._traffic() == before[0], "something was sent after the stop")
        moved = max(float(np.abs(self._position(arm) - before[1][arm]).max()) for arm in range(2))
        self.demand(moved < 1e-3, f"an arm moved by {moved:.4f} rad after the stop")

    def _held_until_s(self) -> float:
        """Return the time until which links may deliver what was sent before."""
        held = [
            self.injector.fired.get(number, 0.0) + each.duration_s + each.amount + 0.05
            for number, each in enumerate(self.schedule.faults)
            if each.kind == "link" and each.effect in ("frozen", "delay_s", "jitter_s")
        ]
        return max(held, default=0.0)

    def _is_played(self, arm: int) -> bool:
        """Return True if an operator starts a program at the pendant, which then idles."""
        return any(
            each.kind == "press" and each.then == "play" and each.arm == ARMS[arm] for each in self.schedule.faults
        )

    def _position(self, arm: int) -> np.ndarray:
        return np.array(self.cell.emulators[arm].world.read(arm).q_rad)

    def _speed(self, arm: int) -> float:
        return float(np.abs(self.cell.emulators[arm].world.read(arm).qd_rad_s).max())

    def _rests(self, arm: int) -> bool:
        controller = self.observer.controller(arm)
        ended = _runtime(controller) == RuntimeState.STOPPED or self._is_played(arm)
        return self._dead(arm) or (ended and self._speed(arm) < 0.005)

    def _slack_s(self) -> float:
        """Return the time by which the schedule's own stalls and delays may lengthen a stop."""
        total = 0.0
        for fault in self.schedule.faults:
            if fault.kind == "stall":
                total += fault.duration_s
            elif fault.kind == "link":
                total += 2 * fault.amount if fault.effect in ("delay_s", "jitter_s") else 0.0
                total += fault.duration_s
        return total

    def _check_processes(self) -> None:
        alive = [
            each.name
            for each in self.cell._world.processes.values()
            if each.is_alive and each.name in ("left", "right", "supervisor", "recorder")
        ]
        self.demand(not alive, f"processes were left: {alive}")

    def _check_latch(self) -> None:
        fault = self.cell.fault
        must = [text for number, each in enumerate(self.schedule.faults) if (text := self._must_latch(number, each))]
        if must:
            self.demand(bool(fault), f"nothing was latched although {must[0]}")
        if all(self._never_latches(each) for each in self.schedule.faults):
            self.demand(not fault, f"latched without a reason: {fault}")
            self.demand(not isinstance(self.error, CellFaulted), f"stopped without a reason: {self.error}")
        if isinstance(self.error, CellFaulted) and self.observer.episodes:
            self.demand(bool(fault), f"the program was told of a latched stop, and nothing is latched: {self.error}")
        if not self.observer.episodes:
            return
        episode = self.observer.episodes[-1]
        stopping = [at for arm in episode.phases for at, phase, _ in arm if phase >= Phase.STOPPING]
        stopped_s = min([episode.fault_s, *stopping])
        for number, each in enumerate(self.schedule.faults):
            at_s = self.injector.fired.get(number, math.inf)
            if each.kind == "slider" and each.fraction < 0.9 and each.duration_s > 0.15 and self._streaming(at_s, 0.3):
                self.demand(episode.slowed or episode.known_s < at_s + 0.1, "the arms ignored a speed slider")
        if self.error is None and not self.ended_early:
            self.demand(stopped_s > episode.ending_s - 0.3, "the program went on, and was not told of a stop")
        if fault:
            before = self._traffic()
            try:
                self._make().close()
            except (CellFaulted, RecordingError) as error:
                self.demand(
                    isinstance(error, RecordingError) or fault.split(".")[0][:40] in str(error),
                    f"the refusal of a start does not tell the fault {fault!r}: {error}",
                )
            else:
                self.demand(False, "a start was not refused after a latched stop")
            self.demand(self._traffic() == before, "a refused start sent something")
        single = self.schedule.faults[0] if len(self.schedule.faults) == 1 else None
        if single is not None and single.kind == "safety" and must:
            self.demand(single.arm in fault, f"the latch does not name the {single.arm} arm: {fault}")

    def _streaming(self, at_s: float, for_s: float) -> bool:
        """Return True if both arms streamed from `at_s`, and the program went on for `for_s` unless it was stopped."""
        episode = self.observer.episodes[-1] if self.observer.episodes else None
        if episode is None or not all(episode.sent) or at_s < max(each[0][0] for each in episode.sent) + 0.15:
            return False
        return at_s < episode.known_s and (episode.ending_s > at_s + for_s)

    def _must_latch(self, number: int, fault: Any) -> str:
        at_s = self.injector.fired.get(number, math.inf)
        tick_s = TICK_S[self.schedule.cell.family]
        lasts_s = fault.duration_s or math.inf
        enough, within_s = False, 0.4
        match fault.kind:
            case "safety":
                enough = lasts_s > 3 * tick_s
            case "press":
                enough = not fault.then or lasts_s > 3 * tick_s
            case "reduced":
                enough = not self.schedule.cell.allow_reduced_mode and lasts_s > 3 * tick_s
            case "override":
                needed = {
                    "tracking": 0.05,
                    "clock stands": 0.16,
                    "clock back": 0.16,
                    "robot mode": 0.03,
                    "program": 0.03,
                }
                enough = lasts_s > needed.get(fault.what, math.inf)
            case "link":
                broken = fault.effect in ("short", "long", "foreign") and lasts_s > 2 * tick_s
                enough = fault.port == "rtde" and (broken or (fault.effect == "mute" and lasts_s > 0.2))
            case "drop":
                enough = fault.port in ("rtde", "dashboard") and not fault.writers
            case "stall":
                enough = fault.process != "recorder" and lasts_s > 0.3
                within_s = 0.6
            case "death":
                enough = fault.process != "recorder"
            case "policy":
                enough = fault.how in ("nan", "inf", "shape", "text")
                within_s = -1.0 if enough else 0.0
                policies = [each.how for each in self.schedule.faults if each.kind == "policy"]
                enough = enough and not {"raise", "interrupt"} & set(policies)
                if fault.how == "late":
                    enough, within_s = fault.duration_s > 0.75, 0.75
        if enough and self._streaming(at_s, within_s) and not self._other_stalls(number):
            return (
                f"fault {number} ({fault.kind}) occurred {at_s - self.observer.episodes[-1].begun_s:.3f} s after begin"
            )
        return ""

    def _other_stalls(self, number: int) -> bool:
        """Return True if another fault may keep one from being seen."""
        others = [each for n, each in enumerate(self.schedule.faults) if n != number]
        return any(each.kind in ("stall", "link", "override", "slider", "death", "drop") for each in others)

    def _never_latches(self, fault: Any) -> bool:
        match fault.kind:
            case "slider":
                return True
            case "policy":
                return fault.how in ("huge", "raise") or (fault.how == "late" and fault.duration_s < 0.4)
            case "override":
                return fault.what in ("hot", "payload")
            case "stall" | "death":
                return fault.process == "recorder" and self.schedule.cell.record != "stop"
            case "disk":
                return self.schedule.cell.record != "stop"
            case "second" | "wall_clock":
                return True
            case "link":
                return fault.effect in ("delay_s", "jitter_s") and fault.amount < 0.002 and fault.port != "rtde"
        return False

    def _check_record(self) -> None:
        runs = sorted(self.folder.glob("*/*.mcap")) if self.schedule.cell.record else []
        boxes = sorted((Path(self.cell._folder.name)).glob("**/*.mcap"))
        told = False
        for path in (*runs, *boxes):
            try:
                run = read_run(path, allow_partial=True)
            except RecordingError as error:
                self.demand(
                    any(each.kind in ("disk", "death", "stall") for each in self.schedule.faults),
                    f"{path.name} cannot be read: {error}",
                )
                continue
            told = told or any(each.kind == "fault" for each in run.events)
        recorder_fails = any(
            each.kind == "disk" or getattr(each, "process", "") == "recorder" for each in self.schedule.faults
        )
        stepped = isinstance(self.error, CellFaulted) and "motion" in self.injector.phases
        if runs and stepped and not recorder_fails:
            self.demand(told, "no record tells the fault")

    def _again(self) -> None:
        """Heal everything, clear the latch, and move again."""
        hopeless = any(each.kind in ("death", "pretend", "disk") for each in self.schedule.faults)
        if hopeless or self._dead(0) or self._dead(1):
            return
        self.injector.heal()
        self.cell.clock.sleep(6.0)
        for number, arm in enumerate(ARMS):
            if self._is_played(number):
                self.injector._ask(arm, "press", button="stop")  # the operator's own program
            for mode in {fault.mode for fault in self.schedule.faults if fault.kind == "safety"}:
                self.injector._ask(arm, "release", mode=mode)
            for button in ("power_on", "release_brakes"):
                self.injector._ask(arm, "press", button=button)
        self.cell.clock.sleep(2.0)
        self.observer.on_stop = lambda: None
        if self.cell.fault:
            self.cell.clear()
        try:
            self.env = self._make()
        except DualUR10Error as error:
            serious = any(each.kind == "safety" and each.mode in (8, 9) for each in self.schedule.faults)
            self.demand(serious, f"the cell does not start again after all faults were removed: {error}")
            return
        self.env.reset(seed=self.schedule.cell.seed)
        for _ in range(3):
            self.env.step(np.zeros(self.env.action_space.shape, dtype=np.float32))
        self._keep_limits()
        self.env.close()
        self.demand(not self.cell.fault, f"latched again after all faults were removed: {self.cell.fault}")
        Checks(self, self.observer.episodes[-1], len(self.observer.episodes) - 1).all()


def _runtime(controller: Any) -> int:
    """Return the runtime state itself, whatever is reported."""
    return int(controller.program.state)


class Checks:
    """Invariants of one runner's targets."""

    def __init__(self, run: Run, episode: Episode, number: int) -> None:
        self.run, self.episode, self.number = run, episode, number
        self.demand = run.demand
        self.cell = run.schedule.cell
        self.tick_s = TICK_S[self.cell.family]
        self.faults = run.schedule.faults

    def all(self) -> None:
        """Check them all."""
        if not any(self.episode.sent):
            return
        self._gate()
        for arm in range(2):
            self._wire(arm)
            self._path(arm)
            self._limits(arm)
            self._ends(arm)
        self._together()

    def _packages(self, arm: int) -> list[Any]:
        received = self.run.observer.controller(arm).received
        first = received.motion_count - len(received.motion)
        begin = self.episode.wire[arm]
        following = self.run.observer.episodes[self.number + 1 :]
        end = following[0].wire[arm] if following else received.motion_count
        return list(received.motion)[begin - first : end - first]

    def _wire(self, arm: int) -> None:
        name, received = ARMS[arm], self.run.observer.controller(arm).received
        packages = self._packages(arm)
        self.demand(all(each.command == SERVOJ for each in packages), f"{name}: other commands than servoj were sent")
        targets = np.array([each.numbers for each in packages]).reshape(-1, 6)
        self.demand(bool(np.isfinite(targets).all()), f"{name}: a target is not finite")
        self.demand(bool((np.abs(targets) <= JOINT_RANGE_RAD).all()), f"{name}: a target is out of range")
        self.demand(received.uploads <= self.run.starts, f"{name}: {received.uploads} programs were uploaded")
        if packages:
            watchdog = received.watchdog
            self.demand(
                watchdog is not None and (self.number > 0 or watchdog[0] <= packages[0].tick),
                f"{name}: it moved before its watchdog was armed: {watchdog}",
            )
            self.demand(watchdog is not None and watchdog[1:] == (10.0, "stop"), f"{name}: its watchdog is {watchdog}")
        noted = [each[4].tobytes() for each in self.episode.sent[arm]]
        came = [np.array(each.numbers).tobytes() for each in packages]
        lost = len(noted) - len(came)
        self.demand(came == noted[: len(came)], f"{name}: a target that came is not the one that was sent")
        shaky = any(
            each.kind in ("link", "drop", "death") or (each.kind == "stall" and "contro" in each.process)
            for each in self.faults
        )
        if not shaky:
            self.demand(lost <= 1, f"{name}: {lost} targets were lost")
            ticks = np.diff([each.tick for each in packages])
            # A stop of the program ends the reading of targets, which then come together.
            self.demand(bool((ticks >= 1).all()), f"{name}: two targets came in one control period")

    def _gate(self) -> None:
        """Check that what is written for the arms was released, or is the brake after it, within the limits."""
        episode, released = self.episode, self.run.observer.released
        path: dict[int, np.ndarray] = {}
        for number, (_, first, targets) in enumerate(episode.puts):
            if number == 0:
                path[0] = targets[0].reshape(12)
                continue
            rows = targets.reshape(-1, 12)
            self.demand(rows[0].tobytes() in released, f"target {first} was written without being released")
            begin = min(first, max(path) + 1)
            before = [path[max(0, min(n, max(path)))] for n in range(begin - 3, begin)]
            gap = [path[max(path)]] * max(0, first - max(path) - 1)
            whole = np.array([*before, *gap, *rows])
            if episode.limits is not None and len(rows) > 1:
                self._within(whole, episode.limits, f"written from {first} on")
            for offset, row in enumerate(rows):
                path[first + offset] = row
            for stale in [each for each in path if each >= first + len(rows)]:
                del path[stale]
            for n in range(begin, first):
                path.setdefault(n, before[-1])

    def _within(self, rows: np.ndarray, limits: Any, what: str) -> None:
        level = rows
        for name, limit in (
            ("speed", limits.speed_rad_s),
            ("acceleration", limits.acceleration_rad_s2),
            ("jerk", limits.jerk_rad_s3),
        ):
            level = np.diff(level, axis=0) / self.tick_s
            used = float((np.abs(level) / np.tile(np.broadcast_to(limit, 6), 2)).max(initial=0.0))
            # Rounding of a third difference.
            self.demand(used <= 1.0 + 1e-4, f"{used:.4f} of the largest {name} {what}")

    def _path(self, arm: int) -> None:
        """Check that targets lie on the released path, in time and in order."""
        name, episode = ARMS[arm], self.episode
        puts = iter(episode.puts)
        following = next(puts, None)
        path: list[np.ndarray] = []
        last_index, slow = -1.0, episode.slowed
        straight = any("a target is" in text for _, _, text in episode.phases[arm])
        for at_s, _, index, late_s, target, stopping in episode.sent[arm]:
            while following is not None and following[0] <= at_s:
                _, first, rows = following
                if first > len(path):
                    path += [path[-1]] * (first - len(path))
                path[first:] = list(rows[:, arm])
                following = next(puts, None)
            if not (stopping and straight):
                off = float(np.abs(_at(path, index) - target).max())
                self.demand(off < 1e-12, f"{name}: target {index:.3f} is {off:.6f} rad off the released path")
            self.demand(index >= last_index - 1e-9, f"{name}: target {index:.3f} was sent after {last_index:.3f}")
            last_index = max(index, last_index)
            self.demand(late_s <= 0.1 + 1e-6 or stopping, f"{name}: a target was sent {1e3 * late_s:.0f} ms late")
            due = (at_s - episode.begin_s) / self.tick_s * self.cell.speed_factor
            self.demand(index <= due + 2.5, f"{name}: target {index:.2f} was sent at {due:.2f}, too early")
            if not stopping and not slow:
                behind = 0.1 / self.tick_s + 4
                self.demand(index >= due - behind, f"{name}: target {index:.2f} was sent at {due:.2f}: an old one")

    def _limits(self, arm: int) -> None:
        """Check the targets sent against the hard limits."""
        name, sent = ARMS[arm], self.episode.sent[arm]
        period = np.array([each[1] for each in sent], dtype=float)
        target = np.array([each[4] for each in sent]).reshape(-1, 6)
        stopping = np.array([each[5] for each in sent])
        if len(sent) < 3:
            return
        self.demand(bool((np.diff(period) >= 1).all()), f"{name}: two targets are for one control period")
        steps = np.maximum(np.diff(period), 1.0)
        speed = np.diff(target, axis=0) / (steps * self.tick_s)[:, None]
        used = float((np.abs(speed) / HARD_SPEED_RAD_S).max())
        self.demand(used <= _TOLERANCE, f"{name}: {used:.3f} of the hard speed was sent")
        between = (steps[1:] + steps[:-1]) / 2 * self.tick_s
        change = np.abs(np.diff(speed, axis=0)) / between[:, None]
        slow = self.episode.slowed
        allowed = HARD_ACCELERATION_RAD_S2 * 1.05 + (4.0 * np.abs(speed[1:]) if slow else 0.0)
        # The ramp of a stop adds its own deceleration and curvature.
        allowed = np.where(stopping[2:, None], allowed + 2 * HARD_ACCELERATION_RAD_S2, allowed)
        if self.cell.speed_factor == 1.0 or not slow:
            most = float((change / allowed).max())
            self.demand(most <= _TOLERANCE, f"{name}: {most:.3f} of the largest acceleration was sent")
        self.demand(
            float(change.max()) <= 3.0 * HARD_ACCELERATION_RAD_S2 * 1.05, f"{name}: {change.max():.1f} rad/s² was sent"
        )

    def _ends(self, arm: int) -> None:
        """Check that targets end soon after the first note of a stop, and with a ramp."""
        name, episode = ARMS[arm], self.episode
        last_s = episode.sent[arm][-1][0] if episode.sent[arm] else -math.inf
        most_s = STOP_S + self.run._slack_s()
        self.demand(
            last_s <= episode.known_s + most_s,
            f"{name}: a target was sent {last_s - episode.known_s:.3f} s after the stop",
        )
        other = [at for at, phase, _ in episode.phases[1 - arm] if phase >= Phase.STOPPING]
        streaming = [each[0] for each in episode.sent[arm] if not each[5]]
        if other and streaming:
            late_s = streaming[-1] - other[0]
            own = any(each.kind == "stall" for each in self.faults)
            self.demand(
                late_s <= 3 * self.tick_s or own,
                f"{name}: it was led on for {late_s:.3f} s after the other arm stopped",
            )

        texts = [text for _, phase, text in episode.phases[arm] if phase == Phase.STOPPED]
        led = texts and not any("sent nothing" in each or "no longer took" in each for each in texts)
        shaky = any(each.kind in ("stall", "link") for each in self.faults)
        moving = [each for each in episode.sent[arm] if not each[5]]
        if led and not shaky and len(moving) > 1:
            before, after = _step(moving), _step(episode.sent[arm])
            self.demand(
                after <= 0.25 * before + 0.01 * self.tick_s,
                f"{name}: targets ended at {after / self.tick_s:.3f} of {before / self.tick_s:.3f} rad/s: no ramp",
            )

        gentle = all(each.kind in ("slider", "second", "policy", "wall_clock", "disk") for each in self.faults)
        # A slow slider lengthens the controller's own stop, in which nobody feeds the watchdog.
        slow = any(
            each.kind == "slider"
            and each.fraction < 0.5
            and (not each.duration_s or self.run.injector.fired.get(n, 0.0) + each.duration_s > episode.ending_s)
            for n, each in enumerate(self.faults)
        )
        if led and gentle and not slow and episode is self.run.observer.episodes[-1]:
            why = self.run.observer.controller(arm).program.stopped_by
            self.demand("watchdog" not in why, f"{name}: its watchdog ended its program")

    def _together(self) -> None:
        """Check that two arms that can both be led to rest stop at one place of their path."""
        episode = self.episode
        if any(each.kind in ("stall", "link") for each in self.faults):
            return
        ended = [[text for _, phase, text in arm if phase == Phase.STOPPED] for arm in episode.phases]
        texts = [text for arm in ended for text in arm]
        if len(texts) < 2 or any("sent nothing" in each or "no longer took" in each for each in texts):
            return
        if any("a target is" in text for arm in episode.phases for _, _, text in arm):
            return
        stopping = [sum(each[5] for each in sent) for sent in episode.sent]
        if min(stopping) == 0:
            return
        last = [sent[-1][2] for sent in episode.sent]
        apart_s = abs(last[0] - last[1]) * self.tick_s
        self.demand(apart_s <= 0.04, f"the arms stopped {1e3 * apart_s:.0f} ms of their path apart")


def _step(sent: list[Any]) -> float:
    """Return the largest joint's last step, rad per control period."""
    return float(np.abs(sent[-1][4] - sent[-2][4]).max()) / max(sent[-1][1] - sent[-2][1], 1)


def _at(path: list[np.ndarray], index: float) -> np.ndarray:
    """Return the path at a fractional number."""
    index = max(index, 0.0)
    below, last = int(index), len(path) - 1
    if index == below or below >= last:
        return path[min(below, last)]
    # Hermite's cubic whose slopes are those between neighbours; not the function under test.
    t = index - below
    before, start, stop, after = (path[min(max(n, 0), last)] for n in range(below - 1, below + 3))
    basis = (2 * t**3 - 3 * t**2 + 1, t**3 - 2 * t**2 + t, 3 * t**2 - 2 * t**3, t**3 - t**2)
    return basis[0] * start + basis[1] * (stop - before) / 2 + basis[2] * stop + basis[3] * (after - start) / 2


def run(schedule: Schedule) -> Outcome:
    """Run one schedule."""
    begin_s = time.process_time()
    logging.disable(logging.CRITICAL)
    try:
        outcome = Run(schedule)()
        outcome.cpu_s = time.process_time() - begin_s
        return outcome
    finally:
        logging.disable(logging.NOTSET)
