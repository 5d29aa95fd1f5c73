"""Python's garbage collector in a program that moves two arms.

A collection of a whole program takes longer than an action may, and blocks the threads of grippers and cameras. So the
objects of before the first episode are frozen: the collector ignores them. Freezing again at each episode would keep
all cyclic garbage of that instant, so later episodes begin with a collection of the newer objects.
"""

from __future__ import annotations

import gc
from typing import Final

MOST_OBJECTS: Final = 50_000
"""Most objects collected before an episode: in about 10 ms, measured, of the 40 ms of an action."""


class GarbageCollector:
    """Garbage collector of this process from its first episode to `release`."""

    def __init__(self) -> None:
        self._frozen = False

    def collect(self) -> None:
        """Free all garbage, and freeze the rest."""
        gc.collect()
        gc.freeze()

    def prepare_episode(self) -> None:
        """Free the garbage of the last episode.

        Before the first episode, and where a program has made more than `MOST_OBJECTS` since, freeze all instead.
        """
        if self._frozen and len(gc.get_objects()) <= MOST_OBJECTS:
            gc.collect()
        else:
            gc.freeze()
            self._frozen = True

    def release(self) -> None:
        """Let the collector find all objects again."""
        gc.unfreeze()
        self._frozen = False


class NoGarbageCollector(GarbageCollector):
    """Garbage collector of a program on a virtual clock, which no collection delays."""

    def collect(self) -> None:
        """Do nothing."""

    def prepare_episode(self) -> None:
        """Do nothing."""

    def release(self) -> None:
        """Do nothing."""
