"""Cartesian steps shrink towards a singularity, end before it, and lead away from it at full speed."""

import numpy as np
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from dual_ur10.assets.settings import HOME_Q_RAD
from dual_ur10.sim2real.control.adapter import TCP_ROTATION_RAD_S, TCP_STEP_M_S, ServojAdapter
from dual_ur10.sim2real.control.cartesian_step import HALT_CONDITION, SLOW_CONDITION, condition, fraction_of_step
from tests.sim2real.control.test_adapter import HARD
from tests.soak import scaled
from ur_core.kinematics.forward import pose_and_jacobian
from ur_core.kinematics.ur10 import NOMINAL_DH
from ur_core.servoj import ServojProfile

# Joint that leads an arm near home into a singularity, and its angle there.
SINGULARITIES = {"elbow": (2, 0.0), "wrist": (4, 0.0)}
POSTURES = arrays(np.float64, (4, 6), elements=st.floats(-3.0, 3.0))


def jacobian(q):
    return pose_and_jacobian(q, NOMINAL_DH)[2]


@given(POSTURES)
def test_the_condition_is_that_of_the_jacobian(q):
    wanted = np.linalg.cond(jacobian(q))
    near = wanted > 1e9
    np.testing.assert_allclose(condition(q, NOMINAL_DH)[~near], wanted[~near], rtol=1e-6)
    assert (condition(q, NOMINAL_DH)[near] > 1e8).all()


@settings(max_examples=scaled(300, 3))
@given(POSTURES, arrays(np.float64, (4, 6), elements=st.floats(-0.2, 0.2)), st.floats(1.0, 10.0))
def test_a_step_is_made_smaller_only_towards_a_singularity(q, step, ahead):
    fraction = fraction_of_step(q, step, ahead, NOMINAL_DH)
    assert set(fraction * 8) <= set(range(9))
    for row in range(len(q)):
        on_way = condition(q[row] + np.arange(9)[:, None] / 8 * ahead * step[row], NOMINAL_DH)
        here, most = on_way[0], on_way.max()
        assume(most < 1e6)  # beyond, its last digits are noise
        if most <= max(SLOW_CONDITION, here):
            assert fraction[row] == 1.0
        elif most > max(SLOW_CONDITION, here * (1 + 2e-6)):
            assert fraction[row] < 1.0
            most = on_way[: int(fraction[row] * 8) + 1].max()
            assert most <= max(here * (1 + 2e-6), HALT_CONDITION - fraction[row] * (HALT_CONDITION - SLOW_CONDITION))
            more = on_way[: int(fraction[row] * 8) + 2].max() * (1 + 2e-6)
            assert more > HALT_CONDITION - (fraction[row] + 1 / 8) * (HALT_CONDITION - SLOW_CONDITION)
        if here >= HALT_CONDITION and on_way[1] > here * (1 + 2e-6):
            assert fraction[row] == 0.0


@given(POSTURES)
def test_rows_do_not_depend_on_each_other(q):
    step = 0.1 * np.roll(q, 1, axis=0)
    together = fraction_of_step(q, step, 5.0, NOMINAL_DH)
    alone = [fraction_of_step(q[k : k + 1], step[k : k + 1], 5.0, NOMINAL_DH)[0] for k in range(len(q))]
    np.testing.assert_array_equal(together, alone)


def along(adapter, joint, way):
    """Return the action that rotates one joint of the left arm alone, as far as flange steps can."""
    q = adapter.commanded_q_rad[0, 0]
    twist = jacobian(q)[:, joint] * way
    twist[[0, 1, 3, 4]] *= -1.0  # `base` is rotated by π from the cell's frame
    fraction = np.concatenate([twist[:3] / TCP_STEP_M_S, twist[3:] / TCP_ROTATION_RAD_S])
    action = np.zeros((1, 2, 6))
    action[0, 0] = 0.9 * fraction / np.abs(fraction).max()
    return action


