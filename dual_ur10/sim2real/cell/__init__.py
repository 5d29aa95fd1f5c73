"""A cell: two arms as environments see them, its state and configuration, and the kinds of cells by name.

It holds no connection, and reads no file.
"""
