"""The report, and the commands, as a user meets them."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any
from unittest import mock

import numpy as np
import pytest
import typer
from typer.testing import CliRunner

from dual_ur10.cli import records
from dual_ur10.errors import CellFileError, DualUR10Error, MissingExtraError, RecordingError
from dual_ur10.sim2real.analysis import plots
from dual_ur10.sim2real.analysis.compare import Comparison, compare
from dual_ur10.sim2real.analysis.plot_style import figure
from dual_ur10.sim2real.analysis.report import report, write_report
from dual_ur10.sim2real.cell_file.cell_file import load_cell_file
from tests.sim2real.analysis.made import run, with_arm
from tests.sim2real.analysis.recorded import record

app = typer.Typer()
for command in (records.replay, records.compare, records.fit):
    app.command()(command)


def called(*arguments: str) -> tuple[int, str]:
    result = CliRunner().invoke(app, arguments, env={"COLUMNS": "160"})
    if result.exception is not None and not isinstance(result.exception, SystemExit):
        raise result.exception
    return result.exit_code, re.sub(r"\x1b\[[0-9;]*m", "", result.output)


@pytest.fixture
def undrawn(monkeypatch: pytest.MonkeyPatch) -> None:
    """Words alone: drawings take most of the time of a report."""
    for name in ("paths", "flange_error", "flange_vector", "joint_errors", "skew"):
        monkeypatch.setattr(plots, name, mock.Mock(return_value="", __name__=name))


def test_the_report_holds_everything_and_fetches_nothing(tmp_path: Path) -> None:
    path = tmp_path / "report.html"
    names = ("<b>one</b>", "two")
    write_report(
        path, compare(run(2.0, episodes=3), run(2.0, episodes=3, delay_parts=(4, 4), source="emulated")), names
    )
    text = path.read_text()
    assert "<title>&lt;b&gt;one&lt;/b&gt; and two compared</title>" in text
    assert "<b>one</b>" not in text
    assert "<h1>Two runs of DualUR10/SineTracking-v0</h1>" in text
    for words in ("emulated controllers, no arms", "left, 4.00 ms lag off", "No real arm is in this comparison"):
        assert words in text
    assert text.count("data:image/svg+xml;base64,") == 5
    assert not re.search(r"(src|href)=.(?!data:)", text)
    assert not re.search(r"<(script|link|iframe)", text)
    assert "nan" not in re.sub(r"base64,[A-Za-z0-9+/=]*", "", text)


@pytest.mark.parametrize("plot", [plots.flange_error, plots.paths])
def test_plots_show_all_of_their_lines(plot: Callable[[Comparison], str], monkeypatch: pytest.MonkeyPatch) -> None:
    """Also where taking the lag off makes errors larger."""
    shown: list[Any] = []

    @contextmanager
    def noted(*size: float, **options: Any) -> Iterator[Any]:
        with figure(*size, **options) as made:
            yield made
            shown.extend(made[1].flat)

    monkeypatch.setattr(plots, "figure", noted)
    found = compare(run(2.0), run(2.0, delay_parts=(4, 4)))
    plot(replace(found, pairs=[found.pairs[0]._replace(free_m=found.pairs[0].free_m + 0.1)]))
    assert shown
    for axis in shown:
        top = max(float(np.nanmax(line.get_ydata())) for line in axis.get_lines())
        assert 0.0 < top < 0.85 * axis.get_ylim()[1]  # the legend is above


def test_a_report_without_figures_says_why() -> None:
    still = run(2.0, size=0.0)
    text = report(compare(still, still))
    assert "the arm did not move" in text
    assert "two episodes or more are needed" in text
    assert "nan" not in re.sub(r"base64,[A-Za-z0-9+/=]*", "", text)
    made = run(2.0)
    # Both arms' targets have the same numbers.
    apart = with_arm(made, 1, sent={"index": made.arms[1].sent["index"] + 1000.0})
    with pytest.raises(RecordingError, match="right: 0 targets"):
        compare(apart, made)


@pytest.mark.usefixtures("undrawn")
def test_the_report_names_policies_seeds_and_the_replayed_run() -> None:
    replays = {"replays": {"run": "20260101T000000-Sine", "sha256": "ab" * 32, "episode": 4}}
    ours, theirs = run(2.0, policy="learned", policy_sha256="cd" * 32), run(2.0, policy="", extra=replays)
    ours = replace(ours, header=replace(ours.header, seed=7))
    theirs = replace(theirs, header=replace(theirs.header, seed=None))
    text = report(compare(ours, theirs))
    assert "<td>learned</td><td>—</td>" in text
    assert f"<td>{'cd' * 8}…</td><td>—</td>" in text
    assert f"<td>—</td><td>episode 4 of 20260101T000000-Sine, {'ab' * 8}…</td>" in text
    assert "<td>7</td><td>—</td>" in text


@pytest.mark.usefixtures("undrawn")
def test_hostile_headers_stay_text() -> None:
    made = run(2.0, policy="<script>alert(1)</script>", started_utc="<img src=x>")
    text = report(compare(made, made))
    assert "<script" not in text
    assert "<img src=x" not in text


def test_replay_compare_and_fit_from_the_command_line(tmp_path: Path) -> None:
    record(tmp_path / "one", "DualUR10/SineTracking-v0", [3], 60)
    one = str(tmp_path / "one")
    code, text = called("replay", one)
    assert (code, text) == (0, "60 of 60 steps, 300 of 300 ticks with the recorded targets in every bit\n"
                               "the replay is as recorded\n")  # fmt: skip
    out = tmp_path / "out.html"
    code, text = called("compare", one, str(tmp_path / "one" / "run.mcap"), "--out", str(out))
    assert code == 0
    assert "300 of 300" in text
    assert f"report  {out}" in text
    assert "one and one compared" in out.read_text()
    code, text = called("fit", one)
    assert code == 0
    assert re.search(r"left, controller alone .* 30\.000 ± 0\.", text)
    cell = tmp_path / "lab.toml"
    cell.write_text("kind = 'emulated'\n[left]\nhost='127.0.0.2'\n[right]\nhost='127.0.0.3'\n")
    with pytest.raises(RecordingError, match="only a run of this cell"):
        called("fit", one, "--write", str(cell))
    assert load_cell_file(cell).left.measured.lookahead_s is None


def test_errors_are_reported_before_work_begins(tmp_path: Path) -> None:
    record(tmp_path / "one", "DualUR10/SineTracking-v0", [3], 3)
    one = str(tmp_path / "one")
    with pytest.raises(DualUR10Error, match="does not exist"):
        called("compare", one, one, "--out", str(tmp_path / "no" / "out.html"))
    with pytest.raises(RecordingError):
        called("replay", str(tmp_path / "nothing"))
    with pytest.raises(RecordingError, match="no episode 4"):
        called("replay", one, "--episode", "4")
    with pytest.raises(CellFileError, match="there is no cell file"):
        called("replay", one, "--cell", str(tmp_path / "lab.toml"))
    whole = (tmp_path / "one" / "run.mcap").read_bytes()
    (tmp_path / "one" / "run.mcap").write_bytes(whole[: int(len(whole) * 0.6)])
    with pytest.raises(RecordingError, match="--allow-partial"):
        called("replay", one)


def test_a_replay_that_differs_ends_with_code_1(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    made = record(tmp_path / "one", "DualUR10/SineTracking-v0", [3], 5)
    made.episodes[0].q_rad[3, 0, 0] = np.nextafter(made.episodes[0].q_rad[3, 0, 0], 9.0)
    monkeypatch.setattr("dual_ur10.sim2real.recording.reader.read_run", lambda path, allow_partial: made)
    code, text = called("replay", "anything", "--no-record")
    assert code == records.DIFFERENT == 1
    assert "different: joints in step 2 differ: left shoulder_pan_joint" in text


def test_without_matplotlib_the_extra_is_named(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("importlib.util.find_spec", lambda name: None)
    with pytest.raises(MissingExtraError, match=r"dual-ur10\[records,plot\]"):
        called("compare", str(tmp_path), str(tmp_path), "--out", str(tmp_path / "out.html"))
