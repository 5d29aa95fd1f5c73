"""Style of all plots, and their embedding in a page."""

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
    """Yield a figure, its axes, and a list that receives the `data:` URI of the finished plot."""
    import matplotlib
    from matplotlib.figure import Figure

    address: list[str] = []
    with matplotlib.rc_context(_STYLE):
        canvas = Figure(figsize=(11, height), layout="constrained")
        axes = canvas.subplots(rows, columns, squeeze=False, **keywords)
        yield canvas, axes, address
        buffer = io.BytesIO()
        canvas.savefig(buffer, format="svg", metadata={"Date": None, "Creator": None})
        address.append("data:image/svg+xml;base64," + base64.b64encode(buffer.getvalue()).decode())


def legend_right(axis: Any) -> None:
    """Place the legend beside the axes."""
    axis.legend(loc="center left", bbox_to_anchor=(1.0, 0.5))


def capital(text: str) -> str:
    """Return the text with a capital first letter."""
    return text[:1].upper() + text[1:]
