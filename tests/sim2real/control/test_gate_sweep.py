"""Checks of the safety gate between the configurations at which brakes end."""

from __future__ import annotations

import dataclasses
import threading

import numpy as np
import pytest

from dual_ur10.assets.collision_model import CLEARANCE_CUTOFF_M
from dual_ur10.assets.obstacles import Box, Capsule, Plane
from dual_ur10.assets.settings import HOME_Q_RAD, Equipment, SceneSettings
from dual_ur10.sim2real.control.adapter import ServojAdapter
from dual_ur10.sim2real.control.clearance import MINIMUM_M, Clearance
from dual_ur10.sim2real.control.gate import SWEEP_TOLERANCE_M, SafetyGate
from dual_ur10.sim2real.control.limits import MotionLimits
from dual_ur10.sim2real.runtime.approach import Rates, plan, retreat_clearance
from tests.sim2real.control.motion_checks import HARD, AlwaysClear, Measured
from tests.sim2real.control.reference_cell import UNEQUAL, random_q
from ur_core.kernel import call
from ur_core.kinematics.ur10 import NOMINAL_DH
from ur_core.servoj import ServojProfile

WIDE_M = 0.01
HOME = HOME_Q_RAD.reshape(12)
RODS = tuple(
    Capsule(name=f"rod-{k}", from_m=(0.1 + 0.15 * (k % 2), y, 0.0), to_m=(0.1 + 0.15 * (k % 2), y, 1.6), radius_m=0.004)
    for k, y in enumerate((-1.1, -0.75, -0.3, 0.0, 0.3, 0.75, 1.1))
)
CLUTTER = (*RODS, Box(name="plate", position_m=(0.3, 0.0, 0.9), size_m=(0.6, 0.01, 0.4)))


class Post(Measured):
    """Thin obstacle at an angle of the left arm's first joint, in a cell whose arms are levers of 1 m."""

    def __init__(self, at_rad):
        super().__init__(np.eye(2, 12))
        self.at_rad = at_rad

    def spare_m(self, q_rad):
        return np.array([abs(q_rad[0] - self.at_rad) - WIDE_M, 5.0])

    def worst(self, q_rad):
        return "left/forearm_link and post", abs(q_rad[0] - self.at_rad), WIDE_M


def driven(clearance, push, periods, n=1, ticks=5):
    """Return all released targets, (n, ticks, 12), of a policy that pushes joints, and all verdicts.

    What it pushes by, (n, 12) or (12,), may be a function of the period.
    """
    adapter = ServojAdapter(ServojProfile("cb3"), HARD, ticks, n=n, dh=[NOMINAL_DH] * 2)
    gate = SafetyGate(HARD, 0.008, ticks, clearance, n=n)
    start = np.tile(HOME_Q_RAD, (n, 1, 1))
    adapter.reset(start)
    gate.reset(start)
    sent, verdicts = [], {}
    for period in range(periods):
        now = push(period) if callable(push) else push
        found = gate(adapter(np.broadcast_to(now, (n, 12)).reshape(n, 2, 6)).targets_rad.copy())
        sent.append(found.targets_rad.reshape(n, -1, 12))
        verdicts = found.verdicts
    return np.concatenate(sent, axis=1), verdicts


TURN = np.array([1.0] + [0.0] * 11)


@pytest.mark.parametrize("phase", np.linspace(0.0, 0.08, 8, endpoint=False))
def test_a_thin_obstacle_between_two_checks_is_seen(phase):
    post = Post(HOME[0] + 0.9 + phase)
    sent, verdicts = driven(post, TURN, 60)
    assert np.abs(np.diff(sent[0, :, 0])).max() > 0.01  # 8 cm a period: it would be by
    assert sent[0, :, 0].max() <= post.at_rad - WIDE_M + SWEEP_TOLERANCE_M
    assert verdicts[0].kind == "distance"
    assert verdicts[0].found < WIDE_M == verdicts[0].allowed
    assert verdicts[0].subject == "left/forearm_link and post"


def test_each_row_is_checked_by_itself():
    """A row in a batch stops as it does alone, and the others continue."""
    push = np.stack([TURN, 0.0 * TURN, -TURN, 0.5 * TURN])
    whole, verdicts = driven(Post(HOME[0] + 0.93), push, 40, n=4)
    for row in range(4):
        alone, its_own = driven(Post(HOME[0] + 0.93), push[row], 40)
        np.testing.assert_array_equal(alone[0], whole[row])
        assert (row in verdicts) == bool(its_own)
        if its_own:
            assert its_own[0] == verdicts[row]
    assert set(verdicts) == {0, 3}


def test_distant_pairs_need_no_further_checks():
    post = Post(HOME[0] + 3.0)
    driven(post, TURN, 30)
    assert post.checks == 30


