"""URScript programs that follow points from RTDE registers, and the registers' meaning.

Each arm's controller runs one of them, uploaded like any client's program. A point is a position of all joints, their
speeds and a time on the path. The program for points interpolates cubics between them, a target of `servoj` in every
control period, on a path time of its own that a factor from the sender steers by half a part in a thousand. It trusts
no sender: it stops the arm by itself, by `stopj`, if the next point has not come when it reaches the last one, if a
point was skipped, or if a target is farther from the one before than the largest joint speed allows. That for moves
rests at each point in any case.
"""

from __future__ import annotations

from enum import IntEnum
from typing import Final

from ur_core.servoj import ServojProfile

FIRST: Final = 24
"""First register of each kind: UR's RTDE guide leaves those from 24 on to RTDE clients."""

RATE_BAND: Final = 5e-4
"""Largest part by which the path time may be slower than the controller's clock. It is never faster."""

WAIT_S: Final = 20.0
"""Longest wait of a program for its start: the other arm's program may start slowly."""

NOMINAL_RATE: Final = 1.0 - RATE_BAND / 2
"""Rate of the path time that leaves room for corrections: neither controller is faster than what was checked."""

FAR_RAD: Final = 0.01
"""Largest distance of the first point from where the arm stands, as in UR's own follower for slow links."""

STOP_RAD_S2: Final = 4.0
"""Deceleration of a stop: that of the runner's stop ramp."""

MOVE_PART: Final = 0.9
"""Part of an interval that a fixed-time `movej` takes, so that it has ended before the next one begins."""

_SETTLE_S: Final = 0.2  # hold at the last point, several times the lag of the law

INPUTS: Final = (
    *(f"input_int_register_{FIRST + k}" for k in range(4)),
    *(f"input_double_register_{FIRST + k}" for k in range(15)),
)
"""Command, number of the point, that of the last one, token; positions, speeds, time, rate, shift of the path time."""

STATE: Final = f"output_int_register_{FIRST}"
NUMBER: Final = f"output_int_register_{FIRST + 1}"
TOKEN: Final = f"output_int_register_{FIRST + 2}"
PATH_TIME: Final = f"output_double_register_{FIRST}"
OUTPUTS: Final = (STATE, NUMBER, TOKEN, PATH_TIME)


class ProgramCommand(IntEnum):
    """Commands to a program."""

    WAIT = 0
    RUN = 2
    STOP = 3


class State(IntEnum):
    """States of a program. Those from FINISHED on are final: the arm rests, or slows down to rest."""

    WAITING = 1
    MOVING = 2
    FINISHED = 3
    STARVED = 4
    JUMP = 5
    GAP = 6
    STOPPED = 7
    START = 8


REASONS: Final = {
    State.STARVED: "no point came in time, so that its program stopped it",
    State.JUMP: "a target was farther from the one before than the largest joint speed allows",
    State.GAP: "a point was skipped on the way",
    State.STOPPED: "its program was stopped on request",
    State.START: f"the first point is more than {FAR_RAD:g} rad from where it stands",
}
"""Descriptions of the final states but FINISHED, of an arm."""

_READ: Final = f"""
    if state == {State.WAITING:d}:
      waited = waited + 1
      if waited > @wait@:
        state = {State.STARVED:d}
      end
    end
    if read_input_integer_register({FIRST + 3}) == token:
      command = read_input_integer_register({FIRST})
      number = read_input_integer_register({FIRST + 1})
      last = read_input_integer_register({FIRST + 2})
      if command == {ProgramCommand.STOP:d}:
        state = {State.STOPPED:d}
      elif number != accepted:
        j = 0
        while j < 6:
          q2[j] = read_input_float_register({FIRST} + j)
          v2[j] = read_input_float_register({FIRST + 6} + j)
          j = j + 1
        end
        t2 = read_input_float_register({FIRST + 12})
        fresh = True
      end
    end"""

_WRITE: Final = f"""
    write_output_float_register({FIRST}, t)
    write_output_integer_register({FIRST + 1}, accepted)
    write_output_integer_register({FIRST}, state)"""

_BEGIN: Final = f"""
  state = {State.WAITING:d}
  waited = 0
  command = 0
  number = 0
  last = 0
  accepted = 0
  fresh = False
  t = 0.0
  t2 = 0.0
  q2 = [0.0, 0.0, 0.0, 0.0, 0.0, 0.0]
  v2 = [0.0, 0.0, 0.0, 0.0, 0.0, 0.0]
  write_output_integer_register({FIRST}, state)
  write_output_integer_register({FIRST + 1}, 0)
  write_output_float_register({FIRST}, 0.0)
  write_output_integer_register({FIRST + 2}, token)"""

