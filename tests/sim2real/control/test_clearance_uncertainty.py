"""Extra clearance for the uncertainty of the base poses, once for each base of a pair."""

from __future__ import annotations

import pickle

import mujoco
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from dual_ur10.assets.collision_model import CLEARANCE_CUTOFF_M, build_collision_model, reach_m
from dual_ur10.assets.obstacles import Box, Capsule, Plane
from dual_ur10.assets.settings import HOME_Q_RAD, Equipment, SceneSettings
from dual_ur10.errors import CollisionAtStartError, SettingsError
from dual_ur10.sim2real.control.clearance import MINIMUM_M, BaseUncertainty, Clearance
from tests.sim2real.control.reference_cell import SHIFTED, UNEQUAL, random_q, segment
from tests.soak import scaled
from ur_core.kinematics.frames import ArmMount
from ur_core.kinematics.ur10 import ARMS

GRIPPERS = Equipment(grippers=True)
FURNISHED = SceneSettings(
    left=UNEQUAL.left,
    right=UNEQUAL.right,
    equipment=GRIPPERS,
    obstacles=(
        Box(name="box", position_m=(0.1, 0.3, 0.5), size_m=(0.3, 0.5, 0.2), rotation_rad=(0.4, -0.3, 0.8)),
        Capsule(name="post", from_m=(-0.2, 0.0, 0.0), to_m=(-0.2, 0.1, 1.2), radius_m=0.05),
        Plane(name="wall", point_m=(0.6, 0.0, 0.0), normal=(-1.0, 0.0, 0.0)),
    ),
)
UNCERTAIN = ((0.004, 0.011), (0.007, 0.006))


def moved(model: mujoco.MjModel, settings: SceneSettings, rng: np.random.Generator, uncertainty) -> mujoco.MjModel:
    """Return the model with both bases at a random largest error."""
    shifts, turns = [], []
    for shift, turn in uncertainty:
        shifts.append(shift * unit(rng))
        turns.append(Rotation.from_rotvec(turn * unit(rng)))
    for name, position, quat in [
        *((f"{arm}/shoulder_link", model.body_pos, model.body_quat) for arm in ARMS),
        *((f"{arm}/base_link", model.geom_pos, model.geom_quat) for arm in ARMS),
    ]:
        row = model.body(name).id if name.endswith("shoulder_link") else model.geom(name).id
        arm = ARMS.index(name.split("/")[0])
        base = np.array(settings.mounts[arm].position_m)
        position[row] = base + shifts[arm] + turns[arm].apply(position[row] - base)
        turned = turns[arm] * Rotation.from_quat(quat[row], scalar_first=True)
        quat[row] = turned.as_quat(scalar_first=True)
    return model


def allowed(clearance: Clearance) -> np.ndarray:
    """Return the smallest legal distances at home, (pairs,)."""
    return clearance.measure(HOME_Q_RAD.reshape(1, 12)).allowed_m[0]


def unit(rng: np.random.Generator) -> np.ndarray:
    direction = rng.normal(size=3)
    return direction / np.linalg.norm(direction)


def test_no_base_error_brings_a_pair_closer_than_allowed() -> None:
    rng = np.random.default_rng(1)
    believed = build_collision_model(FURNISHED)
    data = mujoco.MjData(believed)
    clearance = Clearance(FURNISHED, uncertainty=UNCERTAIN)
    most_m = BaseUncertainty(UNCERTAIN, FURNISHED, believed).most_m
    used, compared = np.zeros(len(clearance.pairs)), 0
    for _ in range(scaled(800, 40)):
        truth = moved(build_collision_model(FURNISHED), FURNISHED, rng, UNCERTAIN)
        true = mujoco.MjData(truth)
        for q in (*random_q(rng, 20), *(HOME_Q_RAD + rng.uniform(-0.7, 0.7, (20, 2, 6)))):
            data.qpos[:] = true.qpos[:] = q.ravel()
            mujoco.mj_forward(believed, data)
            mujoco.mj_forward(truth, true)
            lost = np.where(data.sensordata > 0.0, data.sensordata - true.sensordata, 0.0)
            added = clearance.measure(q.reshape(1, 12)).allowed_m[0] - MINIMUM_M
            assert (lost <= added + 1e-6).all()
            assert (added <= most_m + 1e-12).all()
            used = np.maximum(used, lost / np.maximum(added, 1e-9))
            compared += int((data.sensordata < CLEARANCE_CUTOFF_M).sum())
    assert compared > 5000
    assert used.max() > 0.85  # what is added is not far too much


