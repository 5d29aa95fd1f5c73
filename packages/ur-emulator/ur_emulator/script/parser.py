"""Parser from the text of a URScript program to its syntax tree."""

from __future__ import annotations

import re
from importlib.resources import files
from typing import Any, Final, cast

from lark import Lark, Token, Transformer
from lark.exceptions import UnexpectedCharacters, UnexpectedInput, UnexpectedToken

from ur_core.errors import ScriptSyntaxError
from ur_emulator.script import syntax
from ur_emulator.script.values import INT_MAX, POSE_LENGTH

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


class _NodeBuilder(Transformer[Token, Any]):
    """Transformer that makes nodes while the parser runs, so that no other tree is built."""

    def number(self, items: list[Any]) -> syntax.Number:
        word: Token = items[0]
        if word.isdigit():
            # Check the length first: Python refuses to parse numbers of thousands of digits.
            if len(word.lstrip("0")) > 10 or int(word) > INT_MAX:
                raise syntax.error(word, f"an integer has at most 32 bits: {-INT_MAX - 1} to {INT_MAX}")
            return syntax.Number(word, int(word))
        value = float(word)
        if value == float("inf"):
            raise syntax.error(word, "this number is too large for a float")
        return syntax.Number(word, value)

    def text(self, items: list[Any]) -> syntax.Text:
        return syntax.Text(items[0], str(items[0])[1:-1])

    def truth(self, items: list[Any]) -> syntax.Number:
        return syntax.Number(items[0], items[0] == "True")

    def name(self, items: list[Any]) -> syntax.Name:
        return syntax.Name(items[0])

    def series(self, items: list[Any]) -> syntax.ListOf:
        return syntax.ListOf(items[0], [item for item in items[1:] if item is not None], is_pose=False)

    def subscript(self, items: list[Any]) -> list[syntax.Expression]:
        return items

    def index(self, items: list[Any]) -> syntax.Expression:
        base, subscript = items
        if isinstance(base, syntax.Name) and base.at == "p" and len(subscript) == POSE_LENGTH:
            return syntax.ListOf(base.at, subscript, is_pose=True)
        _check_subscript(base.at, subscript)
        return syntax.Index(base.at, base, subscript)

    def keyword(self, items: list[Any]) -> tuple[Token, syntax.Expression]:
        return items[0], items[1]

    def call(self, items: list[Any]) -> syntax.Call:
        return _call(items[0], items[1:])

    def run(self, items: list[Any]) -> syntax.Call:
        call = _call(items[1], items[2:])
        call.runs = True
        return call

    def expression(self, items: list[Any]) -> syntax.Expression:
        if len(items) == 1:
            return cast(syntax.Expression, items[0])
        return _Ranking(items).parse(0)

    def parameter(self, items: list[Any]) -> tuple[Token, syntax.Expression | None]:
        return items[0], items[1]

    def parameters(self, items: list[Any]) -> list[Any]:
        return items

    def block(self, items: list[Any]) -> list[Any]:
        return items

    start = block

    def define(self, items: list[Any]) -> syntax.Define:
        kind, name, parameters, body, _ = items
        return syntax.Define(name, str(kind), parameters or [], body)

    def assign(self, items: list[Any]) -> syntax.Assign:
        qualifier, (name, *subscripts), value = items
        if len(subscripts) > 1 or (subscripts and qualifier):
            raise syntax.error(name, "only a variable or one element of it (a[i] or a[i, j]) can be assigned")
        for subscript in subscripts:
            _check_subscript(name, subscript)
        return syntax.Assign(name, str(qualifier or ""), subscripts[0] if subscripts else [], value)

    def target(self, items: list[Any]) -> list[Any]:
        return items

    def loop(self, items: list[Any]) -> syntax.While:
        return syntax.While(*items[:3])

    def choice(self, items: list[Any]) -> syntax.If:
        word, condition, block, *branches, otherwise, _ = items
        return syntax.If(word, [(word, condition, block), *branches], otherwise or [])

    def branch(self, items: list[Any]) -> tuple[Any, ...]:
        return tuple(items)

    def otherwise(self, items: list[Any]) -> list[Any]:
        return cast("list[Any]", items[1])

    def result(self, items: list[Any]) -> syntax.Return:
        return syntax.Return(items[0], items[1] if len(items) > 1 else None)

    def kill(self, items: list[Any]) -> syntax.Kill:
        return syntax.Kill(*items)

    def simple(self, items: list[Any]) -> syntax.Simple:
        return syntax.Simple(items[0])


