"""Points at low rates to both controllers of a virtual cell: accuracy, time, every way to stop, and refusals."""

import importlib
import pathlib
import random
import re

import numpy as np
import pytest

from dual_ur10.cli import follow as follow_command
from dual_ur10.errors import CellFaulted, RecordingError, StartError, TrajectoryError
from dual_ur10.sim2real.control.limits import MotionLimits
from dual_ur10.sim2real.control.link_profiles import profile_for
from dual_ur10.sim2real.programs import program_link
from dual_ur10.sim2real.programs.point_stream import PointStream
from dual_ur10.sim2real.programs.program_box import ProgramBox
from dual_ur10.sim2real.programs.program_link import stop_programs
from dual_ur10.sim2real.programs.stream_script import (
    REASONS,
    STATE,
    WAIT_S,
    ProgramCommand,
    State,
    moves_script,
    points_script,
)
from dual_ur10.sim2real.recording.black_box import BlackBox
from dual_ur10.sim2real.recording.reader import read_run
from dual_ur10.sim2real.runtime.latch import Latch
from dual_ur10.sim2real.teaching.hand_guiding import SILENCE_S, HandGuiding
from dual_ur10.sim2real.trajectory.joint_trajectory import JointTrajectory
from dual_ur10.sim2real.trajectory.point_path import PointPath
from dual_ur10.testing import VirtualCell
from tests.soak import scaled

FOLDER = pathlib.Path(__file__).parents[2] / "benchmarks"
TICK_S = 0.008
ARMS = ("left", "right")
BUSY = "this machine is too busy to move arms in real time"


def stream(cell, rate_hz=5.0, **options):
    servoj = cell.file.config().servoj
    return PointStream(cell.file, profile_for(rate_hz, servoj), system=cell.system, **options)


def swing(q_rad, duration_s=2.0, size_rad=0.15, tick_s=TICK_S):
    """Return targets from rest to rest, in which one joint never turns back."""
    s = np.arange(round(duration_s / tick_s) + 1) * tick_s / duration_s
    smooth = s**3 * (10 + s * (6 * s - 15))
    joints = np.array([[1.0, 0.3, -0.4, 0.2, 0.5, -0.6], [0.8, 0.2, -0.3, 0.1, -0.5, 0.6]])
    return q_rad + size_rad * smooth[:, None, None] * joints


def rests(cell):
    """Check that both arms rest, and stay."""
    cell.clock.sleep(0.5)
    before = joints(cell)
    cell.clock.sleep(0.5)
    return np.abs(joints(cell) - before).max() < 1e-4


def joints(cell):
    return np.array([cell.ask("state", arm=arm, names=["actual_q"])["actual_q"] for arm in ARMS])


def programs(cell):
    return [cell.ask("state", arm=arm, names=["runtime_state"])["runtime_state"] for arm in ARMS]


def follow(cell, at_s=None, act=None, rate_hz=5.0, duration_s=2.0, **options):
    """Follow a path, and do something once at a time of it; return stream, path and the states on it."""
    seen, done = [], []
    points = stream(cell, rate_hz, **options)
    path = points.thin(swing(points.measured(), duration_s, tick_s=cell.emulator.tick_s))

    def feedback(progress):
        seen.append(progress)
        if act is not None and not done and progress.path_s >= at_s:
            done.append(True)
            act()

    try:
        points.run(path, feedback=feedback)
    finally:
        points.close()
    return path, seen


@pytest.mark.parametrize(("rate_hz", "family"), [(50.0, "cb3"), (5.0, "cb3"), (10.0, "e-series")])
def test_both_controllers_follow_the_checked_cubics_and_nothing_else(rate_hz, family):
    with VirtualCell(plant="nominal", family=family) as cell:
        path, tick_s = follow(cell, rate_hz=rate_hz)[0], cell.emulator.tick_s
        _check_setpoints(cell, path, tick_s)
        assert programs(cell) == [1, 1]


