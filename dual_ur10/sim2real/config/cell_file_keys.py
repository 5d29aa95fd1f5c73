"""How the keys and tables of a cell file are described."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, Final, Literal

_TYPES: Final = {
    "number": "a number",
    "integer": "a whole number",
    "text": "a text in quotes",
    "switch": "true or false",
}


@dataclass(frozen=True)
class Key:
    """One key of a table.

    Attributes:
        name: As in the file.
        meaning: What it is, for the template and the documents.
        type: Of the value, or of each of several.
        low, high: Range of a number.
        count: How many values in brackets; 0: a single one, without brackets.
        choices: The allowed texts; empty: by `pattern`.
        pattern: Regular expression of an allowed text, and what it stands for.
        required: "always", "real" (in the file of a real cell), or "" (never).
        default: Where the file does not say it; None: not known.
        note: More about the range.
        example: A legal value; None: the default is one.
    """

    name: str
    meaning: str
    type: Literal["number", "integer", "text", "switch"] = "number"
    low: float = -math.inf
    high: float = math.inf
    count: int = 0
    choices: tuple[str, ...] = ()
    pattern: tuple[str, str] = ("", "")
    required: Literal["always", "real", ""] = ""
    default: Any = None
    note: str = ""
    example: Any = None

    @property
    def allowed(self) -> str:
        """What is allowed, in words."""
        if self.choices:
            text = " or ".join(map(json.dumps, self.choices))
        elif self.type == "text":
            text = self.pattern[1]
        elif self.type == "switch":
            text = _TYPES["switch"]
        else:
            what = _TYPES[self.type] if not self.count else f"{self.count} {'whole ' * (self.type == 'integer')}numbers"
            text = f"{what}, {self.low:.6g} to {self.high:.6g}"
        return text + (f" ({self.note})" if self.note else "")

    @property
    def sample(self) -> str:
        """A line of a file with a legal value."""
        value = self.default if self.example is None else self.example
        if value is None:
            value = self.choices[0] if self.choices else 0.0
        return f"{self.name} = {json.dumps(value)}"


@dataclass(frozen=True)
class Table:
    """One table.

    Attributes:
        name: As in the file.
        meaning: What it is.
        keys: What may stand in it.
        variants: What else may stand in it, by the value of its key `kind`.
        tables: Tables inside it.
        optional: Whether nothing stands for it when it is missing. Else its keys' defaults do.
        required: Whether it must be there.
        many: Whether it is an array of tables.
    """

    name: str
    meaning: str
    keys: tuple[Key, ...] = ()
    variants: Mapping[str, tuple[Key, ...]] = field(default_factory=dict)
    tables: tuple[Table, ...] = ()
    optional: bool = False
    required: bool = False
    many: bool = False
