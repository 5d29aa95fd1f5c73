"""Points taught by a scripted hand on a virtual cell: recorded, followed, and every way in which freedrive ends."""

import numpy as np
import pytest

from dual_ur10.cli import teach as teach_command
from dual_ur10.errors import CellFaulted, StartError, TrajectoryError
from dual_ur10.follower import home_of, make_follower
from dual_ur10.sim2real.cell_file.cell_file import CellFile
from dual_ur10.sim2real.programs.program_link import stop_programs
from dual_ur10.sim2real.programs.stream_script import STATE, ProgramCommand, State
from dual_ur10.sim2real.recording.reader import read_run
from dual_ur10.sim2real.teaching.hand_guiding import SILENCE_S, HandGuiding, freedrive_script
from dual_ur10.sim2real.teaching.teaching import STEP_RAD, TeachKey
from dual_ur10.sim2real.trajectory import TrajectoryGoal, read_trajectory
from dual_ur10.sim2real.trajectory.path_timing import BLEND_RAD, time_path
from dual_ur10.testing import VirtualCell

ARMS = ("left", "right")
FIRM = [0.0, 0.0, 19.0, 0.0, 0.0, 0.0]  # 0.15 m/s
STANDS_S = 0.2
"""Time in which an arm stops after freedrive, and the last sign of life that may still have been on its way."""


def person(cell, *acts):
    """Return the requests of a person who pushes, waits and presses keys, one after the other."""
    acts, until_s = list(acts), 0.0

    def keys():
        nonlocal until_s
        while acts and cell.now_s >= until_s:
            act = acts.pop(0)
            if isinstance(act, TeachKey):
                return act
            if callable(act):
                act()
            else:
                until_s = cell.now_s + act
        return TeachKey.END if cell.now_s >= until_s else None

    return keys


def push(cell, arm, wrench, seconds=0.5):
    return lambda: cell.ask("push", arm=arm, wrench=wrench, seconds=seconds)


def teach(cell, path, *acts, arms=ARMS, rate_hz=None):
    return teach_command.record(cell.file, path, arms, person(cell, *acts), rate_hz, cell.system)


def joints(cell):
    return np.array([cell.ask("state", arm=arm, names=["actual_q"])["actual_q"] for arm in ARMS])


def is_free(cell):
    """Push both arms, and return which of them yield."""
    before = joints(cell)
    for arm in ARMS:
        push(cell, arm, FIRM, 0.2)()
    cell.clock.sleep(0.4)
    return (np.abs(joints(cell) - before).max(axis=1) > 1e-3).tolist()


def follow(cell, path):
    """Follow a file as `follow --retime` does; return the trajectory and the measured positions on it."""
    taught = read_trajectory(path)
    passed = []
    with make_follower(cell, arm=taught.arms[0] if len(taught.arms) == 1 else None) as executor:
        rows = [ARMS.index(arm) for arm in taught.arms]
        start = home_of(cell)
        start[rows] = taught.q_rad[0]
        executor.start(start)
        points = np.repeat(executor.desired_q_rad[None], len(taught), axis=0)
        points[:, rows] = taught.q_rad
        timed = time_path(points, executor.gate, executor.law, arms=taught.arms)
        result = executor.execute(TrajectoryGoal(timed)).wait(lambda seen: passed.append(seen.actual_q_rad))
    assert result.succeeded, result.text
    return taught, np.array(passed)


def off(taught, passed):
    """Return the largest distance of a taught point from the nearest measured one, rad."""
    return np.abs(taught.q_rad[:, None] - passed[None]).max(axis=(2, 3)).min(axis=1).max()


def three_points(cell):
    """Return acts of a person who teaches three points; the right arm moves once."""
    return (
        *(0.3, TeachKey.RECORD, push(cell, "left", [0.0, 12.0, 10.0, 0.0, 0.0, 0.5])),
        *(push(cell, "right", [0.0, -12.0, 9.0, 0.0, 0.0, 0.0]), 1.2, TeachKey.RECORD),
        *(push(cell, "left", [8.0, 0.0, 12.0, 0.0, 0.0, 0.0]), 1.2, TeachKey.RECORD, TeachKey.END),
    )


@pytest.mark.parametrize("family", ["cb3", "e-series"])
def test_taught_points_are_followed(family, tmp_path, capsys):
    path = tmp_path / "points.csv"
    with VirtualCell(plant="nominal", family=family) as cell:
        home = joints(cell)
        assert teach(cell, path, *three_points(cell)) == (3, 0)
        assert "point 3 is in" in capsys.readouterr().out
        taught = read_trajectory(path)
        assert taught.arms == ARMS
        np.testing.assert_allclose(taught.q_rad[0], home, atol=1e-6)
        np.testing.assert_allclose(taught.q_rad[2], joints(cell), atol=1e-6)
        moved = np.abs(np.diff(taught.q_rad, axis=0)).max(axis=2)
        assert (moved[0] > 0.02).all()
        assert moved[1, 0] > 0.02
        assert moved[1, 1] < 1e-4
        assert is_free(cell) == [False, False]
        if family == "cb3":
            taught, passed = follow(cell, path)
            assert off(taught, passed) < BLEND_RAD
            np.testing.assert_allclose(passed[-1], taught.q_rad[-1], atol=1e-4)
        assert not cell.fault


