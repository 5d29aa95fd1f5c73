"""Invariants of what follows an episode: rest, processes, latch, record, and a new start."""

from __future__ import annotations

import math
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from dual_ur10.errors import CellFaulted, DualUR10Error, RecordingError
from dual_ur10.sim2real.recording.reader import read_run
from dual_ur10.sim2real.runtime.arm_memory import Phase
from tests.virtual.target_checks import TargetChecks, slack_s
from ur_core.kinematics.ur10 import ARMS, TICK_S
from ur_core.protocol.modes import RuntimeState

if TYPE_CHECKING:
    from tests.virtual.simulation import Run

END_S: Final = 6.0
"""Longest time to the end of both programs: ramp, limit of the supervisor, dashboard."""


class Aftermath:
    """Invariants after the episode of a run."""

    def __init__(self, run: Run) -> None:
        self.run, self.schedule, self.cell = run, run.schedule, run.cell
        self.observer, self.injector, self.demand = run.observer, run.injector, run.demand
        self.error, self.ended_early, self.folder = run.error, run.ended_early, run.folder

    def _dead(self, arm: int) -> bool:
        """Return True if the emulation of an arm has ended: its state is not known."""
        return any(
            fault.kind == "death" and fault.process in ("controllers", f"{ARMS[arm]} controller")
            for fault in self.schedule.faults
        )

    def check(self) -> None:
        """Check them all, and move the arms again where the schedule asks for it."""
        self._wait_for_rest()
        for number, episode in enumerate(self.observer.episodes):
            TargetChecks(self.run, episode, number).all()
        self._check_processes()
        self._check_latch()
        self._check_record()
        if self.schedule.cell.again:
            self._again()

    def _wait_for_rest(self) -> None:
        known_s = min([each.known_s for each in self.observer.episodes], default=math.inf)
        if known_s == math.inf:
            return
        end_s = max(known_s + END_S, self.cell.now_s + 0.5) + slack_s(self.schedule)
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
        before = self.run.traffic(), [self._position(arm) for arm in range(2)]
        self.cell.clock.sleep(0.1)
        self.demand(self.run.traffic() == before[0], "something was sent after the stop")
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
            before = self.run.traffic()
            try:
                self.run.make().close()
            except (CellFaulted, RecordingError) as error:
                self.demand(
                    isinstance(error, RecordingError) or fault.split(".")[0][:40] in str(error),
                    f"the refusal of a start does not tell the fault {fault!r}: {error}",
                )
            else:
                self.demand(False, "a start was not refused after a latched stop")
            self.demand(self.run.traffic() == before, "a refused start sent something")
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
                # A step that waits for slow arms may be the last one: the program then never asks for the wrong action.
                asked = not any(each is fault for each in self.injector.policy)
                enough = enough and asked and not {"raise", "interrupt"} & set(policies)
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
        late = {fault.arm for fault in self.schedule.faults if fault.kind == "script_delay"}
        for number, arm in enumerate(ARMS):
            if self._is_played(number) or arm in late:
                # The operator's own program, or one that began after its client had given up.
                self.injector.ask(arm, "press", button="stop")
            for mode in {fault.mode for fault in self.schedule.faults if fault.kind == "safety"}:
                self.injector.ask(arm, "release", mode=mode)
            for button in ("power_on", "release_brakes"):
                self.injector.ask(arm, "press", button=button)
        self.cell.clock.sleep(2.0)
        self.observer.on_stop = lambda: None
        if self.cell.fault:
            self.cell.clear()
        try:
            self.run.env = self.run.make()
        except DualUR10Error as error:
            serious = any(each.kind == "safety" and each.mode in (8, 9) for each in self.schedule.faults)
            self.demand(serious, f"the cell does not start again after all faults were removed: {error}")
            return
        self.run.env.reset(seed=self.schedule.cell.seed)
        for _ in range(3):
            self.run.env.step(np.zeros(self.run.env.action_space.shape, dtype=np.float32))
        self.run.keep_limits()
        self.run.env.close()
        self.demand(not self.cell.fault, f"latched again after all faults were removed: {self.cell.fault}")
        TargetChecks(self.run, self.observer.episodes[-1], len(self.observer.episodes) - 1).all()


def _runtime(controller: Any) -> int:
    """Return the runtime state itself, whatever is reported."""
    return int(controller.program.state)