def test_motion_along_an_obstacle_is_not_refused():
    """Joints that do not move a pair are free, however near it is."""
    post = Post(HOME[0] + WIDE_M)
    post.spare_m = lambda q: np.array([0.0 if abs(q[0] - HOME[0]) < 1e-9 else -1.0, 5.0])
    sent, verdicts = driven(post, np.roll(TURN, 1), 30)
    assert not verdicts
    assert np.ptp(sent[0, :, 1]) > 0.5


def measured_for_the_gate(clearance, q_rad):
    """Return (n, pairs) spare distances as the gate gets them."""
    result = np.empty((len(q_rad), len(clearance.pairs)))
    context = clearance.kernel.values["context"]
    for q, row in zip(np.ascontiguousarray(q_rad), result, strict=True):
        call("clearance_spare", context, q, row)
    return result


SCENES = [
    pytest.param(SceneSettings(), {}, id="bare"),
    pytest.param(UNEQUAL, {"uncertainty": ((0.004, 0.01), (0.002, 0.02))}, id="calibrated, uncertain"),
    pytest.param(SceneSettings(equipment=Equipment(grippers=True), obstacles=CLUTTER), {}, id="hands, obstacles"),
]


@pytest.mark.parametrize(("settings", "keywords"), SCENES)
def test_no_distance_changes_by_more_than_the_joints_move_it(settings, keywords):
    n = 400
    clearance = Clearance(settings, **keywords)
    rng = np.random.default_rng(0)
    begin = random_q(rng, n).reshape(n, 12) * 0.5 + HOME
    tight = 0.0
    for size in (1e-3, 0.02, 0.2):
        # One joint, one arm, all: what moves things least and most.
        for mask in (
            np.eye(12)[rng.integers(12, size=n)],
            np.repeat(np.eye(2)[rng.integers(2, size=n)], 6, axis=1),
            1.0,
        ):
            end = begin + size * rng.uniform(-1, 1, (n, 12)) * mask
            first, second = (clearance.spare_m(each).copy() for each in (begin, end))
            apart = np.minimum(first, second) > -MINIMUM_M  # how deep two things are in each other is not exact
            travel = np.abs(end - begin) @ clearance.kernel.values["levers"].T
            change = np.abs(first - second)
            assert (change <= travel + 1e-5)[apart].all()
            tight = max(tight, (change / np.maximum(travel, 1e-3))[apart].max())
    assert tight > 0.5  # the bound is of the size of what happens


@pytest.mark.parametrize(("settings", "keywords"), SCENES)
def test_the_gate_knows_distances_beyond_the_cutoff(settings, keywords):
    wall = Plane(name="wall", point_m=(2.0, 0.0, 0.0), normal=(-1.0, 0.0, 0.0))
    settings = dataclasses.replace(settings, obstacles=(*settings.obstacles, wall))
    clearance = Clearance(settings, **keywords)
    configurations = random_q(np.random.default_rng(3), 400).reshape(400, 12)
    near = clearance.measure(configurations).distances_m < CLEARANCE_CUTOFF_M
    spare, for_the_gate = clearance.spare_m(configurations), measured_for_the_gate(clearance, configurations)
    np.testing.assert_array_equal(for_the_gate[near], spare[near])
    assert (for_the_gate >= spare)[~near].all()
    assert for_the_gate.max() > 0.5  # farther than the cutoff


