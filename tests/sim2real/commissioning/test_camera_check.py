"""Check of the cameras of a cell file."""

import io

import numpy as np
from PIL import Image

from dual_ur10.sim2real.cameras.pattern_camera import pattern_time_s
from dual_ur10.sim2real.cameras.png import png
from dual_ur10.sim2real.commissioning.camera_check import check_cameras
from dual_ur10.testing import VirtualCell
from tests.cli.command import run

CAMERAS = [
    {"name": "front", "kind": "pattern", "rate_hz": 20.0},
    {"name": "side", "kind": "file", "file": "nowhere.mp4"},
    {"name": "left/wrist", "kind": "own", "camera": "tests.sim2real.cameras.test_cameras:Shaky", "width": 64,
     "height": 48, "options": "then=end images=500", "rate_hz": 20.0},
    {"name": "right/wrist", "kind": "own", "camera": "tests.sim2real.cameras.test_cameras:Shaky", "options": "then=end",
     "width": 64, "height": 48},
]  # fmt: skip


def test_a_picture_is_read_again():
    image = np.random.default_rng(0).integers(0, 256, (5, 7, 3), dtype=np.uint8)
    np.testing.assert_array_equal(np.asarray(Image.open(io.BytesIO(png(image)))), image)


def test_rate_age_and_picture_of_each_camera():
    with VirtualCell(file={"camera": CAMERAS}) as cell:
        front, side, wrist, lost = check_cameras(cell.file, cell.system)
        assert front.finding.level == "ok"
        assert front.finding.name == "camera front"
        assert "pattern, 640 × 480, 20.0 Hz, " in front.finding.found
        assert cell.now_s - pattern_time_s(front.picture.image) < 0.1
        assert (side.finding.level, side.picture) == ("fail", None)
        assert "there is no video file nowhere.mp4" in side.finding.found
        assert (wrist.finding.level, wrist.finding.expected) == ("warn", "20 Hz")  # it sends 50
        assert "own, 64 × 48, 50.0 Hz" in wrist.finding.found
        assert (lost.finding.level, lost.finding.remedy) == ("fail", "unplugged")


def test_the_command_lists_cameras_and_writes_pictures(tmp_path):
    path = tmp_path / "cell.toml"
    path.write_text(
        'kind = "emulated"\n[left]\nhost = "127.0.0.2"\n[right]\nhost = "127.0.0.3"\n'
        '[[camera]]\nname = "left/wrist"\nkind = "pattern"\n'
    )
    _, text = run("doctor", "--cell", str(path), "--json", "--pictures", str(tmp_path / "shown"))
    assert '"check": "camera left/wrist"' in text
    image = np.asarray(Image.open(tmp_path / "shown" / "left-wrist.png"))
    assert image.shape == (480, 640, 3)
