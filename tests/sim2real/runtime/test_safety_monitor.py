"""Stops by the safety monitor, from states of controllers, processes and policy."""

from __future__ import annotations

import math
import os

import numpy as np
import pytest

from dual_ur10.assets.settings import HOME_Q_RAD, SceneSettings
from dual_ur10.sim2real.control.coupling import APART_M, APART_RAD
from dual_ur10.sim2real.control.time_scaling import TimeScaling
from dual_ur10.sim2real.runtime.arm_memory import ArmMemory, Phase
from dual_ur10.sim2real.runtime.arm_sender import STALE_S, WAITING_S
from dual_ur10.sim2real.runtime.cell_memory import CellMemory
from dual_ur10.sim2real.runtime.safety_monitor import (
    POLICY_S,
    REDUCED_SCALING,
    MonitorSettings,
    SafetyMonitor,
)
from tests.pairwise import pairwise
from tests.ur_emulator.statuses import status_of
from ur_core.kinematics.forward import flange_pose, flange_pose_quat
from ur_core.kinematics.frames import ArmMount, Frames
from ur_core.kinematics.inverse import try_nearest
from ur_core.kinematics.rotations import quat_from_rotvec, quat_multiply, quat_to_matrix, rotate
from ur_core.processes.machine_load import too_busy

TICK_S = 0.008
MOUNTS = SceneSettings().mounts
ARM = ("left", "right")


@pytest.fixture
def parts():
    arms, cell = [ArmMemory(), ArmMemory()], CellMemory()
    yield arms, cell
    for each in (*arms, cell):
        each.close()


def watch(parts, *, coupled=False, mounts=MOUNTS, phase=Phase.STREAMING):
    arms, cell = parts
    for memory in arms:
        memory.enter(phase)
    cell.couple(coupled)
    return SafetyMonitor(MonitorSettings(mounts, TICK_S), arms, cell)


def at(q, wanted=None, **values):
    return status_of(actual_q=tuple(q), target_q=tuple(q if wanted is None else wanted), **values)


# States of controllers.


@pytest.mark.parametrize("arm", [0, 1])
def test_every_safety_mode_but_one_stops(parts, arm):
    monitor = watch(parts)
    for mode in range(256):
        reason = monitor.state(arm, status_of(safety_mode=mode))
        if mode == 1:
            assert reason is None
        else:
            assert reason is not None
            assert reason.startswith(f"{ARM[arm]}: safety mode {mode} (")


def test_every_robot_mode_and_safety_bit_but_one_stops(parts):
    monitor = watch(parts)
    assert [mode for mode in range(-1, 256) if monitor.state(1, status_of(robot_mode=mode)) is None] == [7]
    found = [bit for bit in range(32) if monitor.state(0, status_of(safety_status_bits=1 << bit)) is None]
    assert found == [0]


@pytest.mark.parametrize("phase", list(Phase))
def test_a_program_must_play_while_targets_are_sent(parts, phase):
    monitor = watch(parts, phase=phase)
    reason = monitor.state(0, status_of(runtime_state=1))
    assert ("left: program state 1 (STOPPED): " in str(reason)) == (phase == Phase.STREAMING)
    assert monitor.state(0, status_of(runtime_state=2)) is None


def test_old_states_are_not_judged(parts):
    monitor = watch(parts)
    status = status_of(timestamp=1.0)
    assert [monitor.state(0, status) for _ in range(200)] == [None] * 200


@pytest.mark.parametrize("arm", [0, 1])
def test_a_tracking_error_stops_both(parts, arm):
    monitor = watch(parts)
    bad, good = at(HOME_Q_RAD[arm] + [0, 0, 0.2, 0, 0, 0], HOME_Q_RAD[arm]), at(HOME_Q_RAD[1 - arm])
    found = []
    for _ in range(3):  # each arm is counted by itself
        found.append(monitor.state(arm, bad))
        assert monitor.state(1 - arm, good) is None
    assert found[:2] == [None, None]
    assert found[2] is not None
    assert found[2].startswith(f"{ARM[arm]}: elbow_joint is 0.200 rad from")


