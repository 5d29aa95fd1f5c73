"""Policies that return chunks of future actions, and their execution within the limits of motion."""

from __future__ import annotations
