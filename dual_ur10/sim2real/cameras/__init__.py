"""Cameras of a cell: each in a process of its own, which puts images into shared memory. Nobody waits for one."""
