"""Which seeds are for what, so that no policy is judged by episodes that it was made with."""

from __future__ import annotations

from typing import Final

from dual_ur10.errors import SettingsError

CHECKS: Final = 10_000_000
"""First seed of the episodes by which a training follows its progress. Published figures begin at 0."""

_TRAINING: Final = 1_000_000_000
_EACH: Final = 1_000_000
_MOST: Final = 2_000_000


def episodes_of(seed: int) -> int:
    """First seed of the episodes that the training with this seed learns from; it may use a million.

    Raises:
        SettingsError: The seed is out of its range.
    """
    if isinstance(seed, bool) or not isinstance(seed, int) or not 0 <= seed < _MOST:
        raise SettingsError(f"the seed of a training is {seed!r}: it must be a whole number, 0 to {_MOST - 1}")
    return _TRAINING + _EACH * seed
