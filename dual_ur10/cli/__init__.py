"""Command line of `dual-ur10`: one file per command.

A command parses its arguments, calls one function of the package and prints the result. It contains no logic.
"""