def _check_setpoints(cell, path, tick_s):
    for arm, name in enumerate(ARMS):
        sent = np.array([row[1] for row in cell.setpoints(name)])
        checked = path.targets(1e-4)[:, arm]  # far denser than the control periods
        moving = np.abs(sent[:, 0] - sent[0, 0]) > 1e-6
        moving &= np.abs(sent[:, 0] - sent[-1, 0]) > 1e-6
        for joint in range(1, 6):
            wanted = np.interp(sent[moving, 0], checked[:, 0], checked[:, joint])
            np.testing.assert_allclose(sent[moving, joint], wanted, atol=2e-7)
        np.testing.assert_allclose(sent[-1], path.q_rad[-1, arm], atol=1e-9)
        speed = np.abs(np.diff(sent, axis=0)).max() / tick_s
        assert speed <= 1.001 * np.abs(np.diff(checked, axis=0)).max() / 1e-4
        assert all(row[2:] == [tick_s, 0.03, 2000.0] for row in cell.setpoints(name))


def test_the_command_follows_a_file_at_a_low_rate(cell, capsys):
    home = joints(cell)
    there = JointTrajectory(("right",), [1.0, 3.0], home[None, 1:] + [[[0.05]], [[0.2]]], np.zeros((2, 1, 6)))
    follow_command._stream(there, cell.file, 10.0, cell.system)
    assert "both arms are at the last point" in capsys.readouterr().out
    np.testing.assert_allclose(joints(cell), home + np.array([[0.0], [0.2]]), atol=1e-4)
    sent = np.array([row[1] for row in cell.setpoints("right")])[:, 0] - home[1, 0]
    assert np.abs(np.diff(sent)).max() / TICK_S < 0.2
    assert np.abs(sent - 0.05).min() < 1e-3  # by way of the first point
    assert np.ptp(np.array([row[1] for row in cell.setpoints("left")]), axis=0).max() < 1e-9


@pytest.fixture
def followers(monkeypatch):
    monkeypatch.syspath_prepend(FOLDER)
    paths = importlib.import_module("follower_paths")
    monkeypatch.setattr(paths, "DURATION_S", 6.0)
    return importlib.import_module("followers")


def test_slow_links_reach_the_accuracy_of_125_hz(followers):
    """Which is at best 0: `test_follower` compares it with the path."""
    found = followers.run(followers.virtual, "nominal", {"5hz": 5.0}, ("dual",))
    assert found["5hz"]["flange_max_mm"] < 0.1
    assert max(each["skew_p99_ms"] for each in found["paths"]["dual"].values()) < 0.1


def test_both_arms_grasp_a_bar_at_a_low_rate(followers):
    found = followers.run(followers.virtual, "nominal", {"10hz": 10.0}, ("grasp",))
    assert found["paths"].keys() == {"grasp"}
    grasp = found["paths"]["grasp"]["10hz"]
    assert grasp["period_ms"] == 100.0
    assert grasp["flange_max_mm"] < 0.05
    assert grasp["relative_max_mm"] < 0.05
    assert max(grasp["angle_max_deg"], grasp["relative_max_deg"]) < 0.01


def test_fixed_time_moves_reach_every_point_with_both_arms_at_once(cell):
    points = PointStream(cell.file, profile_for(2.0), system=cell.system)
    home = points.measured()
    path = points.thin(swing(home, duration_s=3.0))
    near = np.full(len(path.q_rad), np.inf)

    def feedback(progress):
        nonlocal near
        off = np.abs(np.array(progress.status.q_rad) - path.q_rad[:, progress.arm]).max(axis=1)
        near = np.minimum(near, off)

    assert points.run(path, feedback=feedback)
    points.close()
    assert near.max() < 2e-3
    np.testing.assert_allclose(joints(cell), path.q_rad[-1], atol=1e-4)
    assert rests(cell)


