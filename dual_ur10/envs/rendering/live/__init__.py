"""Live page: both arms, their targets and the state of a run in a browser, from a process of its own.

The program that moves the arms writes a small record per step into shared memory, and never waits for the page. The
process of the page reads it, draws, and writes back what the person at the page drags and presses.
"""
