"""Hand guiding: arms of a cell in freedrive, watched while a person moves them.

Each guided arm runs a program of ours, see `freedrive_script`. This program only reads states and shows signs of life.
If either arm faults, or moves faster than a person should guide it, freedrive ends on both: they become stiff where
they are. If this program dies or the line is silent, each controller ends freedrive by itself.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import Any, Final, NamedTuple

import numpy as np

from dual_ur10.errors import DualUR10Error, LinkError, StartError, UnknownNameError
from dual_ur10.sim2real.cell_file.cell_file import CellFile
from dual_ur10.sim2real.commissioning.findings import REST_RAD_S
from dual_ur10.sim2real.commissioning.operator_prompts import Confirm
from dual_ur10.sim2real.control.limits import MotionLimits
from dual_ur10.sim2real.programs.program_link import MotionObserver, ProgramLink, ProgrammedArms, check_ended
from dual_ur10.sim2real.programs.stream_script import FIRST, STATE, STOP_RAD_S2, TOKEN, WAIT_S, ProgramCommand, State
from ur_core.kinematics.ur10 import ARMS, JOINTS, TICK_S, Family
from ur_core.links.arm_status import ArmStatus, stop_reason
from ur_core.processes.system import LOCAL, System
from ur_core.types import Array

STATES_HZ: Final = 62.5
"""Rate of the states: every second one of a CB3, every eighth one of an e-Series."""

FASTEST_M_S: Final = 0.5
"""Speed of a TCP above which freedrive ends: twice the reduced speed of ISO 10218-1."""

FASTEST_RAD_S: Final = 1.0
"""Speed of a joint above which freedrive ends: twice that of a first run."""

NEAR_M: Final = 0.02
"""Distance of two bodies, beyond the smallest allowed one, from which a warning is due: chosen."""

NEAR_RAD: Final = 0.1
"""Distance of a joint from the end of its range from which a warning is due: chosen."""

_BEAT_S: Final = 0.05
_STALE_S: Final = 0.2  # oldest state of a controller
_MOST_TRIP_S: Final = 0.1


SILENCE_S: Final = 0.5
"""Longest time without a sign of life in freedrive. A disk or a busy machine may stall for a part of it."""

FREEDRIVE_REASONS: Final = {
    State.STARVED: f"no sign of life came for {SILENCE_S:g} s, so that its program ended freedrive",
    State.STOPPED: "its program was stopped on request",
}
"""Descriptions of the final states, of an arm."""

# `freedrive_mode` without arguments, in all axes, is in UR's script manuals of CB3 and e-Series alike.
_FREEDRIVE: Final = f"""def dual_ur10_freedrive():
  token = @token@
  state = {State.WAITING:d}
  command = {ProgramCommand.WAIT:d}
  number = 0
  seen = 0
  silent = 0
  patience = @wait@
  write_output_integer_register({FIRST}, state)
  write_output_integer_register({FIRST + 1}, 0)
  write_output_integer_register({FIRST + 2}, token)
  while state < {State.FINISHED:d}:
    silent = silent + 1
    if read_input_integer_register({FIRST + 3}) == token:
      command = read_input_integer_register({FIRST})
      number = read_input_integer_register({FIRST + 1})
      if number != seen:
        seen = number
        silent = 0
      end
    end
    if command == {ProgramCommand.STOP:d}:
      state = {State.STOPPED:d}
    elif silent > patience:
      state = {State.STARVED:d}
    elif state == {State.WAITING:d} and command == {ProgramCommand.RUN:d}:
      freedrive_mode()
      silent = 0
      patience = @patience@
      state = {State.MOVING:d}
    end
    write_output_integer_register({FIRST + 1}, seen)
    write_output_integer_register({FIRST}, state)
    sync()
  end
  end_freedrive_mode()
  stopj({STOP_RAD_S2})
