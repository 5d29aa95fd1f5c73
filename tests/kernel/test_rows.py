"""Rows of the kernel: independent, to the bit, of the batch, its order, the threads, and of being copied."""

from __future__ import annotations

import copy
import pickle

import numpy as np
import pytest

from dual_ur10.assets.obstacles import Box
from dual_ur10.assets.settings import HOME_Q_RAD, SceneSettings
from dual_ur10.sim2real.control.adapter import ServojAdapter
from dual_ur10.sim2real.control.clearance import Clearance
from dual_ur10.sim2real.control.gate import SafetyGate
from dual_ur10.sim2real.control.pipeline import ServojPipeline
from tests.sim2real.control.motion_checks import ACTION_KINDS, HARD, TIGHT, adversarial_action
from ur_core.kinematics.ur10 import ARMS, NOMINAL_DH
from ur_core.servoj import ServojProfile

N, PERIODS = 64, 45
SCENE = SceneSettings(obstacles=(Box(name="plate", position_m=(0.3, 0.0, 0.9), size_m=(0.6, 0.01, 0.4)),))
UNCERTAIN = ((0.004, 0.01), (0.002, 0.02))
ALONE = [*range(0, 20, 2), 3, 17, 40, 41, 63]  # pushed at random, of every adversarial kind, and those that start again
# Shapes of a run: the periods at whose beginning some rows start again, elsewhere.
RESETS = {11: np.array([3, 17, 40, 63]), 30: np.array([0, 3, 41])}


def make(n: int, threads: int = 1, mode: str = "joint_delta", ticks: int = 5, limits=HARD, leads=False):
    profile = ServojProfile()
    adapter = ServojAdapter(profile, limits, ticks, n=n, mode=mode, dh=[NOMINAL_DH] * 2, threads=threads)
    clearance = Clearance(SCENE, uncertainty=UNCERTAIN)
    gate = SafetyGate(limits, profile.tick_s, ticks, clearance, n=n, threads=threads)
    return ServojPipeline(adapter, gate, held=None, leads=leads)


def starts() -> np.ndarray:
    return HOME_Q_RAD + np.random.default_rng(3).uniform(-0.1, 0.1, (N, 2, 6))


