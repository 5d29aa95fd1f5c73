"""Counts that `make soak` runs in full and `make test` in part."""

import os

SOAK = os.environ.get("DUAL_UR10_SOAK") == "1"


def scaled(count: int, part: int = 20) -> int:
    """Return `count` in a soak, otherwise the `part`-th part of it."""
    return count if SOAK else max(1, count // part)