def test_the_slower_slider_counts(parts):
    monitor = watch(parts)
    assert monitor.slowest == 1.0
    monitor.state(0, status_of(target_speed_fraction=0.7, speed_scaling=1.0))
    assert monitor.slowest == 0.7
    monitor.state(1, status_of(target_speed_fraction=0.9, speed_scaling=0.3))
    assert monitor.slowest == 0.3
    monitor.state(1, status_of(target_speed_fraction=1.0, speed_scaling=1.0))
    assert monitor.slowest == 0.7


@pytest.mark.parametrize("arm", [0, 1])
def test_only_reduced_mode_may_continue_and_slows_down(parts, arm):
    parts[1].permit_reduced_mode()
    monitor = watch(parts)
    full = {"target_speed_fraction": 1.0}
    reduced = {**full, "safety_mode": 2, "safety_status_bits": 2}
    assert [mode for mode in range(256) if monitor.state(arm, status_of(safety_mode=mode)) is None] == [1, 2]
    assert monitor.state(arm, status_of(**reduced)) is None
    assert monitor.slowest == REDUCED_SCALING  # by itself, for a controller does not slow down what it is sent
    assert monitor.state(arm, status_of(**{**reduced, "target_speed_fraction": 0.5})) is None
    assert monitor.slowest == REDUCED_SCALING / 2
    assert monitor.state(arm, status_of(**full)) is None
    assert monitor.slowest == 1.0
    assert monitor.state(arm, status_of(**{**reduced, "safety_status_bits": 2 | 4})) is not None


@pytest.mark.parametrize("values", [{"target_speed_fraction": math.nan}, {"speed_scaling": math.nan}])
def test_a_slider_that_is_no_number_stops(parts, values):
    reason = watch(parts).state(0, status_of(**values))
    assert reason is not None
    assert "finite" in reason


@pytest.mark.parametrize("phase", list(Phase))
def test_moving(parts, phase):
    monitor = watch(parts, phase=Phase.READY)
    parts[0][1].enter(phase)
    assert not monitor.moving  # a start that failed has moved nothing
    parts[1].begin(1.0)
    assert monitor.moving == (phase >= Phase.STREAMING)


# Two arms that hold one object.


def led(parts, late, size=0.4, arm=0):
    """Rotate both first joints at 0.2 rad/s; one arm is sent its targets `late` ticks later than the other."""
    arms, _ = parts
    ticks = np.arange(400)
    targets = np.array([HOME_Q_RAD + np.array([1.0, 0, 0, 0, 0, 0]) * size * k * TICK_S for k in ticks])
    for which, memory in enumerate(arms):
        for begin in range(0, len(ticks), 100):
            memory.put(begin, targets[begin : begin + 100, which])
        index = 300 - (late if which == arm else 0)
        memory.note_sent(index, float(index), 0.0, 0.0, targets[index, which])
    return targets


@pairwise(arm=[0, 1], late=[0, 2, 11], lag=[0, 5, 12])
def test_an_arm_that_lags_as_a_whole_is_an_error(parts, late, lag, arm):
    """Its controller's own target lags as well and does not show it. A common lag is no error."""
    targets = led(parts, late, arm=arm)
    monitor = watch(parts, coupled=True)
    reason = None
    for _ in range(5):
        for which in (0, 1):
            q = targets[300 - lag - (late if which == arm else 0), which]
            reason = reason or monitor.state(which, at(q))
        reason = reason or monitor.relative_pose()
    if late == 11:  # 88 ms at 0.4 rad/s and a lever of about a metre
        assert reason is not None
        assert "hold one object" in reason
    else:
        assert reason is None


def moved(arm, away_m=(0.0, 0.0, 0.0), turn_rad=(0.0, 0.0, 0.0), mounts=MOUNTS):
    """Return joints of an arm whose flange is shifted and rotated in its `base`."""
    q, dh = HOME_Q_RAD[arm], mounts[arm].dh
    position, rotation = flange_pose(q, dh)
    wanted = quat_to_matrix(quat_from_rotvec(np.array(turn_rad))) @ rotation
    result, reached = try_nearest((position + away_m)[None], wanted[None], q[None], dh)
    assert reached.all()
    return result[0]


def apart(parts, left, right, **more):
    """Return the reasons after four states of arms at these configurations, with targets at home."""
    monitor, found = watch(parts, **{"coupled": True, **more}), []
    for _ in range(4):
        assert monitor.state(0, at(left, HOME_Q_RAD[0])) is None
        assert monitor.state(1, at(right, HOME_Q_RAD[1])) is None
        found.append(monitor.relative_pose())
    return found