def actions(seed: int = 0) -> np.ndarray:
    """Return (periods, n, 2, 6): half of the rows are pushed at random, so that bodies meet, the others adversarial."""
    rng = np.random.default_rng(seed)
    result = rng.uniform(-1.0, 1.0, (N, 2, 6)) + rng.uniform(-0.5, 0.5, (PERIODS, N, 2, 6))
    for row in range(0, N, 2):
        kind = ACTION_KINDS[row // 2 % len(ACTION_KINDS)]
        for period in range(PERIODS):
            result[period, row] = adversarial_action(kind, period, rng, (1, 2, 6))[0]
    return result


def played(pipeline: ServojPipeline, rows: np.ndarray, given: np.ndarray):
    """Return the targets, (periods, rows, ticks, 2, 6), of some rows, and verdicts and led motion by row of the run."""
    where = {row: index for index, row in enumerate(rows.tolist())}
    begin = starts()
    pipeline.reset(begin[rows])
    sent, verdicts, led = [], {}, set()
    for period, action in enumerate(given):
        again = np.array([row for row in RESETS.get(period, ()) if row in where], dtype=int)
        if again.size:
            pipeline.reset(begin[again] + 0.01, np.array([where[row] for row in again.tolist()]))
        command, found = pipeline(action[rows])
        sent.append(command.targets_rad)
        verdicts[period] = {int(rows[index]): str(verdict) for index, verdict in found.items()}
        led |= {(period, row) for row in rows[pipeline.led].tolist()}
    return np.array(sent), verdicts, led


@pytest.mark.parametrize(
    ("mode", "ticks", "limits", "leads"),
    [
        ("joint_delta", 5, HARD, False),
        ("joint_position", 25, TIGHT, False),
        ("joint_delta", 5, HARD, True),
        ("tcp_delta", 25, TIGHT, True),
    ],
)
def test_a_row_is_the_same_in_any_batch(mode, ticks, limits, leads) -> None:
    given, every = actions(), np.arange(N)
    kind = {"mode": mode, "ticks": ticks, "limits": limits, "leads": leads}
    together, verdicts, led = played(make(N, 2, **kind), every, given)
    assert {text.split(": ")[1].split()[0] for found in verdicts.values() for text in found.values()} <= {"distance"}
    assert 5 < len({row for _, row in led} if leads else {row for found in verdicts.values() for row in found}) < N
    single = make(1, **kind)  # which each row resets: making it takes longer than its run
    for batch in ([row] for row in ALONE):
        alone, its_own, its_leads = played(single, np.array(batch), given)
        np.testing.assert_array_equal(alone[:, 0], together[:, batch[0]])
        assert its_own == {k: {row: v[row] for row in batch if row in v} for k, v in verdicts.items()}
        assert its_leads == {each for each in led if each[1] in batch}
    order = np.random.default_rng(1).permutation(N)
    for threads in (1, 3):
        shuffled, *found = played(make(N, threads, **kind), order, given)
        np.testing.assert_array_equal(shuffled, together[:, order])
        assert found == [verdicts, led]


def test_distances_do_not_depend_on_the_batch() -> None:
    clearance = Clearance(SCENE, uncertainty=UNCERTAIN)
    q_rad = np.random.default_rng(1).uniform(-3.0, 3.0, (200, 12))
    together, order = clearance.spare_m(q_rad), np.random.default_rng(2).permutation(200)
    np.testing.assert_array_equal(clearance.spare_m(q_rad[order]), together[order])
    for row in range(200):
        np.testing.assert_array_equal(clearance.spare_m(q_rad[[row]])[0], together[row])


@pytest.mark.parametrize("through", [copy.deepcopy, lambda each: pickle.loads(pickle.dumps(each))])
@pytest.mark.parametrize("leads", [False, True])
def test_a_copied_pipeline_continues_and_is_independent(through, leads) -> None:
    given, pipeline, other = actions(5), make(N, 2, leads=leads), make(N, 2, leads=leads)
    begin = starts()
    for each in (pipeline, other):
        each.reset(begin)
        for action in given[:20]:
            each(action)
    copied = through(other)
    for action in given[::-1][:10]:
        other(action)
    for action in given[20:]:
        (command, verdicts), (expected, reasons) = copied(action), pipeline(action)
        np.testing.assert_array_equal(command.targets_rad, expected.targets_rad)
        assert verdicts == reasons
    assert reasons or leads
    assert (copied.led == pipeline.led).all()
    copied.reset(begin[:1], np.array([0]))
    np.testing.assert_array_equal(copied(given[0])[0].targets_rad[0], played_once(begin, given[0])[0])


def played_once(begin: np.ndarray, action: np.ndarray) -> np.ndarray:
    pipeline = make(N)
    pipeline.reset(begin)
    return pipeline(action)[0].targets_rad


@pytest.mark.parametrize("through", [copy.deepcopy, lambda each: pickle.loads(pickle.dumps(each))])
def test_copied_distances_are_the_same(through) -> None:
    plain = Clearance(SCENE, minimum_m=0.03, uncertainty=UNCERTAIN)
    q_rad = np.random.default_rng(4).uniform(-3.0, 3.0, (50, 12))
    for clearance in (plain, plain.granting(np.linspace(0.0, 0.01, len(plain.pairs)))):
        copied = through(clearance)
        np.testing.assert_array_equal(copied.spare_m(q_rad), clearance.spare_m(q_rad))
        np.testing.assert_array_equal(copied.measure(q_rad).allowed_m, clearance.measure(q_rad).allowed_m)
        assert copied.worst(q_rad[0]) == clearance.worst(q_rad[0])
        assert copied.worst(q_rad[0])[0].split("/")[0] in ARMS
