"""Command line of `dual-ur10`: one file per command.

The top of the house: imports every room and is imported by none. Commands parse, call one function of the package and
print; logic lives in the rooms below.
"""
