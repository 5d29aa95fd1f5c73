"""The slow approach to the start of a task."""

from __future__ import annotations

import itertools
import re
from functools import partial
from types import SimpleNamespace

import numpy as np
import pytest

from dual_ur10.assets.settings import HOME_Q_RAD, SceneSettings
from dual_ur10.errors import StartError
from dual_ur10.sim2real.cell.cell_config import CellConfig
from dual_ur10.sim2real.control.clearance import MINIMUM_M, Clearance, PairDistances
from dual_ur10.sim2real.control.gate import SafetyGate
from dual_ur10.sim2real.control.limits import MotionLimits
from dual_ur10.sim2real.control.planner import plan_path
from dual_ur10.sim2real.control.time_scaling import TimeScaling
from dual_ur10.sim2real.runtime import approach as approach_module
from dual_ur10.sim2real.runtime import path_to_start as way_to_start
from dual_ur10.sim2real.runtime.approach import (
    ACCELERATION_RAD_S2,
    SPEED_RAD_S,
    TCP_SPEED_M_S,
    Approach,
    Rates,
    plan,
    retreat_clearance,
)
from dual_ur10.sim2real.runtime.arm_memory import RING, ArmMemory
from dual_ur10.sim2real.runtime.arm_sender import MOST_LATE_S
from dual_ur10.sim2real.runtime.path_to_start import MEASURED_RAD, START_RAD, PathToStart
from tests.pairwise import pairwise
from tests.sim2real.control.motion_checks import HARD, AlwaysClear, Measured, cartesian_speed
from ur_core.kinematics.frames import ArmMount
from ur_core.kinematics.ur10 import JOINT_RANGE_RAD

HOME = HOME_Q_RAD.reshape(12)
RATES = Rates(HARD.robots)
TICKS_S = (0.008, 0.002)


