"""Requests of fault injection for the objects of a task."""

import numpy as np
import pytest

from tests.emulated.ticking import Cell
from tests.ur_emulator.ticking import Lone


@pytest.fixture(scope="module")
def carry():
    made = Cell(task="Handover")
    yield made
    made.close()


def test_pose_has_noise_and_is_late(carry):
    def place(x):
        carry.get("place", position_m=[x, 0.0, 1.0], quat=[1.0, 0.0, 0.0, 0.0])

    def x(**values):
        return carry.get("pose", body="block", **values)["position_m"][0]

    place(0.1)
    carry.tick()
    assert x() == pytest.approx(0.1, abs=1e-3)
    x(delay_s=0.1)  # from now on it is remembered
    carry.tick(40)
    place(0.4)
    carry.tick(5)
    assert x() == pytest.approx(0.4, abs=0.02)
    assert x(delay_s=0.1) == pytest.approx(0.1, abs=0.02)
    carry.tick(15)
    assert x(delay_s=0.1) == pytest.approx(0.4, abs=0.02)
    seen = np.array([carry.get("pose", body="block", noise_m=0.01, noise_rad=0.1)["quat"] for _ in range(200)])
    assert np.allclose(np.linalg.norm(seen, axis=1), 1.0)
    assert 0.03 < seen[:, 1].std() < 0.07  # half the angle
    xs = [x(noise_m=0.01) for _ in range(200)]
    assert 0.007 < np.std(xs) < 0.013
    for bad in ({"noise_m": -1}, {"noise_rad": 9}, {"delay_s": 3}, {"delay_s": float("nan")}):
        assert "allowed" in carry.refused("pose", body="block", **bad)
    assert "'block'" in carry.refused("pose", body="blok")


def test_place(carry):
    carry.get("place", position_m=[0.2, 0.1, 0.9], quat=[0.0, 0.0, 0.0, 1.0])
    carry.tick()
    pose = carry.get("pose", body="block")
    assert pose["position_m"] == pytest.approx([0.2, 0.1, 0.9], abs=2e-3)
    assert abs(pose["quat"][3]) == pytest.approx(1.0, abs=1e-3)
    for bad in ([0.0, 0.0], [np.nan, 0.0, 0.0], [1e300, 0.0, 0.0], ["x", 0.0, 0.0]):
        carry.refused("place", position_m=bad, quat=[1.0, 0.0, 0.0, 0.0])
    carry.refused("place", position_m=[0.0, 0.0, 1.0], quat=[1.0, 1.0, 0.0, 0.0])
    carry.tick(50)
    assert not carry.emulator.world.failed
    alone = Lone()
    assert "no object" in alone.refused("place", position_m=[0.0, 0.0, 1.0], quat=[1.0, 0.0, 0.0, 0.0])
    alone.close()
