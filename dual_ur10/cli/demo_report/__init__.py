"""The demonstration: cases that are run, their figures, and the report page.

Imports everything below the command line; nothing but the command line imports it.
"""
