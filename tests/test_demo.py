"""The demonstration, from the command line to its files."""

from __future__ import annotations

import contextlib
import dataclasses
import importlib.util
import re
import sys
from collections.abc import Callable, Iterator
from html.parser import HTMLParser
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from typer.testing import CliRunner

pytest.importorskip("matplotlib")
pytest.importorskip("imageio_ffmpeg")

from demo import carry, case, emulated, film, handover, run, sine
from demo.__main__ import app
from demo.report import TASKS, Findings, emulated_values
from dual_ur10.emulated.virtual_cell import VirtualCell
from dual_ur10.envs.tasks.sync_carry.path import MOVES
from dual_ur10.errors import CellFaulted, DualUR10Error, MissingExtraError, RenderError
from dual_ur10.policies.evaluation.rollout import Trace
from dual_ur10.sim2real.analysis.page import number, render
from dual_ur10.sim2real.control.limits import MotionLimits

SIZE = (film.HEIGHT, film.WIDTH)
VOID = {"meta", "img", "br"}
MOST_MM = 15.0  # placing error of a success
VIDEOS = {task.name: task.video for task in TASKS}
EXTENT = dataclasses.replace(
    run.QUICK,
    duration_s=2.0,
    episodes=1,
    speed={"sine": 10.0, "carry": 100.0, "handover": 100.0, "emulated": 10.0},  # three to nine frames
    emulated=(emulated.sine_run(1.6),),
)
# Friction on an exact model has its figures in tests/envs/tasks/test_sync_carry.py. A weld is the fastest to film.
CARRY = dataclasses.replace(carry.TASK, cases=(carry.CASES[0], carry.CASES[-1]), filmed=carry.CASES[0])


def has_opengl() -> bool:
    import gymnasium as gym

    env = gym.make(sine.SINE_ID, render_mode="rgb_array", width=16, height=16)
    try:
        env.reset()
        env.render()
    except RenderError:
        return False
    finally:
        env.close()
    return True


class Page(HTMLParser):
    """Collects what a test wants to know of a page, and fails where its tags do not match."""

    def __init__(self, text: str) -> None:
        super().__init__()
        self.open: list[str] = []
        self.sources: list[tuple[str, str]] = []
        self.tables: dict[str, list[list[str]]] = {}
        self.ids: set[str] = set()
        self.text = ""
        self._table = ""
        self.feed(text)
        self.close()
        assert not self.open, self.open
        self.text = " ".join(self.text.split())

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        if tag not in VOID:
            self.open.append(tag)
        values = dict(attrs)
        self.sources += [(tag, values[name] or "") for name in ("src", "href", "data", "poster") if name in values]
        self.ids |= {values["id"] or ""} if "id" in values else set()
        if tag == "table":
            self._table = values["id"] or ""
            self.tables[self._table] = []
        elif tag == "tr":
            self.tables[self._table].append([])
        elif tag in ("th", "td"):
            self.tables[self._table][-1].append("")

    def handle_endtag(self, tag: str) -> None:
        assert self.open.pop() == tag

    def handle_data(self, data: str) -> None:
        if "style" not in self.open:
            self.text += data
        if self.open and ("th" in self.open or "td" in self.open):
            self.tables[self._table][-1][-1] += data


@contextlib.contextmanager
def on_a_virtual_clock(of: emulated.EmulatedRun, folder: Path) -> Iterator[tuple[VirtualCell, Callable[[], str]]]:
    """Yield a cell of two emulated controllers on a virtual clock."""
    with VirtualCell(task=of.case.env_id, plant="nominal") as cell:
        yield cell, str


@pytest.fixture(scope="module")
def found() -> list[Findings]:
    """Findings of the quick demonstration; empty before `made`."""
    return []


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory, found: list[Findings]) -> tuple[Path, str]:
    """Folder and output of one quick demonstration."""
    pytest.importorskip("rtde_control")
    out = tmp_path_factory.mktemp("demo") / "new" / "folder"
    write = run.write_report

    def watched(path: Path, findings: Findings) -> None:
        found.append(findings)
        write(path, findings)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(run, "write_report", watched)
        patch.setattr(run, "QUICK", EXTENT)
        patch.setattr(run, "TASKS", (sine.TASK, CARRY, handover.TASK))
        patch.setattr(emulated, "_emulated_cell", on_a_virtual_clock)
        result = CliRunner().invoke(app, ["--quick", "--out", str(out)], env={"COLUMNS": "160"})
    assert result.exit_code == 0, result.output
    return out, result.output


