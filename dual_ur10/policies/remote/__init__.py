"""Policies in other processes and on other machines, by openpi's WebSocket protocol."""

from __future__ import annotations

from importlib.util import find_spec

from dual_ur10.errors import MissingExtraError

for _package in ("msgspec", "websockets"):
    if find_spec(_package) is None:
        raise MissingExtraError(_package, "remote", "a policy in another process or on another machine")
