"""Text of cell files: keys in words, by the JSON schema of the models, and values as TOML."""

from __future__ import annotations

import difflib
import json
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, Final, NamedTuple

from ur_core.kinematics.ur10 import ARMS

Comment = Callable[[str], str | None]
Schema = Mapping[str, Any]

_SHOWN: Final = 60  # characters of a value that a message shows
_DEPTH: Final = 3  # and brackets inside brackets


@dataclass(frozen=True)
class Key:
    """One key in words.

    Attributes:
        path: Names of its tables and its own; `ARM` stands for either arm.
        schema: JSON schema of its value.
        required: Whether every file needs it.
        variant: Value of `kind` in its table that it belongs to; "" where it does not depend on that.
    """

    path: str
    schema: Schema
    required: bool = False
    variant: str = ""

    @property
    def name(self) -> str:
        """Name without its tables."""
        return self.path.rsplit(".", 1)[-1]

    @property
    def label(self) -> str:
        """Path, with the variant in brackets."""
        return f"{self.path} ({self.variant})" if self.variant else self.path

    @property
    def count(self) -> int:
        """Number of values in brackets; 0: a single value without brackets."""
        return len(self.schema.get("prefixItems", ()))

    @property
    def single(self) -> Schema:
        """JSON schema of one value of several, or of the only one."""
        single: Schema = self.schema["prefixItems"][0] if self.count else self.schema
        return single

    @property
    def allowed(self) -> str:
        """Legal values in words."""
        single, note = self.single, self.schema.get("note")
        if choices := single.get("enum"):
            text = " or ".join(map(json.dumps, choices))
        elif single["type"] == "string":
            text = single["allowed"]
        elif single["type"] == "boolean":
            text = "true or false"
        else:
            whole = "whole " if single["type"] == "integer" else ""
            text = f"{self.count} {whole}numbers" if self.count else f"a {whole}number"
            text += f", {single['minimum']:.6g} to {single['maximum']:.6g}"
        return text + (f" ({note})" if note else "")

    @property
    def sample(self) -> str:
        """A line of a file with a legal value."""
        choices = self.schema.get("enum", ())
        value = (*self.schema.get("examples", ()), self.schema.get("default"), *choices)
        return f"{self.name} = {json.dumps(next(each for each in value if each is not None))}"


class Place(NamedTuple):
    """A place in a file that a message is about.

    Attributes:
        path: Names and indices, as in "left.tcp_position_m[2]".
        key: The key or table there, or the key whose array it is in; None: there is no such key.
        table: JSON schema of the table around it.
        variants: JSON schemas of the variants of that table by `kind`.
    """

    path: str
    key: Key | None
    table: Schema
    variants: Mapping[str, Schema]


class KeyList:
    """Keys of a cell file.

    Args:
        schema: JSON schema of the model of the file.
    """

    def __init__(self, schema: Schema) -> None:
        self._definitions: Schema = schema["$defs"]
        self._root = schema
        self.keys: Final = tuple(self._table(schema, ""))

    def place(self, location: Sequence[str | int]) -> Place:
        """Return the place that pydantic's `loc` stands for."""
        path, key, table = "", Key("", self._root), self._root
        variants: Mapping[str, Schema] = {}
        for part in location:
            if isinstance(part, int):
                path = f"{path}[{part}]"
                if "items" in key.schema:
                    key = Key(path, self._resolved(key.schema["items"]))
            elif "oneOf" in key.schema:  # `loc` names the variant, too
                variants = self.variants(key.schema)
                key = Key(path, variants[part])
            else:
                table, path = key.schema, joined(path, shown(part, bare=True))
                if part not in table["properties"]:
                    return Place(path, None, table, variants)
                key = Key(path, self._resolved(table["properties"][part]))
        return Place(path, key, table, variants)

    def finding(self, kind: str, location: tuple[str | int, ...], value: Any) -> str:
        """Return a message that reports what was found, what is allowed and what to do, for an error of pydantic.

        Args:
            kind: Type of the error.
            location: Its `loc`.
            value: The value that is wrong, or the one around it.
        """
        if kind == "missing" and isinstance(location[-1], int):
            kind, location = "too_short", location[:-1]
        place = self.place(location)
        path, described = place.path, place.key
        if described is None:
            return self._unknown_key(place, str(location[-1]))
        if "items" in described.schema:
            most = described.schema["maxItems"]
            found = f"{len(value)} tables" if isinstance(value, tuple) else shown(value)
            return f"{path} is {found}: allowed is an array of at most {most} tables. Write each as [[{path}]]"
        if kind.startswith("union_tag"):
            kind, value = "" if "kind" in value else "missing", value.get("kind")
            described = self.kind(described.schema, path)
            path = described.path
        elif "properties" in described.schema or "oneOf" in described.schema:
            if kind == "missing":
                return f"{path} is missing: a cell has two arms. Add a table [{path}]"
            return f"{path} is {shown(value)}: allowed is a table. Write it as [{path}]"
        if kind == "missing":
            return missing(path, described, "it has to be there")
        several = f"{described.count} of them in brackets," if described.count and path == described.path else "it"
        return f"{path} is {shown(value)}: allowed is {described.allowed}. Write {several} as in {described.sample}"

    def _unknown_key(self, place: Place, name: str) -> str:
        names, table = list(place.table["properties"]), place.path.rpartition(".")[0]
        text = f"{place.path} is no key of a cell file. "
        other = next((kind for kind, each in place.variants.items() if name in each["properties"]), None)
        if near := difflib.get_close_matches(name[:60], names, 1):
            text += f"Did you mean {near[0]}? "
        elif other is not None:
            text += f"It is one with kind = {json.dumps(other)} only. "
        elif elsewhere := next((each for each in self.keys if each.name == name), None):
            text += f"Did you mean {elsewhere.label}? "
        where = f"in [{table}]" if table else "at the top"
        return f"{text}Allowed {where} are {', '.join(names)}. Correct it, or take it out"

    def strays(self, location: Sequence[str | int], found: Mapping[str, Any]) -> Iterator[str]:
        """Yield the findings of a table whose `kind` is not legal: keys that no variant has.

        Args:
            location: Pydantic's `loc` of the table.
            found: The table.
        """
        path, key, _, _ = self.place(location)
        variants = [] if key is None else [each["properties"] for each in self.variants(key.schema).values()]
        common = {"properties": [name for name in variants[0] if all(name in each for each in variants)]}
        for name in found:
            if not any(name in each for each in variants):
                yield self._unknown_key(Place(joined(path, shown(name, bare=True)), None, common, {}), name)

    def variants(self, schema: Schema) -> dict[str, Schema]:
        """Return the JSON schema of each variant of a table by its `kind`."""
        tables = [self._resolved(each) for each in schema["oneOf"]]
        return {each["properties"]["kind"]["const"]: each for each in tables}

    def kind(self, schema: Schema, path: str) -> Key:
        """Return the key `kind` of a table with variants."""
        default = (schema.get("default") or {}).get("kind")
        value = {"type": "string", "enum": list(self.variants(schema)), "default": default}
        return Key(f"{path}.kind", {**value, "description": schema.get("description", "")}, required=default is None)

    def _resolved(self, schema: Schema) -> Schema:
        """Return the schema with its reference replaced, and without the null of an optional value."""
        for each in schema.get("anyOf", ()):
            if each.get("type") != "null":
                schema = {**each, **{name: value for name, value in schema.items() if name != "anyOf"}}
        if "$ref" in schema:
            own = {name: value for name, value in schema.items() if name != "$ref"}
            schema = {**self._definitions[schema["$ref"].rsplit("/", 1)[-1]], **own}
        return schema

    def _table(self, table: Schema, path: str, variant: str = "") -> Iterator[Key]:
        for name, value in table["properties"].items():
            schema, here = self._resolved(value), joined(path, name if name not in ARMS else "ARM")
            inner = {**self._resolved(schema["items"]), **schema} if "items" in schema else schema
            if "oneOf" in inner:
                yield from self._varied(inner, here)
            elif "properties" in inner:
                if name != ARMS[1]:
                    yield from self._table(inner, here)
            elif not (variant and name == "kind"):
                yield Key(here, schema, name in table.get("required", ()), variant)

    def _varied(self, schema: Schema, path: str) -> Iterator[Key]:
        yield self.kind(schema, path)
        variants = self.variants(schema)
        found = [key for kind, each in variants.items() for key in self._table(each, path, kind)]
        for key in found:
            same = [each for each in found if replace(each, variant=key.variant) == key]
            if len(same) < len(variants):
                yield key
            elif key is same[0]:
                yield replace(key, variant="")  # a key that all variants have


