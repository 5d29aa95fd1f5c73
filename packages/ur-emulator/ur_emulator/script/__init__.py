"""URScript interpreter: parse, check and run programs of UR controllers, one control period at a time.

It knows of no arm: the functions that move or read one come from outside.
"""

from ur_emulator.script.compiled import Program, parse, read
from ur_emulator.script.library import library
from ur_emulator.script.machine import Machine, ScriptThread
from ur_emulator.script.splitter import Splitter
from ur_emulator.script.values import Builtins, Pose, VersionBuiltins, text

__all__ = [
    "Builtins",
    "Machine",
    "Pose",
    "Program",
    "ScriptThread",
    "Splitter",
    "VersionBuiltins",
    "library",
    "parse",
    "read",
    "text",
]
