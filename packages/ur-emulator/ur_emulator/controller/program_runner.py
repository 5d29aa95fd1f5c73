"""Program of one controller: it is loaded, plays, pauses and stops, and sets the time scaling of the motion."""

from __future__ import annotations

import logging
from collections.abc import Callable

from ur_core.errors import OperationRefusedError, ScriptError, ScriptRuntimeError
from ur_core.protocol.modes import RuntimeState
from ur_core.protocol.primary_messages import PROGRAM_STARTED, PROGRAM_STOPPED
from ur_emulator.controller.safety import Demand
from ur_emulator.motion import MotionGenerator
from ur_emulator.profile import ControllerProfile
from ur_emulator.script import Builtins, Machine, Program, read

log = logging.getLogger(__name__)

SLIDER_S = 0.25
"""Time in which the speed follows the slider over its whole range. A choice of this project, so that no speed jumps."""

_SECONDARY = 8  # concurrent secondary programs

_PLAYS = (RuntimeState.PLAYING, RuntimeState.RESUMING)


class ProgramRunner:
    """Runner of one controller's main and secondary programs.

    Args:
        profile: Profile of the controller.
        motion: The arm's reference motion, which ends with the program.
        builtins: Functions that programs may call, by name.
        failed: Callback for every program that was refused or stopped by an error.
        announce: Callback for start and end of main programs: the title of the key message, and the program's name.
        ended: Callback for the end of programs.

    Attributes:
        state: RTDE's `runtime_state`.
        name: Name of the program that plays or played last, or "".
        scaling: Time scaling of the motion in this tick, 0 to 1.
        machine: The program that plays, or None.
        last: Program that `play` starts: the one that was loaded or played last, or None.
        stopped_by: Reason for which the last program was stopped, or "" if it ended by itself.
    """

    def __init__(
        self,
        profile: ControllerProfile,
        motion: MotionGenerator,
        builtins: Builtins,
        failed: Callable[[ScriptError], None],
        announce: Callable[[str, str], None],
        ended: Callable[[], None],
    ) -> None:
        self.profile, self.motion, self.builtins = profile, motion, builtins
        self._failed, self._announce, self._ended = failed, announce, ended
        self.state = RuntimeState.STOPPED
        self.name = ""
        self.scaling = 1.0
        self.machine: Machine | None = None
        self._secondary: list[Machine] = []
        self.last: Program | None = None
        self.stopped_by = ""
        self._paused_by_safety = False
        self._demand = Demand.NONE
        self._unstarted = False

    @property
    def running(self) -> Machine | None:
        """Machine, of the main or a secondary program, one of whose threads runs now; None between control periods."""
        machines = self._secondary if self.machine is None else [self.machine, *self._secondary]
        return next((each for each in machines if each.thread is not None), None)

    def load(self, text: str, found: Program | ScriptError | None = None) -> None:
        """Play a program in place of the present one, or a secondary program beside it.

        An invalid program is refused as a controller does: the present program ends all the same.

        Args:
            text: Text of the program.
            found: Result of parsing it, if it has been parsed already.
        """
        program = read(text, self.builtins) if found is None else found
        if isinstance(program, ScriptError):
            if not text.lstrip().startswith("sec "):
                self.stop("an invalid program took its place")
            self._failed(program)
        elif program.is_secondary:
            self._start_secondary(program)
        else:
            self.start(program)

    def start(self, program: Program) -> None:
        """Play a program in place of the present one."""
        if self._unstarted and self._demand is Demand.NONE:
            self._run()  # two programs in one control period: keep the immediate effects of the first
        self.stop("another program took its place")
        if self._demand is not Demand.NONE:
            self._failed(ScriptRuntimeError(1, program.name, "not started: the arm is stopped or has no power"))
            return
        self.last, self.name, self.stopped_by = program, program.name, ""
        self.machine, self._unstarted = self._started(program), True
        self.state = RuntimeState.PLAYING
        self._announce(PROGRAM_STARTED, program.name)

    def _start_secondary(self, program: Program) -> None:
        if self._demand is Demand.STOP:
            self._failed(ScriptRuntimeError(1, program.name, "not started: the arm is stopped or has no power"))
        elif len(self._secondary) >= _SECONDARY:
            self._failed(
                ScriptRuntimeError(1, program.name, f"not started: {_SECONDARY} secondary programs run already")
            )
        else:
            self._secondary.append(self._started(program))

    def _started(self, program: Program) -> Machine:
        steps = self.profile.assumptions.infinite_loop_steps
        return Machine(program, self.builtins, steps_per_tick=steps)

    def prepare(self, program: Program) -> None:
        """Prepare a program for `play`."""
        self.stop("another program was loaded")
        self.last, self.name = program, program.name

    def play(self) -> None:
        """Resume after a pause, or restart the program that was loaded or played last. A playing program goes on.

        Raises:
            OperationRefusedError: There is no program.
        """
        if self.state in (RuntimeState.PAUSED, RuntimeState.PAUSING):
            self.state, self._paused_by_safety = RuntimeState.RESUMING, False
        elif self.state in _PLAYS:
            return
        elif self.last is None:
            raise OperationRefusedError("no program is loaded")
        else:
            self.start(self.last)

    def pause(self) -> None:
        """Stop on the path until `play`, whatever paused the program before.

        Raises:
            OperationRefusedError: No program plays.
        """
        if self.machine is None:
            raise OperationRefusedError("no program plays")
        self._paused_by_safety = False
        self._pause()

    def _pause(self) -> None:
        if self.state in _PLAYS:
            self.state = RuntimeState.PAUSING

    def stop(self, reason: str) -> None:
        """End the program and stop the arm."""
        if self.machine is not None:
            log.info("program %s ends: %s", self.name, reason)
            self.machine.kill()
            self._announce(PROGRAM_STOPPED, self.machine.program.name)
            self.machine, self.stopped_by = None, reason
            self._ended()
            self._brake()
            self.state = RuntimeState.STOPPING
        self._paused_by_safety = False

    def _brake(self) -> None:
        """Brake from the present speed."""
        if self.scaling == 0.0:
            self.motion.hold()  # paused: the rest of its path is given up
        elif self._demand is Demand.NONE:
            self.motion.halt(self.scaling)
            self.scaling = 1.0  # from here on, time is not scaled
        else:
            self.motion.halt()  # the safety stop in progress goes on reducing the time scaling, too

    def tick(self, demand: Demand, *, may_move: bool, resumes: bool, slider: float) -> None:
        """Advance by one control period: run the program and update the time scaling.

        Args:
            demand: Demand of the safety state.
            may_move: Whether the arm may move at all.
            resumes: Whether a program paused by safety resumes once no pause is demanded.
            slider: Target of the time scaling, 0 to 1.
        """
        self._demand = demand
        if demand is Demand.STOP:
            self.stop("the controller's safety state ended it")
            self._end_secondary()
        elif demand is Demand.PAUSE and self.state in _PLAYS:
            self._pause()
            self._paused_by_safety = resumes
        elif demand is Demand.PAUSE and not resumes:
            self._paused_by_safety = False
        elif demand is Demand.NONE and self._paused_by_safety and self.state == RuntimeState.PAUSED:
            self.play()
        if self.state in _PLAYS:
            self._run()
        self._run_secondary()
        self._update_scaling(demand, may_move, slider)

    def _run(self) -> None:
        machine, self._unstarted = self.machine, False
        if machine is None:
            return
        try:
            machine.tick()
        except ScriptError as error:
            self._failed(error)
            self.stop("an error")
            return
        if machine.finished and self.machine is machine:
            self.stop("it has finished")

    def _run_secondary(self) -> None:
        for machine in list(self._secondary):
            try:
                machine.tick()
            except ScriptError as error:
                machine.kill()
                self._failed(error)
            if machine.finished:
                self._secondary.remove(machine)
                if self.machine is None:
                    self._ended()

    def _end_secondary(self) -> None:
        for machine in self._secondary:
            machine.kill()
        self._secondary.clear()

    def _update_scaling(self, demand: Demand, may_move: bool, slider: float) -> None:
        tick_s = self.profile.tick_s
        if self.state == RuntimeState.STOPPING:
            # The brake ignores the slider. A safety stop takes no longer than any other.
            if demand is not Demand.NONE:
                self.scaling = max(0.0, self.scaling - tick_s / self.profile.assumptions.stopping_s)
            if self.scaling == 0.0 or not self.motion.moving:
                self.state = RuntimeState.STOPPED
                self.motion.hold()
            return
        halts = self.state in (RuntimeState.PAUSING, RuntimeState.PAUSED) or demand is not Demand.NONE
        goal = 0.0 if halts else slider
        step = tick_s / (self.profile.assumptions.stopping_s if halts else SLIDER_S)
        self.scaling = max(goal, self.scaling - step) if self.scaling > goal else min(goal, self.scaling + step)
        if self.state == RuntimeState.PAUSING and self.scaling == 0.0:
            self.state = RuntimeState.PAUSED
        elif self.state == RuntimeState.RESUMING and self.scaling == goal:
            self.state = RuntimeState.PLAYING
        if self.state == RuntimeState.STOPPED and not may_move:
            self.motion.hold()
