"""Property: whatever targets arrive, those that the gate releases keep every limit, by computations of others."""

from __future__ import annotations

import functools

import mujoco
import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

from dual_ur10.assets.collision_model import build_collision_model
from dual_ur10.assets.obstacles import Box, Capsule
from dual_ur10.assets.settings import HOME_Q_RAD, SceneSettings
from dual_ur10.sim2real.control.adapter import ServojAdapter
from dual_ur10.sim2real.control.clearance import MINIMUM_M, Clearance
from dual_ur10.sim2real.control.gate import SWEEP_TOLERANCE_M, SafetyGate
from dual_ur10.sim2real.control.limits import MotionLimits
from tests.sim2real.control.motion_checks import HARD, NARROW, TIGHT, TOOL, assert_within, braked
from tests.soak import scaled
from ur_core.kinematics.ur10 import NOMINAL_DH
from ur_core.servoj import ServojProfile

SCENE = SceneSettings(
    obstacles=(
        Box(name="plate", position_m=(0.3, 0.0, 0.9), size_m=(0.6, 0.01, 0.4)),
        Capsule(name="rod", from_m=(0.1, 0.75, 0.0), to_m=(0.1, 0.75, 1.6), radius_m=0.004),
    )
)
N = 4


@functools.cache
def made(family: str, ticks: int, limits: MotionLimits) -> tuple[ServojAdapter, SafetyGate]:
    """Return an adapter and a gate, which each example resets: making them takes longer than an example."""
    profile = ServojProfile(family)
    adapter = ServojAdapter(profile, limits, ticks, n=N, dh=[NOMINAL_DH] * 2)
    return adapter, SafetyGate(limits, profile.tick_s, ticks, Clearance(SCENE), n=N)


@functools.cache
def collision_model() -> mujoco.MjModel:
    return build_collision_model(SCENE)


def spoiled(targets: np.ndarray, last: np.ndarray, kind: str, size: float, rng: np.random.Generator) -> np.ndarray:
    """Return targets, (n, ticks, 2, 6), that continue the last ones, (n, 2, 6), in another way than planned."""
    ticks = np.arange(1, targets.shape[1] + 1)[:, None, None] / targets.shape[1]
    offset = size * rng.uniform(-1.0, 1.0, (len(targets), 1, 2, 6))
    if kind == "noise":
        return targets + size * rng.uniform(-1.0, 1.0, targets.shape)
    if kind == "drift":
        return targets + offset * ticks**3
    if kind == "hold":
        return np.repeat(last[:, None], targets.shape[1], axis=1) + offset * ticks
    return targets


@settings(max_examples=scaled(2000))
@given(
    kinds=st.lists(
        st.tuples(st.sampled_from(["planned", "planned", "noise", "drift", "hold"]), st.floats(-9.0, 1.0)),
        min_size=1,
        max_size=8,
    ),
    family=st.sampled_from(["cb3", "e-series"]),
    ticks=st.sampled_from([1, 3, 5, 25]),
    limits=st.sampled_from([HARD, TIGHT, NARROW, TOOL]),
    seed=st.integers(0, 2**31),
)
def test_what_is_released_keeps_every_limit(kinds, family, ticks, limits, seed) -> None:
    profile, rng = ServojProfile(family), np.random.default_rng(seed)
    adapter, gate = made(family, ticks, limits)
    start = np.tile(HOME_Q_RAD, (N, 1, 1))
    adapter.reset(start)
    gate.reset(start)
    push = rng.uniform(-1.0, 1.0, (N, 2, 6))
    sent = [np.repeat(start[:, None], 4, axis=1)]
    for kind, exponent in kinds:
        for _ in range(max(1, 12 // ticks)):  # planned motion before each
            sent.append(gate(adapter(push).targets_rad).targets_rad)
        planned = adapter(push).targets_rad
        sent.append(gate(spoiled(planned, gate.last_targets_rad, kind, 10.0**exponent, rng)).targets_rad)
    released = np.concatenate(sent, axis=1)
    assert_within(released, limits, profile.tick_s)
    assert_within(braked(released[:, -3:], limits, profile.tick_s), limits, profile.tick_s)
    model = collision_model()
    data = mujoco.MjData(model)
    for q in released[:, :: max(1, released.shape[1] // 20)].reshape(-1, 12):
        data.qpos[:] = q
        mujoco.mj_kinematics(model, data)
        mujoco.mj_sensorPos(model, data)
        assert data.sensordata.min() >= MINIMUM_M - SWEEP_TOLERANCE_M