def joined(path: str, name: str) -> str:
    """Return the path of a key of the table at `path`."""
    return f"{path}.{name}" if path else name


def missing(path: str, key: Key, reason: str) -> str:
    """Return the message about a key that is missing."""
    return f"{path} is missing: {reason}. Add a line such as {key.sample} ({key.allowed})"


def shown(value: Any, bare: bool = False, depth: int = 0) -> str:
    """Return a value as a message may show it: short, and on one line."""
    if isinstance(value, int) and not isinstance(value, bool) and abs(value) > 10**30:
        return "a very large number"  # Python refuses to write the largest
    if isinstance(value, Mapping):
        return "a table"
    if depth > _DEPTH:
        return "..."
    if isinstance(value, bool):
        return "true" if value else "false"
    if isinstance(value, list | tuple):
        inside = ", ".join(shown(each, depth=depth + 1) for each in value[:8]) + ", ..." * (len(value) > 8)
        text = f"[{inside}]"
    elif isinstance(value, str):
        text = json.dumps(value[: 2 * _SHOWN])
        text = text[1:-1] if bare else text
    else:
        text = str(value)
    return text if len(text) <= _SHOWN else text[: _SHOWN - 3] + "..."


def toml_text(values: Mapping[str, Any], comment: Comment = lambda path: None) -> str:
    """Return plain values as TOML.

    Args:
        values: Numbers, texts, switches, sequences of them, tables, and sequences of tables.
        comment: Comment after a key or above a table, by its path.
    """
    return "\n".join(_blocks(values, "", "", comment))


def toml_value(value: Any) -> str:
    """Return one value as TOML."""
    if isinstance(value, Sequence) and not isinstance(value, str):
        return f"[{', '.join(map(toml_value, value))}]"
    # JSON's escapes are TOML's, but for a control character that JSON leaves as it is.
    return json.dumps(value, ensure_ascii=False).replace("\x7f", "\\u007f")


def _blocks(values: Mapping[str, Any], header: str, path: str, comment: Comment) -> list[str]:
    """Return one text per table, that of `values` first."""
    above = comment(path) if path else None
    lines = ([f"# {above}"] if above else []) + ([header] if header else [])
    inner: list[str] = []
    for name, value in values.items():
        here = joined(path, name)
        if isinstance(value, Mapping):
            inner += _blocks(value, f"[{here}]", here, comment)
        elif isinstance(value, list | tuple) and value and isinstance(value[0], Mapping):
            for each in value:
                inner += _blocks(each, f"[[{here}]]", here, comment)
        else:
            beside = comment(here)
            lines.append(f"{name} = {toml_value(value)}" + (f"  # {beside}" if beside else ""))
    # A table that only holds tables needs no header of its own.
    return (["\n".join(lines) + "\n"] if len(lines) > (1 if header else 0) or not inner else []) + inner