_POINTS: Final = f"""def dual_ur10_points():
  token = @token@
  tick = @tick@
  most = @most@{_BEGIN}
  t0 = 0.0
  t1 = 0.0
  q0 = get_actual_joint_positions()
  q1 = q0
  sent = q0
  target = [0.0, 0.0, 0.0, 0.0, 0.0, 0.0]
  v0 = [0.0, 0.0, 0.0, 0.0, 0.0, 0.0]
  v1 = v0
  pending = False
  played = 2
  shifted = 0.0
  settle = @settle@
  while state < {State.FINISHED:d}:{_READ}
    if fresh:
      fresh = False
      if number != accepted + 1 or pending:
        state = {State.GAP:d}
      elif number == 1:
        q0 = q2
        v0 = v2
        t0 = t2
        t = t2
        sent = q2
        here = get_actual_joint_positions()
        j = 0
        while j < 6:
          if norm(q2[j] - here[j]) > {FAR_RAD}:
            state = {State.START:d}
          end
          j = j + 1
        end
      elif number == 2:
        q1 = q2
        v1 = v2
        t1 = t2
      else:
        pending = True
      end
      accepted = number
    end
    if state == {State.WAITING:d} and command == {ProgramCommand.RUN:d} and accepted > 1:
      state = {State.MOVING:d}
    end
    if state == {State.MOVING:d}:
      rate = read_input_float_register({FIRST + 13})
      if rate < {1.0 - RATE_BAND}:
        rate = {1.0 - RATE_BAND}
      elif rate > 1.0:
        rate = 1.0
      end
      t = t + tick * rate
      if played == 2:
        # The arm rests during the first interval: only there may the path time jump.
        shift = read_input_float_register({FIRST + 14})
        if t + shift - shifted > t0 and t + shift - shifted < t1:
          t = t + shift - shifted
          shifted = shift
        end
      end
      if t >= t1 and pending:
        q0 = q1
        v0 = v1
        t0 = t1
        q1 = q2
        v1 = v2
        t1 = t2
        pending = False
        played = played + 1
      end
      if t >= t1:
        if played == last:
          t = t1
          settle = settle - 1
          if settle < 0:
            state = {State.FINISHED:d}
          end
        else:
          state = {State.STARVED:d}
        end
      end
    end
    if state == {State.MOVING:d}:
      h = t1 - t0
      s = (t - t0) / h
      a = 1 + s * s * (2 * s - 3)
      b = s * (1 - s) * (1 - s) * h
      c = s * s * (3 - 2 * s)
      d = s * s * (s - 1) * h
      j = 0
      while j < 6:
        target[j] = a * q0[j] + b * v0[j] + c * q1[j] + d * v1[j]
        if norm(target[j] - sent[j]) > most:
          state = {State.JUMP:d}
        end
        j = j + 1
      end
    end{_WRITE}
    if state == {State.MOVING:d}:
      sent = target
      servoj(sent, t=tick, lookahead_time=@lookahead@, gain=@gain@)
    else:
      sync()
    end
  end
  stopj({STOP_RAD_S2})
end
"""

_MOVES: Final = f"""def dual_ur10_moves():
  token = @token@
  speed = @speed@{_BEGIN}
  global moving = False
  global goal = get_actual_joint_positions()
  global span = 1.0
  thread dual_ur10_move():
    movej(goal, t=span)
    moving = False
  end
  mover = 0
  idle = 0
  while state < {State.FINISHED:d}:{_READ}
    if fresh and not moving and command == {ProgramCommand.RUN:d}:
      fresh = False
      if number != accepted + 1:
        state = {State.GAP:d}
      else:
        j = 0
        while j < 6:
          if norm(q2[j] - goal[j]) > speed * t2:
            state = {State.JUMP:d}
            if number == 1:
              state = {State.START:d}
            end
          end
          j = j + 1
        end
        accepted = number
      end
      if state < {State.FINISHED:d}:
        state = {State.MOVING:d}
        t = t + t2
        goal = q2
        span = t2
        moving = True
        idle = 0
        mover = run dual_ur10_move()
      end
    end
    fresh = False
    if state == {State.MOVING:d} and not moving:
      idle = idle + 1
      if accepted == last:
        state = {State.FINISHED:d}
      elif idle > @patience@:
        state = {State.STARVED:d}
      end
    end{_WRITE}
    sync()
  end
  if moving:
    kill mover
  end
  stopj({STOP_RAD_S2})
end
"""


def points_script(token: int, servoj: ServojProfile, speed_rad_s: float) -> str:
    """Return the program that interpolates points.

    Args:
        token: Number that the sender repeats in a register: what an earlier sender left there has no effect.
        servoj: Family of the controller and settings of `servoj`.
        speed_rad_s: Largest speed of a joint's targets.
    """
    tick_s = servoj.tick_s
    return _filled(
        _POINTS,
        token=token,
        tick=tick_s,
        most=speed_rad_s * tick_s,
        wait=round(WAIT_S / tick_s),
        settle=round(_SETTLE_S / tick_s),
        lookahead=servoj.lookahead_s,
        gain=servoj.gain,
    )


def moves_script(token: int, servoj: ServojProfile, speed_rad_s: float, interval_s: float) -> str:
    """Return the program that moves from point to point in a fixed time; see `points_script`.

    Args:
        token: See `points_script`.
        servoj: Family of the controller.
        speed_rad_s: Largest mean speed of a joint between two points.
        interval_s: Time between two points. The program ends when it rests for twice as long without another one.
    """
    wait, patience = (round(each / servoj.tick_s) for each in (WAIT_S, 2.0 * interval_s))
    return _filled(_MOVES, token=token, speed=speed_rad_s, wait=wait, patience=patience)


def _filled(text: str, **values: float) -> str:
    for name, value in values.items():
        text = text.replace(f"@{name}@", str(value) if isinstance(value, int) else f"{value:.9f}")
    return text
