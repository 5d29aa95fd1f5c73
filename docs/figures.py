"""Draw the plots of the benchmarks and of the stock learners from the JSON beside those pages, and the diagrams."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import matplotlib

matplotlib.use("Agg")
import matplotlib.pyplot as plt
import numpy as np

DOCS = Path(__file__).parent
OURS, LIGHT, PEER, BAD = "#3f51b5", "#9fa8da", "#9e9e9e", "#c62828"
STYLE = {
    "font.size": 11.0,
    "axes.titlesize": 11.0,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.axisbelow": True,
    "svg.hashsalt": "dual_ur10",  # the same file from the same figures
}
Rows = list[dict[str, Any]]


def interval(k: int, n: int) -> tuple[float, float]:
    """Return Wilson's 95 % interval of k successes of n, in percent."""
    z2 = 1.959964**2
    middle, width = k + z2 / 2, (z2 * (k * (n - k) / n + z2 / 4)) ** 0.5
    return 100 * (middle - width) / (n + z2), 100 * (middle + width) / (n + z2)


def _labelled(axis: Any, rows: Rows) -> Any:
    """Put the labels of rows at the left, the first one on top, and return their heights."""
    heights = np.arange(len(rows))[::-1]
    axis.set_yticks(heights, [each["label"] for each in rows])
    axis.tick_params(axis="y", length=0)
    axis.grid(axis="x", alpha=0.3)
    axis.set_ylim(-0.6, len(rows) - 0.4)
    return heights


def success(axis: Any, rows: Rows) -> None:
    """Draw a point with its interval for each row."""
    for height, each in zip(_labelled(axis, rows), rows, strict=True):
        percent, (low, high) = 100 * each["k"] / each["n"], interval(each["k"], each["n"])
        axis.plot([low, high], [height, height], color=OURS, lw=2)
        axis.plot(percent, height, "o", color=OURS, ms=6)
        axis.text(min(low, 96) - 2, height, f"{each['k']}", ha="right", va="center")
    axis.set_xlim(0, 102)
    axis.set_xlabel("%")


def speed(axis: Any, rows: Rows) -> None:
    """Draw three bars for each row: another simulator, one environment, 64 environments."""
    kinds = (
        ("peer", "robosuite 1.5.2", PEER),
        ("one", "one environment", LIGHT),
        ("batch", "64 environments", OURS),
    )
    for height, each in zip(_labelled(axis, rows), rows, strict=True):
        for place, (kind, label, colour) in zip((0.27, 0.0, -0.27), kinds, strict=True):
            first = label if each is rows[0] else None
            axis.barh(height + place, each[kind], height=0.25, color=colour, label=first)
            axis.text(each[kind] + 1, height + place, f"{each[kind]:g}", va="center")
    axis.set_xlim(0, 92)
    axis.legend(frameon=False, loc="upper right", fontsize=10)


def two_arms(axis: Any, rows: Rows) -> None:
    """Draw each row as a ratio of its goal, on a quiet and on a busy machine."""
    for height, each in zip(_labelled(axis, rows), rows, strict=True):
        for kind, filled, above in (("quiet", OURS, 9), ("busy", "white", -19)):
            ratio, first = each[kind] / each["goal"], kind if each is rows[0] else None
            axis.plot(ratio, height, "o", ms=8, mfc=filled, mec=OURS, mew=1.5, ls="", label=first, clip_on=False)
            place = {"xytext": (0, above), "textcoords": "offset points", "ha": "center"}
            box = {"facecolor": "white", "edgecolor": "none", "pad": 1}  # the line of the goal does not cross it
            axis.annotate(f"{each[kind]:g}", (ratio, height), bbox=box, **place)
    axis.axvline(1.0, color=BAD, lw=1.5)
    axis.set_xticks([0, 1, 2], ["0", "goal", "2"])
    axis.set_xlim(-0.08, 2.2)
    axis.legend(frameon=False, loc="upper right", fontsize=10)