def test_the_terminal_shows_a_row_per_case_and_the_files(made: tuple[Path, str]) -> None:
    out, text = made
    for each in (*sine.CASES, *CARRY.cases):
        assert each.title in text
    for each in handover.CASES:
        assert all(f"{each.title}, seed {seed}" in text for seed in range(EXTENT.episodes))
    assert str(out / "report.html") in text
    assert "No real arm was measured" in text


def test_the_report_has_the_tables_of_the_sine(made: tuple[Path, str]) -> None:
    page = Page((made[0] / "report.html").read_text(encoding="utf-8"))
    accuracy = page.tables["sine-table"]
    assert [row[0] for row in accuracy[1:]] == [each.title for each in sine.CASES]
    assert all(len(row) == 9 for row in accuracy)
    figures = {row[0]: row[1:] for row in accuracy[1:]}
    assert float(figures["nominal"][0]) < 0.01 < float(figures["perturbed"][0]) < 1.0
    assert float(figures["perturbed, without learning"][0]) > 1.0
    assert 33.0 < float(figures["nominal, lag not compensated"][6]) < 35.0
    assert figures["single arm, nominal"][7] == "—"


def test_the_report_has_a_row_for_each_case_of_carrying(made: tuple[Path, str]) -> None:
    head, *rows = Page((made[0] / "report.html").read_text(encoding="utf-8")).tables["carry-table"]
    assert [row[0] for row in rows] == [each.title for each in CARRY.cases]
    column = {re.sub(r"(mm|°|N|%.*)$", "", name): k for k, name in enumerate(head)}
    relative = [float(row[column["relative position"]]) for row in rows]
    # A weld is better than friction, and an exact model better than one that is not.
    assert 0.0 < relative[0] < 0.05 < 1.0 < relative[1] < 10.0
    assert [row[column["slip"]] == "—" for row in rows] == [True, False]
    for row in rows:
        assert row[column["success"]] == "yes"
        assert 25.0 < float(row[column["least load"]]) <= 50.0
        assert 0.0 < float(row[column["joint speed"]]) <= 100.0
        assert float(row[column["bar RMS"]]) < float(row[column["bar max"]])


def test_the_report_has_a_row_for_each_handover(made: tuple[Path, str]) -> None:
    head, *rows = Page((made[0] / "report.html").read_text(encoding="utf-8")).tables["handover-table"]
    seeds = range(EXTENT.episodes)
    assert [row[0] for row in rows] == [f"{each.title}, seed {k}" for each in handover.CASES for k in seeds]
    for row in rows:
        assert len(row) == len(head)
        assert row[1] in ("left", "right")
        assert row[2] == "yes"
        assert 5.0 < float(row[3]) < 20.0
        assert float(row[4]) < MOST_MM
        assert 0.0 < float(row[7]) <= 100.0


def test_the_report_states_the_limits_of_its_figures(made: tuple[Path, str]) -> None:
    text = Page((made[0] / "report.html").read_text(encoding="utf-8")).text
    for words in ("No real arm was measured", "artefact of an exact model", "Only the perturbed rows mean", "L = 0"):
        assert words in text


def test_the_report_needs_nothing_from_outside(made: tuple[Path, str]) -> None:
    source = (made[0] / "report.html").read_text(encoding="utf-8")
    page = Page(source)
    plots = [address for tag, address in page.sources if tag == "img" and address.startswith("data:image/svg")]
    assert len(plots) == len(set(plots)) == 7 + 4 + 2 + 1
    for tag, address in page.sources:
        if tag == "a":
            assert address.removeprefix("#") in page.ids
        else:
            assert address.startswith("data:")
    for loader in ("url(", "@import", "<script", "<link", "http:", "https:"):
        assert loader not in source


