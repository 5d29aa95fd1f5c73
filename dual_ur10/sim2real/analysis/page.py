"""What the demonstration's report is built of: text, tables, pictures and videos as HTML, and the page around them."""

from __future__ import annotations

import base64
import math
from collections.abc import Iterable, Sequence
from html import escape
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from dual_ur10.cli.demo_report.film import Film, KeyFrame

_MOST_VIDEO_BYTES = 6_000_000  # a page with more in it opens slowly

Headers = Sequence[tuple[str, str]]
"""Names and units of columns."""


def number(value: float) -> str:
    """A figure to no more than can be read from it: three digits, at most four after the point."""
    if math.isnan(value):
        return "—"
    size = abs(value)
    if size < 5e-5:
        return "0.0000"
    digits = min(4, max(0, 2 - math.floor(math.log10(size))))
    return f"{value:.{digits}f}".replace("-", "−")


def text(words: str) -> str:
    """A paragraph below a table or a picture, of HTML."""
    return f"<p class='caption'>{words}</p>"


def lead(words: str) -> str:
    """A paragraph that begins a section, of HTML."""
    return f"<p class='lead'>{words}</p>"


def image(address: str, words: str) -> str:
    """A picture, with words for those who cannot see it."""
    return f"<figure><img alt='{escape(words)}' src='{address}'></figure>"


def tiles(entries: Iterable[tuple[str, str, str]]) -> str:
    """Figures in large, each with what it is and its kind: "main", "faint" or ""."""
    cells = (
        f"<div class='tile {kind}'><b>{escape(value)}</b><span>{escape(words)}</span></div>"
        for value, words, kind in entries
    )
    return f"<div class='tiles'>{''.join(cells)}</div>"


def note(title: str, points: Iterable[str]) -> str:
    """Points, of HTML, that are not to be overlooked."""
    listed = "".join(f"<li>{point}</li>" for point in points)
    return f"<section class='note'><h2>{escape(title)}</h2><ul>{listed}</ul></section>"


def table(name: str, headers: Headers, rows: Iterable[tuple[str, str, Sequence[str]]]) -> str:
    """A table.

    Args:
        name: Its id.
        headers: Of all columns but the first.
        rows: Title, kind ("weak", "ours" or "") and cells of each.
    """
    head = "".join(f"<th>{escape(each)}<br><small>{unit}</small></th>" for each, unit in headers)
    body = "".join(
        f"<tr class='{kind}'><th>{escape(title)}</th>{''.join(f'<td>{escape(cell)}</td>' for cell in cells)}</tr>"
        for title, kind, cells in rows
    )
    return (
        f"<div class='scroll'><table id='{name}'><thead><tr><th></th>{head}</tr></thead>"
        f"<tbody>{body}</tbody></table></div>"
    )


def video(film: Film | None) -> str:
    """A film, in the page unless it is too large; nothing if there is none."""
    if film is None:
        return ""
    data = film.path.read_bytes()
    if len(data) > _MOST_VIDEO_BYTES:
        source = escape(film.path.name)
    else:
        source = "data:video/mp4;base64," + base64.b64encode(data).decode()
    pace = "In real time" if math.isclose(film.pace, 1.0) else f"{film.pace:g} times faster than in reality"
    return (
        f"<figure><video controls loop muted playsinline src='{source}'></video>"
        f"<figcaption>{escape(film.text)} {pace}.</figcaption></figure>"
    )


def pictures(frames: Sequence[KeyFrame]) -> str:
    """Pictures side by side; nothing if there are none."""
    if not frames:
        return ""
    cells = (
        f"<figure><img alt='{escape(each.title)}' src='{each.address}'>"
        f"<figcaption><b>{escape(each.title[:1].upper() + each.title[1:])}</b>{escape(each.text)}</figcaption></figure>"
        for each in frames
    )
    return f"<div class='frames'>{''.join(cells)}</div>"


def page(body: str) -> str:
    """The whole page."""
    return _PAGE.replace("{body}", body).replace("{style}", _STYLE)