def returns(axis: Any, rows: Rows) -> None:
    """Draw the return of each training over its steps."""
    for each, colour, line in zip(rows, ("#3f51b5", "#3f51b5", "#ef6c00", "#2e7d32", "#9e9e9e"), "-:---", strict=False):
        axis.plot(each["thousand_steps"], each["return"], line, color=colour, marker="o", ms=3, label=each["label"])
    axis.set_xlim(0, 620)
    axis.set_ylim(0, 780)
    axis.set_xlabel("thousand steps")
    axis.set_ylabel("return (script: 750)")
    axis.grid(alpha=0.3)
    axis.legend(frameon=False, fontsize=9.5, loc="center right")


def noise(axis: Any, rows: Rows) -> None:
    """Draw the flange error of an exact policy over the deviation of its actions."""
    for each, colour in zip(rows, (OURS, "#ef6c00"), strict=True):
        axis.loglog(each["deviation"], each["flange_error_mm"], color=colour, marker="o", ms=4, label=each["label"])
    axis.set_xticks([0.003, 0.01, 0.03, 0.1], ["0.003", "0.01", "0.03", "0.1"])
    axis.set_yticks([0.3, 1, 3, 10], ["0.3", "1", "3", "10"])
    axis.set_xlabel("standard deviation, fraction of the speed limit")
    axis.set_ylabel("flange error, mm")
    axis.grid(alpha=0.3)
    axis.legend(frameon=False, fontsize=9.5)


def stages(axis: Any, rows: Rows) -> None:
    """Draw the stages of Handover that each training passed."""
    for each in rows:
        axis.plot(each["thousand_steps"], each["stages"], color=LIGHT, marker="o", ms=3)
    axis.axhline(7, color=BAD, lw=1.5)
    axis.text(990, 6.75, "success", color=BAD, ha="right", va="top")
    axis.axhline(5, color=PEER, lw=1.0, ls="--")
    axis.text(990, 5.1, "both arms hold the block", color="#616161", ha="right", va="bottom")
    axis.set_ylim(0, 7.3)
    axis.set_xlim(0, 1020)
    axis.set_xlabel("thousand steps")
    axis.set_ylabel("stages passed, of 7")
    axis.grid(alpha=0.3)


LEARNERS = {"script": "#616161", "dagger": OURS, "bc": "#ef6c00", "act": "#00838f", "ppo": BAD}
"""Colours of the learners of the baselines."""


def baselines(axis: Any, rows: Rows) -> None:
    """Draw a point with its interval for each learner of each task, on mild plants."""
    shown = set()
    for height, each in zip(_labelled(axis, rows), rows, strict=True):
        for number, (learner, colour) in enumerate(LEARNERS.items()):
            if learner not in each:
                continue
            k, n = each[learner]["mild"]
            low, high = interval(k, n)
            y = height + 0.3 - 0.15 * number
            label = {} if learner in shown else {"label": learner}
            axis.errorbar(
                100 * k / n,
                y,
                xerr=[[max(0.0, 100 * k / n - low)], [max(0.0, high - 100 * k / n)]],
                fmt="o",
                ms=4,
                color=colour,
                **label,
            )
            shown.add(learner)
    axis.set_xlim(-3, 103)
    axis.set_xlabel("success, %, on mild plants")
    axis.legend(
        frameon=False,
        fontsize=9.5,
        ncols=5,
        loc="lower left",
        bbox_to_anchor=(-0.1, 1.0),
        columnspacing=0.9,
        handletextpad=0.4,
    )


