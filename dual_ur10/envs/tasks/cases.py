"""Decisions in plain Python on one row's conditions, looked up for all rows.

At these sizes a NumPy call costs more than its arithmetic, and nested masks hide what is decided. So a task writes its
decision as a function of named conditions, with `if`. It is evaluated once for every combination of them.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable
from functools import lru_cache
from typing import Any, Generic, TypeVar

import numpy as np

from ur_core.types import Array

CaseT = TypeVar("CaseT", bound=tuple[Any, ...])
DecisionT = TypeVar("DecisionT", bound=tuple[Any, ...])


class Cases(Generic[CaseT, DecisionT]):
    """Decisions of rows.

    Args:
        case: Named tuple of conditions, at most 16.
        decide: Function from one row's case to its decision, a named tuple of numbers or of tuples of them. It must
            depend on nothing else.
    """

    def __init__(self, case: type[CaseT], decide: Callable[[CaseT], DecisionT]) -> None:
        self._case, self._decide = case, decide
        self._weights = 2.0 ** np.arange(len(case._fields))  # type: ignore[attr-defined]

    def __call__(self, case: CaseT) -> DecisionT:
        """Return the decision of one row, or that of each row of masks, (n,): numbers and (n,) arrays, likewise."""
        if isinstance(case[0], bool):
            decision: DecisionT = _decided(self._decide, case)
            return decision
        numbers = np.stack(case, axis=1).dot(self._weights).astype(np.intp)
        kind, tables = _tabulated(self._case, self._decide)
        decisions: DecisionT = kind(*[table.take(numbers, axis=-1) for table in tables])
        return decisions


_decided = lru_cache(maxsize=None)(lambda decide, case: decide(case))


@lru_cache(maxsize=32)
def _tabulated(case: Any, decide: Callable[[Any], Any]) -> tuple[Callable[..., Any], list[Array]]:
    decisions = [decide(case(*each[::-1])) for each in itertools.product((False, True), repeat=len(case._fields))]
    return type(decisions[0]), [np.array(column).T.copy() for column in zip(*decisions, strict=True)]
