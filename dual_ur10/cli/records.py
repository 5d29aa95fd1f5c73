"""Commands on recorded runs: `replay`, `compare` and `fit`."""

from __future__ import annotations

import json
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer
from rich.markup import escape
from rich.table import Table

from dual_ur10.cli.live import PAGE_EXTRA, NoBrowser, Port, tell
from dual_ur10.cli.options import (
    RUNS,
    CellName,
    NoRecord,
    OneArm,
    Partial,
    PowerOn,
    Record,
    RunPath,
    check_extras,
    console,
    errors,
    keywords_of,
    progress_of,
    record_in,
)
from dual_ur10.cli.session import STOP_COMMANDED, asks, late_text, on_virtual, power_on
from dual_ur10.envs.rendering.live.guard import PORT
from dual_ur10.errors import SettingsError
from ur_core.files import check_target, write_text
from ur_core.processes.interrupts import INTERRUPTED

DIFFERENT = 1
"""Exit code when a replay differs from the recording."""


def replay(
    run: RunPath,
    cell: CellName = None,
    episode: Annotated[int, typer.Option("--episode", "-e", min=0, help="Number of the episode in the run.")] = 0,
    arm: OneArm = None,
    power: PowerOn = False,
    allow_partial: Partial = False,
    record: Record = RUNS,
    no_record: NoRecord = False,
    page: Annotated[
        bool,
        typer.Option("--page", help="Show the record itself in a page instead, with the images of its cameras."),
    ] = False,
    no_browser: NoBrowser = False,
    port: Port = PORT,
    seconds: Annotated[float | None, typer.Option("--seconds", min=0.1, help="Close the page after this time.")] = None,
) -> None:
    """Replay the actions of a recorded episode through the same adapter and gate.

    A simulated run that is simulated again must be the same in every bit, else the exit code is 1. On arms, the
    targets that the gate releases are compared.
    """
    check_extras(("records", "reading a record"), *((PAGE_EXTRA,) if page else ()), cell=cell)
    if page:
        if cell is not None or arm is not None or power:
            raise SettingsError("--page moves nothing: leave out --cell, --arm and --power-on")
        if record != RUNS or no_record:
            raise SettingsError("--page records nothing: leave out --record and --no-record")
        _show(run, episode, seconds, allow_partial=allow_partial, browser=not no_browser, port=port)
        return
    if seconds is not None or port != PORT or no_browser:
        raise SettingsError("--seconds, --port and --no-browser are for the page: add --page, or leave them out")
    from dual_ur10.sim2real.analysis.reconstruction import task_keywords
    from dual_ur10.sim2real.analysis.replay import replay as play
    from dual_ur10.sim2real.analysis.replay import source_of
    from dual_ur10.sim2real.recording.reader import read_run

    keywords = keywords_of(None, perturbed=False, cell=cell, arm=arm)
    keywords.pop("cell", None)
    recorded = read_run(run, allow_partial=allow_partial)
    settings = task_keywords(recorded.header)
    if not no_record:
        record_in(keywords, record, source_of(run, episode))
    if power:
        power_on(cell)
    try:
        with progress_of(console, asks(cell)) as progress:
            bar = progress.add_task("playing")
            found = play(
                recorded,
                on_virtual(cell, recorded.header.env_id, settings),
                episode=episode,
                keywords=keywords,
                on_step=lambda done, total: progress.update(bar, completed=done, total=total),
            )
    except KeyboardInterrupt:
        if cell is None:
            raise
        errors.print(f"interrupted; {STOP_COMMANDED}", highlight=False, soft_wrap=True)
        raise typer.Exit(INTERRUPTED) from None
    ticks = found.targets_rad.shape[0] * found.targets_rad.shape[1]
    ended = f", ended by {escape(found.ended_by)}" if found.ended_by else ""
    console.print(
        f"{found.steps} of {found.recorded} steps, {found.equal_targets} of {ticks} ticks with the recorded targets "
        f"in every bit{ended}{late_text(found.late_actions)}",
        highlight=False,
        soft_wrap=True,
    )
    if found.is_exact:
        console.print("the replay is as recorded", style="green", highlight=False)
        return
    errors.print(f"[bold red]different:[/] [red]{escape(found.difference)}[/]", soft_wrap=True, highlight=False)
    raise typer.Exit(DIFFERENT)