def test_clocks_that_drift_apart_are_kept_together():
    right = {"phase_s": 0.005, "drift_ppm": -150.0}
    with VirtualCell(plant="nominal", phase_s=0.001, drift_ppm=150.0, right=right) as cell:
        _, seen = follow(cell, duration_s=5.0)
        late = [np.array([each.late_s for each in seen if each.arm == arm and each.path_s > 1.0]) for arm in (0, 1)]
        assert max(np.abs(each).max() for each in late) < 1.5e-3


# Ways to stop.


def silence(cell):
    """Let the sending program sleep."""
    return lambda: cell.clock.sleep(1.5)


def protective(cell):
    return lambda: cell.ask("stop", arm="left", mode=3)


def lost(cell):
    return lambda: cell.ask("drop", arm="right", port="rtde")


def mute(cell):
    return lambda: cell.ask("link", arm="left", port="rtde", mute=True)


def slider(cell):
    return lambda: cell.ask("override", arm="right", target_speed_fraction=0.5)


def replaced(cell):
    def act():
        script = cell.system.connect(cell.left, 30003, 1.0)
        script.send_now(b"def other():\n  sleep(5)\nend\n")

    return act


@pytest.mark.parametrize(
    ("fault", "rate_hz", "words"),
    [
        (silence, 5.0, "no point came in time"),
        (silence, 2.0, "no point came in time"),  # moves of a fixed time
        (protective, 2.0, "PROTECTIVE_STOP"),
        (lost, 5.0, "right"),
        (mute, 5.0, "the controller's clock has stalled"),
        (slider, 5.0, "scaled to 50 %"),
        (replaced, 5.0, "program"),
        (replaced, 2.0, "program"),
    ],
)
def test_a_fault_of_either_arm_stops_both_and_is_latched(cell, fault, rate_hz, words):
    with pytest.raises(CellFaulted, match=words):
        follow(cell, 1.2, fault(cell), rate_hz, duration_s=4.0)
    cell.ask("heal", arm="left")
    assert rests(cell)
    assert words in cell.fault
    with pytest.raises(CellFaulted, match=r"call `\.clear\(\)` of the virtual cell"):
        stream(cell)


@pytest.mark.parametrize("kind", ["emulated", "real"])
def test_a_stall_of_this_program_is_one_of_this_machine(cell, kind):
    """Also with real controllers: this program knows how late it was with a point."""
    object.__setattr__(cell.file, "kind", kind)
    with pytest.raises(
        CellFaulted, match=rf"{BUSY} \(no point came in time.*; this program was 1\d\d\d ms late with one"
    ):
        follow(cell, 1.2, silence(cell), duration_s=4.0, confirm=lambda question: True)
    assert BUSY in cell.fault


def test_a_controller_that_alone_falls_silent_is_a_matter_of_its_network(cell):
    with pytest.raises(CellFaulted, match=r"the controller's clock has stalled .* look at its network"):
        follow(cell, 1.2, mute(cell), duration_s=4.0, confirm=lambda question: True)
    assert BUSY not in cell.fault


def test_points_that_a_link_delays_name_the_link_and_this_machine(cell):
    def slow():
        cell.ask("link", arm="left", port="rtde", delay_s=0.3)

    with pytest.raises(CellFaulted) as found:
        follow(cell, 1.2, slow, duration_s=4.0)
    assert re.search(r"left: .*(check the link, and with `uptime`|too busy)", str(found.value))
    assert rests(cell)


