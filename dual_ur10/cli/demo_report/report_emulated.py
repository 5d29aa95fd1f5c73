"""What the demonstration's report says of the tasks on emulated controllers."""

from __future__ import annotations

import math
import os
from collections.abc import Sequence
from html import escape
from typing import TYPE_CHECKING

from dual_ur10.cli.demo_report import figures_emulated
from dual_ur10.cli.demo_report.runs_carry import figures_of_carry
from dual_ur10.cli.demo_report.runs_emulated import EmulatedFailure, EmulatedResult
from dual_ur10.policies.evaluation.accuracy import accuracy
from dual_ur10.sim2real.analysis.page import image, lead, note, number, table, text

if TYPE_CHECKING:
    from dual_ur10.cli.demo_report.runs_emulated import Side

TASK_HEADERS = {
    "sine": (("success", ""), ("flange RMS", "mm"), ("flange max", "mm"), ("angle max", "°"), ("vector max", "mm")),
    "carry": (
        ("success", ""),
        ("relative position", "mm"),
        ("relative angle", "°"),
        ("squeeze", "N"),
        ("bar RMS", "mm"),
    ),
    "handover": (("success", ""), ("time", "s"), ("placing error", "mm"), ("placing angle", "°"), ("slip", "mm")),
}
"""Columns of each task's table, with their units."""

TIMING_HEADERS = (
    ("path RMS", "mm"),
    ("path max", "mm"),
    ("path max, lag off", "mm"),
    ("lag", "ms"),
    ("equal targets", ""),
    ("targets apart", "mrad"),
    ("skew p99", "ms"),
    ("late > 2 ms", "%"),
    ("late > 8 ms", "%"),
    ("late actions", ""),
    ("load", ""),
)
"""Columns of the table of both recordings beside each other, with their units."""

ON_FAILURE = (
    "A busy machine keeps emulated controllers, or what moves their arms, waiting: both arms are then stopped, "
    "as real ones would be. Run the demonstration again when the machine is quiet. There is nothing to clear: each "
    "emulated cell ended with its run."
)
"""What to do about it."""

Emulated = Sequence[EmulatedResult | EmulatedFailure]


def figures_of_task(name: str, side: Side) -> list[str]:
    """An episode's cells, in the order of the task's `TASK_HEADERS`."""
    success = "yes" if side.record.success else "no"
    if name == "sine":
        found = accuracy(side.record)
        values = [found.flange_rms_mm, found.flange_max_mm, found.orientation_max_deg, found.vector_max_mm]
        return [success, *map(number, values)]
    if name == "carry":
        if not (side.trace["clock_s"] > 0.0).any():  # it ended before its path began
            return [success, *["—"] * 4]
        carried = figures_of_carry(side.trace, rigid=False, share=math.nan)
        values = [carried.relative_max_mm, carried.relative_max_deg, carried.squeeze_max_n, carried.bar_rms_mm]
        return [success, *map(number, values)]
    trace = side.trace
    values = [
        1e3 * float(trace["object_error_m"][-1]),
        math.degrees(float(trace["object_error_rad"][-1])),
        1e3 * float(trace["slip_m"].max()),
    ]
    return [success, f"{side.record.time_s[-1]:.2f}", *map(number, values)]


def figures_of_timing(result: EmulatedResult) -> list[str]:
    """A task's cells, in the order of `TIMING_HEADERS`: those of the worse arm."""
    arms, timing = result.comparison.arms, result.comparison.timing[1]
    late = [each.late for each in timing.arms]
    shares = [max(each.shares[k] for each in late) for k in range(2)]
    return [
        number(1e3 * max(each.found.flange_m.rms for each in arms)),
        number(1e3 * max(each.found.flange_m.most for each in arms)),
        number(1e3 * _worst([math.nan if each.free is None else each.free.flange_m.most for each in arms])),
        number(1e3 * _worst([each.lag.value for each in arms])),
        f"{sum(each.sent.equal for each in arms)} of {sum(each.sent.compared for each in arms)}",
        number(1e3 * max(each.sent.most_rad for each in arms)),
        number(1e3 * timing.skew_s.p99),
        *(number(100 * share) for share in shares),
        str(result.emulated.late_actions),
        f"{result.load:.1f}",
    ]


def _worst(values: Sequence[float]) -> float:
    """That with the largest size of those that are known; NaN: none is."""
    known = [each for each in values if not math.isnan(each)]
    return max(known, key=abs) if known else math.nan


def emulated_section(found: Emulated) -> str:
    """The section, as HTML; nothing if nothing was asked for."""
    if not found:
        return ""
    results = [each for each in found if isinstance(each, EmulatedResult)]
    failures = [each for each in found if isinstance(each, EmulatedFailure)]
    parts = [
        "<h2 id='emulated'>The same tasks on two emulated controllers</h2>",
        lead(
            "SineTracking is replayed: the actions that were recorded in simulation. SyncCarry and Handover are done "
            "by the same scripted policies, which act on what they see there. All go through the same adapter and "
            "safety gate, by the unmodified <code>ur_rtde</code>, with a process for each arm and a supervisor: "
            "<code>gym.make(…, cell=FILE)</code>. "
            "What stands for UR's controllers is software of this package on this machine. <b>Emulated is not "
            "real</b>: no real arm has run any of this."
        ),
    ]
    if failures:
        parts.append(note("What did not run on emulated controllers", _reasons(failures)))
    if results:
        parts += [_task(each) for each in results]
        parts += [_words(), _timing(results), _kept(results)]
    return "\n".join(parts)


