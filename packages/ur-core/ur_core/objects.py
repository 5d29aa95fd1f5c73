"""Objects that are named as text, "module:name"."""

from __future__ import annotations

import importlib
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from contextvars import ContextVar
from types import ModuleType
from typing import Any, NamedTuple

from ur_core.errors import SettingsError


class _Source(NamedTuple):
    noun: str
    discover: Callable[[], None]
    group: str


_received: ContextVar[_Source | None] = ContextVar("received", default=None)


@contextmanager
def received(noun: str, discover: Callable[[], None], group: str) -> Iterator[None]:
    """Import and call nothing in the block that a "module:NAME" in received data names.

    Args:
        noun: Noun of the data for messages, such as "the recording".
        discover: Function that loads what installed packages register.
        group: Group of entry points by which they do.
    """
    token = _received.set(_Source(noun, discover, group))
    try:
        yield
    finally:
        _received.reset(token)


def load_object(path: str, kind: str, *, registered: bool = False) -> Any:
    """Import an object, "module:name".

    Args:
        path: Module and name.
        kind: Noun for the message, such as "the task of MyLab/Reach-v0".
        registered: The path is that of something registered, and was not received.

    Raises:
        SettingsError: The module cannot be imported, or has no such name; or data that were received name it, and it
            was not imported before, or is called.
    """
    module, _, name = path.partition(":")
    source = None if registered else _received.get()
    holder = load_module(module, f"{kind}, {path!r},", registered=registered)
    try:
        # A module may run code for a name that it does not have.
        found = vars(holder)[name] if source else getattr(holder, name)
    except Exception as error:
        raise SettingsError(f"{kind}, {path!r}, cannot be imported: {error}. Name what {module!r} defines") from error
    if source and callable(found):
        raise SettingsError(
            f"{kind}, {path!r}, is named by {source.noun}, and nothing is called for what was received: name what this "
            "package or an installed one registers"
        )
    return found


def load_module(module: str, what: str, *, registered: bool = False) -> ModuleType:
    """Import a module, unless received data name it: then it must have been imported before.

    Args:
        module: Its name.
        what: Noun for the message.
        registered: As for `load_object`.

    Raises:
        SettingsError: It cannot be imported, or must not be.
    """
    source = None if registered else _received.get()
    if source:
        source.discover()
        if module not in sys.modules:
            raise SettingsError(
                f"{what} is named by {source.noun}, and nothing is imported for what was received: import {module!r} "
                f"in your program first, or install a package with an entry point of {source.group!r} for it"
            )
        return sys.modules[module]
    try:
        return importlib.import_module(module)
    except (Exception, SystemExit) as error:  # a module of others may raise anything
        raise SettingsError(
            f"{what} cannot be imported: {type(error).__name__}: {error}. Run this where Python finds {module!r}, and "
            "name what it defines"
        ) from error
