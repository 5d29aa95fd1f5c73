"""Versions, as they are written beside what was made with them."""

from __future__ import annotations

from importlib.metadata import PackageNotFoundError, version

from dual_ur10 import __version__


def versions(*packages: str) -> dict[str, str]:
    """That of this package, and of others as far as they are installed, by name."""
    found = {"dual_ur10": __version__}
    for name in packages:
        try:
            found[name] = version(name)
        except PackageNotFoundError:
            continue
    return found
