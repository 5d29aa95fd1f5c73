"""The command `follow`, in simulation: what it prints, writes and returns."""

import csv
import re

import numpy as np
import pytest

from dual_ur10 import follower
from dual_ur10.assets.settings import HOME_Q_RAD
from dual_ur10.cli import follow
from dual_ur10.sim2real.serial_arm.firmware import SerialFirmware
from dual_ur10.sim2real.trajectory.files import write_trajectory
from dual_ur10.sim2real.trajectory.joint_trajectory import JointTrajectory
from tests.busy_machine import BusyMachine
from tests.cli.command import run
from tests.sim2real.serial_rig import serial_port, trajectory
from tests.sim2real.trajectory.following import wave
from ur_core.kinematics.ur10 import ARMS, JOINTS


@pytest.fixture
def file(tmp_path):
    return str(write_trajectory(tmp_path / "wave.json", wave(1.0, start=HOME_Q_RAD + 0.1)))


def test_a_file_is_followed_and_its_errors_are_shown(file, tmp_path):
    record = tmp_path / "found.csv"
    code, text = run("follow", file, "--record", str(record))
    assert code == 0
    assert "succeeded, SUCCESSFUL (0), after 1." in text
    rows = [line.split("│")[1:-1] for line in text.splitlines() if line.startswith("│")]
    assert [row[0].strip() for row in rows] == ["left", "right"]
    assert all(float(row[1]) < 0.05 and float(row[4]) < 0.05 for row in rows)
    with record.open() as table:
        found = list(csv.DictReader(table))
    assert len(found) > 60
    assert float(found[-1]["left/elbow_joint.desired_rad"]) == pytest.approx(HOME_Q_RAD[0, 2] + 0.1 - 0.15)
    assert float(found[-1]["left/elbow_joint.actual_rad"]) == pytest.approx(HOME_Q_RAD[0, 2] - 0.05, abs=1e-4)
    code, text = run("follow", file, "--record", str(record))
    assert code == 2
    assert "exists" in text


def test_a_smaller_scaling_takes_longer(file):
    code, text = run("follow", file, "--scaling", "0.5")
    assert code == 0
    assert "after 2." in text


def test_a_violated_tolerance_has_a_code(file):
    code, text = run("follow", file, "--perturbed", "--path-tolerance", "0.0001")
    assert code == follow.NOT_REACHED
    assert "aborted, PATH_TOLERANCE_VIOLATED (-4)" in text


def test_a_path_through_the_table_is_rejected(tmp_path):
    down = np.stack([HOME_Q_RAD, HOME_Q_RAD])
    down[1, 0, 1] += 0.6
    deep = JointTrajectory(("left", "right"), [0.0, 4.0], down, np.zeros((2, 2, 6)))
    code, text = run("follow", str(write_trajectory(tmp_path / "deep.csv", deep)))
    assert code == follow.NOT_REACHED
    assert "rejected, INVALID_GOAL (-1)" in text
    assert "between points" in text


def test_an_interrupt_stops_both_arms_on_the_path(file, monkeypatch):
    shown = []

    def interrupt(self, feedback):
        shown.append(feedback.path_s)
        if len(shown) == 30:
            raise KeyboardInterrupt

    monkeypatch.setattr(follow._FeedbackPrinter, "__call__", interrupt)
    code, text = run("follow", file)
    assert code == 130
    assert "interrupted: both arms stop on the path" in text
    assert "preempted, SUCCESSFUL (0)" in text
    assert len(shown) > 30
    assert 0.0 < shown[-1] < 1.0