@pytest.mark.parametrize(("ticks", "steady"), [(5, True), (25, True), (125, False)])
def test_arms_at_full_speed_keep_away_from_thin_rods(ticks, steady):
    """Checks at the ends of brakes alone gave 12 mm at 25 Hz, and 50 mm of penetration at 5 Hz.

    At 1 Hz a joint goes forth and back within a window, 10 mm into a rod where only its ends were looked at, too.
    """
    n = 32
    rng = np.random.default_rng(0 if steady else 1)
    settings = SceneSettings(obstacles=RODS, equipment=Equipment(grippers=True))
    push = rng.choice([-1.0, 1.0], (n, 12)) * rng.uniform(0.3, 1.0, (n, 12)) * np.tile([1.0, 0.5, 0.5, 1, 1, 1], 2)
    by = push if steady else lambda period: rng.uniform(-1.0, 1.0, (n, 12))
    sent, verdicts = driven(Clearance(settings), by, max(500 // ticks, 24), n=n, ticks=ticks)
    measured = Clearance(settings)
    nearest = min(measured.measure(row).distances_m.min() for row in sent)
    assert nearest >= MINIMUM_M - SWEEP_TOLERANCE_M
    assert len(verdicts) > 0.9 * n


@pytest.mark.parametrize("ticks", [25, 125])
def test_a_joint_that_moves_forth_and_back_is_seen(ticks):
    """As far as limits allow, from rest to rest: the end of the brake alone does not show it."""
    fraction = np.minimum(np.arange(1, ticks + 1) / (ticks - 3), 1.0)
    way = 64.0 * (fraction * (1.0 - fraction)) ** 3 * 9.0 * (0.008 * (ticks - 3)) ** 2 / 24.0
    targets = np.tile(HOME, (1, ticks, 1))
    targets[0, :, 0] += way
    gate = SafetyGate(HARD, 0.008, ticks, Post(HOME[0] + WIDE_M + 2e-3))
    gate.reset(HOME_Q_RAD[None])
    found = gate(targets.reshape(1, ticks, 2, 6))
    assert way.max() > SWEEP_TOLERANCE_M + 3e-3
    assert found.verdicts[0].kind == "distance"


def test_distances_of_one_row_prove_nothing_of_another():
    """The other row, first and far away, is what the kernel measured last."""
    ticks = 25
    fraction = np.minimum(np.arange(1, ticks + 1) / (ticks - 3), 1.0)
    path = 64.0 * (fraction * (1.0 - fraction)) ** 3 * 9.0 * (0.008 * (ticks - 3)) ** 2 / 24.0
    gate = SafetyGate(HARD, 0.008, ticks, Post(HOME[0] + WIDE_M + 2e-3), n=2)
    start = np.tile(HOME, (2, 1))
    start[0, 0] -= 1.0
    gate.reset(start.reshape(2, 2, 6))
    targets = np.repeat(start[:, None], ticks, axis=1)
    assert not gate(targets.reshape(2, ticks, 2, 6)).verdicts
    targets[1, :, 0] += path
    found = gate(targets.reshape(2, ticks, 2, 6)).verdicts
    assert [(row, verdict.kind) for row, verdict in found.items()] == [(1, "distance")]


@pytest.mark.parametrize("jump", [0.3, 30.0, 1e6, 1e17, 1e300])
def test_impossible_motion_is_refused_without_checks(jump):
    post = Post(HOME[0] + 0.05)
    gate = SafetyGate(HARD, 0.008, 5, post)
    gate.reset(HOME_Q_RAD[None])
    targets = np.tile(HOME, (1, 5, 1))
    targets[..., 0] += jump
    (verdict,) = gate(targets.reshape(1, 5, 2, 6)).verdicts.values()
    assert verdict.kind != "distance"
    assert post.checks == 0


class Corridor(Measured):
    """Walls on all sides, 0.1 mm from too close."""

    def spare_m(self, q_rad):
        return np.array([1e-4])

    def worst(self, q_rad):
        return "left/forearm_link and wall", 1e-4, 0.0


def test_checks_are_bounded():
    corridor = Corridor(np.full((1, 12), 10.0))
    sent, verdicts = driven(corridor, np.ones(12), 40)
    assert verdicts[0].kind == "distance"
    assert corridor.checks < 40 * 2 + 8 * 100
    assert np.ptp(sent[0, -3:], axis=0).max() < 1e-4  # at rest


class Crowded(Post):
    """A post in whose cell all is near as long as the right wrist is raised."""

    def spare_m(self, q_rad):
        return np.full(2, 1e-3) if q_rad[9] > HOME[9] else super().spare_m(q_rad)


def test_a_row_does_not_depend_on_neighbours_that_need_many_checks():
    raised = np.roll(TURN, 9) * 0.2
    alone, verdict = driven(Crowded(HOME[0] + 0.93), TURN, 40)
    assert verdict[0].kind == "distance"
    crowd = Crowded(HOME[0] + 0.93)
    together, verdicts = driven(crowd, np.stack([TURN * 0.3 + raised, TURN, TURN * 0.1 + raised]), 40, n=3)
    assert crowd.checks > 2 * 40 * 3
    np.testing.assert_array_equal(together[1], alone[0])
    assert verdicts[1] == verdict[0]


def test_arms_that_are_too_close_may_separate():
    """The distance of a pair that does not move stays equal up to rounding."""
    clearance = Clearance(SceneSettings())
    rng = np.random.default_rng(0)
    starts = 0
    while starts < 10:
        start = HOME.copy()
        start[2:6] += rng.uniform(-1.0, 1.0, 4) * (1.0, 2.0, 2.0, 2.0)
        spare = clearance.spare_m(start[None])[0]
        if not (-0.02 < spare.min() < 0.0 and (spare < 0.0).sum() == 1):
            continue
        if not all(each.startswith("left/") for each in clearance.pairs[int(spare.argmin())]):
            continue
        starts += 1
        for joint in (0, 6, 7):  # carries both, or neither
            goal = start.copy()
            goal[joint] += 0.3
            targets = plan(start.reshape(2, 6), goal.reshape(2, 6), clearance, Rates(HARD.robots)).targets(0.008)
            targets = targets[: len(targets) // 5 * 5].reshape(-1, 1, 5, 2, 6)
            gate = SafetyGate(HARD, 0.008, 5, retreat_clearance(clearance, start.reshape(2, 6)))
            gate.reset(start.reshape(1, 2, 6))
            assert not any(gate(window).verdicts for window in targets)


class Failing(AlwaysClear):
    """Stub whose measurement fails from a given check on, and with it the reason of a refusal."""

    def __init__(self, after):
        super().__init__()
        self.after = after

    def spare_m(self, q_rad):
        if self.checks > self.after:
            raise ZeroDivisionError("no sensor")
        return super().spare_m(q_rad)

    def worst(self, q_rad):
        raise ZeroDivisionError("no sensor, either")


@pytest.mark.parametrize("after", [0, 3])
def test_what_cannot_be_measured_is_not_released(after):
    gate = SafetyGate(HARD, 0.008, 5, Failing(after))
    gate.reset(HOME_Q_RAD[None])
    still = np.tile(HOME, (1, 5, 1)).reshape(1, 5, 2, 6)
    for _ in range(after):
        assert not gate(still).verdicts
    with pytest.raises(ZeroDivisionError, match="no sensor"):
        gate(still)
    found = gate(still + 1e-6)
    assert (found.verdicts[0].kind, found.verdicts[0].tick) == ("distance", 5 * after)
    assert (found.targets_rad == still).all()


class Unnamed(Post):
    """Stub that cannot name the pair that is too close."""

    def worst(self, q_rad):
        raise ZeroDivisionError("no names")


def test_a_refusal_without_a_reason_still_brakes():
    named, unnamed = ((post, *driven(post, TURN, 40, n=2)) for post in (Post(HOME[0] + 0.5), Unnamed(HOME[0] + 0.5)))
    np.testing.assert_array_equal(named[1], unnamed[1])
    for row in range(2):
        expected, found = named[2][row], unnamed[2][row]
        assert (found.kind, found.tick) == (expected.kind, expected.tick)
        assert "unknown pair (ZeroDivisionError: no names)" in str(found)


class Blind(Measured):
    """Thin obstacle that the left arm passes at 20 mm, of which one check measures NaN. All levers are 1 m."""

    def __init__(self, check):
        super().__init__(np.eye(2, 12))
        self.check = check

    def spare_m(self, q_rad):
        spare = np.array([np.hypot(q_rad[0] - HOME[0] - 0.5, 0.03) - WIDE_M, 5.0])
        if self.checks == self.check:
            spare[0] = np.nan
        return spare

    def worst(self, q_rad):
        return "left/forearm_link and post", np.nan, WIDE_M


def test_a_distance_that_is_nan_refuses_wherever_it_is_measured():
    def passed(check):
        """Return the number of checks up to the end of each period before the refusal, if there is one."""
        post, checks = Blind(check), []
        adapter = ServojAdapter(ServojProfile("cb3"), HARD, 5, dh=[NOMINAL_DH] * 2)
        gate = SafetyGate(HARD, 0.008, 5, post)
        adapter.reset(HOME_Q_RAD[None])
        gate.reset(HOME_Q_RAD[None])
        for _ in range(25):
            if gate(adapter(TURN.reshape(1, 2, 6)).targets_rad.copy()).verdicts:
                break
            checks.append(post.checks)
        return checks

    every = passed(0)
    assert len(every) == 25
    # In some periods only at the end of the brake, in some at the end of the window, and in some between, too.
    assert {1, 2} < set(np.diff([0, *every]).tolist())
    for check in range(1, every[-1] + 1):
        assert passed(check) == [each for each in every if each < check]


def test_a_brake_that_takes_minutes_fits_any_stack():
    """The path to the end of the brake has 72,000 points under the smallest acceleration that a cell file allows."""
    slow = MotionLimits(acceleration_rad_s2=0.1, jerk_rad_s3=10.0)
    refused = []

    def drive():
        gate = SafetyGate(slow, 0.002, 20, Post(HOME[0] + WIDE_M + 1e-3))
        gate.reset(HOME_Q_RAD[None])
        adapter = ServojAdapter(ServojProfile("e-series"), slow, 20, dh=[NOMINAL_DH] * 2)
        adapter.reset(HOME_Q_RAD[None])
        for _ in range(400):
            found = gate(adapter(np.broadcast_to(TURN, (1, 12)).reshape(1, 2, 6)).targets_rad)
            refused.extend(found.verdicts.values())
            if refused:
                break

    before = threading.stack_size(512 * 1024)
    try:
        thread = threading.Thread(target=drive)
        thread.start()
        thread.join()
    finally:
        threading.stack_size(before)
    assert refused[0].kind == "distance"
