"""The demonstration's report: one HTML file with everything in it."""

from __future__ import annotations

import base64
import math
from collections.abc import Sequence
from html import escape
from pathlib import Path
from typing import TYPE_CHECKING

from dual_ur10 import __version__, figures
from dual_ur10.envs.sine_tracking import SineTracking
from dual_ur10.errors import DualUR10Error

if TYPE_CHECKING:
    from dual_ur10.runs import Result

HEADERS = (
    ("flange max", "mm"),
    ("flange RMS", "mm"),
    ("angle max", "°"),
    ("distance max", "mm"),
    ("vector max", "mm"),
    ("ripple max", "mm/s"),
    ("lag", "ms"),
    ("skew", "ms"),
)
"""Columns of the accuracy table, with their units."""

CLAIMS = (
    ("Gazebo, single arm", "± 0.3", "± 0.15", "—", "1.2"),
    ("Gazebo, dual-arm carry", "± 0.7", "± 0.22", "—", "1.8"),
    ("real, single arm", "± 0.6", "± 0.20", "—", "2.1"),
    ("real, dual-arm synchronous grasp", "± 0.8", "± 0.25", "—", "2.5"),
    ("sine on both arms, 0.1 m, 0.5 Hz, 30 s", "—", "—", "1.200 ± 0.001", "—"),
)
"""What the documents that this project started from state: position (mm), orientation (°), distance (m), cycle (ms)."""

_MOST_VIDEO_BYTES = 8_000_000  # a page with more in it opens slowly


def figures_of(result: Result) -> list[str]:
    """A result's cells of the accuracy table, in the order of `HEADERS`."""
    found = result.accuracy
    values = (
        found.flange_max_mm,
        found.flange_rms_mm,
        found.orientation_max_deg,
        found.distance_max_mm,
        found.vector_max_mm,
        1e3 * found.ripple_max_m_s,
        1e3 * result.lag_s,
        1e3 * result.skew_s,
    )
    return [_number(value) for value in values]


def _number(value: float) -> str:
    """A figure to no more than can be read from it: three digits, at most four after the point."""
    if math.isnan(value):
        return "—"
    size = abs(value)
    if size < 5e-5:
        return "0.0000"
    digits = min(4, max(0, 2 - math.floor(math.log10(size))))
    return f"{value:.{digits}f}".replace("-", "−")


def write_report(path: Path, results: Sequence[Result], video: Path | None, missing: str = "") -> None:
    """Write the report.

    Args:
        path: File to write.
        results: Of all runs of the demonstration.
        video: The video to show, or None.
        missing: Why there is no video.

    Raises:
        DualUR10Error: The file cannot be written.
    """
    named = {result.run.name: result for result in results}
    nominal, perturbed, lagging = named["nominal"], named["perturbed"], named["lagging"]
    fixed = named["perturbed_fixed"]
    duration_s = nominal.record.time_s[-1]
    limit = max(SineTracking.limits.speed_rad_s)
    body = "\n".join(
        (
            _head(duration_s),
            _tiles(nominal, perturbed, fixed, lagging),
            _caveats(),
            _video(video, missing),
            "<h2>Accuracy</h2>",
            _table(results),
            "<h2>The figures this project started from</h2>",
            _claims(named),
            "<h2>All runs at a glance</h2>",
            _image(figures.overview(named), "Flange error over time in all runs, on a logarithmic scale"),
            "<h2>Flange error of each arm</h2>",
            _image(figures.flange_error(named), "Flange error of both arms over time"),
            _text(
                "The scripted policy begins each episode knowing nothing of the plant. It learns, joint by joint, what "
                "offset, speed, friction and acceleration do to the arm, and takes it off its commands: compare the "
                "first two panels. Largest errors come at the reversals, where friction changes its sign."
            ),
            "<h2>Flange distance, and the error vector</h2>",
            _image(figures.distance_and_vector(named), "Flange distance and error vector over time"),
            _text(
                "A constant distance is a weak criterion, even to the ± 1 mm that is often asked for. On the right "
                f"both arms are up to {lagging.accuracy.flange_max_mm:.1f} mm behind their references, and the "
                f"distance is still right to {1e3 * lagging.accuracy.distance_max_mm:.1f} µm: lag that both arms "
                "share shows in neither distance nor vector, but only in the absolute error above. On the left the "
                "vector is worse than the distance, which hardly changes with errors across the line between the "
                "flanges."
            ),
            "<h2>Lag, with and without compensation</h2>",
            _image(figures.lag(named), "Displacement and error with and without compensation of the lag"),
            "<h2>Time skew between the arms</h2>",
            _image(figures.skew(named), "Displacements of both arms and their cross-correlation"),
            "<h2>Joint speeds</h2>",
            _image(figures.joint_speeds(named, limit), "Joint speeds of both arms against the limit"),
            "<h2>Speed ripple</h2>",
            _image(figures.ripple(named), "Speed of the flanges less that of their references"),
            _text("By central differences of positions 40 ms apart: faster ripple than 12.5 Hz is not in it."),
            _foot(),
        )
    )
    page = _PAGE.replace("{body}", body).replace("{style}", _STYLE)
    try:
        path.write_text(page, encoding="utf-8")
    except OSError as error:
        raise DualUR10Error(f"cannot write {path}: {error}") from error


