"""Parser from the text of a URScript program to its syntax tree."""

from __future__ import annotations

import re
from importlib.resources import files
from typing import Any, Final, cast

from lark import Lark, Token, Transformer
from lark.exceptions import UnexpectedCharacters, UnexpectedInput, UnexpectedToken

from dual_ur10.errors import ScriptSyntaxError
from dual_ur10.sim2real.emulator.script.syntax import (
    Assign,
    Binary,
    Call,
    Define,
    Expression,
    If,
    Index,
    Kill,
    ListOf,
    Name,
    Number,
    Return,
    Simple,
    Statement,
    Text,
    Unary,
    While,
    syntax_error,
)
from dual_ur10.sim2real.emulator.script.values import INT_MAX, POSE_LENGTH

# Precedence of the operators. `not` stands between xor/and and the comparisons.
_RANKS: Final = {
    **dict.fromkeys(("or",), 1),
    **dict.fromkeys(("xor",), 2),
    **dict.fromkeys(("and",), 3),
    **dict.fromkeys(("==", "!=", "<", ">", "<=", ">="), 5),
    **dict.fromkeys(("+", "-"), 6),
    **dict.fromkeys(("*", "/", "%"), 7),
}
_NOT_RANK: Final = 4
_NEGATIVE_RANK: Final = 8

# Labels of program nodes that PolyScope writes into saved scripts.
_LABEL: Final = re.compile(r"^[ \t]*\$[^\n]*", re.MULTILINE)

# Most operators before one operand.
_PREFIXES: Final = 50


class _Tree(Transformer[Token, Any]):
    """Transformer that makes nodes while the parser runs, so that no other tree is built."""

    def number(self, items: list[Any]) -> Number:
        word: Token = items[0]
        if word.isdigit():
            # Check the length first: Python refuses to parse numbers of thousands of digits.
            if len(word.lstrip("0")) > 10 or int(word) > INT_MAX:
                raise syntax_error(word, f"an integer has at most 32 bits: {-INT_MAX - 1} to {INT_MAX}")
            return Number(word, int(word))
        value = float(word)
        if value == float("inf"):
            raise syntax_error(word, "this number is too large for a float")
        return Number(word, value)

    def text(self, items: list[Any]) -> Text:
        return Text(items[0], str(items[0])[1:-1])

    def truth(self, items: list[Any]) -> Number:
        return Number(items[0], items[0] == "True")

    def name(self, items: list[Any]) -> Name:
        return Name(items[0])

    def series(self, items: list[Any]) -> ListOf:
        return ListOf(items[0], [item for item in items[1:] if item is not None], is_pose=False)

    def subscript(self, items: list[Any]) -> list[Expression]:
        return items

    def index(self, items: list[Any]) -> Expression:
        base, subscript = items
        if isinstance(base, Name) and base.at == "p" and len(subscript) == POSE_LENGTH:
            return ListOf(base.at, subscript, is_pose=True)
        _check_subscript(base.at, subscript)
        return Index(base.at, base, subscript)

    def keyword(self, items: list[Any]) -> tuple[Token, Expression]:
        return items[0], items[1]

    def call(self, items: list[Any]) -> Call:
        return _call(items[0], items[1:])

    def run(self, items: list[Any]) -> Call:
        call = _call(items[1], items[2:])
        call.runs = True
        return call

    def expression(self, items: list[Any]) -> Expression:
        if len(items) == 1:
            return cast(Expression, items[0])
        return _Ranking(items).parse(0)

    def parameter(self, items: list[Any]) -> tuple[Token, Expression | None]:
        return items[0], items[1]

    def parameters(self, items: list[Any]) -> list[Any]:
        return items

    def block(self, items: list[Any]) -> list[Any]:
        return items

    start = block

    def define(self, items: list[Any]) -> Define:
        kind, name, parameters, body, _ = items
        return Define(name, str(kind), parameters or [], body)

    def assign(self, items: list[Any]) -> Assign:
        qualifier, (name, *subscripts), value = items
        if len(subscripts) > 1 or (subscripts and qualifier):
            raise syntax_error(name, "only a variable or one element of it (a[i] or a[i, j]) can be assigned")
        for subscript in subscripts:
            _check_subscript(name, subscript)
        return Assign(name, str(qualifier or ""), subscripts[0] if subscripts else [], value)

    def target(self, items: list[Any]) -> list[Any]:
        return items

    def loop(self, items: list[Any]) -> While:
        return While(*items[:3])

    def choice(self, items: list[Any]) -> If:
        word, condition, block, *branches, otherwise, _ = items
        return If(word, [(word, condition, block), *branches], otherwise or [])

    def branch(self, items: list[Any]) -> tuple[Any, ...]:
        return tuple(items)

    def otherwise(self, items: list[Any]) -> list[Any]:
        return cast("list[Any]", items[1])

    def result(self, items: list[Any]) -> Return:
        return Return(items[0], items[1] if len(items) > 1 else None)

    def kill(self, items: list[Any]) -> Kill:
        return Kill(*items)

    def simple(self, items: list[Any]) -> Simple:
        return Simple(items[0])


