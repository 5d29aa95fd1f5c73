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
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final, Generic, TypeVar

from dual_ur10.errors import MissingExtraError

if TYPE_CHECKING:
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
class PageRow:
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
class PageTable:
    """A table, as the macro `table` of `parts.html` takes it.

    Attributes:
        name: Id in the page.
        columns: All columns but the first, which holds the titles of the rows.
        rows: Rows from top to bottom.
    """

    name: str
    columns: tuple[Column[Any], ...]
    rows: tuple[PageRow, ...]

    @classmethod
    def of(cls, name: str, columns: Sequence[Column[Item]], items: Iterable[tuple[str, str, Item]]) -> PageTable:
        """Return the table with a row for each title, kind and item."""
        rows = (PageRow(title, tuple(_cell(each.cell(item)) for each in columns), kind) for title, kind, item in items)
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
    try:
        import jinja2
    except ImportError:
        raise MissingExtraError("jinja2", "plot", "a report") from None
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
