"""Programs ready to run: parsing, checking and compiling, with a cache."""

from __future__ import annotations

import marshal
from collections import OrderedDict
from collections.abc import Callable, Mapping
from contextlib import suppress
from dataclasses import dataclass
from threading import Lock
from types import CodeType
from typing import Any, Final, cast

from lark import Token

from ur_core.errors import ScriptError, SettingsError
from ur_emulator.script import syntax
from ur_emulator.script.calls import Calls, Interface, interface
from ur_emulator.script.compiler import generate
from ur_emulator.script.parser import parse_text
from ur_emulator.script.scopes import Names
from ur_emulator.script.values import Builtins, VersionBuiltins

UNNAMED: Final = "unnamed"
"""Name of a program without an enclosing `def`."""

_CACHE_MAX: Final = 16


@dataclass(frozen=True, eq=False)
class Program:
    """Parsed, checked and compiled program.

    Attributes:
        name: Name of the program's function, or "unnamed".
        is_secondary: Whether it is a secondary program (`sec`), which runs beside the main one.
        lines: Source lines.
        code: Python code that runs it.
        used: Interfaces of the builtins that it calls, by name.
    """

    name: str
    is_secondary: bool
    lines: tuple[str, ...]
    code: CodeType
    used: Mapping[str, Interface]

    def __reduce__(self) -> tuple[Any, ...]:
        return _program, (self.name, self.is_secondary, self.lines, marshal.dumps(self.code), self.used)

    def check(self, builtins: Builtins) -> None:
        """Check that builtins match those that the program was parsed for.

        Raises:
            SettingsError: One is missing, or has another kind or other parameters.
        """
        for name, used in self.used.items():
            if name not in builtins or interface(builtins[name]) != used:
                raise SettingsError(f"builtin {name!r} differs from the one that the program was parsed for: {used}")


def _program(
    name: str, is_secondary: bool, lines: tuple[str, ...], code: bytes, used: Mapping[str, Interface]
) -> Program:
    """Return the program of a process that compiled it with this Python."""
    return Program(name, is_secondary, lines, marshal.loads(code), used)


Compiler = Callable[[str, Builtins], Program | ScriptError]
"""Function from a program's text and builtins to the program, or its error."""


# Clients send the same text with every connection.
_CACHE: Final[OrderedDict[str, Program]] = OrderedDict()
_CACHE_LOCK: Final = Lock()  # several threads may parse programs


def compiled(text: str, builtins: Builtins) -> Program | ScriptError:
    """Compile a program, and return it or its error. Interfaces can stand in for the builtins."""
    try:
        return _read(text, builtins)
    except ScriptError as error:
        return error


def interfaces(builtins: Builtins) -> Builtins:
    """Return what can be sent to another process, and stands in for builtins there."""
    absent = builtins.absent if isinstance(builtins, VersionBuiltins) else {}
    return VersionBuiltins(cast(Builtins, {name: interface(each) for name, each in builtins.items()}), absent)


def parse(text: str, builtins: Builtins, compiler: Compiler = compiled) -> Program:
    r"""Parse a program.

    Args:
        text: A program of its own (`def name(): .. end` or `sec name(): .. end`), or statements. Lines end with \n or
            \r\n.
        builtins: Functions that it may call, by name. Generator functions block. None is called here: the program can
            run with any others of the same names, parameters and kinds.
        compiler: Function that compiles it, if it is not known already.

    Raises:
        ScriptSyntaxError: The text does not follow the grammar, or uses a name that is unknown or does not fit.
    """
    known = _CACHE.get(text)
    if known is not None:
        with suppress(SettingsError):
            known.check(builtins)
            return known
    program = compiler(text, builtins)
    if isinstance(program, ScriptError):
        raise program
    with _CACHE_LOCK:
        _CACHE[text] = program
        if len(_CACHE) > _CACHE_MAX:
            _CACHE.popitem(last=False)
    return program


def _read(text: str, builtins: Builtins) -> Program:
    statements = parse_text(text)
    first = statements[0] if statements else None
    if isinstance(first, syntax.Define) and first.kind != "thread":
        if len(statements) > 1:
            after = statements[1].at
            raise syntax.error(after, f"the program {first.at} ended before it")
        for word, default in first.parameters:
            if default is None:
                raise syntax.error(word, "a program has no arguments")
        main, name = first, str(first.at)
        main = syntax.Define(first.at, first.kind, [], first.body)
    else:
        name = UNNAMED
        main = syntax.Define(Token("NAME", UNNAMED, line=1, column=1), "def", [], statements)
    try:
        names = Names(main)
        calls = Calls(names, builtins)
        code = generate(main, names, calls, builtins)
    except (RecursionError, MemoryError):
        raise syntax.error(main.at, "the program is too large, or nested too deeply") from None
    return Program(name, main.kind == "sec", tuple(text.split("\n")), code, calls.used)


def read(text: str, builtins: Builtins, compiler: Compiler = compiled) -> Program | ScriptError:
    """Parse a program, and return it or its error; see `parse`. Any thread may call this."""
    try:
        return parse(text, builtins, compiler)
    except ScriptError as error:
        return error
