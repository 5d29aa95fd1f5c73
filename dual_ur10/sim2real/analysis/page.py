"""HTML reports: the environment of their templates, the columns of their tables, and their format of numbers.

A report is a template that extends `page.html`, which holds the head and the stylesheet. The macros of `parts.html`
write tables, tiles, notes, pictures and videos. Data are escaped: only templates hold HTML.
"""

from __future__ import annotations

import base64
import math
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from functools import cache
from html import escape
from pathlib import Path
from typing import Any, Final, Generic, TypeVar

import jinja2

_MOST_VIDEO_BYTES: Final = 6_000_000  # a page with more in it opens slowly

Item = TypeVar("Item")


@dataclass(frozen=True)
class Column(Generic[Item]):
    """One column of a table.

    Attributes:
        title: Heading.
        unit: Unit of the figures; empty: none.
        cell: Return the content for an item: text as it is, a float as `number` formats it.
    """

    title: str
    unit: str
    cell: Callable[[Item], str | float]


@dataclass(frozen=True)
class Row:
    """One row of a table.

    Attributes:
        title: Heading.
        cells: Text of each column.
        kind: Style: "weak", "ours" or "".
    """

    title: str
    cells: tuple[str, ...]
    kind: str = ""


@dataclass(frozen=True)
class Table:
    """A table, as the macro `table` of `parts.html` takes it.

    Attributes:
        name: Id in the page.
        columns: All columns but the first, which holds the titles of the rows.
        rows: Rows from top to bottom.
    """

    name: str
    columns: tuple[Column[Any], ...]
    rows: tuple[Row, ...]

    @classmethod
    def of(cls, name: str, columns: Sequence[Column[Item]], items: Iterable[tuple[str, str, Item]]) -> Table:
        """Return the table with a row for each title, kind and item."""
        rows = (Row(title, tuple(_cell(each.cell(item)) for each in columns), kind) for title, kind, item in items)
        return cls(name, tuple(columns), tuple(rows))


def _cell(value: str | float) -> str:
    return number(value) if isinstance(value, float) else str(value)


def number(value: float) -> str:
    """Format a figure with three digits, at most four of them after the point; NaN becomes a dash."""
    if math.isnan(value):
        return "—"
    size = abs(value)
    if size < 5e-5:
        return "0.0000"
    digits = min(4, max(0, 2 - math.floor(math.log10(size))))
    return f"{value:.{digits}f}".replace("-", "−")


def video_source(path: Path) -> str:
    """Return the `src` of a video: the video itself as a `data:` URI, or its file's name if it is too large."""
    data = path.read_bytes()
    return path.name if len(data) > _MOST_VIDEO_BYTES else "data:video/mp4;base64," + base64.b64encode(data).decode()


def render(template: str, package: str = __package__, **values: Any) -> str:
    """Render a template.

    Args:
        template: Name of the template.
        package: Package whose folder `templates` holds it; `page.html` and `parts.html` are found from everywhere.
        **values: Variables of the template.
    """
    return _environment(package).get_template(template).render(values)


@cache
def _environment(package: str) -> jinja2.Environment:
    loaders = [jinja2.PackageLoader(each) for each in dict.fromkeys((package, __package__))]
    environment = jinja2.Environment(
        loader=jinja2.ChoiceLoader(loaders),
        autoescape=True,
        undefined=jinja2.StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    environment.filters["number"] = number
    return environment


# Parts as strings, for the pages that still put their HTML together in Python.

Headers = Sequence[tuple[str, str]]


def text(words: str) -> str:
    """Return a caption of HTML."""
    return f"<p class='caption'>{words}</p>"


def lead(words: str) -> str:
    """Return an introduction of HTML."""
    return f"<p class='lead'>{words}</p>"


def _part(macro: str, *values: object) -> str:
    return str(getattr(_environment(__package__).get_template("parts.html").module, macro)(*values))


def image(address: str, words: str) -> str:
    """Return a picture."""
    return _part("image", address, words)


def tiles(entries: Iterable[tuple[str, str, str]]) -> str:
    """Return large figures."""
    return _part("tiles", entries)


def note(title: str, points: Iterable[str]) -> str:
    """Return a box of points of HTML."""
    listed = "".join(f"<li>{point}</li>" for point in points)
    return f"<section class='note'><h2>{escape(title)}</h2><ul>{listed}</ul></section>"


def table(name: str, headers: Headers, rows: Iterable[tuple[str, str, Sequence[str]]]) -> str:
    """Return a table."""
    columns = tuple(Column[Any](title, unit, str) for title, unit in headers)
    return _part("table", Table(name, columns, tuple(Row(title, tuple(cells), kind) for title, kind, cells in rows)))


def video(film: Any) -> str:
    """Return a film; nothing if there is none."""
    if film is None:
        return ""
    pace = "In real time" if math.isclose(film.pace, 1.0) else f"{film.pace:g} times faster than in reality"
    return _part("video", video_source(film.path), f"{film.text} {pace}.")


def pictures(frames: Sequence[Any]) -> str:
    """Return pictures side by side; nothing if there are none."""
    return _part("pictures", frames) if frames else ""


def page(body: str) -> str:
    """Return the whole page of the demonstration."""
    environment = _environment(__package__)
    source = '{% extends "page.html" %}{% block title %}Two UR10s, three tasks: what dual-ur10 does{% endblock %}'
    return environment.from_string(source + "{% block body %}{{ body | safe }}{% endblock %}").render(body=body)
