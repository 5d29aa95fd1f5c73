"""The demonstration, from the command line to its files."""

from __future__ import annotations

import sys
from html.parser import HTMLParser
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from typer.testing import CliRunner

pytest.importorskip("matplotlib")
pytest.importorskip("imageio_ffmpeg")

from dual_ur10 import cli, demo
from dual_ur10.errors import DualUR10Error, MissingExtraError, RenderError

QUICK_FRAMES, SIZE = 125, (540, 960)
VOID = {"meta", "img", "br"}


def has_opengl() -> bool:
    import gymnasium as gym

    env = gym.make(demo.ENV_ID, render_mode="rgb_array", width=16, height=16)
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
        self.text = ""
        self._table = ""
        self.feed(text)
        self.close()
        assert not self.open, self.open

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        if tag not in VOID:
            self.open.append(tag)
        values = dict(attrs)
        self.sources += [(tag, values[name] or "") for name in ("src", "href", "data", "poster") if name in values]
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


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, str]:
    """Folder and output of one quick demonstration."""
    out = tmp_path_factory.mktemp("demo") / "new" / "folder"
    result = CliRunner().invoke(cli.app, ["demo", "--quick", "--out", str(out)], env={"COLUMNS": "160"})
    assert result.exit_code == 0, result.output
    return out, result.output


def test_the_terminal_shows_a_row_per_run_and_where_the_files_are(made: tuple[Path, str]) -> None:
    out, text = made
    for run in demo.RUNS:
        assert run.title in text
    assert str(out / "report.html") in text
    assert "No real arm was measured" in text


def test_the_report_is_a_page_with_both_tables(made: tuple[Path, str]) -> None:
    page = Page((made[0] / "report.html").read_text(encoding="utf-8"))
    accuracy = page.tables["accuracy"]
    assert [row[0] for row in accuracy[1:]] == [run.title for run in demo.RUNS]
    assert all(len(row) == 9 for row in accuracy)
    figures = {row[0]: row[1:] for row in accuracy[1:]}
    assert float(figures["nominal"][0]) < 0.01 < float(figures["perturbed"][0]) < 1.0
    assert float(figures["perturbed, without learning"][0]) > 1.0
    assert 33.0 < float(figures["nominal, lag not compensated"][6]) < 35.0
    assert figures["single arm, nominal"][7] == "—"
    claims = {row[0]: row[1:] for row in page.tables["claims"]}
    assert claims["Gazebo, single arm"][:2] == ["± 0.3", "± 0.15"]
    assert claims["Gazebo, dual-arm carry"][:2] == ["± 0.7", "± 0.22"]
    assert claims["sine on both arms, 0.1 m, 0.5 Hz, 30 s"][2] == "1.200 ± 0.001"
    assert claims["here, both arms, perturbed"][0] == figures["perturbed"][0]


def test_the_report_says_what_its_figures_are_worth(made: tuple[Path, str]) -> None:
    text = Page((made[0] / "report.html").read_text(encoding="utf-8")).text
    for words in ("No real arm was measured", "artefact of an exact model", "Only the perturbed rows mean", "L = 0"):
        assert words in text


def test_the_report_needs_nothing_from_outside(made: tuple[Path, str]) -> None:
    source = (made[0] / "report.html").read_text(encoding="utf-8")
    page = Page(source)
    assert sum(tag == "img" for tag, _ in page.sources) == 7
    assert all(address.startswith("data:") for _, address in page.sources)
    for loader in ("url(", "@import", "<script", "<link", "http:", "https:"):
        assert loader not in source


def test_the_video_has_every_frame_and_shows_motion(made: tuple[Path, str]) -> None:
    import imageio.v2 as imageio

    path = made[0] / "sine_tracking.mp4"
    if not has_opengl():
        assert not path.exists()
        assert "apt-get install" in made[1]
        pytest.skip("no OpenGL: there is no video, and the command says why")
    with imageio.get_reader(path) as reader:
        frames: list[Any] = list(reader.iter_data())
    assert len(frames) == QUICK_FRAMES
    assert frames[0].shape[:2] == SIZE
    assert np.ptp(frames[0]) > 150  # not one colour
    scene = [frame[:500].astype(int) for frame in (frames[0], frames[62])]
    assert np.abs(scene[0] - scene[1]).max() > 60  # beside its caption, too


def test_without_opengl_there_is_a_report_and_no_video(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def fail(*_: Any, **__: Any) -> None:
        raise RenderError("no OpenGL backend was found: apt-get install libegl1")

    monkeypatch.setattr(demo, "record_video", fail)
    told: list[tuple[float, float]] = []
    results, missing = demo.run_demo(tmp_path, quick=True, progress=lambda _, done, total: told.append((done, total)))
    assert "libegl1" in missing
    assert not (tmp_path / "sine_tracking.mp4").exists()
    assert "libegl1" in Page((tmp_path / "report.html").read_text(encoding="utf-8")).text
    assert [result.run.name for result in results] == [run.name for run in demo.RUNS]
    done = [each for each, _ in told]
    assert done == sorted(done)
    assert told[-1][0] == pytest.approx(told[-1][1])


@pytest.mark.parametrize("package", ["matplotlib", "imageio"])
def test_a_missing_extra_is_named_before_anything_runs(
    package: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, package, None)
    with pytest.raises(MissingExtraError, match=rf'{package}: pip install "dual-ur10\[plot\]"'):
        demo.run_demo(tmp_path / "out")
    assert not (tmp_path / "out").exists()


def test_a_folder_that_cannot_be_made_is_an_error_of_one_line(tmp_path: Path) -> None:
    (tmp_path / "file").touch()
    result = CliRunner().invoke(cli.app, ["demo", "--quick", "--out", str(tmp_path / "file")])
    assert result.exit_code == 2
    assert "cannot write to" in result.output


def test_a_run_cut_short_has_no_figures(monkeypatch: pytest.MonkeyPatch) -> None:
    real = demo.rollout

    def cut(*arguments: Any, **keywords: Any) -> Any:
        import dataclasses

        return dataclasses.replace(real(*arguments, **keywords), ended_by="too close")

    monkeypatch.setattr(demo, "rollout", cut)
    with pytest.raises(DualUR10Error, match="too close"):
        demo.measure(demo.RUNS[0], 0.4)
