"""The command `video`, and films of an episode."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from typer.testing import CliRunner

pytest.importorskip("imageio_ffmpeg")

import dual_ur10  # noqa: F401 - registers the ids
from dual_ur10.cli import main as cli
from dual_ur10.envs.rendering.marks import Marks, describe
from dual_ur10.envs.rendering.video_file import VideoFile
from dual_ur10.errors import DualUR10Error
from dual_ur10.policies import load
from dual_ur10.policies.evaluation import film as module
from dual_ur10.policies.evaluation.film import Take, film, take

HANDOVER, SINE = "DualUR10/Handover-v0", "DualUR10/SineTracking-v0"
SMALL = ("--seconds", "0.2", "--width", "48", "--height", "36")


def run(*arguments: object) -> Any:
    return CliRunner().invoke(cli.app, ["video", *map(str, arguments)], env={"COLUMNS": "200"})


def frames_of(path: Path) -> list[np.ndarray]:
    import imageio.v2 as imageio

    with imageio.get_reader(path) as reader:
        return list(reader.iter_data())


@pytest.fixture(scope="module")
def taken() -> Take:
    """Half a second of SineTracking."""
    env = gym.make(SINE)
    kept = take(env, load("scripted", SINE), seed=0, seconds=0.4)
    env.close()
    return kept


@pytest.fixture
def drawn(monkeypatch: pytest.MonkeyPatch) -> list[float]:
    """Times of the poses that are drawn; no picture is."""
    times: list[float] = []

    class Studio:
        def __init__(self, *_: Any) -> None:
            pass

        def picture(self, time_s: float) -> np.ndarray:
            times.append(time_s)
            return np.full((8, 8, 3), len(times), np.uint8)

        def captioned(self, picture: np.ndarray, *_: Any) -> np.ndarray:
            return picture

        def close(self) -> None:
            pass

    monkeypatch.setattr(module, "_Studio", Studio)
    return times


def test_it_writes_a_video_of_cameras_side_by_side(tmp_path: Path) -> None:
    path = tmp_path / "handover.mp4"
    result = run("Handover", "--policy", "learned", "-o", path, "--cameras", "front,left/wrist,overhead", *SMALL)
    assert result.exit_code == 0, result.output
    assert f"wrote {path}: 1.2 s, 144 × 36 pixels" in result.output
    frames = frames_of(path)
    assert len(frames) == 5 + 1 + 25  # its steps, the reset, and the last frame for a second
    tiles = np.split(frames[3][:16].astype(float), 3, axis=1)
    assert np.abs(tiles[0] - tiles[1]).mean() > 10.0 < np.abs(tiles[1] - tiles[2]).mean()
    data = path.read_bytes()
    assert b"avc1" in data
    assert data.index(b"moov") < data.index(b"mdat")  # plays while it loads
    assert [each.name for each in tmp_path.iterdir()] == [path.name]


@pytest.mark.parametrize(
    ("arguments", "text"),
    [
        (["--cameras", "wrist"], "unknown camera 'wrist' (did you mean 'right/wrist'?): use one of 'front'"),
        (["--cameras", ","], "0 cameras: name 1 to 9"),
        (["--speed", "0"], "speed is 0: it must be 0.01 to 100"),
        (["--width", "0"], "width is 0: it must be a whole number of pixels"),
        (["--width", "3"], "pictures of 3 × 36 pixels: the caption needs 32 each way or more"),
        (["-o", "{}/film.avi"], ".avi is unknown: use .mp4 or .gif"),
        (["-o", "{}/none/film.mp4"], "does not exist: make it first"),
    ],
)
def test_what_cannot_be_is_refused_before_the_episode(
    tmp_path: Path, arguments: list[str], text: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(module, "take", None)
    old = tmp_path / "film.mp4"
    old.write_bytes(b"old")
    result = run("Handover", "-o", old, *SMALL, *(each.format(tmp_path) for each in arguments))
    assert result.exit_code == 2
    assert text in result.output
    assert [(each.name, each.read_bytes()) for each in tmp_path.iterdir()] == [("film.mp4", b"old")]


def test_a_film_that_fails_keeps_the_old_file(tmp_path: Path) -> None:
    path = tmp_path / "film.gif"
    path.write_bytes(b"old")
    file = VideoFile(path)
    file.append(np.zeros((8, 8, 3), np.uint8))
    file.__exit__(DualUR10Error, DualUR10Error("no pose"), None)
    assert path.read_bytes() == b"old"
    assert list(tmp_path.iterdir()) == [path]


def test_slow_motion_lies_between_the_instants(tmp_path: Path, taken: Take, drawn: list[float]) -> None:
    found = film(tmp_path / "slow.gif", taken, speed=0.25)
    assert drawn[:-1] == pytest.approx(np.arange(0.0, 0.4 + 1e-9, 0.02))  # 12.5 frames a second
    assert found.duration_s == pytest.approx(0.4 / 0.25 + 0.08 + 0.96)
    q = [taken.pose(time_s).qpos.copy() for time_s in (0.32, 0.34, 0.36)]
    assert np.abs(q[2] - q[0]).max() > 1e-4
    assert q[1] == pytest.approx((q[0] + q[2]) / 2, abs=1e-12)


def test_references_and_what_follows_them_are_marked(taken: Take) -> None:
    import mujoco

    scene = mujoco.MjvScene(taken.model, 200)
    Marks(taken.infos, taken.period_s).at(0.4)(scene)
    geoms = scene.geoms[: scene.ngeom]
    balls = [each.pos for each in geoms if each.type == mujoco.mjtGeom.mjGEOM_SPHERE]
    assert balls == pytest.approx(taken.infos[-1]["reference_m"], abs=1e-6)
    traces = [each for each in geoms if each.type == mujoco.mjtGeom.mjGEOM_CAPSULE]
    assert {tuple(np.round(255 * each.rgba[:3])) for each in traces} == {(0, 114, 178), (213, 94, 0), (255, 255, 255)}


def test_the_line_names_stage_error_and_end() -> None:
    assert describe((), {"flange_error_m": (1e-3, 2e-3)}) == "error L 1.00 mm, R 2.00 mm"
    assert describe((), {"object_error_m": 4e-3}) == "object off by 4.0 mm"
    texts = [describe(("reach", "mutual_grasp"), {"stage": passed}) for passed in range(3)]
    assert texts == ["stage 1 of 2: reach", "stage 2 of 2: mutual grasp", "all passed"]
