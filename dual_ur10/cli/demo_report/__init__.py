"""The demonstration: cases, their figures, videos, and the report page.

Each task has one module, which defines its cases, figures, plots and video, and one template.

Imports everything below the command line; nothing but the command line imports it.
"""