def test_a_stop_leaves_a_black_box(cell):
    home = joints(cell)
    there = JointTrajectory(("left", "right"), [0.0, 4.0], np.stack([home, home + 0.2]), np.zeros((2, 2, 6)))
    box = ProgramBox(cell.file, "points", system=cell.system)
    with PointStream(cell.file, profile_for(5.0), observer=box, system=cell.system) as points:
        path = points.points_of(there, points.measured())
        act, done = protective(cell), []

        def feedback(progress):
            if progress.path_s > 2.0 and not done:
                done.append(act())

        with pytest.raises(CellFaulted):
            points.run(path, feedback=feedback)
    run = read_run(*box.boxes)
    assert (run.header.env_id, run.header.source) == ("points", "emulated")
    assert run.events[-1].text == cell.fault
    for number, arm in enumerate(run.arms):
        sent, state = arm.sent["target_rad"], arm.state
        np.testing.assert_array_equal(sent[1:], path.q_rad[: len(sent) - 1, number])
        assert arm.sent["index"].tolist() == list(range(1, len(sent) + 1))
        np.testing.assert_allclose(state["q_rad"][0], home[number], atol=1e-3)
        np.testing.assert_allclose(state["q_rad"][-1], joints(cell)[number], atol=1e-3)
        assert (np.diff(state["arrival_s"]) >= 0.0).all()
    assert run.arms[0].state["safety_mode"][-1] == 3


def test_a_black_box_that_cannot_be_written_changes_no_stop(cell, monkeypatch, caplog):
    def full(*_):
        raise RecordingError("there is no room")

    monkeypatch.setattr(BlackBox, "write", full)
    box = ProgramBox(cell.file, "points", system=cell.system)
    with pytest.raises(CellFaulted, match="PROTECTIVE_STOP"):
        follow(cell, 1.2, protective(cell), observer=box)
    assert "no black box: there is no room" in caplog.text
    assert "PROTECTIVE_STOP" in cell.fault


def test_arms_stop_by_themselves_when_the_sender_is_killed(cell):
    """Within an interval and a half, and the time of the deceleration; on the path up to there."""
    sender = cell.system.spawn(_send, cell.file)
    cell.clock.sleep(2.5)
    before = joints(cell)
    assert programs(cell) == [2, 2]
    sender.kill()
    cell.clock.sleep(0.2 * 1.5 + 0.5)
    after = joints(cell)
    assert programs(cell) == [1, 1]
    assert np.abs(after - before).max() > 0.005
    assert rests(cell)
    with pytest.raises(CellFaulted, match="without stopping"):
        stream(cell)


def _send(file, *, system):
    points = PointStream(file, profile_for(5.0), system=system)
    points.run(points.thin(swing(points.measured(), duration_s=4.0)))


def test_cancelling_at_any_instant_stops_both_arms_without_a_latch(cell):
    rng = random.Random(5)
    for _ in range(scaled(60)):
        points = stream(cell)
        home = points.measured()
        path, at_s = points.thin(swing(home, size_rad=rng.choice([0.1, -0.1]))), rng.uniform(0.0, 3.0)
        begin_s, state = cell.now_s, {}
        ended = points.run(path, canceled=lambda begin_s=begin_s, at_s=at_s: cell.now_s > begin_s + at_s)
        points.close()
        assert ended == (at_s > 2.9) or not ended, state
        assert programs(cell) == [1, 1]
        assert rests(cell)
        assert not cell.fault


def test_a_cancel_whose_effect_is_not_seen_is_latched(cell):
    points = stream(cell)
    path = points.thin(swing(points.measured(), duration_s=4.0))
    until_s = cell.now_s + 2.0

    def canceled():
        if cell.now_s < until_s:
            return False
        cell.ask("link", arm="left", port="rtde", mute=True)
        return True

    with points, pytest.raises(CellFaulted, match="left: it did not report the end of its program"):
        points.run(path, canceled=canceled)
    cell.ask("heal", arm="left")
    assert rests(cell)  # the dashboard has stopped it
    assert cell.fault.startswith("left: it did not report")


def mark(cell):
    """Return what the locks note of motion."""
    folder = cell.system.state_folder()
    return [path.read_text().split()[1:2] for path in sorted(folder.glob("lock-*"))]


