"""Distances between the arms, themselves and the table, and their refusal."""

from __future__ import annotations

import pickle
import re

import mujoco
import numpy as np
import pytest

from dual_ur10.assets.collision_model import CLEARANCE_CUTOFF_M, build_collision_model, clearance_pairs
from dual_ur10.assets.settings import HOME_Q_RAD, Equipment, SceneSettings
from dual_ur10.errors import CollisionAtStartError, SettingsError, UnknownNameError
from dual_ur10.sim2real.control.clearance import MINIMUM_M, Clearance

HOME = HOME_Q_RAD.reshape(12)
ON_TABLE = HOME + np.eye(12)[1] * 0.6  # the left arm reaches down
NEAR_TABLE = HOME + np.eye(12)[1] * 0.505
CROSSED = HOME + np.eye(12)[0] * -0.9 + np.eye(12)[6] * 0.9  # the arms meet in the middle


@pytest.fixture(scope="module")
def clearance() -> Clearance:
    return Clearance(SceneSettings())


def test_distances_are_never_longer_than_they_are(clearance: Clearance) -> None:
    model = build_collision_model(SceneSettings())
    data, points = mujoco.MjData(model), np.zeros(6)
    rng = np.random.default_rng(0)
    configurations = np.stack([HOME, ON_TABLE, CROSSED, rng.uniform(-3, 3, 12)])
    found = clearance.measure(configurations).distances_m.copy()
    assert found.shape == (4, len(clearance_pairs(SceneSettings())))
    for row, configuration in enumerate(configurations):
        data.qpos[:] = configuration
        mujoco.mj_kinematics(model, data)
        for pair, (first, second) in enumerate(clearance_pairs(SceneSettings())):
            expected = mujoco.mj_geomDistance(
                model, data, model.geom(first).id, model.geom(second).id, CLEARANCE_CUTOFF_M, points
            )
            assert found[row, pair] <= expected + 1e-9
            if second != "table":
                assert found[row, pair] == pytest.approx(expected, abs=1e-6)
            elif expected > 0:
                assert found[row, pair] == pytest.approx(expected, abs=0.012)


def test_home_is_clear_and_table_and_other_arm_are_not(clearance: Clearance) -> None:
    assert clearance.is_clear(np.stack([HOME, ON_TABLE, CROSSED, HOME])).tolist() == [True, False, False, True]


def test_a_configuration_after_a_wild_one_is_measured_afresh(clearance: Clearance) -> None:
    wild = np.stack([HOME, HOME, HOME, HOME])
    wild[0, 3], wild[1, 3] = 1e300, -1e18
    clearance.measure(wild)
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
    nearest = Clearance(SceneSettings()).measure(HOME[None]).distances_m.min()
    assert MINIMUM_M < nearest < CLEARANCE_CUTOFF_M
    assert Clearance(SceneSettings(), minimum_m=nearest * 0.99).is_clear(HOME[None])[0]
    assert not Clearance(SceneSettings(), minimum_m=nearest * 1.01).is_clear(HOME[None])[0]


def test_pairs_with_their_own_limit_may_come_that_close() -> None:
    distances = Clearance(SceneSettings()).measure(NEAR_TABLE[None]).distances_m[0]
    pairs = clearance_pairs(SceneSettings())
    near = {pair: float(d) for pair, d in zip(pairs, distances, strict=True) if d < MINIMUM_M}
    assert near
    assert min(near.values()) > 0.0
    assert not Clearance(SceneSettings()).is_clear(NEAR_TABLE[None])[0]
    closer = {pair: 0.99 * distance for pair, distance in near.items()}
    assert Clearance(SceneSettings(), closer=closer).is_clear(NEAR_TABLE[None])[0]
    assert not Clearance(SceneSettings(), closer=closer).is_clear(CROSSED[None])[0]
    assert not Clearance(SceneSettings(), closer=closer).is_clear(ON_TABLE[None])[0]
    for pair, distance in near.items():
        too_far = closer | {pair: 1.01 * distance}
        refusing = Clearance(SceneSettings(), closer=too_far)
        assert not refusing.is_clear(NEAR_TABLE[None])[0]
        assert refusing.worst(NEAR_TABLE) == (" and ".join(pair), distance, too_far[pair])


def test_a_pair_may_have_a_larger_limit_than_the_others() -> None:
    pairs = clearance_pairs(SceneSettings())
    distances = Clearance(SceneSettings()).measure(HOME[None]).distances_m[0]
    nearest = int(distances.argmin())
    limit = float(distances[nearest]) + 0.001
    further = Clearance(SceneSettings(), closer={pairs[nearest]: limit})
    assert not further.is_clear(HOME[None])[0]
    with pytest.raises(CollisionAtStartError, match=f"allowed are {limit * 1e3:.1f} mm"):
        further.check_start(HOME.reshape(1, 2, 6))