class _Ranking:
    """Precedence climbing over a flat expression."""

    def __init__(self, items: list[Any]) -> None:
        self._items, self._next = items, 0

    def parse(self, rank: int) -> syntax.Expression:
        left = self._operand()
        items = self._items
        while self._next < len(items):
            operator = items[self._next]
            binds = _RANKS[operator]
            if binds <= rank:
                break
            self._next += 1
            left = syntax.Binary(operator, left, self.parse(binds))
        return left

    def _operand(self) -> syntax.Expression:
        item = self._items[self._next]
        self._next += 1
        if not isinstance(item, Token):
            return cast(syntax.Expression, item)
        if self._next > _PREFIXES and all(
            isinstance(each, Token) for each in self._items[self._next - _PREFIXES : self._next]
        ):
            raise syntax.error(item, "too many operators before one operand")
        if item == "not":
            return syntax.Unary(item, self.parse(_NOT_RANK))
        operand = self.parse(_NEGATIVE_RANK)
        if isinstance(operand, syntax.Number) and not isinstance(operand.value, bool):
            return syntax.Number(item, -operand.value)
        return syntax.Unary(item, operand)


def _call(name: Token, items: list[Any]) -> syntax.Call:
    arguments: list[syntax.Expression] = []
    keywords: list[tuple[Token, syntax.Expression]] = []
    given: set[str] = set()
    for item in items:
        if isinstance(item, tuple):
            if item[0] in given:
                raise syntax.error(item[0], f"the argument is given twice to {name}")
            given.add(item[0])
            keywords.append(item)
        elif item is not None:
            if keywords:
                raise syntax.error(name, "arguments without a name stand before those with one")
            arguments.append(item)
    return syntax.Call(name, arguments, keywords)


def _check_subscript(word: Token, items: list[syntax.Expression]) -> None:
    if len(items) > 2:
        raise syntax.error(word, f"an element has 1 or 2 indices, a pose p[..] has 6 numbers: found {len(items)}")


_LARK: Final = Lark(
    (files(__package__) / "grammar.lark").read_text(encoding="utf-8"),
    parser="lalr",
    lexer="basic",
    transformer=_NodeBuilder(),
    maybe_placeholders=True,
)


def parse_text(text: str) -> list[syntax.Statement]:
    """Parse the statements of a program.

    Raises:
        ScriptSyntaxError: The text does not follow the grammar.
    """
    if "$" in text:
        text = _LABEL.sub("", text)
    try:
        return cast("list[syntax.Statement]", _LARK.parse(text))
    except UnexpectedCharacters as error:
        word = text[error.pos_in_stream or 0]
        raise ScriptSyntaxError(error.line, word, "no URScript starts with this", error.column) from None
    except UnexpectedToken as error:
        expected = ", ".join(sorted(error.expected - {"$END"}, key=str.lower)).lower()
        if error.token.type == "$END":
            *before, last = text.rstrip().split("\n")
            reason = f"the program is incomplete: expected {expected}"
            raise ScriptSyntaxError(len(before) + 1, "", reason, len(last) + 1) from None
        reason = f"this cannot stand here: expected {expected or 'the end of the text'}"
        raise ScriptSyntaxError(error.line, str(error.token), reason, error.column) from None
    except UnexpectedInput as error:
        raise ScriptSyntaxError(1, "", str(error)) from None