def test_the_mark_of_moving_arms_stays_where_a_stop_cannot_be_latched(cell, monkeypatch, caplog):
    def full(self, text):
        raise OSError(28, "No space left on device")

    with monkeypatch.context() as patch:
        patch.setattr(Latch, "set", full)
        with pytest.raises(CellFaulted, match="PROTECTIVE_STOP"):
            follow(cell, 1.2, protective(cell))
        assert "cannot be latched: [Errno 28]" in caplog.text
        assert mark(cell) == [["moving"]] * 2
        with pytest.raises(OSError, match="No space"):
            stream(cell)
    assert mark(cell) == [["moving"]] * 2
    with pytest.raises(CellFaulted, match="without stopping"):
        stream(cell)


def guide(cell, at_s, act):
    """Guide both arms, and do something at once."""
    with HandGuiding(cell.file, system=cell.system) as guiding:
        guiding.run(act)


@pytest.mark.parametrize("moves", [follow, guide])
def test_the_mark_of_moving_arms_stays_after_a_second_interrupt(cell, monkeypatch, moves):
    def interrupt(*_):
        raise KeyboardInterrupt

    monkeypatch.setattr(program_link, "stop_programs", interrupt)
    with pytest.raises(KeyboardInterrupt):
        moves(cell, 1.2, interrupt)
    assert mark(cell) == [["moving"]] * 2
    cell.clock.sleep(SILENCE_S)
    for arm in ARMS:
        cell.ask("push", arm=arm, wrench=[0.0, 0.0, 19.0, 0.0, 0.0, 0.0], seconds=2.0)
    assert rests(cell)  # their programs starve, and freedrive ends
    with pytest.raises(CellFaulted, match="without stopping"):
        stream(cell)


def test_arms_that_were_seen_to_stop_leave_no_mark(cell):
    follow(cell, duration_s=1.0)
    assert mark(cell) == [[]] * 2


def test_delays_within_half_an_interval_cost_nothing(cell):
    for arm in ARMS:
        cell.ask("link", arm=arm, port="rtde", delay_s=0.03, jitter_s=0.02)
    path, _ = follow(cell, rate_hz=5.0)
    np.testing.assert_allclose(joints(cell), path.q_rad[-1], atol=1e-4)


def test_a_rate_that_is_too_high_for_the_link_is_refused(cell):
    cell.ask("link", arm="right", port="rtde", delay_s=0.03)
    with pytest.raises(StartError, match="right: a round trip took"):
        stream(cell, 10.0)
    stream(cell, 5.0).close()


# The program on the controller trusts no sender.


@pytest.fixture
def arm(cell):
    points = stream(cell)
    arm = points._arms[0]
    arm.home = points.measured()[0]
    arm.upload(points_script(7, profile_for(5.0).servoj, 1.0), 7)
    arm.values["last"] = 9
    yield arm
    stop_programs([arm], cell.clock)
    points.close()


def begin(arm):
    for number in (1, 2):
        arm.put(number, arm.home, np.zeros(6), 0.5 * (number - 1))
        arm.wait(lambda state, seen, number=number: seen == number, "a point")
    arm.values["command"] = ProgramCommand.RUN
    arm.send()


@pytest.mark.parametrize(
    ("number", "size_rad", "state"),
    [(3, 0.6, State.JUMP), (4, 0.1, State.GAP), (3, 0.1, State.STARVED)],
)
def test_wrong_points_end_the_program(cell, arm, number, size_rad, state):
    begin(arm)
    cell.clock.sleep(0.2)
    arm.put(number, arm.home + size_rad, np.zeros(6), 0.7)
    arm.wait(lambda found, seen: found == state, "to stop")
    assert state in REASONS
    assert rests(cell)
    assert np.abs(joints(cell)[0] - arm.home).max() < 0.3