_STYLE = """
:root { color-scheme: light; --ink: #263238; --soft: #607d8b; --line: #dfe5e8; --blue: #0072B2; }
* { box-sizing: border-box; }
body { margin: 0; background: #f6f8f9; color: var(--ink); font: 15px/1.5 system-ui, "Segoe UI", Roboto, Arial,
  sans-serif; }
main { max-width: 1080px; margin: 0 auto; padding: 28px 24px 56px; }
h1 { font-size: 30px; margin: 0 0 4px; letter-spacing: -0.3px; }
h2 { font-size: 24px; margin: 56px 0 4px; padding-top: 22px; border-top: 1px solid var(--line);
  letter-spacing: -0.2px; }
h3 { font-size: 18px; margin: 34px 0 10px; }
nav { margin: 14px 0 0; }
nav a { color: var(--blue); text-decoration: none; margin-right: 18px; font-weight: 600; }
nav a:hover { text-decoration: underline; }
.sub { color: var(--soft); margin: 0; }
.tiles { display: grid; grid-template-columns: repeat(4, 1fr); gap: 12px; margin: 22px 0; }
.tile { background: #fff; border: 1px solid var(--line); border-radius: 10px; padding: 14px 16px; }
.tile b { display: block; font-size: 25px; letter-spacing: -0.4px; }
.tile span { color: var(--soft); font-size: 13px; }
.tile.main { background: var(--blue); border-color: var(--blue); color: #fff; }
.tile.main span { color: #dbeaf4; }
.tile.faint b { color: #90a4ae; }
.note { background: #fffdf3; border: 1px solid #efe3ae; border-radius: 10px; padding: 4px 20px 8px; margin: 22px 0; }
.note h2 { margin: 12px 0 4px; padding: 0; border: 0; font-size: 16px; letter-spacing: 0; }
.note ul { margin: 6px 0; padding-left: 20px; }
.note li { margin: 5px 0; }
figure { margin: 0; background: #fff; border: 1px solid var(--line); border-radius: 10px; padding: 12px; }
figure img, figure video { display: block; width: 100%; border-radius: 4px; }
figcaption, .caption { color: var(--soft); font-size: 13.5px; margin: 8px 2px 0; }
.frames { display: grid; grid-template-columns: repeat(4, 1fr); gap: 12px; }
.frames figure { padding: 8px; }
.frames figcaption { font-size: 12.5px; line-height: 1.4; margin-top: 6px; }
.frames figcaption b { display: block; color: var(--ink); font-size: 13.5px; }
.lead { margin: 6px 0 16px; max-width: 860px; }
.scroll { overflow-x: auto; background: #fff; border: 1px solid var(--line); border-radius: 10px; }
table { border-collapse: collapse; width: 100%; font-variant-numeric: tabular-nums; font-size: 14px; }
th, td { padding: 8px 12px; text-align: right; white-space: nowrap; border-top: 1px solid var(--line); }
thead th { border-top: 0; vertical-align: bottom; font-size: 13px; white-space: normal; }
small { color: var(--soft); font-weight: 400; }
th:first-child { text-align: left; font-weight: 600; }
tr.weak th, tr.weak td { color: #90a4ae; font-weight: 400; }
tr.ours th, tr.ours td { background: #eef6fb; }
code { background: #eceff1; border-radius: 4px; padding: 1px 5px; font-size: 0.92em; }
footer { color: var(--soft); margin-top: 40px; font-size: 13.5px; }
@media (max-width: 760px) { .tiles, .frames { grid-template-columns: repeat(2, 1fr); } }
@media print { body { background: #fff; } figure, .scroll { break-inside: avoid; } }
"""

_PAGE = """<!DOCTYPE html>
<html lang="en">
<head>
<meta charset="utf-8">
<meta name="viewport" content="width=device-width, initial-scale=1">
<title>Two UR10s, three tasks: what dual-ur10 does</title>
<style>{style}</style>
</head>
<body>
<main>
{body}
</main>
</body>
</html>
"""
