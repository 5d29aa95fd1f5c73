"""Synchronised carry: both arms carry one bar along a path."""
