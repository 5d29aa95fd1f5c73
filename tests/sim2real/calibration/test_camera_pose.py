"""Camera and board from images: the estimate is right, and its intervals are honest."""

import json
import math

import mujoco
import numpy as np
import pytest

from dual_ur10.assets.scene import build_model
from dual_ur10.assets.settings import SceneSettings, home_q_rad
from dual_ur10.envs.rendering.live.scene import Poser
from dual_ur10.errors import CalibrationError
from dual_ur10.sim2real.calibration.board import Intrinsics
from dual_ur10.sim2real.calibration.camera_pose import (
    BODY,
    CameraEstimate,
    CornerView,
    body_in_cell,
    estimate_camera,
    project,
)
from dual_ur10.sim2real.calibration.transforms import (
    base_in_cell,
    flange,
    inverse_of,
    rotation_of,
    rotvec_of,
    transform,
)
from dual_ur10.sim2real.cell_file.cell_file import load_cell_file
from tests.cli import command
from tests.sim2real.calibration.test_board import rendered
from ur_core.kinematics.ur10 import NOMINAL_DH

pytest.importorskip("cv2")
pytest.importorskip("scipy")

SIZE = (480, 640)
MATRIX = np.array([612.0, 609.0, 322.5, 238.0])
DISTORTION = np.array([-0.08, 0.05, 8e-4, -5e-4])
CORNERS = np.array([[0.04 * x, 0.04 * y, 0.0] for y in range(1, 5) for x in range(1, 7)])
BOARD = transform([-0.14, 0.1, 0.08], rotation_of([0.03, -0.02, 0.05]))
BASE = base_in_cell(SceneSettings().left)
SPREAD = np.array([0.15, 0.15, 0.15, 0.6, 0.6, 0.6])
HOME = home_q_rad(SceneSettings().mounts)[0]


def sampled_view(rng, camera_on_arm, axis=None):
    """Return one view without noise: a random configuration around one in which the camera sees the board."""
    eye = transform([0.4, 0.6, 1.5], np.diag([1.0, -1.0, -1.0]))  # looks down at the flange
    q_rad = HOME + rng.uniform(-SPREAD, SPREAD)
    if axis is not None:
        q_rad = HOME.copy()
        q_rad[axis] += rng.uniform(-0.6, 0.6)
    hand = BASE @ flange(q_rad, NOMINAL_DH)
    if camera_on_arm:
        middle = BASE @ flange(HOME, NOMINAL_DH)
        camera = transform([-0.08, 0.01, 0.05], rotation_of([0.05, 0.1, 0.02]))
        stand = transform(middle[:3, 3] + [-0.05, 0.12, -0.75], np.diag([1.0, 1.0, 1.0]))
        board = stand @ transform([0.0, 0.0, 0.0], rotation_of([0.1, 0.05, 0.3]))
        return CornerView(hand, np.eye(4), CORNERS, np.zeros((0, 2))), camera, board
    return CornerView(np.eye(4), hand, CORNERS, np.zeros((0, 2))), eye, None


def views_of(rng, count, noise_px, camera_on_arm=False, axis=None):
    """Return views of one camera, its true pose on what carries it, and that of the board."""
    found = []
    view, camera, board = sampled_view(rng, camera_on_arm, axis)
    if board is None:  # on the flange, facing the camera at home
        hand = BASE @ flange(HOME, NOMINAL_DH)
        facing = camera @ transform([-0.14, -0.1, 0.55], rotation_of([0.2, -0.1, 0.1]))
        board = inverse_of(hand) @ facing
    for _ in range(20 * count):
        view, _, _ = sampled_view(rng, camera_on_arm, axis)
        there = inverse_of(view.camera_frame @ camera) @ view.board_frame @ board
        points = CORNERS @ there[:3, :3].T + there[:3, 3]
        if (points[:, 2] < 0.3).any():
            continue
        pixels = project(points, MATRIX, DISTORTION)
        if (pixels < 5).any() or (pixels > np.array(SIZE[::-1]) - 5).any():
            continue
        noisy = pixels + rng.normal(0.0, noise_px, pixels.shape)
        found.append(CornerView(view.camera_frame, view.board_frame, CORNERS, noisy))
        if len(found) == count:
            return found, camera, board
    raise AssertionError("the camera hardly sees the board")


@pytest.mark.parametrize("camera_on_arm", [False, True])
def test_without_noise_the_estimate_is_the_truth(camera_on_arm):
    views, camera, board = views_of(np.random.default_rng(1), 12, 0.0, camera_on_arm)
    found = estimate_camera(views, SIZE)
    np.testing.assert_allclose(found.pose, camera, atol=1e-6)
    np.testing.assert_allclose(found.board, board, atol=1e-6)
    np.testing.assert_allclose(found.intrinsics.matrix_px, MATRIX, rtol=1e-6)
    np.testing.assert_allclose(found.intrinsics.distortion, DISTORTION, atol=1e-5)
    assert found.fovy_rad == pytest.approx(2 * math.atan(240 / 609))
    seen = found.camera("wrist", f"left/{BODY}" if camera_on_arm else "")
    x, y = np.reshape(seen.axes, (2, 3))
    np.testing.assert_allclose([x, y], [camera[:3, 0], -camera[:3, 1]], atol=1e-5)


