"""URScript interpreter: parse, check and run programs of UR controllers, one control period at a time."""

from dual_ur10.sim2real.emulator.script.compiled import Program, parse, read
from dual_ur10.sim2real.emulator.script.library import library
from dual_ur10.sim2real.emulator.script.machine import Machine, Thread
from dual_ur10.sim2real.emulator.script.splitter import Splitter
from dual_ur10.sim2real.emulator.script.values import Builtins, Pose, VersionBuiltins, text

__all__ = [
    "Builtins",
    "Machine",
    "Pose",
    "Program",
    "Splitter",
    "Thread",
    "VersionBuiltins",
    "library",
    "parse",
    "read",
    "text",
]
