"""Boards in images: rendered by OpenCV with known poses, and boards that are others than described."""

import json

import numpy as np
import pytest

from dual_ur10.errors import CalibrationError
from dual_ur10.sim2real.calibration.board import Board, Intrinsics, calibrated_camera, located
from dual_ur10.sim2real.calibration.data_file import DataFile
from dual_ur10.sim2real.calibration.transforms import rotation_of, rotvec_of, transform

cv2 = pytest.importorskip("cv2")

BOARD = Board(7, 5, 0.04, 0.03)
CAMERA = Intrinsics((900.0, 900.0, 640.0, 480.0))
_PX = 60


def rendered(path, pose, camera=CAMERA, rows=BOARD.squares_y):
    """Write the image of some rows of the board at a pose; pixel coordinates are those of OpenCV."""
    board, _ = BOARD.detector()
    flat = board.generateImage((BOARD.squares_x * _PX, BOARD.squares_y * _PX), marginSize=0)
    flat[rows * _PX :] = 128
    scale = BOARD.square_m / _PX
    metres = np.array([[scale, 0.0, scale / 2], [0.0, scale, scale / 2], [0.0, 0.0, 1.0]])  # of a pixel's centre
    homography = camera.matrix @ np.stack([pose[:3, 0], pose[:3, 1], pose[:3, 3]], axis=1) @ metres
    cv2.imwrite(str(path), cv2.warpPerspective(flat, homography, (1280, 960), flags=cv2.INTER_AREA, borderValue=128))


@pytest.fixture(scope="module")
def images(tmp_path_factory):
    folder, rng = tmp_path_factory.mktemp("images"), np.random.default_rng(0)
    made = {}
    for k in range(6):
        place = [*rng.uniform(-0.18, -0.08, 2), rng.uniform(0.4, 0.55)]
        made[folder / f"{k}.png"] = pose = transform(place, rotation_of(rng.uniform(-0.4, 0.4, 3)))
        rendered(folder / f"{k}.png", pose)
    return made


def test_poses_are_those_of_the_images(images):
    for path, pose in images.items():
        position, rotation = located(path, BOARD, CAMERA)
        assert np.linalg.norm(position - pose[:3, 3]) < 1e-3
        assert np.linalg.norm(rotvec_of(rotation_of(rotation) @ pose[:3, :3].T)) < np.radians(0.25)


def test_a_camera_is_calibrated_from_its_images(images):
    camera = calibrated_camera(list(images), BOARD)
    np.testing.assert_allclose(camera.matrix_px, CAMERA.matrix_px, atol=8.0)
    with pytest.raises(CalibrationError, match="2 images of a camera without intrinsics: 5 are needed"):
        calibrated_camera(list(images)[:2], BOARD)


def test_one_row_of_corners_calibrates_no_camera(images, tmp_path):
    for path, pose in images.items():
        rendered(tmp_path / path.name, pose, rows=2)
    with pytest.raises(CalibrationError, match="with more than one row of the board's corners in each"):
        calibrated_camera(sorted(tmp_path.iterdir()), BOARD)


@pytest.mark.parametrize(
    ("board", "text"),
    [
        (Board(5, 5, 0.04, 0.03), r"shows the marker 16: a board of 5 by 5 squares has markers 0 to 11"),
        (Board(5, 7, 0.04, 0.03), "do not stand as on a board of 5 by 7 squares"),
        (Board(9, 7, 0.04, 0.03), "do not stand as on a board of 9 by 7 squares"),
        (Board(7, 5, 0.04, 0.02), "markers of 0.50 of a square"),
        (Board(7, 5, 0.04, 0.03, "DICT_4X4_50"), "no marker of DICT_4X4_50"),
        (Board(7, 5, 0.04, 0.03, "DICT_9X9"), "no dictionary 'DICT_9X9'"),
        (Board(30, 30, 0.04, 0.03), "450 markers"),
    ],
)
def test_another_board_is_refused(board, text, images):
    with pytest.raises(CalibrationError, match=text):
        located(next(iter(images)), board, CAMERA)


@pytest.mark.parametrize("values", [(2, 5, 0.04, 0.03), (7, 99, 0.04, 0.03), (7, 5, 0.03, 0.04), (7, 5, 9.0, 0.03)])
def test_impossible_boards_are_refused(values):
    with pytest.raises(CalibrationError, match=r"allowed are 3 to 50|markers must be smaller"):
        Board(*values)


def test_images_without_a_board_and_other_cameras_are_refused(tmp_path, images):
    blank = tmp_path / "blank.png"
    cv2.imwrite(str(blank), np.full((480, 640), 128, np.uint8))
    with pytest.raises(CalibrationError, match=r"blank.png shows no marker"):
        located(blank, BOARD, CAMERA)
    with pytest.raises(CalibrationError, match="is no image"):
        located(tmp_path / "none.png", BOARD, CAMERA)
    with pytest.raises(CalibrationError, match="does not fit the camera"):
        located(next(iter(images)), BOARD, Intrinsics((900.0, 300.0, 100.0, 480.0)))


def test_views_name_images_beside_the_data_file(images):
    folder = next(iter(images)).parent
    content = {
        "board": {"squares_x": 7, "squares_y": 5, "square_m": 0.04, "marker_m": 0.03},
        "observations": [
            {"kind": "board", "camera_on": "fixed", "board_on": "left", "left_q_rad": [0.0] * 6, "image": path.name}
            for path in images
        ],
    }
    views = DataFile.model_validate_json(json.dumps(content)).measured(folder)
    for view, pose in zip(views, images.values(), strict=True):
        assert np.linalg.norm(view.position_m - pose[:3, 3]) < 0.01  # the camera was calibrated from six images