def test_which_base_counts_for_which_pair() -> None:
    known = Clearance(FURNISHED)
    np.testing.assert_array_equal(allowed(known), MINIMUM_M)
    left = allowed(Clearance(FURNISHED, uncertainty=((0.01, 0.0), (0.0, 0.0)))) - MINIMUM_M
    right = allowed(Clearance(FURNISHED, uncertainty=((0.0, 0.0), (0.03, 0.0)))) - MINIMUM_M
    both = allowed(Clearance(FURNISHED, uncertainty=((0.01, 0.0), (0.03, 0.0)))) - MINIMUM_M
    for pair, *found in zip(known.pairs, left, right, both, strict=True):
        arms = {name.split("/")[0] for name in pair} & set(ARMS)
        own = len(arms) == 1 and all(name.startswith(tuple(arms)) for name in pair)
        by_left, by_right = 0.01 * ("left" in arms and not own), 0.03 * ("right" in arms and not own)
        assert found == pytest.approx([by_left, by_right, by_left + by_right], abs=1e-12), pair
    assert {0.0, 0.01, 0.03, 0.04} == set(np.round(both, 6).tolist())


@pytest.mark.parametrize("settings", [SceneSettings(equipment=GRIPPERS), FURNISHED], ids=["nominal", "calibrated"])
def test_nothing_gets_further_from_its_base_than_its_reach(settings: SceneSettings) -> None:
    model = build_collision_model(settings)
    data = mujoco.MjData(model)
    bound = {geom: reach_m(model, settings, geom) for geom in range(model.ngeom)}
    fixed = [model.geom(geom).name for geom, (arm, _) in bound.items() if arm == -1]
    assert set(fixed) >= {"floor", "table", "table:hull"}
    assert not [name for name in fixed if name.startswith(ARMS)]
    furthest = dict.fromkeys(bound, 0.0)
    straight = np.zeros((2, 6)), np.array([[0.0, -np.pi / 2, 0.0, 0.0, np.pi / 2, 0.0]] * 2)
    for q in (*straight, *random_q(np.random.default_rng(2), 400)):
        data.qpos[:] = q.ravel()
        mujoco.mj_kinematics(model, data)
        for geom, (arm, reach) in bound.items():
            if arm == -1:
                continue
            if model.geom_type[geom] == mujoco.mjtGeom.mjGEOM_CAPSULE:
                points, radius = segment(model, data, geom), model.geom_size[geom, 0]
            else:
                points, radius = data.geom_xpos[[geom]], 0.0  # of the fingers' box, its centre
            away = np.linalg.norm(points - settings.mounts[arm].position_m, axis=1).max() + radius
            assert away <= reach + 1e-9, model.geom(geom).name
            furthest[geom] = max(furthest[geom], away)
    for geom, (arm, reach) in bound.items():
        assert (arm, reach) == (-1, 0.0) or furthest[geom] > 0.75 * reach, model.geom(geom).name


def test_a_calibration_that_shifts_frames_changes_no_reach() -> None:
    nominal, shifted = (
        SceneSettings(left=ArmMount((-0.75, 0.6, 0.0), 0.0, dh)) for dh in (SceneSettings().left.dh, SHIFTED)
    )
    found = []
    for settings in (nominal, shifted):
        model = build_collision_model(settings)
        found.append(reach_m(model, settings, model.geom("left/wrist_3_link").id))
    assert found[1] == pytest.approx(found[0], abs=0.01)
    assert found[0][0] == 0


def test_pairs_that_a_task_brings_together_are_exempt() -> None:
    pair = ("left/forearm_link", "table")
    row = Clearance(SceneSettings()).pairs.index(pair)
    plain = allowed(Clearance(SceneSettings(), closer={pair: 0.001}))
    grown = allowed(Clearance(SceneSettings(), closer={pair: 0.001}, uncertainty=((0.01, 0.0), (0.0, 0.0))))
    assert plain[row] == grown[row] == 0.001
    others = np.arange(len(plain)) != row
    assert (grown[others] >= plain[others]).all()
    assert (grown[others] > plain[others]).any()