def ladder(axis: Any, rows: Rows) -> None:
    """Draw the success of each training of PPO over its steps."""
    for each, colour in zip(rows, plt.colormaps["tab10"].colors, strict=False):
        for number, curve in enumerate(each["curves"]):
            steps = [point["steps"] / 1e3 for point in curve]
            success = [100 * point["success"] for point in curve]
            label = {"label": each["label"]} if number == 0 else {}
            axis.semilogx(steps, success, color=colour, marker="o", ms=3, lw=1.2, alpha=0.8, **label)
    axis.set_ylim(-3, 103)
    axis.set_xticks([30, 100, 300, 1000, 2000], ["30", "100", "300", "1,000", "2,000"])
    axis.minorticks_off()
    axis.set_xlabel("thousand steps")
    axis.set_ylabel("success, %")
    axis.grid(alpha=0.3)
    axis.legend(frameon=False, fontsize=9.5, loc="center right")


class Diagram(NamedTuple):
    """Boxes and arrows.

    Attributes:
        boxes: Column and row of each box, and what it does, by its name.
        arrows: Names of both ends, the text beside the middle, and True for both directions.
        size: Width and height in inches.
    """

    boxes: dict[str, tuple[float, float, str]]
    arrows: list[tuple[str, str, str, bool]]
    size: tuple[float, float]

    def draw(self, axis: Any) -> None:
        """Draw it."""
        for name, (x, y, what) in self.boxes.items():
            box = {"boxstyle": "round,pad=0.02", "facecolor": "#e8eaf6", "edgecolor": OURS}
            axis.add_patch(matplotlib.patches.FancyBboxPatch((x - 0.4, y - 0.26), 0.8, 0.52, **box))
            axis.text(x, y + (0.14 if what else 0.0), name, ha="center", va="center", fontweight="bold", fontsize=9)
            axis.text(x, y - 0.1, what, ha="center", va="center", fontsize=8.5)
        for first, second, text, both in self.arrows:
            (x, y, _), (to_x, to_y, _) = self.boxes[first], self.boxes[second]
            wide, tall = abs(to_x - x), abs(to_y - y)
            share = min(0.43 / max(wide, 1e-9), 0.29 / max(tall, 1e-9))  # to the edge of a box
            begin, end = (
                (x + share * (to_x - x), y + share * (to_y - y)),
                (to_x - share * (to_x - x), to_y - share * (to_y - y)),
            )
            arrow = {"arrowstyle": "<|-|>" if both else "-|>", "color": OURS, "lw": 1.5, "shrinkA": 0, "shrinkB": 0}
            axis.annotate("", end, begin, arrowprops=arrow)
            middle, beside = ((x + to_x) / 2, (y + to_y) / 2), 0.05 if x == to_x else 0.0
            box = {"facecolor": "white", "edgecolor": "none", "pad": 0.5}
            side = "left" if x == to_x else "center"
            axis.text(middle[0] + beside, middle[1], text, ha=side, va="center", fontsize=8.5, style="italic", bbox=box)
        columns, rows = zip(*((x, y) for x, y, _ in self.boxes.values()), strict=True)
        axis.set_xlim(min(columns) - 0.46, max(columns) + 0.46)
        axis.set_ylim(min(rows) - 0.32, max(rows) + 0.32)
        axis.set_axis_off()