def test_a_path_recorded_while_guiding_is_followed(cell, tmp_path):
    path = tmp_path / "path.csv"
    acts = (0.3, push(cell, "left", [0.0, 15.0, 10.0, 0.0, 0.0, 0.0], 1.0), 0.6)
    acts += (push(cell, "left", [12.0, 0.0, 10.0, 0.0, 0.6, 0.0], 0.8), 1.5, TeachKey.END)
    count, refused = teach(cell, path, *acts, rate_hz=10.0)
    assert refused == 0
    taught = read_trajectory(path)
    assert 10 < count == len(taught) <= 16
    assert taught.qd_rad_s is None
    assert np.abs(np.diff(taught.q_rad, axis=0)).max(axis=(1, 2)).min() >= STEP_RAD
    np.testing.assert_allclose(taught.q_rad[-1], joints(cell), atol=STEP_RAD)
    steps = np.diff(taught.time_s)
    assert steps[steps < 0.15].mean() == pytest.approx(0.1, abs=0.01)
    taught, passed = follow(cell, path)
    assert off(taught, passed) < BLEND_RAD


def test_one_arm_is_guided_and_the_other_stands(cell, tmp_path):
    path = tmp_path / "points.csv"
    right = joints(cell)[1]
    acts = three_points(cell)
    assert teach(cell, path, *acts, arms=("left",)) == (3, 0)
    taught, passed = follow(cell, path)
    assert taught.arms == ("left",)
    assert off(taught, passed) < BLEND_RAD
    np.testing.assert_allclose(joints(cell)[1], right, atol=1e-4)


@pytest.mark.parametrize(
    ("acts", "words"),
    [
        (lambda cell: (push(cell, "left", FIRM, 2.0), 0.5, TeachKey.RECORD, 2.0), "Hold them still"),
        (lambda cell: (TeachKey.RECORD,), "Hold them still"),  # too few states yet
        (lambda cell: (0.3, TeachKey.RECORD, 0.3, TeachKey.RECORD), "no joint is 5 mrad from the point before"),
    ],
)
def test_points_are_refused(cell, tmp_path, capsys, acts, words):
    count, _ = teach(cell, tmp_path / "points.csv", *acts(cell))
    assert words in capsys.readouterr().out
    assert count == (1 if "before" in words else 0)
    assert (tmp_path / "points.csv").exists() == (count > 0)


def test_points_that_follow_would_refuse_are_warned_of_and_refused(tmp_path, capsys):
    wall = {"kind": "box", "name": "wall", "position_m": [0.0, 0.0, 0.0], "size_m": [0.1, 0.1, 0.1]}
    with VirtualCell(plant="nominal") as cell:
        flange = cell.ask("pose", body="left/wrist_3_link")["position_m"]
        wall["position_m"] = [flange[0] + 0.18, flange[1], flange[2]]
        file = CellFile.read({**cell.description, "obstacle": [wall]}, "the virtual cell")
        acts = (0.3, TeachKey.RECORD, push(cell, "left", [-14.0, 0.0, 0.0, 0.0, 0.0, 0.0], 1.0), 1.5, TeachKey.RECORD)
        found = teach_command.record(file, tmp_path / "a.csv", ARMS, person(cell, *acts), None, cell.system)
        text = capsys.readouterr().out
        assert found == (1, 0)
        assert "note: left/wrist_3_link and obstacle/wall are" in text
        assert "`follow` would refuse this point" in text
        acts = (0.3, push(cell, "left", [0.0, 10.0, 0.0, 0.0, 0.0, 0.0], 0.6), 1.5, TeachKey.END)
        count, refused = teach_command.record(file, tmp_path / "b.csv", ARMS, person(cell, *acts), 20.0, cell.system)
        assert 0 < refused <= count


@pytest.mark.parametrize("answer", [False, None, "no"])  # the last as of `confirm=input`
def test_nobody_confirms(cell, answer):
    asked = []
    guiding = HandGuiding(cell.file, confirm=lambda text: asked.append(text) or answer, system=cell.system)
    with guiding, pytest.raises(StartError, match="not confirmed"):
        guiding.run(lambda guided: False)
    assert "left 0.00 kg at (0, 0, 0) mm" in asked[0]
    assert is_free(cell) == [False, False]
    assert not cell.fault


def test_another_payload_than_in_the_cell_file_is_refused(tmp_path):
    with VirtualCell(plant="nominal") as cell:
        right = {**cell.description["right"], "payload_kg": 1.5}
        file = CellFile.read({**cell.description, "right": right}, "the virtual cell")
        with pytest.raises(StartError, match=r"right, payload: 0.000 kg"):
            HandGuiding(file, system=cell.system)


# Ways in which freedrive ends.


def end(cell, fault):
    """Guide both arms, let something happen, and return what ended it."""
    with HandGuiding(cell.file, system=cell.system) as guiding, pytest.raises(CellFaulted) as found:
        guiding.run(person_until(cell, fault))
    return str(found.value)