def test_a_larger_uncertainty_refuses_more() -> None:
    nearest = float(Clearance(SceneSettings()).measure(HOME_Q_RAD.reshape(1, 12)).distances_m.min())
    pairs = Clearance(SceneSettings()).pairs
    own = pairs[int(Clearance(SceneSettings()).measure(HOME_Q_RAD.reshape(1, 12)).distances_m[0].argmin())]
    assert own[0].split("/")[0] == own[1].split("/")[0]  # what is nearest at home is one arm's own
    low = HOME_Q_RAD.reshape(12) + np.eye(12)[1] * 0.45  # towards the table
    distances = Clearance(SceneSettings()).measure(low[None]).distances_m[0]
    table = min(d for d, pair in zip(distances, pairs, strict=True) if pair[1] == "table")
    assert MINIMUM_M < table < 0.1
    spare = table - MINIMUM_M
    barely = Clearance(SceneSettings(), uncertainty=((0.99 * spare, 0.0), (0.0, 0.0)))
    assert barely.is_clear(low[None])[0] == (nearest >= MINIMUM_M)
    refusing = Clearance(SceneSettings(), uncertainty=((1.01 * spare, 0.0), (0.0, 0.0)))
    assert not refusing.is_clear(low[None])[0]
    subject, distance, least = refusing.worst(low)
    assert subject.endswith(" and table")
    assert least == pytest.approx(MINIMUM_M + 1.01 * spare)
    assert distance == pytest.approx(table)
    with pytest.raises(CollisionAtStartError, match=f"allowed are {least * 1e3:.1f} mm"):
        refusing.check_start(low.reshape(1, 2, 6))
    # The other arm's base does not matter to it.
    assert Clearance(SceneSettings(), uncertainty=((0.0, 0.0), (1.01 * spare, 0.0))).is_clear(low[None])[0]


def test_pickling_keeps_what_is_allowed() -> None:
    clearance = Clearance(FURNISHED, uncertainty=UNCERTAIN)
    again = pickle.loads(pickle.dumps(clearance))
    np.testing.assert_array_equal(allowed(again), allowed(clearance))
    assert allowed(again).max() > 0.03
    q = HOME_Q_RAD.reshape(1, 12)
    np.testing.assert_array_equal(again.measure(q).distances_m, clearance.measure(q).distances_m)


def test_a_row_does_not_depend_on_the_others() -> None:
    alone, together = Clearance(FURNISHED, uncertainty=UNCERTAIN), Clearance(FURNISHED, uncertainty=UNCERTAIN)
    q = random_q(np.random.default_rng(3), 3).reshape(3, 12)
    found = together.measure(q)
    allowed, distances = found.allowed_m.copy(), found.distances_m.copy()
    for row in range(3):
        np.testing.assert_array_equal(alone.measure(q[[row]]).allowed_m[0], allowed[row])
        np.testing.assert_array_equal(alone.measure(q[[row]]).distances_m[0], distances[row])
    assert len(np.unique(allowed, axis=0)) == 3  # a rotation moves distant arms further


@pytest.mark.parametrize(
    "uncertainty",
    [
        ((0.0, 0.0), (0.0, -1e-9)),
        ((np.nan, 0.0), (0.0, 0.0)),
        ((0.0, 0.0), (np.inf, 0.0)),
        ((0.0, 0.0),),
        (0.001, 0.002),
        ((0.0, 0.0, 0.0), (0.0, 0.0, 0.0)),
    ],
)
def test_invalid_uncertainties_are_refused(uncertainty) -> None:
    with pytest.raises(SettingsError, match="uncertainty of the bases is"):
        Clearance(SceneSettings(), uncertainty=uncertainty)


def test_distances_that_would_not_be_measured_are_refused() -> None:
    room = CLEARANCE_CUTOFF_M - MINIMUM_M
    Clearance(SceneSettings(), uncertainty=((0.49 * room, 0.0), (0.49 * room, 0.0)))
    for uncertainty in (
        ((0.5 * room, 0.0), (0.5 * room, 0.0)),  # of both arms together
        ((0.0, 0.2), (0.0, 0.0)),
        ((1.0, 0.0), (0.0, 0.0)),
    ):
        with pytest.raises(SettingsError, match=r"left/\w+ and .* below 0.2 m, .*measure where the bases stand"):
            Clearance(SceneSettings(), uncertainty=uncertainty)
