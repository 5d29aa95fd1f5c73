"""Motion by a program of the controller: points streamed to a resident URScript program, and records of it.

Servo targets go another way. A program has the latch and the supervisor of the runner, never its own.
"""