@pytest.mark.parametrize("arm", [0, 1])
@pytest.mark.parametrize(
    ("away_m", "turn_rad", "words"),
    [
        ((0.0, 0.011, 0.0), (0, 0, 0), "11.0 mm"),
        ((0, 0, 0), (0.0, 0.0, 0.055), "3.2°"),
        ((0, 0, -0.02), (0, 0, 0), "20"),
    ],
)
def test_an_error_of_the_relative_pose_stops_both(parts, arm, away_m, turn_rad, words):
    q = [HOME_Q_RAD[0], HOME_Q_RAD[1]]
    q[arm] = moved(arm, away_m, turn_rad)
    found = apart(parts, *q)
    assert found[:2] == [None, None]
    assert found[2] is not None
    assert "which hold one object" in found[2]
    if arm == 1 or not any(turn_rad):  # a rotation of the left one moves the right one in its frame
        assert words in found[2]
    assert apart(parts, *q, coupled=False) == [None] * 4


@pytest.mark.parametrize("arm", [0, 1])
def test_small_errors_of_the_relative_pose_are_allowed(parts, arm):
    near = 0.95
    q = [HOME_Q_RAD[0], HOME_Q_RAD[1]]
    q[arm] = moved(arm, (near * APART_M, 0.0, 0.0))
    assert apart(parts, *q) == [None] * 4
    right = moved(1, turn_rad=(0.0, near * APART_RAD, 0.0))
    assert apart(parts, HOME_Q_RAD[0], right) == [None] * 4


@pytest.mark.parametrize("seed", range(8))
def test_a_common_lag_is_no_error(parts, seed):
    """Equal motions in the cell do not tear the object, in any configuration."""
    rng = np.random.default_rng(seed)
    yaw = rng.uniform(-np.pi, np.pi, 2)
    mounts = (ArmMount((-0.75, 0.6, 0.0), yaw[0]), ArmMount((-0.75, -0.6, 0.0), yaw[1]))
    away = rng.normal(size=3)
    away *= 0.03 / np.linalg.norm(away)
    q = []
    for arm in (0, 1):
        turn = np.pi + yaw[arm]  # `base` is rotated by π from base_link
        back = np.array([[np.cos(turn), np.sin(turn), 0], [-np.sin(turn), np.cos(turn), 0], [0, 0, 1]])
        q.append(moved(arm, back @ away, mounts=mounts))
    assert apart(parts, *q, mounts=mounts) == [None] * 4
    assert apart(parts, q[0], HOME_Q_RAD[1], mounts=mounts)[2] is not None


@pytest.mark.parametrize("axis", range(3))
@pytest.mark.parametrize("yaw", [(0.0, 0.0), (0.7, -0.9), (0.0, np.pi / 2)])
def test_a_common_displacement_is_no_error(parts, axis, yaw):
    """Moved in the cell as one, it is not torn; one arm alone would tear it."""
    mounts = (ArmMount((-0.75, 0.6, 0.0), yaw[0]), ArmMount((-0.75, -0.6, 0.0), yaw[1]))
    frames = Frames(mounts)
    poses = [flange_pose_quat(HOME_Q_RAD[arm], mounts[arm].dh) for arm in (0, 1)]
    position = frames.position_to_cell(np.array([each[0] for each in poses]))
    quat = frames.quat_to_cell(np.array([each[1] for each in poses]))
    turn = quat_from_rotvec(0.06 * np.eye(3)[axis])
    middle = position.mean(axis=0)
    position = frames.position_to_base(middle + rotate(turn, position - middle))
    matrix = quat_to_matrix(frames.quat_to_base(quat_multiply(turn, quat)))
    q, reached = zip(
        *(try_nearest(position[k][None], matrix[k][None], HOME_Q_RAD[k][None], mounts[k].dh) for k in (0, 1)),
        strict=True,
    )
    assert np.all(reached)
    assert np.abs(np.array(q)[:, 0] - HOME_Q_RAD).max() < 0.1  # else each arm by itself would be off
    assert apart(parts, q[0][0], q[1][0], mounts=mounts) == [None] * 4
    assert apart(parts, q[0][0], HOME_Q_RAD[1], mounts=mounts)[2] is not None


