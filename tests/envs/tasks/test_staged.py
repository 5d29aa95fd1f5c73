"""Base of tasks with stages: order, terms, settling, loads and coupling, by row."""

from typing import ClassVar, NamedTuple

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from dual_ur10.envs.tasks.observation_layout import ARM_FIELDS, ObservationLayout
from dual_ur10.envs.tasks.staged import Cases, StagedTask, stage, term
from dual_ur10.envs.tasks.task import Timing
from dual_ur10.errors import SettingsError
from dual_ur10.sim2real.cell.cell_config import CellConfig
from dual_ur10.sim2real.control.limits import MotionLimits

N, STAGES = 4, 3
TIMING = Timing(0.04, 0.04)


class Now(NamedTuple):
    passes: np.ndarray  # (n, stages)
    progress: np.ndarray  # (n, stages, 2)
    lost: np.ndarray  # (n,)


class Errand(StagedTask):
    """Three stages whose conditions and progress are given, as `measured`."""

    limits = MotionLimits()
    settled_s = 0.12
    layout = ObservationLayout(*ARM_FIELDS)

    @stage(weight=0.5, earned=(2.0, 0.0), load_kg=(0.5, 0.0))
    def go(self, now):
        return now.passes[:, 0], (now.progress[:, 0, 0], now.progress[:, 0, 1])

    @stage(weight=0.3, early=(False, True), load_kg=(0.5, 1.0), coupled=True)
    def carry(self, now):
        return now.passes[:, 1], (now.progress[:, 1, 0], now.progress[:, 1, 1])

    @stage(weight=0.2)
    def put(self, now):
        return now.passes[:, 2], now.progress[:, 2, 0]

    def facts(self, state, measured):
        return measured

    def lost(self, now):
        return now.lost

    def values(self, measured):
        return {"extra": measured.progress[:, 0, 0]}

    start = measure = observe = None


Errand.__abstractmethods__ = frozenset()


def begun(first=0, duration_s=2.0, n=N):
    task = Errand(None, CellConfig(), TIMING, n, duration_s)
    task.begin_rows(np.arange(n), first)
    return task


def now(passes=False, progress=0.0, lost=False, n=N):
    return Now(
        np.broadcast_to(passes, (n, STAGES)).copy(),
        np.broadcast_to(progress, (n, STAGES, 2)).astype(float),
        np.broadcast_to(lost, n).copy(),
    )


def test_a_task_without_stages_is_refused():
    class Nothing(StagedTask):
        limits = MotionLimits()
        layout = ObservationLayout(*ARM_FIELDS)

    Nothing.__abstractmethods__ = frozenset()
    with pytest.raises(SettingsError, match="Nothing has no stage"):
        Nothing(None, CellConfig(), TIMING, 1, 2.0)


def test_stages_and_weights_follow_from_the_methods():
    assert Errand.stages == ("go", "carry", "put")
    assert Errand.weights == {"go": 0.5, "carry": 0.3, "put": 0.2, "finish": 1.0}
    assert Errand.couples
    assert begun().horizon == 50


def test_a_subclass_replaces_a_stage_in_its_place():
    class Other(Errand):
        @stage(weight=0.7)
        def carry(self, now):
            return now.passes[:, 2], now.progress[:, 2, 0]

    assert Other.stages == Errand.stages
    assert Other.weights["carry"] == 0.7
    assert not Other.couples


def test_further_terms_stand_between_the_stages_and_the_end():
    class Tidy(Errand):
        @term(weight=0.1)
        def tidy(self, now):
            return now.progress[:, 1, 0], now.progress[:, 1, 1]

        @term(weight=0.0)
        def calm(self, now):
            return 0.25

    assert list(Tidy.weights.items())[3:] == [("tidy", 0.1), ("calm", 0.0), ("finish", 1.0)]
    task = Tidy(None, CellConfig(), TIMING, N, 2.0)
    task.begin_rows(np.arange(N), [0, 1, 0, 1])
    progress = np.zeros((N, STAGES, 2))
    progress[:, 1] = (0.75, 0.5)
    terms = task.evaluate(None, now(progress=progress)).terms
    assert terms.shape == (N, 2, 6)
    assert terms[:, :, 3].tolist() == [[0.75, 0.5], [0.5, 0.75]] * 2
    assert (terms[:, :, 4] == 0.25).all()
    assert (terms[:, :, [0, 2, 5]] == 0).all()


