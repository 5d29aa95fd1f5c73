"""The command `teach`."""

from __future__ import annotations

import os
import sys
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer
from rich.markup import escape

from dual_ur10.cli.options import PowerOn, console
from dual_ur10.cli.session import interrupts_noted, power_on
from dual_ur10.errors import UnknownNameError
from dual_ur10.sim2real.cell_file.cell_file import load_cell_file
from ur_core.kinematics.ur10 import ARMS
from ur_core.processes.system import LOCAL, System

if TYPE_CHECKING:
    from dual_ur10.sim2real.cell_file.cell_file import CellFile
    from dual_ur10.sim2real.teaching.teaching import TeachKey


def teach(
    file: Annotated[Path, typer.Argument(metavar="FILE", help="New CSV file of the points, for `follow --retime`.")],
    cell: Annotated[Path, typer.Option("--cell", metavar="FILE", help="A cell file: guide the arms of its cell.")],
    arm: Annotated[
        str | None, typer.Option("--arm", help="left or right: only this arm is guided, the other stands.")
    ] = None,
    continuous: Annotated[
        float | None,
        typer.Option("--continuous", metavar="RATE", help="Record the whole path, at up to so many rows per second."),
    ] = None,
    power: PowerOn = False,
) -> None:
    """Record points while you guide the arms by hand, in freedrive. Enter records a point; q and Enter, or Ctrl-C, end.

    A point is recorded while both arms rest. Freedrive ends on both arms when either faults or is moved too fast, when
    you end, and by itself half a second after this program or the link has fallen silent.
    """
    if arm is not None and arm not in ARMS:
        raise UnknownNameError("arm", arm, ARMS)
    if power:
        power_on(cell)
    with interrupts_noted() as interrupted:
        terminal = _TypedRequests(interrupted.is_set)
        count, refused = record(load_cell_file(cell), file, ARMS if arm is None else (arm,), terminal, continuous)
    if refused:
        console.print(f"[yellow]note:[/] `follow` will refuse {refused} of the points: teach it again", highlight=False)
    if count:
        more = f"python -m dual_ur10 follow {file} --cell {cell} --retime"
        console.print(f"{count} points are in {escape(str(file))}; {escape(more)}", highlight=False, soft_wrap=True)
    else:
        console.print("no point was recorded, and no file written", highlight=False)


def record(
    cell: CellFile,
    path: Path,
    arms: tuple[str, ...],
    keys: Callable[[], TeachKey | None],
    rate_hz: float | None = None,
    system: System = LOCAL,
) -> tuple[int, int]:
    """Record points, and return their number and that of points that `follow` will refuse.

    Raises:
        DualUR10Error: See `HandGuiding`, `PointRecorder` and `TaughtFile`.
    """
    from dual_ur10.sim2real.programs.program_box import ProgramBox
    from dual_ur10.sim2real.teaching.hand_guiding import HandGuiding
    from dual_ur10.sim2real.teaching.taught_file import TaughtFile
    from dual_ur10.sim2real.teaching.teaching import PointRecorder

    def say(text: str) -> None:
        console.print(escape(text), highlight=False, soft_wrap=True)

    with TaughtFile(path, arms, at_rest=rate_hz is None) as file:
        recorder = PointRecorder(file, arms, keys, say, rate_hz)
        box = ProgramBox(cell, "hand guiding", system=system)
        with HandGuiding(cell, arms, observer=box, system=system) as guiding:
            say(f"guide: {' and '.join(arms)}. " + ("Enter records, q ends" if rate_hz is None else "q ends"))
            guiding.run(recorder)
            say("the arms stand")
        return file.count, recorder.refused


class _TypedRequests:
    """Requests typed at the terminal, without waiting for them. The end of the input ends, as Ctrl-C does.

    Args:
        interrupted: Function that returns True after Ctrl-C.
    """

    def __init__(self, interrupted: Callable[[], bool]) -> None:
        self._interrupted, self._typed, self._ended = interrupted, b"", False

    def __call__(self) -> TeachKey | None:
        from dual_ur10.sim2real.teaching.teaching import TeachKey

        number = sys.stdin.fileno()
        while not self._ended and LOCAL.clock.wait((number,), 0.0)[0]:
            data = os.read(number, 4096)
            self._typed += data
            self._ended = not data
        line, newline, rest = self._typed.partition(b"\n")
        if self._interrupted() or (self._ended and not newline):
            return TeachKey.END
        if not newline:
            return None
        self._typed = rest
        return TeachKey.END if line.strip().lower() == b"q" else TeachKey.RECORD
