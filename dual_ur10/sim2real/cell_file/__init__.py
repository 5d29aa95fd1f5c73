"""The cell file: its tables with their bounds, its reader, its text with comments, and its reference page.

It opens no connection, and runs no code that a file names but what a person's own cell file may name.
"""