DIAGRAMS = {
    "architecture": Diagram(
        {
            "policy": (0, 1, ""),
            "adapter": (1, 1, "targets of\none period"),
            "leading": (2, 1, "along what\nis near"),
            "safety gate": (3, 1, "releases\nor refuses"),
            "cell": (3, 0, "waits for\nL ticks"),
            "arms": (2, 0, "simulated\nor real"),
            "CellState": (1, 0, "what a real cell\ncan measure"),
            "task": (0, 0, "observes,\nevaluates"),
        },
        [
            ("policy", "adapter", "", False),
            ("adapter", "leading", "", False),
            ("leading", "safety gate", "", False),
            ("safety gate", "cell", "targets", False),
            ("cell", "arms", "", False),
            ("arms", "CellState", "", False),
            ("CellState", "task", "", False),
            ("task", "policy", "observation", False),
        ],
        (4.9, 2.3),
    ),
    "processes": Diagram(
        {
            "program": (0.6, 2, "policy, adapter,\ngate"),
            "recorder": (2.6, 2, "both arms,\nall events"),
            "left arm": (0, 1, "one target per\ncontrol period"),
            "right arm": (1.2, 1, "one target per\ncontrol period"),
            "supervisor": (2.6, 1, "speed, faults,\nstops"),
            "left UR": (0, 0, "controller"),
            "right UR": (1.2, 0, "controller"),
        },
        [
            ("program", "recorder", "events", False),
            ("program", "left arm", "targets", True),
            ("program", "right arm", "states", True),
            ("program", "supervisor", "speed, faults", True),
            ("left arm", "left UR", "servoj", True),
            ("right arm", "right UR", "servoj", True),
            ("supervisor", "right UR", "both: stop", True),
        ],
        (4.9, 3.3),
    ),
    "emulated_cell": Diagram(
        {
            "clients": (0, 0, "any program"),
            "sockets": (1, 0, "bytes in,\nbytes out"),
            "Controller": (2, 0, "program,\nsafety, motion"),
            "MujocoWorld": (3, 0, "the arms of\nMujocoCell"),
        },
        [
            ("clients", "sockets", "", True),
            ("sockets", "Controller", "", True),
            ("Controller", "MujocoWorld", "", True),
        ],
        (4.9, 1.1),
    ),
}
"""Drawings of the pages on the architecture."""


PLOTS: dict[str, tuple[str, Callable[[Any, Rows], None]]] = {
    "success": ("reference/benchmarks", success),
    "speed": ("reference/benchmarks", speed),
    "two_arms": ("reference/benchmarks", two_arms),
    "returns": ("decisions/stock-learners", returns),
    "noise": ("decisions/stock-learners", noise),
    "stages": ("decisions/stock-learners", stages),
    "baselines": ("reference/baselines", baselines),
    "ladder": ("reference/ladder", ladder),
}
"""Page and function of each plot by its name in the JSON of the page."""


HEIGHTS = {"baselines": 4.6}
"""Heights of plots in inches that are not the usual one."""


def plot_of(name: str) -> dict[str, Any]:
    """Return the title and the rows of a plot."""
    found = json.loads((DOCS / f"{PLOTS[name][0]}.json").read_text())
    if name == "baselines":  # that JSON is the benchmark's own, by tasks
        return {
            "title": "Baselines",
            "rows": [{"label": task.partition("-v")[0], **row} for task, row in found.items()],
        }
    if name == "ladder":
        rows = [{"label": rung.replace("-v0", ""), **each["ppo"]} for rung, each in found.items() if "ppo" in each]
        return {"title": "Stock PPO on the rungs of the ladder", "rows": rows}
    plot: dict[str, Any] = found[name]
    return plot


def digest(plot: dict[str, Any]) -> str:
    """Return a hash of the figures of a plot, which its file holds."""
    return hashlib.sha256(json.dumps(plot, sort_keys=True).encode()).hexdigest()[:16]


def main() -> None:
    """Draw all plots into docs/images."""
    plt.rcParams.update(STYLE)
    for name, (_, draw) in PLOTS.items():
        plot = plot_of(name)
        figure, axis = plt.subplots(figsize=(5.2, HEIGHTS.get(name, 3.0)), layout="constrained")
        draw(axis, [each for each in plot["rows"] if each.get("drawn", True)])
        figure.suptitle(plot["title"], fontsize=11.5, x=0.01, ha="left", fontweight="bold")
        about = {"Date": None, "Source": digest(plot)}
        figure.savefig(DOCS / "images" / f"figure_{name}.svg", metadata=about)
        plt.close(figure)
    for name, diagram in DIAGRAMS.items():
        figure, axis = plt.subplots(figsize=diagram.size, layout="constrained")
        diagram.draw(axis)
        figure.savefig(DOCS / "images" / f"figure_{name}.svg", metadata={"Date": None})
        plt.close(figure)


if __name__ == "__main__":
    main()