def person_until(cell, fault):
    keys = person(cell, 0.5, fault, 5.0)
    return lambda guided: keys() is not TeachKey.END


def fast(cell):
    for arm, force in (("left", [0.0, 0.0, 20.0]), ("right", [0.0, 0.0, 80.0])):
        cell.ask("push", arm=arm, wrench=[*force, 0.0, 0.0, 0.0], seconds=2.0)


@pytest.mark.parametrize(
    ("fault", "words"),
    [
        (lambda cell: cell.ask("stop", arm="left", mode=3), "left: safety mode 3 (PROTECTIVE_STOP)"),
        (lambda cell: cell.ask("stop", arm="right", mode=7), "right: safety mode 7 (ROBOT_EMERGENCY_STOP)"),
        (lambda cell: cell.ask("press", arm="left", button="pause"), "left: program state"),
        (lambda cell: cell.ask("press", arm="right", button="stop"), "right: program state"),
        (lambda cell: cell.ask("drop", arm="right", port="rtde"), "right"),
        (lambda cell: cell.ask("link", arm="left", port="rtde", mute=True), "left: its controller has fallen silent"),
        (lambda cell: cell.ask("override", arm="left", robot_status_bits=7), "freedrive button pressed"),
        (fast, "right: it moves at"),
        (lambda cell: cell.clock.sleep(SILENCE_S + 0.1), "no sign of life came for 0.5 s"),
    ],
)
def test_a_fault_of_either_arm_ends_freedrive_of_both(cell, fault, words):
    assert words in end(cell, lambda: fault(cell))
    cell.ask("heal", arm="left")
    assert is_free(cell) == [False, False]
    assert words in cell.fault
    with pytest.raises(CellFaulted, match=r"\.clear\(\)"):
        HandGuiding(cell.file, system=cell.system)


def test_a_fault_leaves_a_black_box_and_the_points_before(cell, tmp_path):
    path = tmp_path / "points.csv"
    acts = (0.3, TeachKey.RECORD, push(cell, "left", FIRM), 0.3, lambda: cell.ask("stop", arm="right", mode=3), 5.0)
    with pytest.raises(CellFaulted):
        teach(cell, path, *acts)
    assert len(read_trajectory(path)) == 1
    (box,) = (cell.system.state_folder() / "black_boxes").glob("*.mcap")
    run = read_run(box)
    assert run.header.env_id == "hand guiding"
    assert run.events[-1].text == cell.fault
    left, right = (each.state for each in run.arms)
    assert np.abs(left["q_rad"][-1] - left["q_rad"][0]).max() > 0.01
    assert right["safety_mode"][-1] == 3


def test_the_other_arm_must_stand(cell):
    guiding = HandGuiding(cell.file, ["left"], system=cell.system)
    with guiding, pytest.raises(CellFaulted, match="right: it moves, and is not the arm that is guided"):
        guiding.run(person_until(cell, lambda: cell.ask("override", arm="right", actual_qd=[0.1] * 6)))


def test_a_full_disk_ends_freedrive_in_order(cell):
    def full(guided):
        raise TrajectoryError("no room")

    with HandGuiding(cell.file, system=cell.system) as guiding, pytest.raises(TrajectoryError):
        guiding.run(full)
    assert is_free(cell) == [False, False]
    assert not cell.fault


def _guide(file, *, system):
    HandGuiding(file, system=system).run(lambda guided: True)


def test_arms_become_stiff_when_the_teacher_is_killed(cell):
    other = cell.system.spawn(_guide, cell.file)
    cell.clock.sleep(2.0)
    assert is_free(cell) == [True, True]
    other.kill()
    killed_s = cell.now_s
    for arm in ARMS:
        push(cell, arm, FIRM, 2.0)()
    cell.clock.sleep(SILENCE_S - 0.1)
    assert [cell.ask("state", arm=arm, names=["runtime_state"])["runtime_state"] for arm in ARMS] == [2, 2]
    cell.clock.sleep(0.1 + STANDS_S)
    before = joints(cell)
    assert cell.now_s - killed_s == pytest.approx(SILENCE_S + STANDS_S)
    cell.clock.sleep(0.5)
    np.testing.assert_allclose(joints(cell), before, atol=2e-4)
    assert [cell.ask("state", arm=arm, names=["runtime_state"])["runtime_state"] for arm in ARMS] == [1, 1]
    with pytest.raises(CellFaulted, match="without stopping"):
        HandGuiding(cell.file, system=cell.system)


def test_an_earlier_client_makes_no_arm_free(cell):
    """Neither its signs of life nor its command count for the next program."""
    with HandGuiding(cell.file, system=cell.system) as guiding:
        (arm, _) = guiding._arms
        arm.upload(freedrive_script(7, "cb3"), 7)
        arm.token = 6
        arm.values["command"] = ProgramCommand.RUN
        arm.send()
        cell.clock.sleep(0.2)
        arm.poll()
        assert arm.link.latest.values[STATE] == State.WAITING
        arm.token = 7
        stop_programs([arm], cell.clock)