@pytest.mark.parametrize("seed", range(40))
def test_arms_on_target_have_no_error_in_any_configuration(parts, seed):
    rng = np.random.default_rng(seed)
    wanted = rng.uniform(-3, 3, (2, 6))
    wanted[:, 3:] = np.round(wanted[:, 3:] / (np.pi / 2)) * (np.pi / 2)  # half turns, too, where signs change
    wanted[:, 1:3] = np.round(wanted[:, 1:3] / (np.pi / 2)) * (np.pi / 2)
    found = wanted + rng.uniform(-1e-4, 1e-4, (2, 6))
    monitor = watch(parts, coupled=True)
    for _ in range(4):
        assert monitor.state(0, at(found[0], wanted[0])) is None
        assert monitor.state(1, at(found[1], wanted[1])) is None
        assert monitor.relative_pose() is None


def test_a_single_state_is_tolerated(parts):
    monitor = watch(parts, coupled=True)
    good, bad = at(HOME_Q_RAD[1]), at(moved(1, (0.0, 0.02, 0.0)), HOME_Q_RAD[1])
    for _ in range(6):
        assert monitor.state(1, bad) is None
        assert monitor.relative_pose() is None  # of the left one nothing is known yet
    for _ in range(6):
        for each in (bad, bad, good):
            monitor.state(0, at(HOME_Q_RAD[0]))
            monitor.state(1, each)
            assert monitor.relative_pose() is None
    for _ in range(6):
        monitor.state(1, bad)
        assert monitor.relative_pose() is None  # of the left one nothing new is known


def test_delayed_states_are_compared_with_those_of_their_time(parts):
    """A supervisor that stalled reads all states of one arm, then all of the other."""
    targets = led(parts, 0)
    monitor = watch(parts, coupled=True)
    for newest in range(100, 250, 15):  # 120 ms each: 24 mrad, and as many mm
        for arm in (0, 1):
            for tick in range(newest - 15, newest):
                assert monitor.state(arm, at(targets[tick, arm])) is None
            parts[0][arm].note_sent(newest, float(newest), 0.0, 0.0, targets[newest, arm])
        assert monitor.relative_pose() is None


def test_an_e_series_tolerates_errors_as_long_as_a_cb3(parts):
    arms, cell = parts
    cell.couple(True)
    monitor = SafetyMonitor(MonitorSettings(MOUNTS, 0.002), arms, cell)
    bad = at(moved(1, (0.0, 0.02, 0.0)), HOME_Q_RAD[1])
    said = []
    for _ in range(8):  # two states at a time
        for _ in range(2):
            monitor.state(0, at(HOME_Q_RAD[0]))
            monitor.state(1, bad)
        said.append(monitor.relative_pose())
    assert [each is None for each in said] == [True] * 5 + [False] * 3


def test_errors_before_the_arms_let_go_do_not_count_later(parts):
    _, cell = parts
    monitor, found = watch(parts, coupled=True), []
    bad = at(moved(1, (0.0, 0.02, 0.0)), HOME_Q_RAD[1])
    for coupled in (True, True, False, True, True, True):
        cell.couple(coupled)
        monitor.state(0, at(HOME_Q_RAD[0]))
        monitor.state(1, bad)
        found.append(monitor.relative_pose())
    assert [each is None for each in found] == [True] * 5 + [False]


# What the processes show.


@pytest.mark.parametrize("arm", [0, 1])
@pytest.mark.parametrize("phase", [Phase.STOPPING, Phase.STOPPED, Phase.FAULTED])
def test_an_arm_that_stops_stops_both_with_its_reason(parts, arm, phase):
    monitor = watch(parts)
    for memory in parts[0]:
        memory.beat(10.0)
    assert monitor.processes(10.0) is None
    parts[0][arm].enter(phase, f"{ARM[arm]}: its own reason")
    assert monitor.processes(10.0) == f"{ARM[arm]}: its own reason"
    parts[0][1 - arm].enter(Phase.STOPPING, f"{ARM[1 - arm]}: the other arm stops: {ARM[arm]}: its own reason")
    assert monitor.processes(10.0) == f"{ARM[arm]}: its own reason"


