"""The demonstration: cases, their figures, videos, and the report page.

Each task has one module, which defines its cases, figures, plots and video, and one template.

It may import every lower layer; only the command line imports it.
"""
