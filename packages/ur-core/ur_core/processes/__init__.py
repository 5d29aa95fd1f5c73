"""Child processes, shared memory, scheduling priority and interrupts.

The only room that asks the operating system for time, processes and connections: all else takes them from a `System`.
"""