@pytest.mark.parametrize(("joint", "at_rad"), SINGULARITIES.values(), ids=SINGULARITIES)
def test_flange_steps_end_before_a_singularity_and_lead_back(joint, at_rad):
    adapter = ServojAdapter(ServojProfile(), HARD, 5, mode="tcp_delta", dh=[NOMINAL_DH] * 2)
    adapter.reset(HOME_Q_RAD[None])
    way = np.sign(at_rad - HOME_Q_RAD[0, joint])
    conditions, steps, sent = [], [], []
    for _ in range(600):
        before = adapter.commanded_q_rad[0, 0]
        sent.append(adapter(along(adapter, joint, way)).targets_rad[0, :, 0])
        after = adapter.commanded_q_rad[0, 0]
        conditions.append(float(condition(after[None], NOMINAL_DH)[0]))
        steps.append(float(np.abs(after - before).max()))
    # No target is nearer, either, although arms stop after their last command.
    assert condition(np.concatenate(sent), NOMINAL_DH).max() <= HALT_CONDITION
    assert conditions[-1] >= 0.85 * HALT_CONDITION
    assert steps[-1] < 1e-9
    fast = max(steps)
    assert steps[int(np.argmax(np.array(conditions) > 24.0))] < 0.6 * fast
    before = adapter.commanded_q_rad[0, 0]
    adapter(along(adapter, joint, -way))
    assert np.abs(adapter.commanded_q_rad[0, 0] - before).max() > 0.5 * fast
    assert condition(adapter.commanded_q_rad[0, :1], NOMINAL_DH)[0] < conditions[-1]


def test_rotating_the_base_near_a_singularity_is_free():
    q = np.array([[0.3, -1.2, 0.4, -1.0, 1.2, 0.0]])
    assert condition(q, NOMINAL_DH)[0] > SLOW_CONDITION
    for turn in np.linspace(-0.1, 0.1, 201):
        step = np.array([[turn, 0.0, 0.0, 0.0, 0.0, 0.0]])
        assert fraction_of_step(q, step, 5.0, NOMINAL_DH)[0] == 1.0


@pytest.mark.parametrize("period_ticks", [1, 5, 12])
def test_an_arm_that_stretches_stops_before_it_is_singular(period_ticks):
    adapter = ServojAdapter(ServojProfile(), HARD, period_ticks, mode="tcp_delta", dh=[NOMINAL_DH] * 2)
    adapter.reset(HOME_Q_RAD[None])
    action = np.zeros((1, 2, 6))
    action[0, 0, 0] = 1.0  # away from the base
    sent = np.concatenate([adapter(action).targets_rad[0, :, 0] for _ in range(600 // period_ticks)])
    conditions = condition(sent, NOMINAL_DH)
    assert 0.8 * HALT_CONDITION < conditions.max() <= HALT_CONDITION
    assert np.ptp(sent[-50:], axis=0).max() < 1e-3


def test_a_flange_above_the_base_stops_before_it_is_singular():
    adapter = ServojAdapter(ServojProfile(), HARD, 5, mode="tcp_delta", dh=[NOMINAL_DH] * 2)
    adapter.reset(HOME_Q_RAD[None])
    action = np.zeros((1, 2, 6))
    action[0, 0, 0] = -1.0  # towards the base
    sent = np.concatenate([adapter(action).targets_rad[0, :, 0] for _ in range(150)])
    conditions = condition(sent, NOMINAL_DH)
    assert 0.8 * HALT_CONDITION < conditions.max() <= HALT_CONDITION
    assert np.ptp(sent[-50:], axis=0).max() < 1e-3
    assert np.abs(np.sin(sent[-1, [2, 4]])).min() > 0.5  # neither elbow nor wrist is near theirs
    action[0, 0, 0] = 1.0
    for _ in range(10):
        adapter(action)
    assert condition(adapter.commanded_q_rad[0, :1], NOMINAL_DH)[0] < 0.5 * conditions[-1]
