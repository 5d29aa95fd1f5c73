"""The demonstration's report: one HTML file with everything in it."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from html import escape
from pathlib import Path
from typing import TYPE_CHECKING

from dual_ur10 import __version__
from dual_ur10.cli.demo_report.report_carry import carry_section
from dual_ur10.cli.demo_report.report_emulated import Emulated, emulated_section
from dual_ur10.cli.demo_report.report_handover import handover_section
from dual_ur10.cli.demo_report.report_sine import sine_section
from dual_ur10.errors import DualUR10Error
from dual_ur10.sim2real.analysis.page import note, number, page, tiles

if TYPE_CHECKING:
    from dual_ur10.cli.demo_report.film import Film
    from dual_ur10.cli.demo_report.runs import Result
    from dual_ur10.cli.demo_report.runs_carry import CarryResult
    from dual_ur10.cli.demo_report.runs_handover import HandoverResult


@dataclass(frozen=True)
class Findings:
    """All that the demonstration has found.

    Attributes:
        sine: Results of SineTracking, in the order of its runs.
        carry: Results of SyncCarry, in the order of its runs.
        handover: Episodes of Handover, run by run.
        films: Films by the task's short name: "sine", "carry" and "handover".
        missing: Why there are no films; "" if there are.
        emulated: What came of each task on emulated controllers, or why nothing did; empty: none was asked for.
    """

    sine: Sequence[Result]
    carry: Sequence[CarryResult]
    handover: Sequence[HandoverResult]
    films: Mapping[str, Film] = field(default_factory=dict)
    missing: str = ""
    emulated: Emulated = ()


def write_report(path: Path, findings: Findings) -> None:
    """Write the report.

    Raises:
        DualUR10Error: The file cannot be written.
    """
    films = findings.films
    body = "\n".join(
        (
            _head(bool(findings.emulated)),
            _tiles(findings),
            _caveats(findings.missing),
            sine_section(findings.sine, films.get("sine")),
            carry_section(findings.carry, films.get("carry")),
            handover_section(findings.handover, films.get("handover")),
            emulated_section(findings.emulated),
            "<footer>Written by <code>python -m dual_ur10 demo</code>.</footer>",
        )
    )
    try:
        path.write_text(page(body), encoding="utf-8")
    except OSError as error:
        raise DualUR10Error(f"cannot write {path}: {error}") from error


def _head(emulated: bool) -> str:
    more = "<a href='#emulated'>Emulated controllers</a>" if emulated else ""
    return (
        "<header><h1>Two UR10s, three tasks</h1>"
        f"<p class='sub'>dual-ur10 {escape(__version__)} · scripted policies · 25 Hz policy, 125 Hz servoj (lookahead "
        "0.03 s, gain 2000)</p><nav><a href='#sine'>SineTracking</a><a href='#carry'>SyncCarry</a>"
        f"<a href='#handover'>Handover</a>{more}</nav></header>"
    )


def _tiles(findings: Findings) -> str:
    sine = {result.run.name: result for result in findings.sine}
    carry = findings.carry[-1]
    noisy = [each for each in findings.handover if each.run.name == findings.handover[-1].run.name]
    done = sum(each.success for each in noisy)
    return tiles(
        (
            (
                f"{number(sine['perturbed'].accuracy.flange_max_mm)} mm",
                "SineTracking: largest flange error, perturbed plant",
                "main",
            ),
            (
                f"{number(carry.figures.relative_max_mm)} mm",
                f"SyncCarry: largest error between the flanges, {carry.run.title}",
                "main",
            ),
            (f"{done} of {len(noisy)}", f"Handover: blocks placed, {noisy[0].run.title}", "main"),
            (
                f"{number(sine['nominal'].accuracy.flange_max_mm)} mm",
                "SineTracking, nominal: an artefact of an exact model",
                "faint",
            ),
        )
    )


def _caveats(missing: str) -> str:
    points = [
        "<b>No real arm was measured.</b> Everything here is simulation: MuJoCo, and a model of UR's unpublished "
        "<code>servoj</code> law, on emulated controllers, too. A real UR10 repeats to ± 0.1 mm, and its absolute "
        "accuracy is worse than that.",
        "<b>Nominal figures are an artefact of an exact model.</b> Where the feed-forward knows the plant exactly, the "
        "error is zero by construction. Only the perturbed rows mean something. SineTracking: masses + 5 %, Coulomb "
        "friction of 5, 5, 3, 1, 1, 1 N·m in the joints, lookahead + 5 %, and 2 ms of latency that nobody compensates. "
        "SyncCarry: the preset <code>mild</code> of the randomization. Handover: the measured pose of the block alone; "
        "its plant is exact. The sizes of all of these are a choice, not data of UR's.",
        "<b>Action latency is L = 0</b> except where a row says otherwise, and beside emulated controllers: an action "
        "takes effect in the instant of its observation. On real arms it will not. Latency costs most in the first "
        "seconds of SineTracking, while the policy learns, and along other axes than y.",
        "<b>Few episodes.</b> One for each row of SineTracking and SyncCarry. Rates and worst cases over many are "
        "measured by <code>benchmarks/accuracy.py</code>.",
    ]
    if missing:
        points.append(f"<b>No video:</b> {escape(missing)}")
    return note("What these figures are, and are not", points)