def test_weights_beside_the_stages_are_refused():
    with pytest.raises(SettingsError, match="Other sets weights: give each to its method"):

        class Other(Errand):
            weights: ClassVar = {**Errand.weights, "extra": 0.1}


conditions = st.lists(st.tuples(*[st.tuples(*[st.booleans()] * STAGES)] * N), min_size=1, max_size=8)


@settings(deadline=None)
@given(conditions, st.lists(st.sampled_from([0, 1]), min_size=N, max_size=N), st.integers(0, 2**32 - 1))
def test_each_row_passes_its_stages_in_their_order(steps, first, seed):
    task, rng, expected = begun(first), np.random.default_rng(seed), [0] * N
    alone = [begun(role, n=1) for role in first]
    for passes in steps:
        scene = now(passes, rng.uniform(size=(N, STAGES, 2)))
        outcome = task.evaluate(None, scene)
        for row, each in enumerate(passes):
            while expected[row] < STAGES and each[expected[row]]:
                expected[row] += 1
            own = alone[row].evaluate(None, Now(*[part[row : row + 1] for part in scene]))
            assert np.array_equal(own.terms[0], outcome.terms[row])
            giver = [0.0] * STAGES
            for k in range(STAGES):
                due = (2.0, 1.0, 1.0)[k]
                giver[k] = due if expected[row] > k else due * scene.progress[row, k, 0] * (expected[row] == k)
            assert outcome.terms[row, first[row], :STAGES] == pytest.approx(giver)
        assert outcome.info["stage"].tolist() == expected
        assert task.coupled().tolist() == [each == 1 for each in expected]


def test_a_role_may_earn_progress_of_a_stage_before_it_begins():
    terms = begun().evaluate(None, now(progress=0.5)).terms
    assert terms[0].tolist() == [[1.0, 0.0, 0.0, 0.0], [0.0, 0.5, 0.0, 0.0]]
    swapped = begun(first=1).evaluate(None, now(progress=0.5)).terms
    assert swapped[0].tolist() == terms[0, ::-1].tolist()


def test_success_takes_the_last_condition_for_a_while_and_earns_the_steps_left():
    task = begun()
    task.evaluate(None, now(True))
    task.evaluate(None, now(True))
    assert not task.evaluate(None, now([True, True, False])).terminal.any()  # it begins again
    for left in (46, 45, 44):
        outcome = task.evaluate(None, now(True))
        assert task.horizon - task._count[0] == left
    assert outcome.terminal.all()
    assert outcome.success.all()
    assert (outcome.terms[..., -1] == 44).all()
    assert outcome.info["extra"].shape == (N,)
    task.begin_rows(np.array([1]))
    assert task.evaluate(None, now(True)).terminal.tolist() == [True, False, True, True]  # an episode begins solved


def test_a_lost_row_fails_whatever_it_has_passed():
    task = begun()
    for _ in range(3):
        outcome = task.evaluate(None, now(True, lost=[True, False, False, False]))
    assert outcome.terminal.all()
    assert outcome.success.tolist() == [False, True, True, True]
    assert outcome.terms[:, 0, -1].tolist() == [0.0, 47.0, 47.0, 47.0]


def test_time_runs_out_with_success_only_where_the_last_condition_holds():
    task = begun(duration_s=0.04)
    outcome = task.evaluate(None, now([[True] * 3, [False] * 3, [True] * 3, [True, True, False]]))
    assert outcome.over.all()
    assert outcome.success.tolist() == [True, False, True, False]


def test_the_declared_load_of_each_row_follows_its_stage_with_a_ramp():
    task = begun([0, 1, 0, 0])
    task.evaluate(None, now([[False] * 3, [False] * 3, [True, False, False], [True] * 3]))
    assert task.load_kg().tolist() == [[0.5, 0.0], [0.0, 0.5], [0.5, 1.0], [0.0, 0.0]]
    declared = [task.payload_kg() for _ in range(14)]
    assert declared[0][2].tolist() == pytest.approx([0.08, 0.08])
    assert declared[-1].tolist() == task.load_kg().tolist()
    task.forget_load(np.array([2]))
    task.begin_rows(np.array([2]))
    before = task.payload_kg()
    assert not before[2, 1]
    task.evaluate(None, now(True))  # all put down what they carry
    released = [task.payload_kg() for _ in range(14)]
    assert released[0].ravel().tolist() == pytest.approx(np.maximum(before - 0.08, 0.0).ravel().tolist())
    assert not released[-1].any()


