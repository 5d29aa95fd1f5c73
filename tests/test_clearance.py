"""Distances between the arms, themselves and the table, and which of them are refused."""

from __future__ import annotations

import pickle

import mujoco
import numpy as np
import pytest

from dual_ur10.assets.scene import CLEARANCE_CUTOFF_M, HOME_Q_RAD, SceneSettings, build_clearance_model, clearance_pairs
from dual_ur10.errors import CollisionAtStartError, SettingsError, UnknownNameError
from dual_ur10.sim2real.clearance import MINIMUM_M, Clearance

HOME = HOME_Q_RAD.reshape(12)
ON_TABLE = HOME + np.eye(12)[1] * 0.6  # the left arm reaches down
CROSSED = HOME + np.eye(12)[0] * -0.9 + np.eye(12)[6] * 0.9  # the arms meet in the middle


@pytest.fixture(scope="module")
def clearance() -> Clearance:
    return Clearance(SceneSettings(), n=4)


def test_distances_are_never_longer_than_they_are(clearance: Clearance) -> None:
    model = build_clearance_model(SceneSettings())
    data, points = mujoco.MjData(model), np.zeros(6)
    rng = np.random.default_rng(0)
    postures = np.stack([HOME, ON_TABLE, CROSSED, rng.uniform(-3, 3, 12)])
    found = clearance.distances_m(postures).copy()
    assert found.shape == (4, len(clearance_pairs()))
    for row, posture in enumerate(postures):
        data.qpos[:] = posture
        mujoco.mj_kinematics(model, data)
        for pair, (first, second) in enumerate(clearance_pairs()):
            expected = mujoco.mj_geomDistance(
                model, data, model.geom(first).id, model.geom(second).id, CLEARANCE_CUTOFF_M, points
            )
            # Its sensor takes a capsule to be up to some mm nearer to a box than it is; overlaps end at the cutoff.
            expected = max(expected, -CLEARANCE_CUTOFF_M)
            assert found[row, pair] <= expected + 1e-9
            if second != "table":
                assert found[row, pair] == pytest.approx(expected, abs=1e-6)
            elif expected > 0:
                assert found[row, pair] == pytest.approx(expected, abs=0.012)


def test_a_row_does_not_depend_on_the_others(clearance: Clearance) -> None:
    alone = Clearance(SceneSettings())
    postures = np.random.default_rng(1).uniform(-3, 3, (4, 12))
    together = clearance.distances_m(postures).copy()
    for row in range(4):
        np.testing.assert_array_equal(alone.distances_m(postures[row : row + 1])[0], together[row])


def test_home_is_clear_and_table_and_other_arm_are_not(clearance: Clearance) -> None:
    assert clearance.is_clear(np.stack([HOME, ON_TABLE, CROSSED, HOME])).tolist() == [True, False, False, True]


def test_a_posture_after_a_wild_one_is_measured_afresh(clearance: Clearance) -> None:
    wild = np.stack([HOME, HOME, HOME, HOME])
    wild[0, 3], wild[1, 3] = 1e300, -1e18
    clearance.distances_m(wild)
    assert clearance.is_clear(np.stack([ON_TABLE, CROSSED, HOME, HOME])).tolist() == [False, False, True, True]


def test_the_worst_pair_is_named(clearance: Clearance) -> None:
    pair, distance, allowed = clearance.worst(ON_TABLE)
    assert pair.startswith("left/")
    assert pair.endswith(" and table")
    assert distance < allowed == MINIMUM_M
    pair, distance, _ = clearance.worst(CROSSED)
    assert "left/" in pair
    assert "right/" in pair
    assert distance < MINIMUM_M


def test_a_larger_minimum_refuses_more() -> None:
    nearest = Clearance(SceneSettings()).distances_m(HOME[None]).min()
    assert MINIMUM_M < nearest < CLEARANCE_CUTOFF_M
    assert Clearance(SceneSettings(), minimum_m=nearest * 0.99).is_clear(HOME[None])[0]
    assert not Clearance(SceneSettings(), minimum_m=nearest * 1.01).is_clear(HOME[None])[0]


def test_allowed_pairs_may_touch_and_others_may_not() -> None:
    distances = Clearance(SceneSettings()).distances_m(ON_TABLE[None])[0]
    touching = [pair for pair, distance in zip(clearance_pairs(), distances, strict=True) if distance < MINIMUM_M]
    assert touching
    allowing = Clearance(SceneSettings(), allowed=touching)
    assert allowing.is_clear(ON_TABLE[None])[0]
    assert not allowing.is_clear(CROSSED[None])[0]
    assert allowing.worst(ON_TABLE)[1] >= MINIMUM_M
    assert not Clearance(SceneSettings(), allowed=touching[1:]).is_clear(ON_TABLE[None])[0]


def test_what_is_allowed_is_frozen_at_construction() -> None:
    allowed: list[tuple[str, str]] = []
    clearance = Clearance(SceneSettings(), allowed=allowed)
    allowed.extend(clearance_pairs())
    assert not clearance.is_clear(ON_TABLE[None])[0]
    assert not pickle.loads(pickle.dumps(clearance)).is_clear(ON_TABLE[None])[0]


@pytest.mark.parametrize("pair", [("left/forearm_link", "tabel"), ("table", "left/forearm_link")])
def test_an_unknown_pair_is_refused_at_construction(pair: tuple[str, str]) -> None:
    with pytest.raises(UnknownNameError, match="contact pair"):
        Clearance(SceneSettings(), allowed=[pair])


def test_pickling_keeps_everything() -> None:
    first = Clearance(SceneSettings(), n=2, minimum_m=0.05, allowed=clearance_pairs()[:3])
    second = pickle.loads(pickle.dumps(first))
    postures = np.stack([HOME, ON_TABLE])
    np.testing.assert_array_equal(first.distances_m(postures), second.distances_m(postures))
    assert second.minimum_m == 0.05
    np.testing.assert_array_equal(first.is_clear(postures), second.is_clear(postures))


def test_starts_are_checked_by_row(clearance: Clearance) -> None:
    starts = np.stack([HOME, CROSSED]).reshape(2, 2, 6)
    clearance.check_start(starts[:1], np.array([3]))
    with pytest.raises(CollisionAtStartError, match="mm apart") as caught:
        clearance.check_start(starts, np.array([0, 2]))
    assert "left/" in str(caught.value)
    for bad in (np.nan, np.inf):
        spoiled = starts[:1].copy()
        spoiled[0, 1, 2] = bad
        with pytest.raises(SettingsError, match="finite"):
            clearance.check_start(spoiled, np.array([1]))