def test_the_simulated_camera_of_an_arm_stands_where_the_estimate_has_it():
    pose = transform([-0.08, 0.01, 0.05], rotation_of([0.05, 0.1, 0.02]))
    zero = np.zeros(0)
    found = CameraEstimate(pose, np.eye(6), 1, Intrinsics(tuple(MATRIX)), SIZE, 0.0, zero)
    scene = SceneSettings(cameras=(("wrist", found.camera("wrist", f"left/{BODY}")),))
    model = build_model(scene)
    poser = Poser(model)
    q_rad = np.array(home_q_rad(scene.mounts)) + 0.3
    poser.rest(q_rad)
    mujoco.mj_camlight(model, poser.data)
    camera = poser.data.camera("wrist")
    there = body_in_cell(scene.left, q_rad[0], NOMINAL_DH) @ pose
    np.testing.assert_allclose(camera.xpos, there[:3, 3], atol=1e-6)
    np.testing.assert_allclose(camera.xmat.reshape(3, 3), there[:3, :3] * [1, -1, -1], atol=1e-5)


def test_intervals_at_a_third_of_a_pixel_hold_the_truth():
    rng, inside, errors = np.random.default_rng(3), [], []
    for _ in range(8):
        views, camera, _ = views_of(rng, 30, 0.3)
        found = estimate_camera(views, SIZE)
        shift = found.pose[:3, 3] - camera[:3, 3]
        rotation = rotvec_of(found.pose[:3, :3] @ camera[:3, :3].T)
        inside += (np.abs(np.concatenate([shift, rotation])) <= found.half_widths).tolist()
        errors.append((np.linalg.norm(shift), np.linalg.norm(rotation)))
        assert 0.28 < found.rms_px < 0.32
        assert found.position_bound_m > 0.0
    assert 0.85 <= np.mean(inside) <= 1.0
    position_m, rotation_rad = np.median(errors, axis=0)
    assert position_m < 0.5e-3
    assert rotation_rad < math.radians(0.15)


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (lambda views: views[:4], "4 images of the board: 5 are needed"),
        (
            lambda views: [
                CornerView(each.camera_frame, views[k - 1].board_frame, each.on_board_m, each.in_image_px)
                for k, each in enumerate(views)
            ],
            "do not fit one camera",
        ),
    ],
)
def test_images_that_do_not_fit_are_refused(change, words):
    views, _, _ = views_of(np.random.default_rng(5), 8, 0.3)
    with pytest.raises(CalibrationError, match=words):
        estimate_camera(change(views), SIZE)


def test_a_rotation_about_one_axis_is_not_enough():
    views, _, _ = views_of(np.random.default_rng(6), 8, 0.0, axis=5)
    with pytest.raises(CalibrationError, match="one axis only"):
        estimate_camera(views, SIZE)


def test_the_command_writes_the_camera_of_a_cell_file(tmp_path):
    rng, eye = np.random.default_rng(2), transform([0.4, 0.6, 1.5], np.diag([1.0, -1.0, -1.0]))
    facing = eye @ transform([-0.14, -0.1, 0.5], rotation_of([0.2, -0.1, 0.1]))
    board = inverse_of(BASE @ flange(HOME, NOMINAL_DH)) @ facing
    entries = []
    while len(entries) < 12:
        q_rad = HOME + rng.uniform(-SPREAD, SPREAD)
        pose = inverse_of(eye) @ BASE @ flange(q_rad, NOMINAL_DH) @ board
        seen = CORNERS @ pose[:3, :3].T + pose[:3, 3]
        pixels = 900.0 * seen[:, :2] / seen[:, 2:] + [640.0, 480.0]
        if (seen[:, 2] < 0.3).any() or (pixels < 80).any() or (pixels > [1200, 880]).any():
            continue
        rendered(tmp_path / f"{len(entries)}.png", pose)
        entries.append(
            {"kind": "board", "camera_on": "fixed", "board_on": "left", "left_q_rad": q_rad.tolist(),
             "image": f"{len(entries)}.png"}
        )  # fmt: skip
    square = {"squares_x": 7, "squares_y": 5, "square_m": 0.04, "marker_m": 0.03}
    (tmp_path / "data.json").write_text(json.dumps({"board": square, "observations": entries}))
    file = tmp_path / "cell.toml"
    file.write_text(
        'kind = "emulated"\n[left]\nhost = "127.0.0.2"\n[right]\nhost = "127.0.0.3"\n'
        '[[camera]]  # at the wall\nname = "front"\nkind = "pattern"\n'
    )
    arguments = ("cell", "calibrate", str(file), "--data", str(tmp_path / "data.json"), "--camera")
    code, text = command.run(*arguments, "front", "--write")
    assert code == 0, text
    assert "12 images" in text
    assert "# at the wall" in file.read_text()
    (entry,) = load_cell_file(file).camera
    mounted = entry.mounted
    assert math.dist(mounted.position_m, eye[:3, 3]) < 4e-3
    x, y = np.reshape(mounted.axes, (2, 3))
    assert np.abs([x - eye[:3, 0], y + eye[:3, 1]]).max() < math.radians(0.4)
    assert mounted.fovy_deg == pytest.approx(math.degrees(2 * math.atan(480 / 900)), abs=0.3)
    code, text = command.run(*arguments, "side", "--write")
    assert code == 2
    assert "has no camera 'side': add a table" in text.replace("\n", " ")
    for other in (("--suggest",), ("--accept-m", "0.0005"), ("--moved",), ("--seed", "1"), ("--grasp", "2")):
        code, text = command.run(*arguments, "front", "--write", *other)
        assert code == 2
        assert "--camera takes --data, --kinematics and --write alone" in text.replace("\n", " ")
