"""Questions to the operator at the terminal before arms do something. No setting and no variable answers instead."""

from __future__ import annotations

import sys
import termios
from collections.abc import Callable

from dual_ur10.errors import StartError
from dual_ur10.sim2real.cell_file.cell_file import CellFile

Confirm = Callable[[str], bool]


def prompt_for(cell: CellFile, confirm: Confirm | None = None) -> Confirm:
    """Return `confirm` if there is one; else the terminal's prompt, or none for an emulated cell."""
    if confirm is not None:
        return confirm
    return (lambda question: True) if cell.kind == "emulated" else ask_at_terminal


def ask_at_terminal(question: str) -> bool:
    """Return True if the operator types yes.

    Raises:
        StartError: There is no terminal.
    """
    if not sys.stdin.isatty():
        raise StartError(
            f"somebody must confirm this, and there is no terminal; run it in one, or pass confirm=. {question}"
        )
    termios.tcflush(sys.stdin.fileno(), termios.TCIFLUSH)  # text typed before the question is no answer
    try:
        return input(f"{question}\nType yes to go on: ").strip().lower() == "yes"
    except EOFError:
        return False
