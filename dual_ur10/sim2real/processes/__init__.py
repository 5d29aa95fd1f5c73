"""Child processes, shared memory, scheduling priority and interrupts.

Imports nothing of UR or MuJoCo.
"""
