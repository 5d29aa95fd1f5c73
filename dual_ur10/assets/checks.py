"""What settings of the scene are checked with."""

from __future__ import annotations

import math
from typing import Any

from dual_ur10.errors import SettingsError


def numbers(name: str, values: Any, length: int) -> tuple[Any, ...]:
    """Plain finite floats, so that equal settings hash alike.

    Raises:
        SettingsError: They are not `length` finite numbers.
    """
    try:
        found = tuple(float(value) for value in values)
    except (TypeError, ValueError):
        found = ()
    if len(found) != length or not all(map(math.isfinite, found)):
        raise SettingsError(f"{name} must be {length} finite number{'s' * (length > 1)}, found {values!r}")
    return found
