"""Run of one schedule on a virtual cell."""

from __future__ import annotations

import contextlib
import logging
import tempfile
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import gymnasium as gym

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
    VirtualCellError,
)
from dual_ur10.testing import VirtualCell
from tests.virtual.aftermath import Aftermath
from tests.virtual.injector import Injector, Interrupt, policy_of, wrong
from tests.virtual.observer import Observer
from tests.virtual.schedule import Schedule

BUDGET_S: Final = 60.0
"""Longest virtual time of a schedule. The longest waits are 15 s for a start, and timeouts of connections."""

_EXPECTED: Final = (CellFaulted, LinkError, StartError, CellBusyError, ClosedError, RecordingError)


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
                Aftermath(self).check()
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

    def make(self) -> Any:
        """Return a new environment on the cell."""
        self.starts += 1
        cell = self.schedule.cell
        record = {"record": self.folder, "record_failure": cell.record} if cell.record else {}
        return gym.make(f"DualUR10/{cell.task}-v0", cell=self.cell, disable_env_checker=True, **record)

    def _episode(self) -> None:
        """Make an environment, run an episode, and close it."""
        try:
            self.injector.enter("start")
            self.env = self.make()
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
            self.keep_limits()
            self.env.close()
            self.env.close()

    def keep_limits(self) -> None:
        """Note the limits of all episodes of the environment."""
        for each in self.observer.episodes:
            each.limits = each.limits or self.env.unwrapped.core.pipeline.gate.limits

    def _steps(self, observation: Any) -> None:
        policy = policy_of(self.schedule, self.env)
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
                    action = wrong(fault.how, action)
            if self.injector.second:
                self.injector.second = False
                self._second()
            observation, _, terminated, truncated, _ = self.env.step(action)
            if terminated or truncated:
                self.ended_early = True
                return

    def _second(self) -> None:
        try:
            self.make().close()
        except (CellBusyError, CellFaulted):
            return
        except RecordingError:
            return
        self.demand(False, "a second program got the arms that the first one moves")

    def _still_refused(self) -> None:
        if self.env is None:
            return
        before = self.traffic()
        for again in (lambda: self.env.step(self.env.action_space.sample() * 0), lambda: self.env.reset(seed=1)):
            try:
                again()
            except DualUR10Error:
                continue
            self.demand(False, "a stopped environment continued")
        self.demand(self.traffic() == before, "a stopped environment sent something when it was used again")

    def traffic(self) -> list[int]:
        """Return the numbers of motion packages and uploaded programs of both arms."""
        received = [self.observer.controller(arm).received for arm in range(2)]
        return [*(each.motion_count for each in received), *(each.uploads for each in received)]


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
