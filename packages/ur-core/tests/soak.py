"""Counts that `make soak` runs in full and `make test` at a twentieth."""

import os

SOAK = os.environ.get("DUAL_UR10_SOAK") == "1"


def scaled(count: int) -> int:
    """`count` in a soak, a twentieth of it otherwise."""
    return count if SOAK else max(1, count // 20)