def _show(path: Path, number: int, seconds: float | None, *, allow_partial: bool, browser: bool, port: int) -> None:
    """Show a recorded episode in a page."""
    from dual_ur10.cli.playback_session import PlaybackSession
    from dual_ur10.envs.core.setup import EnvSetup
    from dual_ur10.envs.rendering.live.about import About
    from dual_ur10.envs.rendering.live.live_page import LivePage
    from dual_ur10.sim2real.analysis.reconstruction import keywords_of as recorded_keywords
    from dual_ur10.sim2real.analysis.replay import episode_of
    from dual_ur10.sim2real.recording.reader import file_of, read_run

    run = read_run(path, allow_partial=allow_partial)
    episode = episode_of(run, number)
    setup = EnvSetup.resolve(run.header.env_id, recorded_keywords(run.header))

    def note(text: str) -> None:
        errors.print(f"[yellow]note:[/] {escape(text)}", highlight=False, soft_wrap=True)

    speeds = tuple(setup.limits.speed_rad_s)
    with PlaybackSession(run, episode, file_of(path).parent, note) as session:
        cameras = session.cameras or ("front",)
        about = About(f"{setup.env_id}, recorded", setup.config.scene, (speeds, speeds), cameras=cameras)
        shown = LivePage(about, port=port)
        try:
            tell(shown, browser=browser)
            session.run(shown, seconds)
        except KeyboardInterrupt:
            console.print("closed")
        finally:
            shown.close()


def compare(
    run_a: Annotated[
        Path,
        typer.Argument(metavar="RUN_A", help="A recorded run: its folder or its file; or a table of policies, .csv."),
    ],
    run_b: Annotated[
        Path | None, typer.Argument(metavar="RUN_B", help="Another run of the same task; none beside a table.")
    ] = None,
    out: Annotated[
        Path | None,
        typer.Option(
            "--out",
            "-o",
            metavar="FILE",
            help="The report of two runs, one HTML file. Default: compare.html. Of a table, its figures as JSON.",
        ),
    ] = None,
    allow_partial: Partial = False,
) -> None:
    """Compare two recorded runs of a task, and write a report of their differences.

    Or compare the success of several policies in simulation and on a cell, from a CSV table with the columns task,
    policy, simulation_successes, simulation_episodes, cell_successes and cell_episodes: correlation and rank
    correlation of the rates of each task.
    """
    if run_b is None:
        if run_a.suffix.lower() != ".csv":
            raise SettingsError(f"{run_a} alone: name two recorded runs, or a table of policies, a file with .csv")
        _compare_policies(run_a, out)
        return
    if ".csv" in (run_a.suffix.lower(), run_b.suffix.lower()):
        raise SettingsError("a table of policies is compared alone: name it, or two recorded runs")
    out = Path("compare.html") if out is None else out
    check_extras(("records", "reading a record"), ("plot", "the report of a comparison"))
    from dual_ur10.sim2real.analysis.compare import compare as compared
    from dual_ur10.sim2real.analysis.report import write_report
    from dual_ur10.sim2real.recording.reader import read_run

    check_target(out)
    found = compared(*(read_run(path, allow_partial=allow_partial) for path in (run_a, run_b)))
    write_report(out, found, (_name(run_a), _name(run_b)))
    table = Table(header_style="bold")
    for header in ("arm", "flange RMS\n[dim]mm[/]", "max\n[dim]mm[/]", "lag of B\n[dim]ms[/]"):
        table.add_column(header, justify="left" if header == "arm" else "right")
    for header in ("RMS, lag off\n[dim]mm[/]", "max, lag off\n[dim]mm[/]", "equal targets"):
        table.add_column(header, justify="right")
    for arm, each in zip(("left", "right"), found.arms, strict=True):
        free = None if each.free is None else each.free.flange_m
        table.add_row(
            arm,
            *(f"{1e3 * value:.4f}" for value in (each.found.flange_m.rms, each.found.flange_m.most)),
            "—" if each.lag.reason else f"{1e3 * each.lag.value:.3f}",
            *(["—", "—"] if free is None else [f"{1e3 * value:.4f}" for value in (free.rms, free.most)]),
            f"{each.sent.equal} of {each.sent.compared}",
        )
    console.print(table)
    for arm, each in zip(("left", "right"), found.arms, strict=True):
        if each.lag.reason:
            console.print(f"[yellow]note:[/] {arm}: no lag: {escape(each.lag.reason)}", highlight=False, soft_wrap=True)
    for note in found.notes:
        console.print(f"[yellow]note:[/] {escape(note)}", highlight=False, soft_wrap=True)
    console.print(f"report  {out}", soft_wrap=True, highlight=False, markup=False)


