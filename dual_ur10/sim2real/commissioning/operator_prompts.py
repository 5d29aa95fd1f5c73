"""Asks a person at the terminal before arms do something. No setting and no variable answers instead."""

from __future__ import annotations

import sys
import termios
from collections.abc import Callable

from dual_ur10.errors import StartError
from dual_ur10.sim2real.config.cell_file import CellFile

Confirm = Callable[[str], bool]


def confirmation(cell: CellFile, confirm: Confirm | None = None) -> Confirm:
    """Who is asked: `confirm`, if there is one; else nobody for an emulated cell, and somebody at the terminal."""
    if confirm is not None:
        return confirm
    return _nobody if cell.kind == "emulated" else at_terminal


def at_terminal(question: str) -> bool:
    """Whether somebody types yes.

    Raises:
        StartError: There is no terminal.
    """
    if not sys.stdin.isatty():
        raise StartError(
            f"somebody must confirm this, and there is no terminal; run it in one, or pass confirm=. {question}"
        )
    termios.tcflush(sys.stdin.fileno(), termios.TCIFLUSH)  # what was typed before is no answer
    try:
        return input(f"{question}\nType yes to go on: ").strip().lower() == "yes"
    except EOFError:
        return False


def _nobody(question: str) -> bool:
    return True