def _head(duration_s: float) -> str:
    return (
        "<header><h1>Two UR10s on one sine</h1>"
        f"<p class='sub'>dual-ur10 {escape(__version__)} · DualUR10/SineTracking-v0 · 0.1 m at 0.5 Hz along y for "
        f"{duration_s:.0f} s · 25 Hz policy, 125 Hz servoj (lookahead 0.03 s, gain 2000)<br>bases at "
        "(−0.75, 0.60, 0) m and (−0.92, −0.45, 0.08) m</p></header>"
    )


def _tiles(nominal: Result, perturbed: Result, fixed: Result, lagging: Result) -> str:
    tiles = (
        (perturbed, "largest flange error, perturbed plant", "main"),
        (fixed, "the same plant without learning", ""),
        (lagging, "lag of servoj not compensated", ""),
        (nominal, "nominal: an artefact of an exact model", "faint"),
    )
    cells = (
        f"<div class='tile {kind}'><b>{_number(result.accuracy.flange_max_mm)} mm</b><span>{escape(text)}</span></div>"
        for result, text, kind in tiles
    )
    return f"<div class='tiles'>{''.join(cells)}</div>"


def _caveats() -> str:
    points = (
        "<b>No real arm was measured.</b> Everything here is simulation: MuJoCo, and a model of UR's unpublished "
        "<code>servoj</code> law. A real UR10 repeats to ± 0.1 mm, and its absolute accuracy is worse than that.",
        "<b>Nominal figures are an artefact of an exact model.</b> Where the feed-forward knows the plant exactly, the "
        "error is zero by construction. Only the perturbed rows mean something: masses + 5 %, Coulomb friction of 5, "
        "5, 3, 1, 1, 1 N·m in the joints, lookahead + 5 %, and 2 ms of latency that nobody compensates. The sizes of "
        "these perturbations are a choice, not data of UR's.",
        "<b>Action latency is L = 0</b> except where a row says otherwise: an action takes effect in the instant of "
        "its observation. On real arms it will not. Latency costs most in the first seconds, while the policy learns, "
        "and along other axes than y: <code>benchmarks/accuracy.py --full</code>.",
        "The bases are not symmetric on purpose: two equal arms in equal postures make equal errors, and the distance "
        "between them is then exact whatever the controller does.",
        "Flange poses are computed from the joint positions by the package's own kinematics, 25 times a second, from "
        "the first step on. One seed; the perturbed plant holds no noise.",
    )
    return "<section class='note'><h2>What these figures are, and are not</h2><ul>{}</ul></section>".format(
        "".join(f"<li>{point}</li>" for point in points)
    )


def _video(video: Path | None, missing: str) -> str:
    if video is None:
        return f"<section class='note'><p><b>No video:</b> {escape(missing)}</p></section>"
    data = video.read_bytes()
    if len(data) > _MOST_VIDEO_BYTES:
        source = escape(video.name)
    else:
        source = "data:video/mp4;base64," + base64.b64encode(data).decode()
    return (
        f"<figure><video controls loop muted playsinline src='{source}'></video>"
        "<figcaption>The perturbed run in real time.</figcaption></figure>"
    )


def _table(results: Sequence[Result]) -> str:
    head = "".join(f"<th>{escape(name)}<br><small>{unit}</small></th>" for name, unit in HEADERS)
    rows = []
    for result in results:
        kind = "weak" if "nominal" in result.run.title else ""
        cells = "".join(f"<td>{value}</td>" for value in figures_of(result))
        rows.append(f"<tr class='{kind}'><th>{escape(result.run.title)}</th>{cells}</tr>")
    return (
        f"<div class='scroll'><table id='accuracy'><thead><tr><th></th>{head}</tr></thead>"
        f"<tbody>{''.join(rows)}</tbody></table></div>"
        + _text(
            "Figures of the worse arm. Angle: of a flange to its reference orientation. Distance and vector: errors of "
            "the distance and of the vector between the flanges. Ripple: of the flange's speed. Lag: behind the "
            "reference, by cross-correlation. Skew: left arm behind the right one. Grey rows are those of an exact "
            "model."
        )
    )


