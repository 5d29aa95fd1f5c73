"""Scripted policies, one file per task, and the motion primitives that they share.

A scripted policy acts from observations only.
"""
