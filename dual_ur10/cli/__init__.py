"""Command line of `dual-ur10`: one file per command.

The highest layer: it may import every package, and only `__main__` imports it. A command parses its arguments, calls
one function of the package and prints the result; the lower layers contain the logic.
"""