def _task(result: EmulatedResult) -> str:
    name, title = result.run.name, result.run.title
    sides = (("simulated", "", result.simulated), ("emulated", "ours", result.emulated))
    rows = [(cell, kind, figures_of_task(name, side)) for cell, kind, side in sides]
    return "\n".join(
        (
            f"<h3>{escape(title)}: simulated and emulated, side by side</h3>",
            table(f"emulated-{name}", TASK_HEADERS[name], rows),
            *map(text, map(escape, remarks(result))),
            image(figures_emulated.side_by_side(result), f"{title}: errors simulated and emulated over time"),
        )
    )


def remarks(result: EmulatedResult) -> list[str]:
    """What explains figures of an episode: that it was ended early, that this machine kept both arms waiting."""
    title = result.run.title
    found = [
        f"{title}, {name}: ended after {side.record.time_s[-1]:.2f} s, because {side.record.ended_by}."
        for name, side in (("simulated", result.simulated), ("emulated", result.emulated))
        if side.record.ended_by
    ]
    if late := result.emulated.late_actions:
        found.append(
            f"{title}, emulated: {late} action{' was' if late == 1 else 's were'} too late, and each time both arms "
            "came to rest and went on from there: this machine was busy. Run it again when it is quiet."
        )
    return found


def _words() -> str:
    return text(
        "One episode of each, of the same seed, with an action latency of 80 ms, and of a plant that "
        "is as the policy believes: an artefact of an exact model, on both sides. Errors of SineTracking and SyncCarry "
        "are the largest of the whole episode if not RMS. On emulated controllers joints, forces and the object's pose "
        "are what the controllers and the tracker report, when they report it, by a clock of their own. In simulation, "
        "controllers are told of what the arms hold; here they keep the payload that is set on them, and the arms sink "
        "by some millimetres under bar and block."
    )


def _timing(results: Sequence[EmulatedResult]) -> str:
    rows = [(each.run.title, "", figures_of_timing(each)) for each in results]
    return (
        "<h3>How far apart, and how punctual</h3>"
        + table("emulated-timing", TIMING_HEADERS, rows)
        + text(
            "Figures of the worse arm. Path: way between the simulated flange and the emulated one at the same time "
            "of the task, by each run's own kinematics. Lag: of the emulated arm behind the simulated one by the "
            "times of sending; half a control period, 4 ms, is always in it, because targets are sent so long before "
            "a controller takes them. Equal targets: those of both arms that are the same in every bit. The same "
            "recorded actions give the same targets, all of them from the first that an action shapes on (before, in "
            "the 10 periods of the latency, the arms come to rest from the way to the start), unless an action came "
            "too late: so it is with SineTracking, as with <code>python -m dual_ur10 replay RUN --cell FILE</code>. A "
            "policy that acts on what is told was measured finds something else on two clocks, and so its targets "
            "differ: by how much at most stands beside it. Where a policy waits for something, such as a "
            "grip, it may go on a step of 40 ms sooner or later, and the paths differ by the way of that. Skew: "
            "between the sends of one target to both arms. Late: sends that came so much after their time. Late "
            "actions: those that came too late for their period, so that both arms came to rest and went on from "
            "there. <b>All figures of time depend on what else this machine does</b>: controllers, arms, supervisor, "
            "recorder and policy share it. Load: mean number of programs that wanted to run within the minute "
            "before, on "
            f"{os.cpu_count()} cores."
        )
    )


def _kept(results: Sequence[EmulatedResult]) -> str:
    folder = escape(results[0].emulated.folder.parent.name)
    return text(
        f"Both recordings of each are in <code>{folder}/</code> beside this page; "
        "<code>python -m dual_ur10 compare RUN_A RUN_B</code> says more of them: "
        + "; ".join(
            f"{each.run.title}: {escape(each.simulated.folder.name)}, {escape(each.emulated.folder.name)}"
            for each in results
        )
        + "."
    )


def _reasons(failures: Sequence[EmulatedFailure]) -> list[str]:
    """What went wrong, each reason once."""
    by_reason: dict[str, list[EmulatedFailure]] = {}
    for each in failures:
        by_reason.setdefault(each.reason, []).append(each)
    points = []
    for reason, those in by_reason.items():
        titles = ", ".join(each.run.title for each in those)
        end = f"<br>The cell's log ends: <code>{escape(those[0].log[-600:])}</code>" if those[0].log else ""
        points.append(f"<b>{escape(titles)}:</b> {escape(reason)}{end}")
    points.append(escape(ON_FAILURE))
    return points
