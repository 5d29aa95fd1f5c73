"""URScript: programs of UR controllers, read, checked and run a control period at a time."""

from dual_ur10.sim2real.emulator.script.compiled import Program, parse, read
from dual_ur10.sim2real.emulator.script.library import library
from dual_ur10.sim2real.emulator.script.machine import Machine, Thread
from dual_ur10.sim2real.emulator.script.splitter import Splitter, split_programs
from dual_ur10.sim2real.emulator.script.values import Pose, text

__all__ = [
    "Machine",
    "Pose",
    "Program",
    "Splitter",
    "Thread",
    "library",
    "parse",
    "read",
    "split_programs",
    "text",
]
