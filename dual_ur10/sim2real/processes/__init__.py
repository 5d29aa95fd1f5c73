"""Child processes, shared memory, scheduling priority and interrupts.

Imports no other room. Imported by `sim2real.{runtime, recording, emulator}`, `cli`, and first of all by the package.
"""