@pytest.mark.parametrize("distance", [-1e-9, np.nan, np.inf, -np.inf])
def test_a_limit_that_is_none_is_refused(distance: float) -> None:
    with pytest.raises(SettingsError, match="left/forearm_link and table"):
        Clearance(SceneSettings(), closer={("left/forearm_link", "table"): distance})


@pytest.mark.parametrize("distance", [-0.001, CLEARANCE_CUTOFF_M, 0.25, np.nan])
def test_a_smallest_distance_that_is_not_measured_is_refused(distance: float) -> None:
    below = np.nextafter(CLEARANCE_CUTOFF_M, 0.0)
    with pytest.raises(SettingsError, match=r"must be 0 or more, and below 0.2 m"):
        Clearance(SceneSettings(), minimum_m=distance)
    with pytest.raises(SettingsError, match=r"left/forearm_link and table .* below 0.2 m, beyond which distances are"):
        Clearance(SceneSettings(), closer={("left/forearm_link", "table"): distance})
    # The largest legal one: what is further apart spares something, what is nearer does not.
    largest = Clearance(SceneSettings(), minimum_m=below)
    far = largest.measure(HOME[None]).distances_m[0] >= CLEARANCE_CUTOFF_M
    np.testing.assert_array_equal(largest.spare_m(HOME[None])[0] > 0.0, far)
    assert 0 < far.sum() < len(far)


@pytest.mark.parametrize("shape", [(12,), (2, 6), (3, 2, 6), (3, 11), (3, 13), (12, 1)])
def test_configurations_of_another_shape_are_refused(clearance: Clearance, shape: tuple[int, ...]) -> None:
    for measure in (clearance.measure, clearance.spare_m, clearance.is_clear):
        with pytest.raises(SettingsError, match=rf"must have the shape \(n, 12\), found {re.escape(str(shape))}"):
            measure(np.zeros(shape))
    assert clearance.measure(np.zeros((0, 12))).distances_m.shape == (0, len(clearance.pairs))


def test_limits_are_frozen_at_construction() -> None:
    closer: dict[tuple[str, str], float] = {}
    clearance = Clearance(SceneSettings(), closer=closer)
    closer.update(dict.fromkeys(clearance_pairs(SceneSettings()), 0.0))
    assert not clearance.is_clear(NEAR_TABLE[None])[0]
    assert not pickle.loads(pickle.dumps(clearance)).is_clear(NEAR_TABLE[None])[0]


def test_grippers_are_measured() -> None:
    settings = SceneSettings(equipment=Equipment(grippers=True))
    bare, with_grippers = Clearance(SceneSettings()), Clearance(settings)
    assert with_grippers.pairs == clearance_pairs(settings)
    low = HOME + np.eye(12)[1] * 0.3  # the flange 0.2 m above the table
    assert bare.is_clear(low[None])[0]
    assert not with_grippers.is_clear(low[None])[0]
    assert with_grippers.worst(low)[0] == "left/fingers and table"
    with pytest.raises(UnknownNameError, match="contact pair"):
        Clearance(SceneSettings(), closer={("left/fingers", "table"): 0.0005})


@pytest.mark.parametrize("pair", [("left/forearm_link", "tabel"), ("table", "left/forearm_link")])
def test_an_unknown_pair_is_refused_at_construction(pair: tuple[str, str]) -> None:
    with pytest.raises(UnknownNameError, match="contact pair"):
        Clearance(SceneSettings(), closer={pair: 0.01})


def test_pickling_keeps_everything() -> None:
    first = Clearance(SceneSettings(), minimum_m=0.05, closer={clearance_pairs(SceneSettings())[0]: 0.01})
    second = pickle.loads(pickle.dumps(first))
    configurations = np.stack([HOME, ON_TABLE])
    np.testing.assert_array_equal(first.measure(configurations).distances_m, second.measure(configurations).distances_m)
    assert second.minimum_m == 0.05
    np.testing.assert_array_equal(first.is_clear(configurations), second.is_clear(configurations))


def test_moving_the_bases_is_no_remedy_within_one_arm(clearance: Clearance) -> None:
    folded = HOME.copy().reshape(1, 2, 6)
    folded[0, 0, 2] = 3.1
    with pytest.raises(CollisionAtStartError, match=r"left/\w+ and left/.* or more: choose another start") as caught:
        clearance.check_start(folded)
    assert "bases" not in str(caught.value)


def test_starts_are_checked_by_row(clearance: Clearance) -> None:
    starts = np.stack([HOME, CROSSED]).reshape(2, 2, 6)
    clearance.check_start(starts[:1])
    with pytest.raises(CollisionAtStartError, match="mm apart") as caught:
        clearance.check_start(starts)
    assert "left/" in str(caught.value)
    for bad in (np.nan, np.inf):
        spoiled = starts[:1].copy()
        spoiled[0, 1, 2] = bad
        with pytest.raises(SettingsError, match="finite"):
            clearance.check_start(spoiled)
