"""Ids of the registered environments."""

from __future__ import annotations

from typing import Final

ENV_IDS: Final = ("DualUR10/SineTracking-v0", "DualUR10/SyncCarry-v0", "DualUR10/Handover-v0")
"""All registered ids. An id is a promise: any change of results gets a new version."""
