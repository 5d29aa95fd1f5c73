"""Bit-by-bit comparison of the targets that two runs sent."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from dual_ur10.sim2real.analysis.tracks import Track
from ur_core.types import Array


@dataclass(frozen=True)
class Parity:
    """Targets of one arm in two runs, by their numbers.

    Attributes:
        compared: Number of targets that both runs sent.
        equal: Number of these targets that are equal in every bit.
        first: Episode and number of the first target that differs; None: none does.
        most_rad: Largest difference.
        later: Shift of run B's numbers: the same actions at another latency.
    """

    compared: int
    equal: int
    first: tuple[int, int] | None
    most_rad: float
    later: int = 0

    @property
    def is_exact(self) -> bool:
        """True if all targets are equal, and there are any."""
        return self.compared > 0 and self.equal == self.compared


def parity(episodes: Sequence[tuple[Track, Track]], later: int = 0) -> Parity:
    """Compare the targets sent to one arm, episode by episode.

    Targets between two numbers and targets of a stop are left out.

    Args:
        episodes: Motion of the arm in both runs.
        later: Ticks by which actions act later in run B. A policy may have compensated them or not: the shift that
            makes more targets equal is used.
    """
    plain = _parity(episodes, 0)
    if not later:
        return plain
    moved = _parity(episodes, later)
    return moved if moved.equal > plain.equal else plain


def _parity(episodes: Sequence[tuple[Track, Track]], later: int) -> Parity:
    compared = equal = 0
    most, first = 0.0, None
    for number, (a, b) in enumerate(episodes):
        index_a, rows_a = _whole(a)
        index_b, rows_b = _whole(b)
        shared, at_a, at_b = np.intersect1d(index_a, index_b - later, return_indices=True)
        same = bits_equal(rows_a[at_a], rows_b[at_b]).all(axis=1)
        compared, equal = compared + len(shared), equal + int(same.sum())
        if len(shared):
            most = max(most, float(np.abs(rows_a[at_a] - rows_b[at_b]).max()))
        if first is None and not same.all():
            first = (number, int(shared[np.argmin(same)]))
    return Parity(compared, equal, first, most, later)


def bits_equal(a: Array, b: Array) -> NDArray[np.bool_]:
    """Return the mask of the numbers of two arrays of one shape that are equal in every bit."""
    first, second = (np.ascontiguousarray(each, dtype=np.float64).view(np.int64) for each in (a, b))
    return np.asarray(first == second)


def _whole(track: Track) -> tuple[NDArray[np.int64], Array]:
    """Return whole numbers of the actions' targets, and the first target sent for each."""
    whole = (track.index == np.rint(track.index)) & ~track.stopped
    index, rows = np.unique(track.index[whole].astype(np.int64), return_index=True)
    return index, track.target_rad[whole][rows]