def test_the_videos_show_motion_and_the_report_their_key_frames(made: tuple[Path, str]) -> None:
    import imageio.v2 as imageio

    if not has_opengl():
        assert not any((made[0] / name).exists() for name in VIDEOS.values())
        assert "apt-get install" in made[1]
        pytest.skip("no OpenGL: there is no video, and the command names the reason")
    counts = {}
    for task, name in VIDEOS.items():
        assert str(made[0] / name) in made[1]
        with imageio.get_reader(made[0] / name) as reader:
            frames: list[Any] = list(reader.iter_data())
        counts[task] = len(frames)
        assert frames[0].shape[:2] == SIZE
        assert np.ptp(frames[0]) > 150  # not one colour
        scene = [frame[:300].astype(int) for frame in (frames[0], frames[len(frames) // 2])]
        assert np.abs(scene[0] - scene[1]).max() > 60  # beside its caption, too
    assert counts["sine"] == 3 + 1 + 25  # every tenth of its steps, the reset, and a second of the end
    assert counts["carry"] == 8 + 1 + 25
    source = (made[0] / "report.html").read_text(encoding="utf-8")
    page = Page(source)
    played = re.findall(r"<video autoplay controls loop muted playsinline poster=.data:image/jpeg", source)
    assert len(played) == source.count("<video") == 3 + 1
    assert source.rindex("<video") < source.index('class="tiles"')  # moving pictures first
    pictures = [address for tag, address in page.sources if tag == "img" and address.startswith("data:image/jpeg")]
    stages = 7
    assert len(pictures) == len(set(pictures)) == len(carry.instants(30.0)) + 1 + stages
    for stage in ("Reach", "Mutual grasp", "Place", "Laid down"):
        assert stage in page.text or stage.lower() in page.text


@pytest.mark.usefixtures("made")
def test_without_opengl_there_is_a_report_and_no_video(
    found: list[Findings], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def fail(*_: Any, **__: Any) -> None:
        raise RenderError("no OpenGL backend was found: apt-get install libegl1")

    real = case.DemoTask.measure

    def again(task: case.DemoTask, of: case.Case, seeds: Any, on_step: case.OnStep) -> list[case.CaseResult]:
        if task.name == "sine":
            return real(task, of, seeds, on_step)
        return [each for each in found[0].results[task.name] if each.case.name == of.name]  # as measured before

    monkeypatch.setattr(case.DemoTask, "measure", again)
    monkeypatch.setattr("matplotlib.figure.Figure.savefig", lambda _, buffer, **__: buffer.write(b"<svg/>"))
    monkeypatch.setattr(run, "QUICK", run.Extent(duration_s=1.0, episodes=1))  # all tasks on emulated controllers
    monkeypatch.setitem(sys.modules, "rtde_control", None)
    monkeypatch.setattr(run, "shoot", fail)
    reported: list[tuple[float, float]] = []
    result = run.run_demo(tmp_path, quick=True, progress=lambda _, done, total: reported.append((done, total)))
    assert "libegl1" in result.missing
    assert not result.films
    assert not any((tmp_path / name).exists() for name in VIDEOS.values())
    page = Page((tmp_path / "report.html").read_text(encoding="utf-8"))
    assert "libegl1" in page.text
    assert [each.run.task.name for each in result.failures] == ["sine", "carry", "handover"]
    assert page.text.count('ur_rtde: pip install "dual-ur10[real]"') == 1
    assert "SineTracking, SyncCarry, Handover:" in page.text
    assert not (tmp_path / run.RUNS_FOLDER).exists()
    assert all(address.startswith("data:image/svg") for tag, address in page.sources if tag != "a")
    assert [each.case.name for each in result.results["sine"]] == [each.name for each in sine.CASES]
    done = [each for each, _ in reported]
    assert done == sorted(done)
    assert reported[-1][0] == pytest.approx(reported[-1][1])


def test_the_report_has_the_emulated_runs(made: tuple[Path, str]) -> None:
    page = Page((made[0] / "report.html").read_text(encoding="utf-8"))
    assert "emulated" in page.ids
    assert "Emulated is not real" in page.text
    assert "emulated-sine" in page.tables
    assert "Emulated, simulated" in made[1]
    assert len(list((made[0] / run.RUNS_FOLDER).glob("*/run.mcap"))) == 2


@pytest.fixture
def beside(made: tuple[Path, str], found: list[Findings]) -> emulated.EmulatedPair:
    """Sine of the quick demonstration, simulated and emulated."""
    (pair,) = found[0].pairs
    return pair


def test_simulation_and_emulated_controllers_run_the_same_task(beside: emulated.EmulatedPair) -> None:
    ours, theirs = beside.comparison.headers
    assert (ours.source, theirs.source) == ("mujoco", "emulated")
    assert ours.latency_ticks == theirs.latency_ticks == 10
    assert (ours.mounts, ours.servoj, ours.tick_s) == (theirs.mounts, theirs.servoj, theirs.tick_s)
    assert beside.comparison.complete == (True, True)
    assert beside.simulated.record.steps == beside.emulated.record.steps == len(beside.emulated.trace) == 40
    assert beside.simulated.record.success
    assert beside.emulated.late_actions == 0
    for arm in beside.comparison.arms:
        # The recorded actions are replayed. Until the first one acts, the end of the path to the start is sent.
        assert arm.sent.compared > 150  # of 200
        assert arm.sent.most_rad < 1e-4
        assert arm.sent.equal >= arm.sent.compared - 10
    assert theirs.extra["replays"]["run"] == beside.simulated.folder.name
    assert (ours.policy, theirs.policy) == ("scripted", f"replay of {beside.simulated.folder.name}")


def section(pairs: list[emulated.EmulatedPair], failures: list[emulated.EmulatedFailure] | None = None) -> Page:
    values = emulated_values(Findings({}, pairs=pairs, failures=failures or []))
    return Page(render("emulated.html", run.__package__, emulated=values))


def test_the_section_shows_both_sides_of_a_task(beside: emulated.EmulatedPair) -> None:
    failure = emulated.EmulatedFailure(emulated.CARRY, "CellFaulted: <late>", "a & b")
    page = section([beside], [failure])
    head, *rows = page.tables["emulated-sine"]
    assert [row[0] for row in rows] == ["simulated", "emulated"]
    assert len(head) == len(rows[0]) == len(rows[1]) == 1 + len(sine.TASK.emulated_columns)
    assert rows[0][1] == "yes"
    assert float(rows[0][3]) < 0.1  # an exact model
    (_, row) = page.tables["emulated-timing"]
    assert len(row) == 1 + len(emulated.TIMING_COLUMNS)
    compared = sum(each.sent.compared for each in beside.comparison.arms)
    assert row[5].endswith(f" of {compared}")
    assert row[-2] == str(beside.emulated.late_actions)
    for words in ("Emulated is not real", "depend on the other work of this machine", "SyncCarry: CellFaulted: <late>"):
        assert words in page.text
    assert beside.emulated.folder.name in page.text


def test_the_section_reports_early_ends_and_a_busy_machine(
    beside: emulated.EmulatedPair,
) -> None:
    record = dataclasses.replace(beside.emulated.record, ended_by="<the table>")
    spoiled = dataclasses.replace(beside.emulated, record=record, late_actions=3)
    page = section([dataclasses.replace(beside, emulated=spoiled)])
    assert "SineTracking, emulated: ended after" in page.text
    assert "because <the table>." in page.text
    assert "3 actions were too late" in page.text
    assert "SineTracking, simulated" not in page.text
    quiet = dataclasses.replace(beside.emulated, late_actions=0)
    assert "too late, and each time" not in section([dataclasses.replace(beside, emulated=quiet)]).text


@pytest.mark.streams
def test_an_emulated_fault_is_reported_and_leaves_nothing(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("XDG_STATE_HOME", str(tmp_path / "state"))
    real = case.rollout

    def faulted(env: Any, policy: Any, **keywords: Any) -> Any:
        core = env.unwrapped.core
        if core.config.file is None:
            return real(env, policy, **keywords)
        env.reset(seed=0)
        core.stop("a test wants it")
        assert list((tmp_path / "state").rglob("fault-*"))
        raise CellFaulted("both arms were stopped: a test wants it")

    monkeypatch.setattr(case, "rollout", faulted)
    found = emulated.measure_emulated(emulated.sine_run(0.4), tmp_path / "runs")
    assert isinstance(found, emulated.EmulatedFailure)
    assert found.reason.startswith("CellFaulted: both arms were stopped")
    assert "MuJoCo" in found.log or "program" in found.log
    assert not list((tmp_path / "state").rglob("fault-*"))
    assert not list((tmp_path / "state").rglob("*.mcap"))


def test_a_failed_emulated_run_is_a_warning_and_no_error(monkeypatch: pytest.MonkeyPatch) -> None:
    failure = emulated.EmulatedFailure(emulated.HANDOVER, "CellFaulted: [late] by 106 ms")
    monkeypatch.setattr(run, "run_demo", lambda *_, **__: Findings({}, failures=[failure]))
    result = CliRunner().invoke(app, [], env={"COLUMNS": "160"})
    assert result.exit_code == 0, result.output
    assert "not on emulated controllers: Handover: CellFaulted: [late] by 106 ms" in result.output
    assert "nothing to clear" in result.output


@pytest.mark.parametrize(
    ("lacking", "extras"),
    [
        (("jinja2",), "plot"),
        (("ur_emulator", "rtde_control"), "emulator,real"),
        (("mcap", "matplotlib"), "plot,records"),
    ],
)
def test_all_missing_extras_are_named_before_anything_runs(
    lacking: tuple[str, ...], extras: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    find = importlib.util.find_spec
    monkeypatch.setattr(importlib.util, "find_spec", lambda name, *more: None if name in lacking else find(name, *more))
    result = CliRunner().invoke(app, ["--quick", "--out", str(tmp_path / "out")])
    assert isinstance(result.exception, MissingExtraError) or result.exit_code == 2
    assert f'pip install "dual-ur10[{extras}]"' in f"{result.exception} {result.output}".replace("\n", " ")
    assert not (tmp_path / "out").exists()


def test_a_folder_that_cannot_be_made_is_an_error_of_one_line(tmp_path: Path) -> None:
    (tmp_path / "file").touch()
    result = CliRunner().invoke(app, ["--quick", "--out", str(tmp_path / "file")])
    assert result.exit_code == 2
    assert "cannot write to" in result.output


def test_a_run_cut_short_has_no_figures(monkeypatch: pytest.MonkeyPatch) -> None:
    real = case.rollout

    def cut(*arguments: Any, **keywords: Any) -> Any:
        return dataclasses.replace(real(*arguments, **keywords), ended_by="too close")

    monkeypatch.setattr(case, "rollout", cut)
    with pytest.raises(DualUR10Error, match="too close"):
        sine.TASK.measure(sine.CASES[0].given(duration_s=0.4))


def carried(**columns: Any) -> Trace:
    """Return a trace of three steps, of which the last two are on the path."""
    trace = Trace()
    rows: dict[str, Any] = {
        "clock_s": [-1.0, 0.5, 1.0],
        "object_m": [[0, 0, 0.02], [0, 0, 0.03], [0, 0, 0.2]],
        "load_share": [[0.0, 1.0], [0.1, 0.9], [0.45, 0.55]],
        "slip_m": [[9.0, 9.0], [1e-3, 2e-3], [0.0, 0.0]],
        **{
            name: [9.0, -2e-3, 1e-3]
            for name in ("relative_error_m", "relative_error_rad", "squeeze_n", "lateral_n", "object_error_rad")
        },
        "object_error_m": [9.0, 3e-3, 4e-3],
        **columns,
    }
    for k in range(len(rows["clock_s"])):
        trace({name: np.array(values[k]) for name, values in rows.items()})
    return trace


def test_figures_of_carrying_begin_with_the_path() -> None:
    found = carry.figures_of(carried(), rigid=False)
    assert found["relative_max_mm"] == pytest.approx(2.0)
    assert found["relative_max_deg"] == pytest.approx(np.degrees(2e-3))
    assert (found["squeeze_max_n"], found["lateral_max_n"]) == (2e-3, 2e-3)
    assert found["slip_max_mm"] == pytest.approx(2.0)
    assert (found["bar_max_mm"], found["bar_rms_mm"]) == (pytest.approx(4.0), pytest.approx(np.sqrt(12.5)))
    assert found["least_load_share"] == 0.45  # on the table the load is not the arms' alone
    assert np.isnan(carry.figures_of(carried(), rigid=True)["slip_max_mm"])
    with pytest.raises(DualUR10Error, match="before its path began"):
        carry.figures_of(carried(clock_s=[-3.0, -2.0, -1.0]), rigid=False)


def test_stages_have_the_time_of_the_step_that_passed_them() -> None:
    found = handover.passed_s(np.array([0, 1, 1, 3, 3]), 4, 0.04)
    assert found[:3] == pytest.approx((0.08, 0.16, 0.16))
    assert np.isnan(found[3])


def test_the_speed_ratio_is_that_of_the_joint_nearest_its_limit() -> None:
    limits = MotionLimits(speed_rad_s=(0.5, 1.0) * 3, acceleration_rad_s2=10.0, jerk_rad_s3=2000.0, tcp_speed_m_s=1.0)
    q = np.zeros((3, 2, 6))
    q[1:, 1, 1] = -0.02
    q[2, 0, 0] = 0.015
    assert case.speed_ratio(q, 0.04, limits) == pytest.approx(0.75)


@pytest.mark.parametrize("duration_s", list(MOVES))
def test_key_frames_of_carrying_are_one_for_each_kind_of_move(duration_s: float) -> None:
    times, titles = zip(*carry.instants(duration_s), strict=True)
    assert list(times) == sorted(times)
    assert len(set(titles)) == len(titles) == 8
    assert titles[1] == "lifted"
    assert times[-1] == duration_s


def test_figures_are_shown_to_three_digits() -> None:
    shown = {0.0: "0.0000", 3e-5: "0.0000", 0.00123: "0.0012", 0.1234: "0.123", 12.34: "12.3", 1234.5: "1234"}
    assert {value: number(value) for value in shown} == shown
    assert number(-0.5) == "−0.500"
    assert number(float("nan")) == "—"