@pytest.mark.parametrize(
    ("arguments", "text"),
    [
        (("nothing.json",), "there is no file"),
        (("FILE", "--scaling", "2"), "the scaling is 2.0: allowed are 0.01 to 1"),
        (("FILE", "--path-tolerance", "-1"), "path_tolerance_rad of left/shoulder_pan_joint is -1"),
        (("FILE", "--perturbed", "--cell", "lab.toml"), "--perturbed is for simulation"),
        (("FILE", "--cell", "lab.toml"), "there is no cell file lab.toml"),
        ((), "there is nothing to follow: name a FILE, a configuration with --to, or both"),
        (("--to", "home", "--retime"), "--retime and --duration are for the points of a FILE"),
        (("--to", "somewhere"), "'somewhere' is no configuration: it must be home, 12 joint angles"),
        (("--to", "left:0,1,2"), "'left:0,1,2' is no configuration"),
        (("--to", "left:0,0.5,0,0,0,0"), "in the goal left/"),
        (("FILE", "--duration", "0.2"), "duration_s is 0.2: the motion along the path takes 0."),
    ],
)
def test_a_bad_argument_is_one_line_and_exit_code_2(file, arguments, text):
    code, found = run("follow", *(file if each == "FILE" else each for each in arguments))
    assert code == 2
    assert found.startswith("error: ")
    assert text in found


def test_one_arm_alone_moves(tmp_path):
    path = write_trajectory(tmp_path / "one.csv", wave(1.0, arms=("right",)))
    code, text = run("follow", str(path))
    assert code == 0
    assert [line.split("│")[1].strip() for line in text.splitlines() if line.startswith("│")] == ["right"]


def test_both_arms_are_asked_for_where_the_file_and_the_end_name_one_each(tmp_path, monkeypatch):
    path = write_trajectory(tmp_path / "one.csv", wave(1.0, arms=("right",)))
    asked, make = [], follower.make_follower
    monkeypatch.setattr(follower, "make_follower", lambda cell, arm: asked.append(arm) or make(cell, arm=arm))
    table = tmp_path / "table.csv"
    there = ",".join(f"{each:.3f}" for each in HOME_Q_RAD[0] + 0.05)
    code, text = run("follow", str(path), "--to", f"left:{there}", "--record", str(table))
    assert code == 0, text
    assert asked == [None]
    rows = list(csv.DictReader(table.read_text().splitlines()))
    assert {bool(row["left/elbow_joint.actual_rad"]) for row in rows} == {True, False}
    for arm in ARMS:
        assert all(bool(row[f"{arm}/flange.error_m"]) == bool(row[f"{arm}/elbow_joint.actual_rad"]) for row in rows)


def test_a_dry_run_has_no_errors(file):
    code, text = run("follow", file, "--cell", "echo")
    assert code == 0
    assert "succeeded, SUCCESSFUL (0)" in text


@BusyMachine.mark()  # it streams to a pseudo-terminal in real time
def test_arms_on_a_serial_line_follow_and_say_that_nothing_measures_them(tmp_path):
    there = str(write_trajectory(tmp_path / "there.csv", trajectory(duration_s=0.3, size_rad=0.05)))
    with serial_port(SerialFirmware(device=77)) as port:
        code, text = run("follow-serial", there, "--port", port)
        assert code == follow.NOT_REACHED
        assert "rejected, INVALID_GOAL (-1)" in text
        assert "--at-start" in text
        code, text = run("follow-serial", there, "--port", port, "--at-start", "--scaling", "0.5")
    assert code == 0, text
    assert "succeeded, SUCCESSFUL (0)" in text
    assert "nothing measures" in text


@pytest.mark.parametrize(
    ("command", "options", "words"),
    [
        ("follow-serial", ["FILE", "--at-start"], "Missing option '--port'"),
        ("follow-serial", ["--port", "/dev/none"], "Missing argument 'FILE'"),
        ("follow-serial", ["FILE", "--port", "/dev/none", "--scaling", "2"], "scaling is 2"),
        ("follow-serial", ["FILE", "--port", "/dev/none", "--cell", "echo"], "No such option: --cell"),
        ("follow-serial", ["FILE", "--port", "/dev/none", "--rate", "10"], "No such option: --rate"),
        (
            "follow-serial",
            ["FILE", "--port", "/dev/none", "--goal-tolerance", "0.1"],
            "No such option: --goal-tolerance",
        ),
        ("follow-points", ["FILE", "--rate", "10"], "Missing option '--cell'"),
        ("follow-points", ["FILE", "--cell", "lab.toml"], "Missing option '--rate'"),
        ("follow-points", ["--cell", "lab.toml", "--rate", "10"], "Missing argument 'FILE'"),
        ("follow-points", ["FILE", "--cell", "lab.toml", "--rate", "10"], "there is no cell file lab.toml"),
        ("follow-points", ["FILE", "--cell", "a", "--rate", "10", "--scaling", "0.5"], "No such option: --scaling"),
        ("follow-points", ["FILE", "--cell", "a", "--rate", "10", "--path-tolerance", "1"], "No such option"),
        ("follow", ["FILE", "--rate", "10"], "No such option: --rate"),
        ("follow", ["FILE", "--port", "/dev/none"], "No such option: --port"),
    ],
)
def test_each_command_has_only_options_that_it_checks(file, command, options, words):
    code, text = run(command, *(file if each == "FILE" else each for each in options))
    assert code == 2
    assert words in text


