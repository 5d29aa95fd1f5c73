"""Program files of the emulated controllers: a folder of scripts, as PolyScope saves one beside each program.

The folder is read and its programs are parsed once, when the cell starts: neither may delay a control period.
"""

from __future__ import annotations

import logging
from collections.abc import Mapping
from pathlib import Path
from typing import Final

from ur_core.errors import ScriptError, SettingsError
from ur_core.files import read_regular
from ur_emulator.script import Builtins, Program, read
from ur_emulator.script.splitter import PROGRAM_MAX

log = logging.getLogger(__name__)

FILES_MAX: Final = 100
"""Most scripts of a folder."""

_CHARACTER_BYTES: Final = 4  # the most that UTF-8 needs

ROOTS: Final = ("/programs/", "/ursim/programs/")
"""Folders of the programs on a controller and in URSim, by which clients may name a file."""


def script_texts(folder: str | Path) -> dict[str, str]:
    """Return the texts of all scripts in a folder and those in it, by path within the folder.

    Raises:
        SettingsError: There is no such folder, or a script in it cannot be read.
    """
    root, texts = Path(folder), {}
    if not root.is_dir():
        raise SettingsError(f"there is no folder {str(folder)!r}: name one with programs (NAME.script)")
    paths = sorted(root.rglob("*.script"))
    if len(paths) > FILES_MAX:
        raise SettingsError(f"{folder} has {len(paths)} scripts: at most {FILES_MAX} are served, name a smaller folder")
    for path in paths:
        try:
            text = read_regular(path, _CHARACTER_BYTES * PROGRAM_MAX).decode("utf-8")
        except (OSError, UnicodeDecodeError) as error:
            raise SettingsError(f"the program {path} cannot be read: {error}") from error
        if len(text) > PROGRAM_MAX:
            raise SettingsError(f"the program {path} has {len(text)} characters: at most {PROGRAM_MAX} are allowed")
        texts[path.relative_to(root).as_posix()] = text
    return texts


class ProgramFiles:
    """Parsed programs of one controller.

    Args:
        texts: Texts by path; see `script_texts`.
        builtins: Functions that the programs may call.
    """

    def __init__(self, texts: Mapping[str, str], builtins: Builtins) -> None:
        self._programs: dict[str, Program | ScriptError] = {}
        for name, text in texts.items():
            program = read(text, builtins)
            if isinstance(program, ScriptError):
                log.warning("program %s cannot be loaded: %s", name, program)
            self._programs[name] = program

    @property
    def names(self) -> tuple[str, ...]:
        """Paths of the scripts."""
        return tuple(self._programs)

    def find(self, name: str) -> Program | ScriptError | None:
        """Return the program of a file name, or its error; None: there is no such file.

        `NAME.urp` has the program of `NAME.script`: the script is what PolyScope makes of its program.
        """
        for root in ROOTS:
            name = name.removeprefix(root)
        if name.endswith(".urp"):
            name = name.removesuffix(".urp") + ".script"
        return self._programs.get(name)
