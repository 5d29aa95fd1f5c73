"""Plots of a live page."""

from __future__ import annotations

from typing import Any, Final

import numpy as np

from dual_ur10.envs.rendering.live.about import About
from dual_ur10.envs.rendering.live.history import SHOWN_S, History
from ur_core.kinematics.ur10 import ARMS
from ur_core.types import Array

_SERIES_RGB: Final = ("#2878ff", "#ff7814")


class Plots:
    """Plots of the last seconds."""

    def __init__(self, gui: Any, about: About) -> None:
        self.history = History(np.array(about.speed_rad_s))
        none = np.array([-SHOWN_S, 0.0])
        blank = np.array([np.nan, np.nan])
        self._plots: list[tuple[Any, tuple[int, ...]]] = []
        with gui.add_folder("Plots", expand_by_default=False):
            for title, columns, names in (
                ("Tracking error, mrad", (1, 2), ARMS),
                ("Speed, share of the limit", (3, 4), ARMS),
                ("Clearance above the least, mm", (5,), ("arms",)),
                ("Lateness and skew, ms", (6, 7), ("late", "skew")),
            ):
                series = [{"label": "s"}, *_series(names)]
                plot = gui.add_uplot(
                    (none, *(blank for _ in columns)),
                    tuple(series),
                    title=title,
                    scales={"x": {"time": False, "auto": False, "range": (-SHOWN_S, 0.0)}, "y": {"auto": True}},
                    height=150,
                )
                self._plots.append((plot, columns))

    def draw(self, now_s: float) -> None:
        """Show the series."""
        series = self.history.series(now_s)
        if len(series[0]) < 2:
            return
        for plot, columns in self._plots:
            if any(np.isfinite(series[column]).any() for column in columns):
                plot.data = (series[0], *(_known(series[column]) for column in columns))


def _known(values: Array) -> Array:
    """Return values with the last known one, at first 0, in place of those that are not known: a plot needs all."""
    known = np.where(np.isfinite(values), np.arange(len(values)), -1)
    last = np.maximum.accumulate(known)
    return np.where(last < 0, 0.0, values[last])


def _series(names: tuple[str, ...]) -> list[dict[str, Any]]:
    return [{"label": name, "stroke": rgb, "width": 1.5} for name, rgb in zip(names, _SERIES_RGB, strict=False)]
