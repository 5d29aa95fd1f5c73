"""Syntax tree of a URScript program.

`at` is the word by which messages name a node: an operator, a name, a keyword.
"""

from __future__ import annotations

from dataclasses import dataclass

from lark import Token

from ur_core.errors import ScriptNameError, ScriptSyntaxError


@dataclass(slots=True)
class Number:
    """Number, True or False."""

    at: Token
    value: float | int | bool


@dataclass(slots=True)
class Text:
    """String."""

    at: Token
    value: str


@dataclass(slots=True)
class Name:
    """Variable."""

    at: Token


@dataclass(slots=True)
class Call:
    """Call, or with `runs` the start of a thread."""

    at: Token
    arguments: list[Expression]
    keywords: list[tuple[Token, Expression]]
    runs: bool = False


@dataclass(slots=True)
class Index:
    """Element of a list, or with two items of a matrix."""

    at: Token
    base: Expression
    items: list[Expression]


@dataclass(slots=True)
class ListOf:
    """List or pose."""

    at: Token
    items: list[Expression]
    is_pose: bool


@dataclass(slots=True)
class Unary:
    """Operator `-` or `not`."""

    at: Token
    operand: Expression


@dataclass(slots=True)
class Binary:
    """Operator between two operands."""

    at: Token
    left: Expression
    right: Expression


Expression = Number | Text | Name | Call | Index | ListOf | Unary | Binary


@dataclass(slots=True)
class Assign:
    """Assignment to a variable, or with `items` to an element."""

    at: Token
    qualifier: str
    items: list[Expression]
    value: Expression


@dataclass(slots=True)
class If:
    """Conditions with their blocks, and the block of `else`."""

    at: Token
    branches: list[tuple[Token, Expression, list[Statement]]]
    otherwise: list[Statement]


@dataclass(slots=True)
class While:
    """Loop."""

    at: Token
    condition: Expression
    body: list[Statement]


@dataclass(slots=True)
class Simple:
    """Statement of one word: break, continue, halt, pass, enter_critical, exit_critical."""

    at: Token


@dataclass(slots=True)
class Return:
    """Return from a function, with its value."""

    at: Token
    value: Expression | None


@dataclass(slots=True)
class Kill:
    """Statement `kill` or `join` of a thread."""

    at: Token
    value: Expression


@dataclass(slots=True)
class Define:
    """Function, thread or secondary program: `kind` is def, thread or sec."""

    at: Token
    kind: str
    parameters: list[tuple[Token, Expression | None]]
    body: list[Statement]


Statement = Assign | If | While | Simple | Return | Kill | Define | Call


def error(word: Token, reason: str) -> ScriptSyntaxError:
    """Return the error that a word of a program causes, with its place."""
    return ScriptSyntaxError(word.line or 1, str(word), reason, word.column or 1)


def unknown(word: Token, reason: str) -> ScriptNameError:
    """Return the same for a name that does not exist."""
    return ScriptNameError(word.line or 1, str(word), reason, word.column or 1)