class _Ranking:
    """Precedence climbing over a flat expression."""

    def __init__(self, items: list[Any]) -> None:
        self._items, self._next = items, 0

    def parse(self, rank: int) -> Expression:
        left = self._operand()
        items = self._items
        while self._next < len(items):
            operator = items[self._next]
            binds = _RANKS[operator]
            if binds <= rank:
                break
            self._next += 1
            left = Binary(operator, left, self.parse(binds))
        return left

    def _operand(self) -> Expression:
        item = self._items[self._next]
        self._next += 1
        if not isinstance(item, Token):
            return cast(Expression, item)
        if self._next > _PREFIXES and all(
            isinstance(each, Token) for each in self._items[self._next - _PREFIXES : self._next]
        ):
            raise syntax_error(item, "too many operators before one operand")
        if item == "not":
            return Unary(item, self.parse(_NOT_RANK))
        operand = self.parse(_NEGATIVE_RANK)
        if isinstance(operand, Number) and not isinstance(operand.value, bool):
            return Number(item, -operand.value)
        return Unary(item, operand)


def _call(name: Token, items: list[Any]) -> Call:
    arguments: list[Expression] = []
    keywords: list[tuple[Token, Expression]] = []
    for item in items:
        if isinstance(item, tuple):
            if any(item[0] == other for other, _ in keywords):
                raise syntax_error(item[0], f"the argument is given twice to {name}")
            keywords.append(item)
        elif item is not None:
            if keywords:
                raise syntax_error(name, "arguments without a name stand before those with one")
            arguments.append(item)
    return Call(name, arguments, keywords)


def _check_subscript(word: Token, items: list[Expression]) -> None:
    if len(items) > 2:
        raise syntax_error(word, f"an element has 1 or 2 indices, a pose p[..] has 6 numbers: found {len(items)}")


_LARK: Final = Lark(
    (files(__package__) / "grammar.lark").read_text(encoding="utf-8"),
    parser="lalr",
    lexer="basic",
    transformer=_Tree(),
    maybe_placeholders=True,
)


def parse_text(text: str) -> list[Statement]:
    """Parse the statements of a program.

    Raises:
        ScriptSyntaxError: The text does not follow the grammar.
    """
    if "$" in text:
        text = _LABEL.sub("", text)
    try:
        return cast("list[Statement]", _LARK.parse(text))
    except UnexpectedCharacters as error:
        raise ScriptSyntaxError(error.line, text[error.pos_in_stream or 0], "no word of URScript begins so") from None
    except UnexpectedToken as error:
        expected = ", ".join(sorted(error.expected - {"$END"}, key=str.lower)).lower()
        if error.token.type == "$END":
            line = text.rstrip().count("\n") + 1
            raise ScriptSyntaxError(line, "", f"the program ends in the middle: expected {expected}") from None
        raise ScriptSyntaxError(
            error.line, str(error.token), f"this cannot stand here: expected {expected or 'the end of the text'}"
        ) from None
    except UnexpectedInput as error:
        raise ScriptSyntaxError(1, "", str(error)) from None