end
"""


def freedrive_script(token: int, family: Family) -> str:
    """Return the URScript program that makes an arm free to be moved by hand.

    It uses the registers of `stream_script`: command, number, token, state. Each new number is a sign of life. Without
    one for `SILENCE_S`, on a stop command, and when the program ends for any other reason, freedrive ends and the arm
    stands.

    Args:
        token: Number that the client repeats in a register: what an earlier one left there has no effect.
        family: Family of the controller.
    """
    text = _FREEDRIVE.replace("@token@", str(token))
    for name, duration_s in (("@wait@", WAIT_S), ("@patience@", SILENCE_S)):
        text = text.replace(name, str(round(duration_s / TICK_S[family])))
    return text


class Guided(NamedTuple):
    """State of both arms while they are guided.

    Attributes:
        time_s: Time on this program's clock.
        q_rad: (2, 6) measured joint positions.
        qd_rad_s: (2, 6) measured joint speeds.
        warnings: Joints near the end of their range, bodies near each other.
        refusal: Reason why a trajectory cannot have a point here; "": it can.
    """

    time_s: float
    q_rad: Array
    qd_rad_s: Array
    warnings: tuple[str, ...]
    refusal: str


class HandGuiding(ProgrammedArms):
    """Arms that a person guides. Construction connects and checks; it makes no arm free.

    Args:
        file: Cell file.
        arms: Arms to guide; the other one stands, and is watched.
        confirm: Called with a description before arms become free; None: real arms need a yes at the terminal, emulated
            ones none.
        observer: See `ProgrammedArms`.
        system: Clock, network and state folder.

    Raises:
        UnknownNameError: There is no such arm.
        CellFaulted: See `ProgrammedArms`.
        CellBusyError: See `ProgrammedArms`.
        StartError: See `ProgrammedArms`.
        LinkError: See `ProgrammedArms`.
    """

    def __init__(
        self,
        file: CellFile,
        arms: Sequence[str] = ARMS,
        *,
        confirm: Confirm | None = None,
        observer: MotionObserver | None = None,
        system: System = LOCAL,
    ) -> None:
        for arm in arms:
            if arm not in ARMS:
                raise UnknownNameError("arm", arm, ARMS)
        config = file.config()
        limits = config.capped(MotionLimits())
        self._lower, self._upper = np.array(limits.lower_rad), np.array(limits.upper_rad)
        self._families = {name: entry.family for name, entry in zip(ARMS, file.arms, strict=True)}
        self._beat_s = -math.inf
        super().__init__(file, STATES_HZ, _MOST_TRIP_S, confirm=confirm, observer=observer, system=system)
        self._guided = [arm for arm in self._arms if arm.name in arms]

    def run(self, seen: Callable[[Guided], bool]) -> None:
        """Make the arms free until `seen` returns False, and stiff again.

        Args:
            seen: Called with each state of both arms, and within `SILENCE_S` of the last call; its exceptions end
                freedrive and pass through.

        Raises:
            StartError: An arm is not ready, or freedrive was not confirmed. No arm was free.
            CellFaulted: An arm faulted, was too fast, or did not end freedrive, which is latched.
        """
        self._claim.latch.check()
        self._measured()
        if self._confirm(self._question()) is not True:
            raise StartError("freedrive was not confirmed: no arm was free")
        self._measured()  # the answer may have taken minutes
        self._claim.note_moving()
        begun = False
        try:
            token = round(1e3 * self._clock.now_s()) % 2**30
            for number, arm in enumerate(self._guided):
                arm.upload(freedrive_script(token + number, self._families[arm.name]), token + number)
            begun = True
            for arm in self._guided:
                arm.values["command"] = ProgramCommand.RUN
                arm.send()
            while seen(self._next()):
                pass
            check_ended(self._stop(self._guided))
        except (Exception, KeyboardInterrupt, SystemExit) as error:
            unseen = self._stop(self._guided)
            if isinstance(error, StartError) and not begun:
                self._claim.note_stopped()  # a program that was not told to makes no arm free
                raise
            if not (unseen or isinstance(error, LinkError)):
                raise
            faulted = self._latched(error)
            if not isinstance(error, DualUR10Error):
                raise
            raise faulted from error

    def _question(self) -> str:
        """Return the question to the person who guides. A check has compared payloads with the cell file."""
        payloads = []
        for arm in self._guided:
            status = arm.next_status()
            mass, cog = status.payload_kg, status.payload_cog_m
            if mass is None or cog is None:
                payloads.append(f"{arm.name} not reported: check it at the pendant")
            else:
                at = ", ".join(f"{1e3 * each:.0f}" for each in cog)
                payloads.append(f"{arm.name} {mass:.2f} kg at ({at}) mm")
        names = " and ".join(arm.name for arm in self._guided)
        return (
            f"Freedrive of {names}: whoever pushes an arm moves it. Payloads that are set: {'; '.join(payloads)}. With "
            "a wrong one an arm rises or sinks by itself. See that both arms are free to move, hold those that become "
            "free, keep others away, and have an emergency stop in reach."
        )

    def _next(self) -> Guided:
        """Wait for new states of both arms, with signs of life meanwhile.

        Raises:
            LinkError: Freedrive must end.
        """
        counts = [arm.link.count for arm in self._arms]
        while any(arm.link.count <= count for arm, count in zip(self._arms, counts, strict=True)):
            self._show_life()
            now_s = self._clock.now_s()
            self._clock.wait([arm.link.fileno() for arm in self._arms], now_s + _BEAT_S)
            for arm in self._arms:
                arm.poll()
                if arm.link.age_s(self._clock.now_s()) > _STALE_S:
                    raise LinkError(f"{arm.name}: its controller has fallen silent: check the link")
        statuses = [self._checked(arm) for arm in self._arms]
        q = np.array([each.q_rad for each in statuses])
        warnings, refusal = self._near(q)
        return Guided(self._clock.now_s(), q, np.array([each.qd_rad_s for each in statuses]), warnings, refusal)

    def _show_life(self) -> None:
        now_s = self._clock.now_s()
        if now_s >= self._beat_s + _BEAT_S:
            self._beat_s = now_s
            for arm in self._guided:
                arm.values["number"] = (int(arm.values["number"]) + 1) % 2**30
                arm.send()

    def _checked(self, arm: ProgramLink) -> ArmStatus:
        """Return the status of an arm.

        Raises:
            LinkError: Freedrive must end.
        """
        sample = arm.link.latest
        if sample is None:
            raise LinkError(f"{arm.name}: its controller sends no state: check the link")
        values: Any = sample.values
        status = ArmStatus.from_sample(sample)
        if arm in self._guided:
            final = FREEDRIVE_REASONS.get(values[STATE])
            reason = stop_reason(status, playing=values[STATE] < State.FINISHED) or final or _too_fast(status)
            if values[TOKEN] != arm.token:
                reason = "another program runs on its controller"
        else:
            reason = stop_reason(status, playing=False)
            if reason is None and not max(map(abs, status.qd_rad_s)) < REST_RAD_S:
                reason = "it moves, and is not the arm that is guided"
        if reason is not None:
            raise LinkError(f"{arm.name}: {reason}")
        return status

    def _near(self, q_rad: Array) -> tuple[tuple[str, ...], str]:
        """Return the warnings at positions (2, 6), and the refusal or ""."""
        warnings, refusal = [], ""
        room = np.minimum(q_rad - self._lower, self._upper - q_rad)
        for arm, joint in np.argwhere(room < NEAR_RAD).tolist():
            text = f"{ARMS[arm]}/{JOINTS[joint]} and the end of its range are {room[arm, joint]:.3f} rad apart"
            warnings.append(text)
            if room[arm, joint] <= 0.0:
                refusal = text
        (distances,), (allowed,) = self._clearance.measure(q_rad.reshape(1, 12))
        for pair in np.flatnonzero(distances < allowed + NEAR_M):
            text = f"{' and '.join(self._clearance.pairs[pair])} are {1e3 * distances[pair]:.0f} mm apart, allowed are "
            text += f"{1e3 * allowed[pair]:.0f} mm"
            warnings.append(text)
            if distances[pair] < allowed[pair]:
                refusal = text
        return tuple(warnings), refusal


def _too_fast(status: ArmStatus) -> str | None:
    speed, joint = math.hypot(*status.tcp_speed[:3]), max(map(abs, status.qd_rad_s))
    if speed <= FASTEST_M_S and joint <= FASTEST_RAD_S:  # NaN is too fast
        return None
    return (
        f"it moves at {speed:.2f} m/s and {joint:.2f} rad/s, allowed in freedrive are {FASTEST_M_S:g} m/s and "
        f"{FASTEST_RAD_S:g} rad/s: guide it slowly, and check its payload"
    )
