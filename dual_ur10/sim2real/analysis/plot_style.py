"""What all figures of the demonstration's report share: their style, and how they come into a page."""

from __future__ import annotations

import base64
import io
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

# Okabe and Ito's colours, which colour-blind readers can tell apart.
ARM_COLORS = ("#0072B2", "#D55E00")
INK, SOFT, LIMIT = "#263238", "#90a4ae", "#b71c1c"

_STYLE: Any = {
    "font.size": 10,
    "axes.titlesize": 10.5,
    "axes.titleweight": "bold",
    "axes.titlelocation": "left",
    "axes.grid": True,
    "axes.axisbelow": True,
    "axes.edgecolor": "#90a4ae",
    "axes.spines.top": False,
    "axes.spines.right": False,
    "grid.color": "#e3e8eb",
    "lines.linewidth": 1.3,
    "legend.frameon": False,
    "legend.fontsize": 9,
    "svg.hashsalt": "dual-ur10",  # the same data give the same file
}


@contextmanager
def figure(rows: int, columns: int, height: float, **keywords: Any) -> Iterator[tuple[Any, Any, list[str]]]:
    """A figure, its axes, and a list that receives its address as a `data:` URI."""
    import matplotlib
    from matplotlib.figure import Figure

    address: list[str] = []
    with matplotlib.rc_context(_STYLE):
        drawn = Figure(figsize=(11, height), layout="constrained")
        axes = drawn.subplots(rows, columns, squeeze=False, **keywords)
        yield drawn, axes, address
        buffer = io.BytesIO()
        drawn.savefig(buffer, format="svg", metadata={"Date": None, "Creator": None})
        address.append("data:image/svg+xml;base64," + base64.b64encode(buffer.getvalue()).decode())


def legend_right(axis: Any) -> None:
    """A legend beside the axes."""
    axis.legend(loc="center left", bbox_to_anchor=(1.0, 0.5))


def capital(text: str) -> str:
    """The text with a capital at its begin."""
    return text[:1].upper() + text[1:]