@pytest.mark.parametrize("rate_hz", [5.0, 2.0])
def test_a_program_that_is_never_started_ends(cell, arm, rate_hz):
    servoj = profile_for(rate_hz).servoj
    script = points_script(8, servoj, 1.0) if rate_hz > 2.0 else moves_script(8, servoj, 1.0, 0.5)
    arm.upload(script, 8)
    cell.clock.sleep(WAIT_S - 1.0)
    arm.wait(lambda found, seen: found == State.WAITING, "to wait")
    cell.clock.sleep(1.5)
    arm.wait(lambda found, seen: found == State.STARVED, "to end")
    assert programs(cell)[0] == 1


def test_a_first_point_elsewhere_ends_the_program(cell, arm):
    arm.put(1, arm.home + 0.02, np.zeros(6), 0.0)
    arm.wait(lambda state, seen: state == State.START, "to stop")
    assert rests(cell)


def test_registers_of_an_earlier_sender_have_no_effect(cell, arm):
    arm.token = 6
    begin_s = cell.now_s
    arm.put(1, arm.home + 0.02, np.zeros(6), 0.0)
    while cell.now_s < begin_s + 0.3:
        cell.clock.sleep(0.05)
        arm.poll()
    assert arm.link.latest.values[STATE] == State.WAITING
    arm.token = 7


# Refusals: nothing moves.


def refused(cell, error, words, *, path=None, **options):
    points = stream(cell, **options)
    home = points.measured()
    try:
        with pytest.raises(error, match=words):
            points.run(points.thin(swing(home)) if path is None else path(points, home))
    finally:
        points.close()
    for name in ARMS:
        assert cell.setpoints(name) == []
    assert not cell.fault
    np.testing.assert_allclose(joints(cell), home, atol=1e-6)


def _into_the_table(home):
    s = np.linspace(0.0, 1.0, 1000)
    smooth = s**3 * (10 + s * (6 * s - 15))
    goal = home.copy()
    goal[:, 1] += 1.2
    return home + smooth[:, None, None] * (goal - home)


@pytest.mark.parametrize(
    ("error", "words", "options"),
    [
        (TrajectoryError, "joint", {"path": lambda points, home: points.thin(swing(home + 0.002))}),
        (TrajectoryError, "joint speed", {"limits": MotionLimits(speed_rad_s=0.1)}),
        (TrajectoryError, "distance", {"path": lambda points, home: points.thin(_into_the_table(home))}),
        (TrajectoryError, "every", {"path": lambda points, home: PointPath.of_targets(swing(home), TICK_S, 0.1)}),
        (StartError, "not confirmed", {"confirm": lambda question: False}),
        (StartError, "not confirmed", {"confirm": lambda question: "no"}),  # as of `confirm=input`
    ],
)
def test_what_cannot_be_followed_is_refused_and_moves_nothing(cell, error, words, options):
    refused(cell, error, words, **options)


def test_a_slider_below_100_percent_is_refused(cell):
    points = stream(cell)
    path = points.thin(swing(points.measured()))
    cell.ask("override", arm="left", target_speed_fraction=0.9)
    with pytest.raises(StartError, match="scaled to 90 %"):
        points.run(path)
    points.close()


def test_arms_that_are_not_ready_any_more_after_the_answer_do_not_begin(cell):
    def slow_down(question):
        cell.ask("override", arm="left", target_speed_fraction=0.9)
        return True

    points = stream(cell, confirm=slow_down)
    with points, pytest.raises(StartError, match="scaled to 90 %"):
        points.run(points.thin(swing(points.measured())))
    assert Latch(cell.file, cell.system).read() is None


def test_a_trajectory_without_an_end_has_no_points(cell):
    here = joints(cell)
    endless = JointTrajectory(ARMS, np.array([0.0, 1e12]), np.stack([here, here]))
    with stream(cell) as points, pytest.raises(TrajectoryError, match=r"the last point is 1e\+12 s ahead, allowed are"):
        points.points_of(endless, here)


def test_direct_targets_are_not_its_business(cell):
    with pytest.raises(StartError, match="runner"):
        stream(cell, 125.0)
