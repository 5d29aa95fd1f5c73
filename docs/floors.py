"""Draw the floors of the three distributions and the imports between them from the contracts in `.importlinter`."""

from __future__ import annotations

import configparser
import hashlib
import json
from pathlib import Path
from typing import Any, NamedTuple

import matplotlib

matplotlib.use("Agg")
import matplotlib.pyplot as plt
from matplotlib.patches import FancyBboxPatch

ROOT = Path(__file__).parents[1]
PICTURE = ROOT / "docs" / "images" / "figure_distributions.svg"
DISTRIBUTIONS = {"dual_ur10": "dual-ur10", "ur_emulator": "ur-emulator", "ur_core": "ur-core"}
"""Names of the distributions by their packages."""

LINE = "#3f51b5"
PLAIN, ENVIRONMENTS, REAL = "#ffffff", "#c5cae9", "#ffe0b2"
EMULATES = "#c62828"


class Contracts(NamedTuple):
    """Contracts of imports that the picture shows.

    Attributes:
        floors: Floors of each package from the top, each with the names of its rooms in the package.
        outside: Roots above the packages that are part of no distribution.
        environments: Rooms that load no code of real arms.
        real: That code.
        importers: Modules that may import the emulator.
    """

    floors: dict[str, list[list[str]]]
    outside: list[str]
    environments: list[str]
    real: list[str]
    importers: list[str]

    def digest(self) -> str:
        """Return a hash of the contracts, which the picture holds."""
        return hashlib.sha256(json.dumps(self).encode()).hexdigest()[:16]


def contracts(path: Path = ROOT / ".importlinter") -> Contracts:
    """Return the contracts of a file."""
    file = configparser.ConfigParser()
    file.read(path)
    found = {name.rpartition(":")[2]: file[name] for name in file.sections() if ":" in name}
    floors: dict[str, list[list[str]]] = {each: [] for each in DISTRIBUTIONS}
    outside = []
    for contract in found.values():
        for line in contract.get("layers", "").split("\n"):
            modules = [each.strip() for each in line.split(":") if each.strip()]
            for package in sorted({each.partition(".")[0] for each in modules}):
                rooms = [each.partition(".")[2] for each in modules if each.startswith(f"{package}.")]
                if rooms:
                    floors[package].append(rooms)
                elif package not in floors:
                    outside.append(package)
    return Contracts(
        floors,
        outside,
        found["simulation"]["source_modules"].split(),
        found["simulation"]["forbidden_modules"].split(),
        found["emulator"]["allowed_importers"].split(),
    )


