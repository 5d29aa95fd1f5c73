"""PyAV, which the extra `cameras` brings."""

from __future__ import annotations

from typing import Any

from dual_ur10.errors import MissingExtraError


def pyav(use: str) -> Any:
    """Return the module of PyAV.

    Args:
        use: Noun for the message: what needs it.

    Raises:
        MissingExtraError: It is not installed.
    """
    try:
        import av
    except ImportError:
        raise MissingExtraError("PyAV", "cameras", use) from None
    return av
