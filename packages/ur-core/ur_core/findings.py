"""Findings of pydantic in data of others, in words: places, and lists with an end.

It takes what `ValidationError.errors()` returns, so that the ground needs no pydantic.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from typing import TypeVar

T = TypeVar("T")


def listed(findings: Sequence[T], phrase: Callable[[T], str], most: int) -> str:
    """Return findings in one line, and how many more there are than fit.

    Args:
        findings: All of them.
        phrase: Function that returns the words of one.
        most: Number of findings to put into words.
    """
    more = len(findings) - most
    return "; ".join([*map(phrase, findings[:most]), *([f"and {more} more"] if more > 0 else [])])


def path_of(location: Iterable[int | str]) -> str:
    """Return the path of a finding from its `loc`, such as ".points[3].positions"."""
    return "".join(f"[{key}]" if isinstance(key, int) else f".{key:.80}" for key in location)
