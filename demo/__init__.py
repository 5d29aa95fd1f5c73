"""Demonstration of the suite: cases, their figures, videos, and a report page.

Each task has one module, which defines its cases, figures, plots and video, and one template. It stands beside the
packages and is part of none: what it needs of them is public.
"""
