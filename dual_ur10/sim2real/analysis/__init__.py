"""Comparison, replay and servoj identification of recorded runs, with their plots and reports.

Nothing here is loaded while arms move.
"""
