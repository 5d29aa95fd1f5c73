"""The demonstration's report: one HTML file with everything in it."""

from __future__ import annotations

import math
import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from demo import carry, handover, sine
from demo.case import CaseResult
from demo.emulated import (
    ON_FAILURE,
    TIMING_COLUMNS,
    EmulatedFailure,
    EmulatedPair,
    reasons,
    remarks,
    side_by_side,
)
from demo.film import EpisodeVideo
from dual_ur10.envs.tasks.sync_carry.settings import CarrySettings
from dual_ur10.errors import DualUR10Error
from dual_ur10.ids import __version__
from dual_ur10.sim2real.analysis.page import PageTable, render, video_source

TASKS = (sine.TASK, carry.TASK, handover.TASK)


@dataclass(frozen=True)
class Findings:
    """Everything that the demonstration has found.

    Attributes:
        results: Results of each task by its short name, in the order of its cases.
        films: Films by the task's short name.
        missing: Reason for missing films; "" if there are films.
        pairs: Runs on emulated controllers.
        failures: Runs on emulated controllers that failed.
    """

    results: Mapping[str, Sequence[CaseResult]]
    films: Mapping[str, EpisodeVideo] = field(default_factory=dict)
    missing: str = ""
    pairs: Sequence[EmulatedPair] = ()
    failures: Sequence[EmulatedFailure] = ()


def write_report(path: Path, findings: Findings) -> None:
    """Write the report.

    Raises:
        DualUR10Error: The file cannot be written.
    """
    tasks = {each.name: each for each in TASKS}
    values: dict[str, Any] = {
        name: {**task.context(findings.results[name]), "table": task.table(f"{name}-table", findings.results[name])}
        for name, task in tasks.items()
    }
    handed = {
        case.name: [each for each in findings.results["handover"] if each.case.name == case.name]
        for case in tasks["handover"].cases
        if not case.nominal
    }
    text = render(
        "demo.html",
        __package__,
        version=__version__,
        findings=findings,
        carried=findings.results["carry"][-1],
        handed_tiles=[
            (
                f"{sum(each.record.success for each in those)} of {len(those)}",
                f"Handover: blocks placed, {those[0].case.title}",
                "main",
            )
            for those in handed.values()
            if those
        ],
        films={name: film_values(film) for name, film in findings.films.items()},
        emulated=emulated_values(findings),
        **values,
    )
    try:
        path.write_text(text, encoding="utf-8")
    except OSError as error:
        raise DualUR10Error(f"cannot write {path}: {error}") from error


def film_values(film: EpisodeVideo) -> dict[str, Any]:
    """Return source, poster, caption and key frames of a film."""
    speed = "In real time" if math.isclose(film.speed, 1.0) else f"{film.speed:g} times faster than in reality"
    source, caption = video_source(film.path), f"{film.text} {speed}."
    return {"source": source, "poster": film.poster, "caption": caption, "frames": film.frames}


def emulated_values(findings: Findings) -> dict[str, Any]:
    """Return the values of the section on emulated controllers."""
    kinds = {"simulated": "", "emulated": "ours"}
    return {
        "tasks": [
            {
                "title": pair.run.task.title,
                "table": PageTable.of(
                    f"emulated-{pair.run.task.name}",
                    pair.run.task.emulated_columns,
                    [(name, kinds[name], side) for name, side in pair.sides],
                ),
                "remarks": remarks(pair),
                "plot": side_by_side(pair),
            }
            for pair in findings.pairs
        ],
        "timing": PageTable.of(
            "emulated-timing", TIMING_COLUMNS, [(pair.run.task.title, "", pair) for pair in findings.pairs]
        ),
        "slip_mm": f"{1e3 * CarrySettings().success_slip_m:g}",
        "cores": os.cpu_count(),
        "recordings": [
            (pair.run.task.title, *(side.folder for _, side in pair.sides if side.folder is not None))
            for pair in findings.pairs
        ],
        "reasons": reasons(findings.failures),
        "on_failure": ON_FAILURE,
    }