def test_an_arm_that_stops_without_a_reason(parts):
    monitor = watch(parts)
    for memory in parts[0]:
        memory.beat(10.0)
    parts[0][1].enter(Phase.FAULTED)
    assert monitor.processes(10.0) == "right: its process has stopped"


@pairwise(
    arm=[0, 1],
    phase__most_s=[(Phase.STREAMING, STALE_S), (Phase.READY, WAITING_S)],
    lives__what=[(True, "no longer responds"), (False, "has ended")],
)
def test_a_process_that_no_longer_responds_stops_both(parts, arm, phase, most_s, lives, what):
    monitor = watch(parts, phase=phase)
    parts[0][arm].note_process(os.getpid() if lives else 2**22 + 1)  # the second is beyond those of Linux
    parts[0][1 - arm].beat(10.0 + most_s)
    parts[0][arm].beat(10.0)
    assert monitor.processes(10.0 + 0.99 * most_s) is None
    assert monitor.processes(10.0 + 1.01 * most_s) == f"{ARM[arm]}: its process {what}"


def test_a_process_may_connect_slowly(parts):
    assert watch(parts, phase=Phase.STARTING).processes(1e6) is None


@pytest.mark.parametrize("arm", [0, 1])
def test_a_process_that_does_not_begin_stops_both(parts, arm):
    monitor = watch(parts, phase=Phase.READY)
    parts[0][1 - arm].enter(Phase.STREAMING)
    parts[1].begin(10.0)

    def found(now):
        for memory in parts[0]:
            memory.beat(now)
        return monitor.processes(now)

    assert found(10.0 + 0.99 * STALE_S) is None
    assert found(10.0 + 1.01 * STALE_S) == f"{ARM[arm]}: {too_busy('it does not begin')}"


@pytest.mark.parametrize(("told", "ended"), [(0, False), (1, True), (2, False), (4, False)])
def test_a_program_has_ended_when_its_controller_reports_it(parts, told, ended):
    monitor = watch(parts)
    assert monitor.ended == [False, False]
    monitor.note(1, status_of(runtime_state=told))
    assert monitor.ended == [False, ended]


# What the policy owes.


def owing(parts, scaling, fresh, *, live=True, begin_s=100.0):
    monitor = watch(parts)
    cell = parts[1]
    cell.begin(begin_s)
    cell.set_time_scaling(scaling)
    cell.expect(fresh, live=live)

    def late(now):
        for memory in parts[0]:
            memory.beat(now)
        return monitor.processes(now)

    return late


@pytest.mark.parametrize("rate", [1.0, 0.5, 0.25, 1 / 16])
def test_the_deadline_of_a_policy_is_in_real_time(parts, rate):
    fresh = 50.0
    late = owing(parts, TimeScaling(0.0, 0.0, rate, rate), fresh)
    due_s = 100.0 + fresh / rate * TICK_S
    for before in (-1.0, 0.0, 0.4, 0.999 * POLICY_S):
        assert late(due_s + before) is None, before
    for after in (1.004 * POLICY_S, 2.0):
        assert (
            late(due_s + after)
            == f"the policy gave no action for {1e3 * after:.0f} ms more than it has: both arms rest"
        )


def test_a_change_of_scaling_changes_the_deadline(parts):
    scaling = TimeScaling().towards(0.25, 1000.0, TICK_S)
    fresh = scaling.at(1100.0)
    late = owing(parts, scaling, fresh)
    due_s = 100.0 + 1100.0 * TICK_S
    assert late(due_s + 0.999 * POLICY_S) is None
    assert late(due_s + 1.001 * POLICY_S) is not None


def test_nothing_is_late_while_time_is_stopped(parts):
    late = owing(parts, TimeScaling(0.0, 0.0, 1.0, 0.0, TICK_S), 1000.0)
    assert late(1e6) is None
    late = owing(parts, TimeScaling(0.0, 0.0, 0.0, 0.0), 3.0)
    assert late(1e6) is None


@pytest.mark.parametrize(("live", "begin_s"), [(False, 100.0), (True, 0.0)])
def test_a_policy_that_owes_nothing_is_never_late(parts, live, begin_s):
    assert owing(parts, TimeScaling(), 5.0, live=live, begin_s=begin_s)(1e6) is None
