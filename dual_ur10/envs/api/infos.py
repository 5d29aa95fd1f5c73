"""`info` of one cell, and of many in Gymnasium's form. Values may be nested in dicts, such as `randomization`."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from dual_ur10.types import Mask


def of_row(info: Mapping[str, Any], row: int) -> dict[str, Any]:
    """The values of one cell among those of n, (n, ...) each."""
    return {name: of_row(value, row) if isinstance(value, dict) else value[row] for name, value in info.items()}


def masked(info: Mapping[str, Any], mask: Mask) -> dict[str, Any]:
    """Gymnasium's form of a vector env's info: each array with a mask of its rows, under "_" and its name."""
    result: dict[str, Any] = {}
    masks = np.tile(mask, (len(info), 1))  # a mask of its own for each, at the price of one
    for (name, value), own in zip(info.items(), masks, strict=True):
        result[name] = masked(value, mask) if isinstance(value, dict) else value
        result["_" + name] = own
    return result


def restarted(info: Mapping[str, Any], rows: Mask, begun: Mapping[str, Any]) -> dict[str, Any]:
    """A masked `info` with that of a reset in the masked rows; without what then concerns no row.

    Args:
        info: Of the step.
        rows: (n,) which rows begin.
        begun: Of the reset, not masked; arrays that both have are those of all rows.
    """
    result: dict[str, Any] = {}
    for name, value in info.items():
        if name.startswith("_"):
            continue
        mask = info["_" + name] if name in begun else info["_" + name] & ~rows
        if mask.any():
            result[name], result["_" + name] = begun.get(name, value), mask
    result.update(masked({name: value for name, value in begun.items() if name not in info}, rows))
    return result
