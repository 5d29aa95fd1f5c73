"""Files of taught points: each row is on the disk at once, and nothing that exists is overwritten."""

import os

import numpy as np
import pytest

from dual_ur10.errors import DualUR10Error, TrajectoryError
from dual_ur10.sim2real.teaching.taught_file import TaughtFile
from dual_ur10.sim2real.trajectory.files import read_trajectory

ARMS = ("left", "right")
POINTS = np.random.default_rng(3).normal(size=(4, 2, 6))


@pytest.mark.parametrize("at_rest", [True, False])
@pytest.mark.parametrize("arms", [ARMS, ("right",)])
def test_each_point_is_on_the_disk_at_once_and_to_the_bit(tmp_path, monkeypatch, arms, at_rest):
    path, synced = tmp_path / "points.csv", []
    fsync = os.fsync
    monkeypatch.setattr(os, "fsync", lambda number: synced.append(path.stat().st_size) or fsync(number))
    with TaughtFile(path, arms, at_rest=at_rest) as file:
        for k, point in enumerate(POINTS):
            file.add(0.1 * k, point[: len(arms)])
            found = read_trajectory(path)
            assert synced[-1] == path.stat().st_size
            assert len(synced) == file.count == len(found) == k + 1
            assert np.array_equal(found.q_rad, POINTS[: k + 1, : len(arms)])
            assert found.arms == arms
            assert (found.qd_rad_s is not None) == at_rest
            assert not at_rest or not found.qd_rad_s.any()


def test_no_file_is_overwritten_and_none_without_points_is_left(tmp_path):
    path = tmp_path / "points.csv"
    TaughtFile(path, ARMS, at_rest=True).close()
    assert not path.exists()
    path.write_text("precious")
    with pytest.raises(TrajectoryError, match="exists: choose another name"):
        TaughtFile(path, ARMS, at_rest=True)
    assert path.read_text() == "precious"
    with pytest.raises(TrajectoryError, match=r"suffix must be \.csv"):
        TaughtFile(tmp_path / "points.json", ARMS, at_rest=True)
    with pytest.raises(DualUR10Error, match="does not exist"):
        TaughtFile(tmp_path / "none" / "points.csv", ARMS, at_rest=True)


class Full:
    """File on a disk that has room for some more bytes."""

    def __init__(self, file, room):
        self._file, self._room = file, room

    def __getattr__(self, name):
        return getattr(self._file, name)

    def write(self, data):
        return self._file.write(data[: self._room])


def test_a_full_disk_leaves_the_points_before(tmp_path):
    path = tmp_path / "points.csv"
    file = TaughtFile(path, ARMS, at_rest=False)
    file.add(0.0, POINTS[0])
    whole, file._file = file._file, Full(file._file, 20)
    with pytest.raises(TrajectoryError, match="holds the 1 points before"):
        file.add(0.1, POINTS[1])
    assert len(read_trajectory(path)) == 1
    file._file = whole
    file.add(0.2, POINTS[2])
    file.close()
    assert np.array_equal(read_trajectory(path).q_rad, POINTS[[0, 2]])