def _claims(named: dict[str, Result]) -> str:
    single, dual = named["single_perturbed"].accuracy, named["perturbed"].accuracy
    ours = (
        ("here, single arm, perturbed", _number(single.flange_max_mm), _number(single.orientation_max_deg), "—"),
        (
            "here, both arms, perturbed",
            _number(dual.flange_max_mm),
            _number(dual.orientation_max_deg),
            f"1.200 ± {dual.distance_max_mm / 1e3:.5f}",
        ),
    )
    rows = [
        "<tr class='weak'>" + f"<th>{escape(row[0])}</th>" + "".join(f"<td>{cell}</td>" for cell in row[1:]) + "</tr>"
        for row in CLAIMS
    ]
    rows += [
        f"<tr class='ours'><th>{escape(row[0])}</th>"
        + "".join(f"<td>{cell}</td>" for cell in row[1:])
        + "<td>*</td></tr>"
        for row in ours
    ]
    units = (("position", "mm"), ("orientation", "°"), ("flange distance", "m"), ("control period", "ms"))
    head = "".join(f"<th>{name}<br><small>{unit}</small></th>" for name, unit in units)
    return (
        f"<div class='scroll'><table id='claims'><thead><tr><th></th>{head}</tr></thead>"
        f"<tbody>{''.join(rows)}</tbody></table></div>"
        + _text(
            "Grey: as stated by the documents that this project started from, without trials, payload or path; they "
            "name a laser tracker, which cannot measure Gazebo. The comparison is one of numbers only: no object is "
            "carried in this demonstration, and nothing here stands beside their rows for real arms. * A CB3 "
            "controller takes targets every 8 ms, so that a period of 2.1 to 2.5 ms is not possible on it; what a "
            "period costs in computing time is measured by <code>benchmarks/accuracy.py</code>."
        )
    )


def _foot() -> str:
    return (
        "<footer>Written by <code>python -m dual_ur10 demo</code>. The same figures over all axes: "
        "<code>python benchmarks/accuracy.py --full</code>.</footer>"
    )


def _image(address: str, text: str) -> str:
    return f"<figure><img alt='{escape(text)}' src='{address}'></figure>"


def _text(text: str) -> str:
    return f"<p class='caption'>{text}</p>"


_STYLE = """
:root { color-scheme: light; --ink: #263238; --soft: #607d8b; --line: #dfe5e8; --blue: #0072B2; }
* { box-sizing: border-box; }
body { margin: 0; background: #f6f8f9; color: var(--ink); font: 15px/1.5 system-ui, "Segoe UI", Roboto, Arial,
  sans-serif; }
main { max-width: 1080px; margin: 0 auto; padding: 28px 24px 56px; }
h1 { font-size: 30px; margin: 0 0 4px; letter-spacing: -0.3px; }
h2 { font-size: 19px; margin: 36px 0 10px; }
.sub { color: var(--soft); margin: 0; }
.tiles { display: grid; grid-template-columns: repeat(4, 1fr); gap: 12px; margin: 22px 0; }
.tile { background: #fff; border: 1px solid var(--line); border-radius: 10px; padding: 14px 16px; }
.tile b { display: block; font-size: 25px; letter-spacing: -0.4px; }
.tile span { color: var(--soft); font-size: 13px; }
.tile.main { background: var(--blue); border-color: var(--blue); color: #fff; }
.tile.main span { color: #dbeaf4; }
.tile.faint b { color: #90a4ae; }
.note { background: #fffdf3; border: 1px solid #efe3ae; border-radius: 10px; padding: 4px 20px 8px; margin: 22px 0; }
.note h2 { margin: 12px 0 4px; font-size: 16px; }
.note ul { margin: 6px 0; padding-left: 20px; }
.note li { margin: 5px 0; }
figure { margin: 0; background: #fff; border: 1px solid var(--line); border-radius: 10px; padding: 12px; }
figure img, figure video { display: block; width: 100%; border-radius: 4px; }
figcaption, .caption { color: var(--soft); font-size: 13.5px; margin: 8px 2px 0; }
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
@media (max-width: 760px) { .tiles { grid-template-columns: repeat(2, 1fr); } }
@media print { body { background: #fff; } figure, .scroll { break-inside: avoid; } }
"""

_PAGE = """<!DOCTYPE html>
<html lang="en">
<head>
<meta charset="utf-8">
<meta name="viewport" content="width=device-width, initial-scale=1">
<title>Two UR10s on one sine: accuracy of dual-ur10</title>
<style>{style}</style>
</head>
<body>
<main>
{body}
</main>
</body>
</html>
"""
