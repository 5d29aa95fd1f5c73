"""The command `follow` on emulated controllers: order of the goals, final poses and result codes."""

import csv

import numpy as np
import pytest

from dual_ur10.assets.settings import HOME_Q_RAD
from dual_ur10.cli.follow import NOT_REACHED
from dual_ur10.sim2real.trajectory.files import write_trajectory
from dual_ur10.sim2real.trajectory.joint_trajectory import JointTrajectory
from dual_ur10.testing import CellForTests
from tests.cli.command import run
from tests.sim2real.trajectory.following import wave
from ur_core.kinematics.ur10 import ARMS

NEAR_RAD = 1e-3


def followed(cell, *arguments):
    """Run the command on a cell, and return its exit code, its text and its results."""
    code, text = run("follow", *map(str, arguments), "--cell", cell.path)
    assert "missed the deadline" not in text, f"this machine is too busy: {text}"
    return code, text, [line.split(", after")[0] for line in text.splitlines() if ", after " in line]


def distance_rad(cell, q_rad):
    """Return the largest distance of a joint from a configuration of both arms."""
    found = [cell.ask("state", arm=arm, names=["actual_q"])["actual_q"] for arm in ARMS]
    return np.abs(np.array(found) - q_rad).max()


def last_targets(cell):
    return np.array([cell.packages(arm)[-1][2] for arm in ARMS])


@pytest.mark.streams
def test_files_and_configurations_are_followed_in_order(tmp_path):
    there = wave(1.0, start=HOME_Q_RAD + 0.05, amplitude=0.1)
    file, record = write_trajectory(tmp_path / "there.json", there), tmp_path / "found.csv"
    down = np.stack([HOME_Q_RAD, HOME_Q_RAD])
    down[1, 0, 1] += 0.6
    deep = JointTrajectory(ARMS, [0.0, 4.0], down, np.zeros((2, 2, 6)))
    with CellForTests(tmp_path, task="SineTracking", plant="nominal") as cell:
        code, text, results = followed(cell, file, "--record", record)
        assert (code, results) == (0, ["succeeded, SUCCESSFUL (0)"]), text
        assert distance_rad(cell, there.q_rad[-1]) < NEAR_RAD
        np.testing.assert_allclose(last_targets(cell), there.q_rad[-1], atol=1e-5)
        with record.open() as table:
            rows = list(csv.DictReader(table))
        times = np.array([float(row["path_s"]) for row in rows])
        assert len(times) >= 62  # a period takes 16 ms
        assert (np.diff(times) >= 0.0).all()
        assert times[0] < 0.05
        assert times[-1] >= 1.0

        code, text, results = followed(cell, "--to", "home")
        assert (code, results) == (0, []), text
        assert "the arms are there" in text
        assert distance_rad(cell, HOME_Q_RAD) < NEAR_RAD

        code, text, results = followed(cell, file, "--to", "home")
        assert (code, results) == (0, ["succeeded, SUCCESSFUL (0)"] * 2), text
        assert text.index("points, 1.00 s") < text.index("succeeded") < text.rindex("points, ")
        assert distance_rad(cell, HOME_Q_RAD) < NEAR_RAD

        code, text, results = followed(cell, write_trajectory(tmp_path / "deep.csv", deep))
        assert (code, results) == (NOT_REACHED, ["rejected, INVALID_GOAL (-1)"]), text
        assert distance_rad(cell, HOME_Q_RAD) < NEAR_RAD
        assert not cell.fault