class Case(NamedTuple):
    wet: bool
    cold: bool
    late: bool


class Decision(NamedTuple):
    speed: float
    pair: tuple[int, int]


def decide(case):
    if case.wet:
        return Decision(0.1 if case.cold else 0.2, (1, 2))
    return Decision(1.0 if case.late else 0.5, (3, 4 + case.cold))


@given(st.lists(st.tuples(*[st.booleans()] * 3), min_size=2, max_size=20))
def test_decisions_of_rows_are_those_of_one_row_each(rows):
    cases = Cases(Case, decide)
    found = cases(Case(*np.array(rows).T))
    for row, each in enumerate(rows):
        assert cases(Case(*each)) == decide(Case(*each)) == Decision(found.speed[row], tuple(found.pair[:, row]))


class Hold(Errand):
    """Ends while both arms hold something."""

    @stage(weight=0.1, load_kg=(1.0, 2.0), coupled=True)
    def hold(self, now):
        return now.passes[:, 2], now.progress[:, 2, 0]


class Own(StagedTask):
    """States by itself when its arms are coupled."""

    limits = MotionLimits()
    layout = ObservationLayout(*ARM_FIELDS)
    couples = True

    @stage(weight=0.1)
    def wait(self, now):
        return now.passes[:, 2], now.progress[:, 2, 0]


Hold.__abstractmethods__ = Own.__abstractmethods__ = frozenset()


def test_the_marks_of_the_last_stage_count_until_the_end():
    task = Hold(None, CellConfig(), TIMING, N, 2.0)
    task.begin_rows(np.arange(N), 0)
    task.passed[:] = len(task.stages)
    assert task.coupled().all()
    assert task.load_kg().tolist() == [[1.0, 2.0]] * N
    assert not begun().coupled().any()
    assert Own.couples


def test_no_load_is_declared_at_the_begin_of_an_episode():
    task = begun()
    task.passed[:] = 1
    for _ in range(30):
        task.payload_kg()
    before = task.payload_kg()
    task.forget_load(np.array([1, 3]))
    assert before.tolist() == [[0.5, 1.0]] * N  # it is the caller's
    assert task._declared_kg.tolist() == [[0.5, 1.0], [0.0, 0.0]] * 2


def test_an_episode_may_end_after_a_stage_with_what_the_stages_until_there_earn():
    task = begun()
    task.end_after("carry")
    passes = [True, True, False]
    first = task.evaluate(None, now(passes, progress=1.0))
    assert (task.passed == 2).all()
    assert (first.terms[..., 2] == 0.0).all()  # a later stage
    second = task.evaluate(None, now([True, True, True]))
    third = task.evaluate(None, now(passes))
    assert not first.terminal.any()
    assert not second.terminal.any()
    assert third.success.all()
    assert third.terms[0, 0, -1] == pytest.approx((50 - 3) * 0.8)


def test_an_arm_still_earns_its_waiting_for_later_stages():
    task = begun()
    task.end_after("go")
    found = task.evaluate(None, now([True, True, True], progress=0.5))
    assert (task.passed == 1).all()
    assert found.terms[0].tolist() == [[2.0, 0.0, 0.0, 0.0], [0.0, 0.5, 0.0, 0.0]]
    task.evaluate(None, now(True))
    assert task.evaluate(None, now(True)).terms[0, 0, -1] == pytest.approx((50 - 3) * (0.5 + 0.3 / 2))


def test_a_start_after_a_stage_has_its_load():
    task = begun()
    task.forget_load(np.arange(N))
    task.skip(np.array([1, 3]), np.array([1, 2]))
    assert task.passed.tolist() == [0, 1, 0, 2]
    assert task.declared_kg[[1, 3]].tolist() == task.load_kg()[[1, 3]].tolist() == [[0.5, 1.0], [0.0, 0.0]]
    assert task.declared_kg[[0, 2]].tolist() == [[0.0, 0.0]] * 2