def _compare_policies(path: Path, out: Path | None) -> None:
    """Print the agreement of each task of a table of policies, and write it to a JSON file if one is named."""
    from dual_ur10.policies.evaluation.agreement import agreements, read_policies

    if out is not None:
        if out.suffix.lower() != ".json":
            raise SettingsError(f"--out is {out}: the figures of a table of policies are written as JSON, to FILE.json")
        check_target(out)
    found = agreements(read_policies(path))
    for each in found:
        table = Table(title=escape(each.task), title_justify="left", title_style="bold", header_style="bold")
        table.add_column("policy")
        for header in ("in simulation", "on the cell"):
            table.add_column(f"{header}\n[dim]95 % interval[/]", justify="right")
        for row in each.policies:
            table.add_row(escape(row.policy), _successes(row.simulation), _successes(row.cell))
        console.print(table)
        console.print(
            f"{len(each.policies)} policies: Pearson's r {_correlation(each.pearson)}, Spearman's rank correlation "
            f"{_correlation(each.spearman)}, mean maximum rank violation {each.max_rank_violation:.3f}",
            highlight=False,
            soft_wrap=True,
        )
        for note in each.notes:
            console.print(f"[yellow]note:[/] {note}", highlight=False, soft_wrap=True)
    if out is not None:
        write_text(out, json.dumps([each.as_dict() for each in found], indent=1, ensure_ascii=False) + "\n")
        console.print(f"json  {out}", soft_wrap=True, highlight=False, markup=False)


def _successes(count: SuccessCount) -> str:
    low, high = (100 * each for each in count.interval)
    return f"{count.successes} of {count.episodes}: {low:.0f} to {high:.0f} %"


def _correlation(value: float | None) -> str:
    return "none" if value is None else f"{value:.3f}"


def _name(path: Path) -> str:
    """Return the name of a run: that of its folder."""
    resolved = path.resolve()
    return resolved.parent.name if resolved.is_file() else resolved.name


if TYPE_CHECKING:
    from dual_ur10.policies.evaluation.agreement import SuccessCount
    from dual_ur10.sim2real.analysis.fit import Estimate


def fit(
    run: RunPath,
    write: Annotated[
        Path | None,
        typer.Option("--write", metavar="FILE", help="Write lookahead and latency of both arms into this cell file."),
    ] = None,
    episode: Annotated[
        int | None, typer.Option("--episode", "-e", min=0, help="Number of the episode; by default the longest.")
    ] = None,
    allow_partial: Partial = False,
) -> None:
    """Estimate lookahead and latency of each arm from a recorded run in which both arms move."""
    check_extras(("records", "reading a record"))
    from dual_ur10.sim2real.analysis.cell_update import write_back
    from dual_ur10.sim2real.analysis.fit import fit as fitted
    from dual_ur10.sim2real.analysis.fit import remark
    from dual_ur10.sim2real.recording.reader import read_run

    if write is not None:
        check_target(write)
    recorded = read_run(run, allow_partial=allow_partial)
    found = fitted(recorded, episode)
    table = Table(header_style="bold")
    table.add_column("")
    for header in ("lookahead\n[dim]ms[/]", "latency\n[dim]ms[/]", "unexplained RMS\n[dim]µrad[/]"):
        table.add_column(header, justify="right")
    reasons = []
    for arm, each in zip(("left", "right"), found, strict=True):
        for what, estimate in (("controller alone", each.law), ("controller and arm", each.arm)):
            table.add_row(f"{arm}, {what}", *_figures(estimate))
            reason = estimate.reason or remark(estimate, recorded.header.tick_s)
            if reason:
                reasons.append(f"{arm}, {what}: {reason}")
    console.print(table)
    for reason in reasons:
        console.print(f"[yellow]note:[/] {escape(reason)}", highlight=False, soft_wrap=True)
    if write is not None:
        kept = write_back(write, recorded.header, found)
        console.print(f"wrote {write}; as it was: {kept}", soft_wrap=True, highlight=False, markup=False)


def _figures(estimate: Estimate) -> list[str]:
    if estimate.reason:
        return ["—"] * 3
    return [
        f"{1e3 * estimate.lookahead_s:.3f} ± {1e3 * estimate.lookahead_sigma_s:.3f}",
        f"{1e3 * estimate.latency_s:.3f} ± {1e3 * estimate.latency_sigma_s:.3f}",
        f"{1e6 * estimate.rms_rad:.1f}",
    ]