class Drawing:
    """Canvas whose unit is an inch.

    Args:
        width: Width.
        height: Height.
    """

    PITCH, BOX, GAP, PAD = 0.3, 0.22, 0.07, 0.07
    HEAD = 0.36

    def __init__(self, width: float, height: float) -> None:
        self.figure = plt.figure(figsize=(width, height))
        self.axis = self.figure.add_axes((0, 0, 1, 1))
        self.axis.set_xlim(0, width)
        self.axis.set_ylim(0, height)
        self.axis.set_axis_off()
        self.renderer: Any = self.figure.canvas.get_renderer()  # type: ignore[attr-defined]  # Agg has one

    def text(self, x: float, y: float, text: str, **style: Any) -> None:
        """Write a text that begins at x, with its middle at y."""
        self.axis.text(x, y, text, va="center_baseline", **{"fontsize": 8, **style})

    def box(self, x: float, y: float, width: float, height: float, **style: Any) -> None:
        """Draw a rounded box with its lower left corner at a place."""
        shape = "round,pad=0,rounding_size=0.05"
        self.axis.add_patch(FancyBboxPatch((x, y), width, height, boxstyle=shape, **style))

    def lines(self, rooms: list[str], width: float) -> list[list[tuple[str, float]]]:
        """Return the rooms of a floor with the widths of their boxes, in as few lines as hold them."""
        lines: list[list[tuple[str, float]]] = [[]]
        for room in rooms:
            label = self.axis.text(0, 0, room, fontsize=8)
            needed = label.get_window_extent(self.renderer).width / self.figure.dpi + 2 * self.PAD
            label.remove()
            taken = sum(each + self.GAP for _, each in lines[-1])
            if taken + needed > width:
                lines.append([])
            lines[-1].append((room, needed))
        return lines

    def panel(self, x: float, top: float, width: float, package: str, shown: Contracts) -> float:
        """Draw a distribution below a height, and return the height of its lower edge."""
        inner = width - 4 * self.PAD
        floors = [self.lines([each.replace(".", "/") for each in floor], inner) for floor in shown.floors[package]]
        heights = [len(each) * self.PITCH + 0.02 for each in floors]
        bottom = top - self.HEAD - sum(heights) - (len(floors) - 1) * 0.04 - self.PAD
        self.box(x, bottom, width, top - bottom, facecolor="#fafafa", edgecolor=LINE, lw=1.4)
        self.text(x + 2 * self.PAD, top - 0.18, DISTRIBUTIONS[package], fontsize=10, fontweight="bold")
        y = top - self.HEAD
        for lines, height in zip(floors, heights, strict=True):
            self.box(x + self.PAD, y - height, width - 2 * self.PAD, height, facecolor="#eceff1", edgecolor="none")
            for number, line in enumerate(lines):
                place, middle = x + 2 * self.PAD, y - 0.01 - (number + 0.5) * self.PITCH
                for room, needed in line:
                    module = f"{package}.{room.replace('/', '.')}"
                    emulates = any(f"{each}.".startswith(f"{module}.") for each in shown.importers)
                    colour = REAL if module in shown.real else ENVIRONMENTS if module in shown.environments else PLAIN
                    edge = {"edgecolor": EMULATES, "lw": 1.6} if emulates else {"edgecolor": "#9e9e9e", "lw": 0.6}
                    self.box(place, middle - self.BOX / 2, needed, self.BOX, facecolor=colour, **edge)
                    self.text(place + self.PAD, middle, room)
                    place += needed + self.GAP
            y -= height + 0.04
        return bottom

    def arrow(self, begin: tuple[float, float], end: tuple[float, float], colour: str = LINE) -> None:
        """Draw an import from one place to another."""
        style = {"arrowstyle": "-|>", "color": colour, "lw": 1.5, "shrinkA": 0, "shrinkB": 0}
        self.axis.annotate("", end, begin, arrowprops=style)

    def legend(self, x: float, top: float) -> float:
        """Explain colours and floors below a height, and return that of the lower edge."""
        rows: tuple[tuple[dict[str, Any], str], ...] = (
            ({"facecolor": ENVIRONMENTS, "edgecolor": "#9e9e9e", "lw": 0.6}, "environments"),
            ({"facecolor": REAL, "edgecolor": "#9e9e9e", "lw": 0.6}, "not loaded by environments"),
            ({"facecolor": PLAIN, "edgecolor": EMULATES, "lw": 1.6}, "may import ur-emulator"),
            ({"facecolor": "#eceff1", "edgecolor": "none"}, "floor: may import itself\nand those below"),
        )
        for number, (style, text) in enumerate(rows):
            middle = top - 0.15 - number * 0.28 - 0.05 * text.count("\n")
            self.box(x, middle - 0.08, 0.26, 0.16, **style)
            self.text(x + 0.34, middle, text, linespacing=1.25)
        return middle - 0.3


def draw(shown: Contracts) -> Any:
    """Return the figure of contracts."""
    width, left, right = 6.3, 3.45, 2.45
    margin, height = 0.05, 6.9
    beside = width - margin - right
    sheet = Drawing(width, height)
    top = height - margin
    for name in shown.outside:
        sheet.box(margin, top - 0.3, left, 0.3, facecolor="white", edgecolor="#9e9e9e", lw=1.0, ls="--")
        sheet.text(margin + 2 * sheet.PAD, top - 0.15, f"{name} (in no distribution)")
        sheet.arrow((margin + left / 2, top - 0.3), (margin + left / 2, top - 0.52))
        top -= 0.52
    bottom = sheet.panel(margin, top, left, "dual_ur10", shown)
    emulator = sheet.panel(beside, top, right, "ur_emulator", shown)
    core = sheet.panel(beside, emulator - 0.4, right, "ur_core", shown)
    bottom = min(bottom, core, sheet.legend(margin, bottom - 0.1))
    sheet.arrow((margin + left, (top + emulator) / 2), (beside, (top + emulator) / 2), EMULATES)
    middle = (emulator - 0.4 + core) / 2
    sheet.arrow((margin + left, middle), (beside, middle))
    sheet.arrow((beside + right / 2, emulator), (beside + right / 2, emulator - 0.4))
    sheet.axis.set_ylim(bottom - margin, height)
    sheet.figure.set_figheight(height - bottom + margin)
    return sheet.figure


def main() -> None:
    """Draw the picture into docs/images."""
    plt.rcParams["svg.hashsalt"] = "dual_ur10"  # the same file from the same contracts
    shown = contracts()
    draw(shown).savefig(PICTURE, metadata={"Date": None, "Source": shown.digest()})


if __name__ == "__main__":
    main()