def in_real_time(targets, start, tick_s, speed_factor):
    """Return both arms' targets per control period, (t, 2, 6)."""
    memories, sent = [ArmMemory(), ArmMemory()], []
    every = np.concatenate([start.reshape(1, 2, 6), targets])
    scaling = TimeScaling(0.0, 0.0, speed_factor, speed_factor)
    for arm, memory in enumerate(memories):
        written, rows = 0, []
        period = 0
        while (index := scaling.at(float(period))) <= len(every) + 2:
            if written < len(every) and written - index < RING // 4:  # as far ahead as there is room
                block = every[written : written + RING // 4, arm]
                memory.put(written, block)
                written += len(block)
            rows.append(memory.target(index))
            period += 1
        sent.append(rows)
        memory.close()
    return np.stack(sent, axis=1)


def random_path(seed, size):
    rng = np.random.default_rng(seed)
    return [HOME, HOME + size * rng.uniform(-1, 1, 12)]


@pairwise(speed_factor=[1.0, 0.5, 0.25], tick_s=TICKS_S, size=[1.5, 0.2, 1e-3])
def test_its_real_time_rates_are_those_configured(speed_factor, tick_s, size):
    parts = random_path(round(size * 1000), size)
    approach = Approach([*parts, HOME], RATES, speed_factor)
    sent = in_real_time(approach.targets(tick_s), HOME, tick_s, speed_factor)
    moved = np.diff(sent, axis=0, prepend=sent[:1], append=sent[-1:]) / tick_s
    found = np.array(
        [
            np.abs(moved).max() / SPEED_RAD_S,
            cartesian_speed(sent[None], tick_s).max() / TCP_SPEED_M_S,
            np.abs(np.diff(moved, axis=0)).max() / tick_s / ACCELERATION_RAD_S2,
        ]
    )
    assert (found <= 1.01).all(), found
    assert found.max() > (0.98 if size > 1e-3 else 0.5)  # and not slower than it must be
    assert len(sent) * tick_s == pytest.approx(approach.duration_s, abs=10 * tick_s / speed_factor)


@pytest.mark.parametrize("speed_factor", [1.0, 0.5])
@pytest.mark.parametrize(
    ("caps", "which"),
    [
        ({"speed_rad_s": 0.05}, 0),
        ({"tcp_speed_m_s": 0.04}, 1),
        ({"acceleration_rad_s2": 0.02}, 2),
        ({"jerk_rad_s3": 0.05}, 3),
    ],
)
def test_the_limits_of_a_cell_hold_in_an_approach(caps, which, speed_factor):
    rates = RATES.capped(CellConfig(**caps))
    parts = random_path(3, 0.4)
    approach = plan(*np.array(parts).reshape(2, 2, 6), AlwaysClear(), rates, speed_factor)
    sent = in_real_time(approach.targets(0.008), HOME, 0.008, speed_factor)
    moved = np.diff(sent, axis=0, prepend=sent[:1], append=sent[-1:]) / 0.008
    changed = np.diff(moved, axis=0) / 0.008
    (value,) = caps.values()
    found = [
        np.abs(moved).max(),
        cartesian_speed(sent[None], 0.008).max(),
        np.abs(changed).max(),
        np.abs(np.diff(changed[::20], axis=0)).max() / 0.16,  # of the path, not of rounding
    ]
    assert 0.9 * value < found[which] <= 1.02 * value
    assert found[0] <= 1.01 * SPEED_RAD_S
    # Where the cell allows more, nothing changes.
    assert RATES.capped(CellConfig(speed_rad_s=1.0, jerk_rad_s3=100.0)).speed_rad_s == SPEED_RAD_S
    assert RATES.capped(CellConfig()) == RATES


@pytest.mark.parametrize("speed_factor", [1.0, 0.3])
@pytest.mark.parametrize("size", [1.5, 1e-3, 1e-6])
def test_it_begins_and_ends_exactly(speed_factor, size):
    goal = HOME + size * np.random.default_rng(1).uniform(-1, 1, 12)
    targets = plan(HOME.reshape(2, 6), goal.reshape(2, 6), AlwaysClear(), RATES, speed_factor).targets(0.008)
    assert targets.shape[1:] == (2, 6)
    assert (targets[-1].reshape(12) == goal).all()
    assert np.abs(targets[0].reshape(12) - HOME).max() < ACCELERATION_RAD_S2 * (0.008 / speed_factor) ** 2
    # Straight in the joints.
    along = (targets.reshape(-1, 12) - HOME) / (goal - HOME)
    np.testing.assert_allclose(along, np.broadcast_to(along[:, :1], along.shape), atol=1e-6)
    assert (np.diff(along[:, 0]) >= -1e-9).all()


def test_arms_at_the_goal_stay_there():
    approach = plan(HOME.reshape(2, 6), HOME.reshape(2, 6), AlwaysClear(), RATES)
    assert approach.duration_s == 0.0
    assert (approach.targets(0.008) == HOME_Q_RAD).all()
    assert len(approach.targets(0.008)) >= 1


def test_between_two_parts_both_arms_rest():
    parts = [HOME, HOME + 0.3, HOME - 0.1]
    approach = Approach(parts, RATES)
    targets = np.concatenate([HOME[None], approach.targets(0.008).reshape(-1, 12)])
    (middle,) = np.flatnonzero((targets == parts[1]).all(axis=1))
    steps = np.abs(np.diff(targets, axis=0)).max(axis=1)
    assert max(steps[middle - 1], steps[middle]) < 1e-5
    assert approach.duration_s == pytest.approx(sum(approach.durations_s))
    assert middle * 0.008 == pytest.approx(approach.durations_s[0], abs=0.01)


# Obstacles.


@pytest.fixture(scope="module")
def clearance():
    return Clearance(SceneSettings())


def nearest_m(clearance, approach, every=0.005):
    """Return the smallest distance of any pair on the path."""
    found = []
    for start, end in itertools.pairwise(approach.parts):
        count = 2 + round(np.abs(end - start).max() / every)
        found += [
            clearance.measure(q[None]).distances_m[0].min()
            for q in start + np.linspace(0, 1, count)[:, None] * (end - start)
        ]
    return min(found)


def test_both_arms_share_a_free_path(clearance):
    goal = HOME_Q_RAD + 0.1
    approach = plan(HOME_Q_RAD, goal, clearance, RATES)
    assert len(approach.parts) == 2
    assert nearest_m(clearance, approach) >= MINIMUM_M


def crossings():
    """Return configurations of two arms close together, between which some straight paths are blocked."""
    rng = np.random.default_rng(3)
    for _ in range(400):
        yield [HOME_Q_RAD + rng.uniform(-1, 1, (2, 6)) * [1.2, 0.5, 0.5, 1, 1, 1] for _ in range(2)]


@pytest.fixture(scope="module")
def close():
    return Clearance(SceneSettings(ArmMount((0.0, 0.4, 0.0)), ArmMount((0.0, -0.4, 0.0))))


def test_on_a_blocked_path_they_move_one_after_the_other_or_around(close):
    kinds, nearest = set(), []
    for q, goal in crossings():
        ends = np.array([q, goal]).reshape(2, 12)
        if not close.is_clear(ends).all():
            continue
        approach = plan(q, goal, close, RATES)
        assert (approach.parts[0] == ends[0]).all()
        assert (approach.parts[-1] == ends[1]).all()
        assert bool(approach.detour) == (len(approach.parts) > 2)
        middle = approach.parts[1]
        left_first = (middle[:6] == ends[1][:6]).all() and (middle[6:] == ends[0][6:]).all()
        right_first = (middle[:6] == ends[0][:6]).all() and (middle[6:] == ends[1][6:]).all()
        if len(approach.parts) == 2:
            kinds.add("both")
        elif left_first or right_first:
            assert left_first != right_first
            kinds.add("left" if left_first else "right")
        else:
            assert re.fullmatch(r".+ and .+ would come within -?\d+ mm, allowed are 20 mm", approach.detour)
            kinds.add("around")
        nearest.append(nearest_m(close, approach, 0.02))
        if len(kinds) == 4 and len(nearest) > 30:
            break
    assert kinds == {"both", "left", "right", "around"}
    assert min(nearest) >= MINIMUM_M - 1e-6


def test_the_same_ends_give_the_same_path(close):
    for q, goal in itertools.islice(crossings(), 20):
        if close.is_clear(np.array([q, goal]).reshape(2, 12)).all():
            np.testing.assert_array_equal(plan(q, goal, close, RATES).parts, plan(q, goal, close, RATES).parts)


def test_an_arm_that_has_to_stay_does_not_move_out_of_the_way(close):
    around = 0
    for q, goal in crossings():
        goal[1] = q[1]
        if close.is_clear(np.array([q, goal]).reshape(2, 12)).all():
            parts = plan(q, goal, close, RATES, arms=("left",)).parts
            assert (parts[:, 6:] == parts[0, 6:]).all()
            around += len(parts) > 2
    assert around > 5


def test_an_arm_that_is_too_close_may_only_separate(clearance):
    down = HOME_Q_RAD.copy()
    while clearance.spare_m(down.reshape(1, 12)).min() > -0.06:
        down[0, 1] += 0.01  # towards the table, the arm comes too close to it
    approach = plan(down, HOME_Q_RAD, clearance, RATES)
    assert len(approach.parts) == 2
    lower = down.copy()
    lower[0, 1] += 0.05
    for start, goal in ((down, lower), (HOME_Q_RAD, down)):
        with pytest.raises(StartError, match=r"in the goal left/.* and table would be -?\d.* mm apart, allowed are 20"):
            plan(start, goal, clearance, RATES)


class Somewhere(Measured):
    """Stub of `Clearance` whose obstacle depends on the left base joint alone, by 1 m per rad at most."""

    def __init__(self, shortfall):
        super().__init__(np.eye(12)[:1])
        self.shortfall = shortfall

    def spare_m(self, q_rad):
        return np.array([-self.shortfall(q_rad[0] - HOME[0])])


@pytest.mark.parametrize(
    ("shortfall", "free"),
    [
        (lambda path: 0.01 - abs(path - 0.515), False),  # narrow, and on the path
        (lambda path: 0.05 - 0.1 * path, True),  # ever farther apart
        (lambda path: 0.05 - 0.2 * path + 0.2 * path**2, False),  # away, and nearer again
        (lambda path: 0.05 + 0.001 * path, False),
    ],
)
def test_the_whole_path_is_checked(shortfall, free, monkeypatch):
    monkeypatch.setattr(approach_module, "plan_path", partial(plan_path, iterations=30))
    goal = HOME_Q_RAD + 1.0
    if free:
        assert len(plan(HOME_Q_RAD, goal, Somewhere(shortfall), RATES).parts) == 2
    else:
        with pytest.raises(StartError, match=r"the arms cannot move .* to the start of the task: .*pair 0 would"):
            plan(HOME_Q_RAD, goal, Somewhere(shortfall), RATES)


@pairwise(arm__name=[(0, "left"), (1, "right")], joint=range(6), sign=[-1, 1])
def test_a_joint_out_of_its_range_is_refused(clearance, arm, name, joint, sign):
    q = HOME_Q_RAD.copy()
    q[arm, joint] = sign * (JOINT_RANGE_RAD[joint] + 0.01)
    with pytest.raises(StartError, match=rf"{name}: .* is at {q[arm, joint]:.3f} rad.*rotate it back by hand"):
        plan(q, HOME_Q_RAD, clearance, RATES)


# The gate during an approach.


class Pairs(Clearance):
    """Two pairs, beyond their limits by the first two joints."""

    def __init__(self):
        self.pairs, self._granted = (("first",), ("second",)), np.zeros(2)

    def _connect(self):
        pass

    def measure(self, q_rad):
        return PairDistances(0.02 - q_rad[:, :2], np.full((len(q_rad), 2), 0.02))


@pytest.mark.parametrize(
    ("start", "then", "clear", "blamed"),
    [
        ((0.003, -0.1), (0.003, -0.1), True, ""),  # it may stay
        ((0.003, -0.1), (0.003 + 1e-9, -0.1), True, ""),  # it does
        ((0.003, -0.1), (0.001, -0.1), True, ""),
        ((0.003, -0.1), (0.0031, -0.1), False, "first"),  # closer
        ((0.003, -0.1), (-0.1, 0.001), False, "second"),  # another pair
        ((0.003, -0.1), (0.0029, 0.001), False, "second"),
        ((-0.1, -0.1), (0.0, 0.0), True, ""),
        ((-0.1, -0.1), (0.0, 1e-6), False, "second"),  # a large distance at first does not permit everything
        ((-0.1, -0.1), (np.nan, 0.0), False, "first"),
    ],
)
def test_a_pair_that_is_too_close_may_only_separate(start, then, clear, blamed):
    def configuration(values):
        return np.concatenate([values, np.zeros(10)])

    leaving = retreat_clearance(Pairs(), configuration(start).reshape(2, 6))
    assert bool((leaving.spare_m(configuration(then)[None]) >= 0.0).all()) == clear
    if not clear:  # a pair that is too close and comes no closer is not reported
        assert leaving.worst(configuration(then))[0] == blamed


@pairwise(
    tick_s=TICKS_S,
    factor=[1.0, 0.5, 0.25],
    limits=[
        MotionLimits(),
        MotionLimits(speed_rad_s=(0.2,) * 6, tcp_speed_m_s=0.1, acceleration_rad_s2=0.5, jerk_rad_s3=5.0),
    ],
    size=[1.0, 1e-3],
)
def test_an_approach_passes_the_gate_under_any_limits(tick_s, factor, limits, size):
    path = [HOME, HOME + size * np.tile([0.5, -0.2, 0.2, 0.3, -0.3, 1.0], 2)]
    rates = RATES.within(limits, factor)
    assert rates.speed_rad_s <= RATES.speed_rad_s
    targets = Approach(path, rates, factor).targets(tick_s)
    ticks = round(0.04 / tick_s)
    count = -(-len(targets) // ticks)
    targets = np.concatenate([targets, np.repeat(targets[-1:], count * ticks - len(targets), axis=0)])
    gate = SafetyGate(limits, tick_s, ticks, AlwaysClear())
    gate.reset(HOME.reshape(1, 2, 6))
    for window in targets.reshape(count, 1, ticks, 2, 6):
        result = gate(window)
        assert not result.verdicts
        np.testing.assert_array_equal(result.targets_rad, window)


def test_a_tool_is_no_faster_than_a_flange_may_be():
    tool = ((0.0, 0.3, 0.1), (0.0, 0.0, 0.0))
    start = np.asarray(HOME_Q_RAD, dtype=np.float64).reshape(12)
    end = start.copy()
    end[5] += 1.5  # rotates about the flange's own axis
    rates = Rates(tcp_speed_m_s=0.04, tcp_m=tool, robots=RATES.robots)
    path = Approach([start, end], rates=rates)
    fastest = cartesian_speed(path.targets(0.008)[None], 0.008, tool).max()
    assert 0.039 < fastest <= 0.04 * (1 + 1e-6)
    assert (
        path.duration_s > 1.3 * Approach([start, end], rates=Rates(tcp_speed_m_s=0.04, robots=RATES.robots)).duration_s
    )


@pytest.mark.parametrize(("tick_s", "ticks"), [(0.008, 5), (0.002, 1), (0.002, 20)])
def test_checking_many_windows_delays_the_first_target(monkeypatch, tick_s, ticks):
    """As many as within half a second, at up to 500 Hz: time passes meanwhile."""
    written = []

    class Gate(SafetyGate):
        def __call__(self, window):
            runner.now += 0.0005 / tick_s
            return super().__call__(window)

    class Running:
        now = 0.0
        cell = SimpleNamespace(expect=lambda *_, **__: None)

        @property
        def next(self):
            return int(np.ceil(self.now)) + 2

        def wait_for(self, index):
            self.now = max(self.now, index)

    def write(_, first, block):
        written.append((first, len(block)))
        return first >= runner.next

    runner = Running()
    monkeypatch.setattr(way_to_start, "SafetyGate", Gate)
    targets = SimpleNamespace(write=write, rest_at=lambda q_rad: None)
    monkeypatch.setattr(way_to_start, "retreat_clearance", lambda clearance, start_rad: clearance)
    path = PathToStart(MotionLimits(), AlwaysClear(), tick_s, ticks, 1.0, targets)
    led = Approach([HOME, HOME + np.eye(12)[5]], RATES).targets(tick_s)
    path.follow(runner, HOME.reshape(2, 6), led)
    assert sum(count for _, count in written) >= len(led)
    firsts = [first for first, _ in written]
    assert firsts == list(np.cumsum([firsts[0], *(count for _, count in written[:-1])]))


# The arrival.


class Standing:
    """Runner of arms whose targets and measured angles are some way from the goal, and stay there."""

    def __init__(self, wanted_rad, found_rad):
        self.now_s = 0.0
        self.clock = SimpleNamespace(now_s=lambda: self.now_s, sleep=self._sleep)
        self._statuses = [
            SimpleNamespace(target_q_rad=HOME_Q_RAD[arm] + wanted_rad[arm], q_rad=HOME_Q_RAD[arm] + found_rad[arm])
            for arm in range(2)
        ]

    def _sleep(self, duration_s):
        self.now_s += duration_s

    def check(self):
        """Find no fault."""

    def statuses(self):
        """Return the states."""
        return self._statuses


def arrival(wanted_rad, found_rad=(0.0, 0.0), *, emulated=True):
    """Return how long it takes until both arms count as arrived, s."""
    path = PathToStart(MotionLimits(), AlwaysClear(), 0.008, 5, 1.0, None, emulated=emulated)
    runner = Standing(wanted_rad, found_rad)
    path.arrived(runner, HOME_Q_RAD)
    return runner.now_s


def test_an_episode_begins_at_once_where_targets_have_settled():
    assert arrival((0.0, 0.9e-4), (0.015, -0.015)) == 0.0


@pytest.mark.parametrize("off_rad", [1.7e-4, 2.4e-3])
def test_a_machine_that_lags_is_waited_for_and_then_tolerated(off_rad):
    assert 3.0 < arrival((0.0, off_rad)) < 3.1
    assert off_rad < START_RAD


def test_the_tolerance_is_what_an_approach_leaves_to_a_controller_that_is_as_late_as_targets_may_be():
    path = np.eye(12)[5] * np.linspace(0.0, 1.0, 2)[:, None] + HOME
    targets = Approach([*path], RATES).targets(0.008).reshape(-1, 12)
    left = np.abs(targets - targets[-1]).max(axis=1)
    behind = int(MOST_LATE_S / 0.008)
    assert left[-1 - behind] < START_RAD < left[-1 - 10 * behind]
    assert MEASURED_RAD > START_RAD


@pytest.mark.parametrize(
    ("wanted", "found", "emulated", "words"),
    [
        (2.6e-3, 0.0, True, r"^this machine is too busy .*the right controller's target is 0\.0026 rad from the start"),
        (
            2.6e-3,
            0.0,
            False,
            r"^the right controller's target is 0\.0026 rad .*allowed are 0\.0025\. Check its network",
        ),
        (0.0, 0.021, True, r"^right does not reach the start of the task: it is measured 0\.021 rad .*its payload$"),
        (0.0, 0.021, False, r"^right does not reach the start of the task: it is measured 0\.021 rad .*its payload$"),
    ],
)
def test_arms_that_do_not_arrive(wanted, found, emulated, words):
    with pytest.raises(StartError, match=words):
        arrival((0.0, wanted), (0.0, found), emulated=emulated)
