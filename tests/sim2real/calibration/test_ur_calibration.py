"""Kinematics from the YAML of Universal Robots' calibration extraction."""

import numpy as np
import pytest

from dual_ur10.errors import CalibrationError, SettingsError
from dual_ur10.sim2real.calibration.transforms import flange, rotation_of, transform
from dual_ur10.sim2real.calibration.ur_calibration import FRAMES, of_frames, read
from tests.sim2real.calibration.simulated import random_dh
from ur_core.kinematics.forward import fixed_transforms
from ur_core.kinematics.ur10 import NOMINAL_DH

# The nominal UR10: Universal_Robots_ROS2_Description, config/ur10/default_kinematics.yaml.
NOMINAL = {
    "shoulder": (0.0, 0.0, 0.1273, 0.0, 0.0, 0.0),
    "upper_arm": (0.0, 0.0, 0.0, 1.570796327, 0.0, 0.0),
    "forearm": (-0.612, 0.0, 0.0, 0.0, 0.0, 0.0),
    "wrist_1": (-0.5723, 0.0, 0.163941, 0.0, 0.0, 0.0),
    "wrist_2": (0.0, -0.1157, -2.373046667922381e-11, 1.570796327, 0.0, 0.0),
    "wrist_3": (0.0, 0.0922, -1.891053610911353e-11, 1.570796326589793, 3.141592653589793, 3.141592653589793),
}
KEYS = ("x", "y", "z", "roll", "pitch", "yaw")


def written(path, frames):
    lines = [
        f"  {name}: {{{', '.join(f'{key}: {value!r}' for key, value in zip(KEYS, six, strict=True))}}}"
        for name, six in frames.items()
    ]
    path.write_text("kinematics:\n" + "\n".join(lines) + "\n  hash: calib_1\n")
    return path


def test_the_nominal_file_is_the_nominal_arm(tmp_path):
    found = read(written(tmp_path / "ur10.yaml", NOMINAL), "ur10")
    q = np.random.default_rng(0).uniform(-3.0, 3.0, (50, 6))
    np.testing.assert_allclose(flange(q, found), flange(q, NOMINAL_DH), atol=1e-9)


def chain_of(dh):
    """Return the link frames of a Denavit-Hartenberg chain whose last twist and length are 0."""
    fixed = fixed_transforms(dh)
    rotate = [transform(np.zeros(3), rotation_of((0.0, 0.0, each))) for each in dh.theta_rad]
    lift = [transform((0.0, 0.0, each), np.eye(3)) for each in dh.d_m]
    frames = [rotate[0] @ lift[0]]
    for joint in range(5):
        bend = np.linalg.inv(lift[joint]) @ fixed[joint]
        frames.append(bend @ rotate[joint + 1] @ lift[joint + 1])
    return frames


@pytest.mark.parametrize("seed", range(5))
def test_a_calibrated_chain_is_converted_exactly(seed):
    rng = np.random.default_rng(seed)
    given = random_dh(rng)
    given = type(given)((*given.a_m[:5], 0.0), given.d_m, (*given.alpha_rad[:5], 0.0), given.theta_rad, robot="ur10")
    found = of_frames(chain_of(given), "ur10")
    q = rng.uniform(-3.0, 3.0, (20, 6))
    np.testing.assert_allclose(flange(q, found), flange(q, given), atol=1e-9)


@pytest.mark.parametrize(
    ("name", "six", "error", "text"),
    [
        ("shoulder", (0.001, 0.0, 0.1273, 0.0, 0.0, 0.0), CalibrationError, "0.001 m and 0 rad off the z axis"),
        ("shoulder", (0.0, 0.0, 0.1273, 0.002, 0.0, 0.0), CalibrationError, "--kinematics ARM=controller"),
        ("forearm", (-0.425, 0.0, 0.0, 0.0, 0.0, 0.0), SettingsError, "another robot"),
    ],
)
def test_other_chains_are_refused(tmp_path, name, six, error, text):
    with pytest.raises(error, match=text):
        read(written(tmp_path / "ur.yaml", {**NOMINAL, name: six}), "ur10")


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("kinematics: 3", "no `kinematics` of shoulder"),
        ("[1, 2", "no YAML"),
        ("kinematics: {" + ", ".join(f"{name}: {{x: one}}" for name in FRAMES) + "}", "shoulder x"),
        ("kinematics: {" + ", ".join(f"{name}: {{x: .nan}}" for name in FRAMES) + "}", "shoulder x"),
        ("a: !!python/object/apply:os.getcwd []", "no YAML"),
        ("a: !!bool foo", "has the tag"),
        ("a: &a {b: 1}\nc: {<<: [*a, *a]}", "has the anchor 'a'"),
        ("a: 1\n---\na: 2", "has 2 documents"),
    ],
)
def test_bad_files_are_refused(tmp_path, text, words):
    path = tmp_path / "bad.yaml"
    path.write_text(text)
    with pytest.raises(CalibrationError, match=words):
        read(path, "ur10")
