"""URScript program that makes an arm free to be moved by hand, for as long as its client shows signs of life.

It uses the registers of `stream_script`: command, number, token, state. Each new number is a sign of life. Without one
for `SILENCE_S`, on a stop command, and when the program ends for any other reason, freedrive ends and the arm stands.
"""

from __future__ import annotations

from typing import Final

from dual_ur10.kinematics.ur10 import TICK_S, Family
from dual_ur10.sim2real.runtime.stream_script import FIRST, STOP_RAD_S2, WAIT_S, Command, State

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
  command = {Command.WAIT:d}
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
    if command == {Command.STOP:d}:
      state = {State.STOPPED:d}
    elif silent > patience:
      state = {State.STARVED:d}
    elif state == {State.WAITING:d} and command == {Command.RUN:d}:
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
    """Return the program.

    Args:
        token: Number that the client repeats in a register: what an earlier one left there has no effect.
        family: Family of the controller.
    """
    text = _FREEDRIVE.replace("@token@", str(token))
    for name, duration_s in (("@wait@", WAIT_S), ("@patience@", SILENCE_S)):
        text = text.replace(name, str(round(duration_s / TICK_S[family])))
    return text
