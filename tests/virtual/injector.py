"""Faults of a schedule, injected into a virtual cell and its policy."""

from __future__ import annotations

import contextlib
import json
import math
from typing import Any

import numpy as np

from dual_ur10.errors import UnknownNameError
from dual_ur10.policies import load
from dual_ur10.testing import VirtualCell
from tests.virtual.observer import Observer
from tests.virtual.schedule import Schedule
from ur_core.kinematics.ur10 import ARMS


class Interrupt(BaseException):
    """Ctrl-C, or an exception of a policy."""


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
            self.ask(arm, do="heal")
            for button in ("power_on", "release_brakes"):
                self.ask(arm, do="press", button=button)

    def ask(self, arm: str, do: str, **values: Any) -> bool:
        """Ask the emulated cell for a fault; return True if it accepts."""
        emulator = self._cell.emulators[ARMS.index(arm)]
        answer = json.loads(emulator._injection.answer(json.dumps({"do": do, "arm": arm, **values})))
        return bool(answer["ok"])

    def _begin(self, fault: Any) -> Any:
        """Inject a fault; return the function that ends it."""
        ask, observer = self.ask, self._observer
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
            self.ask(fault.arm, "link", port=fault.port, **{fault.effect: amount})

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


def policy_of(schedule: Schedule, env: Any) -> Any:
    """Return the policy of a schedule."""
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


def wrong(how: str, action: Any) -> Any:
    """Return an action as a faulty policy would give it."""
    action = np.array(action)
    if how in ("nan", "inf"):
        action[2] = math.nan if how == "nan" else math.inf
        return action
    return {"shape": action[:-1], "text": "left", "huge": np.full_like(action, 1e30)}[how]
