"""Child processes, shared memory, scheduling priority and interrupts.

Imports only `errors`. Imported by `sim2real.{runtime, recording}`, `ur_emulator` and `cli`, and first by the package
itself.
"""