# Planning and timing.


def printed_results(text):
    return [line for line in text.splitlines() if line.startswith("succeeded")]


def test_the_arms_move_around_to_a_configuration(tmp_path):
    record = tmp_path / "found.csv"
    goal = np.array(HOME_Q_RAD)
    goal[0, 0] -= 1.9
    text = ",".join(map(str, goal.ravel()))
    code, found = run("follow", "--to", text, "--record", str(record))
    assert code == 0, found
    assert len(printed_results(found)) == 1
    with record.open() as table:
        rows = list(csv.DictReader(table))
    assert float(rows[-1]["left/shoulder_pan_joint.actual_rad"]) == pytest.approx(goal[0, 0], abs=1e-4)


def test_after_a_file_they_move_on(file, tmp_path):
    code, text = run("follow", file, "--to", "home")
    assert code == 0, text
    assert len(printed_results(text)) == 2
    other = write_trajectory(tmp_path / "one.csv", wave(1.0, arms=("right",), start=HOME_Q_RAD + 0.2))
    code, text = run("follow", "--to", str(other))
    assert code == 0, text
    assert [line.split("│")[1].strip() for line in text.splitlines() if line.startswith("│")] == ["right"]


def test_arms_that_are_there_stay():
    code, text = run("follow", "--to", "home")
    assert (code, text.strip()) == (0, "the arms are there")


@pytest.mark.parametrize("duration_s", [None, 3.0])
def test_points_without_times_are_timed(tmp_path, duration_s):
    path = tmp_path / "points.csv"
    names = [f"{arm}/{joint}" for arm in ("left", "right") for joint in JOINTS]
    rows = [HOME_Q_RAD.ravel() + away for away in (0.0, 0.1, 0.05)]
    path.write_text("".join(f"{','.join(map(str, row))}\n" for row in [names, *rows]))
    code, text = run("follow", str(path))
    assert code == 2
    assert "the first column is 'left/shoulder_pan_joint': it must be time_s" in text
    options = ["--retime"] if duration_s is None else ["--duration", str(duration_s)]
    code, text = run("follow", str(path), *options)
    assert code == 0, text
    (result,) = printed_results(text)
    took_s = float(re.search(r"after (\S+) s", result)[1])
    assert 0.3 < took_s < 1.2 if duration_s is None else took_s == pytest.approx(3.0, abs=0.1)


def test_a_file_that_was_cut_off_is_followed_without_its_last_row(tmp_path):
    q = HOME_Q_RAD + np.array([0.0, 0.05, 0.1]).reshape(3, 1, 1)
    path = write_trajectory(tmp_path / "cut.csv", JointTrajectory(("left", "right"), [0.0, 1.0, 2.0], q))
    path.write_text(path.read_text()[:-3])
    code, text = run("follow", str(path), "--retime")
    assert code == 2
    assert "it may be cut off" in text
    record = tmp_path / "found.csv"
    code, text = run("follow", str(path), "--retime", "--allow-partial", "--record", str(record))
    assert code == 0, text
    with record.open() as table:
        last = list(csv.DictReader(table))[-1]
    assert float(last["right/wrist_3_joint.desired_rad"]) == pytest.approx(q[1, 1, 5])
