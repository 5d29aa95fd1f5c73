"""The command `status`, as a user meets it."""

import functools
import re

import pytest
import typer
from typer.testing import CliRunner

from dual_ur10.cli.status import status
from dual_ur10.cli.status_view import StatusView
from dual_ur10.emulated.cell_emulator import write_cell_file
from dual_ur10.sim2real.peripherals.gripper_link import RobotiqLink
from dual_ur10.testing import VirtualCell
from tests import waiting


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    path = tmp_path_factory.mktemp("cell") / "cell.toml"
    with VirtualCell(task="SyncCarry", plant="nominal") as cell:
        write_cell_file(path, cell.description)
        yield cell, path


@pytest.fixture
def cell(made):
    cell, _ = made
    yield cell
    for arm in ("left", "right"):
        cell.ask("heal", arm=arm)


@pytest.fixture
def until(cell):
    return functools.partial(waiting.until, clock=cell.clock)


@pytest.fixture
def show(made, monkeypatch):
    """Function that returns the output of the command, as one text, and its exit code."""
    cell, path = made
    monkeypatch.setattr("dual_ur10.cli.status.LOCAL", cell.system)
    app = typer.Typer()
    app.command()(status)
    monkeypatch.setattr("dual_ur10.cli.status.console._width", 160)

    def run(*arguments, file=path):
        result = CliRunner().invoke(app, ["--cell", str(file), *arguments])
        if result.exception is not None and not isinstance(result.exception, SystemExit):
            raise result.exception
        return re.sub(r"\x1b\[[0-9;]*m", "", result.output), result.exit_code

    return run


def row(text, label):
    """Return the left and the right cell of a row, joined with those of the rows below it without a label."""
    found, inside = [[], []], False
    for line in text.splitlines():
        cells = [each.strip() for each in line.split("│")[1:-1]]
        if len(cells) != 3:
            inside = False
            continue
        inside = cells[0] == label or (inside and not cells[0])
        if inside:
            for column, each in zip(found, cells[1:], strict=True):
                column.append(each)
    return [" ".join(each).strip() for each in found]


def joint(text, name):
    (line,) = (line for line in text.splitlines() if line.split("│")[1:2] and line.split("│")[1].strip() == name)
    return [each.strip() for each in line.split("│")[2:-1]]


def test_both_arms(cell, show):
    cell.ask("slider", arm="right", fraction=0.5)
    cell.ask("input", arm="left", bit=9, on=True)
    cell.ask(
        "override", arm="left", actual_current=[1.25] * 6, joint_temperatures=[41.5] * 6, standard_analog_input1=2.5
    )
    try:
        text, code = show("--once")
    finally:
        cell.ask("slider", arm="right", fraction=1.0)
        cell.ask("input", arm="left", bit=9, on=False)
        cell.ask("override", arm="left", actual_current=None, joint_temperatures=None, standard_analog_input1=None)
    assert code == 0
    assert row(text, "software") == ["3.15.8.106339"] * 2
    assert row(text, "robot mode") == ["7 (RUNNING)"] * 2
    assert row(text, "safety mode") == ["1 (NORMAL)"] * 2
    assert row(text, "could move") == ["yes"] * 2
    assert row(text, "power")[0].startswith("on, 48.0 V, arm 48.0 V")
    assert row(text, "program state") == ["1 (STOPPED)"] * 2
    assert row(text, "program") == ["STOPPED <unnamed>"] * 2
    assert row(text, "speed slider")[0] == "100 %, scaling 100 %"
    assert row(text, "speed slider")[1].startswith("50 %")
    assert row(text, "inputs 0 … 17") == ["00000000 01000000 00", "00000000 00000000 00"]
    assert row(text, "analog")[0].startswith("in 0.000 2.500")
    assert "not activated" in row(text, "gripper")[0]
    assert row(text, "gripper")[0].startswith("85.0 mm")
    values = cell.ask("state", arm="left", names=["actual_q", "actual_TCP_pose"])
    assert joint(text, "elbow")[:4] == [f"{values['actual_q'][2]:.4f}", "1.25", "41.5", "48.0"]
    numbers = [float(each) for each in re.findall(r"-?\d+\.\d+", row(text, "TCP")[0])]
    assert numbers[:3] == pytest.approx(values["actual_TCP_pose"][:3], abs=1e-3)
    assert "lost" not in text


def test_a_stop_is_named(cell, show):
    cell.ask("stop", arm="right", mode=3)
    cell.wait_until("right", "safety_mode", 3)
    text, code = show("--once")
    cell.ask("release", arm="right", mode=3)
    assert row(text, "safety mode") == ["1 (NORMAL)", "3 (PROTECTIVE_STOP)"]
    assert "PROTECTIVE_STOP" in row(text, "could move")[1]
    assert code == 0  # it was shown, which is what was asked for


@pytest.mark.parametrize("fault", ["refuse", "mute"])
def test_a_lost_arm_shows_its_reason_and_the_other_continues(cell, show, fault):
    if fault == "refuse":
        cell.ask("refuse", arm="left", port="all")
    else:
        cell.ask("link", arm="left", port="all", mute=True)
    text, code = show("--once")
    assert code == 1
    lost = row(text, "lost")
    assert "left arm, RTDE at" in lost[0]
    assert lost[1] == ""
    assert row(text, "robot mode") == ["—", "7 (RUNNING)"]
    assert "left arm, dashboard" in row(text, "program")[0]
    assert "left arm, Robotiq gripper" in row(text, "gripper")[0]
    assert row(text, "program")[1] == "STOPPED <unnamed>"


def test_it_ends_after_the_given_seconds(cell, show):
    begin_s = cell.now_s
    text, code = show("--seconds", "0.5")
    assert cell.now_s - begin_s >= 0.5
    assert code == 0
    assert row(text, "robot mode") == ["7 (RUNNING)"] * 2


def test_nothing_is_sent(cell, show):
    before = cell.ask(
        "state", arm="left", names=["robot_mode", "actual_digital_output_bits", "runtime_state", "target_q"]
    )
    text, _ = show("--once")
    assert "not activated" in text
    assert not any(cell.ask("clients", arm="left").values())  # and no client is left
    names = list(before)
    assert cell.ask("state", arm="left", names=names) == before
    link = RobotiqLink(cell.left, 63352, system=cell.system)
    assert link.needs_activation()
    link.close()


def test_a_bad_cell_file(show, tmp_path):
    from dual_ur10.errors import CellFileError

    with pytest.raises(CellFileError, match="no cell file"):
        show(file=tmp_path / "none.toml")


def test_a_silent_arm_is_lost_until_it_sends_again(cell, until):
    watch = StatusView("left", cell.file.left, system=cell.system)
    try:
        watch.wait(5.0)
        assert watch.dead == ""
        cell.ask("link", arm="left", port="rtde", mute=True)
        assert "its time stalls" in until(lambda: watch.dead)
        assert watch.program_fault == ""
        cell.ask("heal", arm="left")
        until(lambda: not watch.dead)
        cell.ask("drop", arm="left", port="rtde")
        assert "left arm, RTDE" in until(lambda: watch.dead)
        cell.clock.sleep(0.2)
        assert watch.dead  # it does not connect again
        until(lambda: cell.ask("clients", arm="left")["rtde"] == [])
        cell.ask("drop", arm="left", port="gripper")
        assert "Robotiq gripper" in until(lambda: watch.gripper_fault)
        assert watch.program.startswith("STOPPED")
    finally:
        watch.close()
        watch.close()


def test_a_fault_of_one_part_is_shown_and_the_others_continue(cell, monkeypatch):
    monkeypatch.setattr("dual_ur10.cli.status_view.ArmStatus.from_sample", lambda sample: 1 / 0)
    watch = StatusView("left", cell.file.left, system=cell.system)
    try:
        watch.wait(5.0)
        assert watch.dead.startswith("ZeroDivisionError")
        assert watch.program.startswith("STOPPED")
        assert watch.gripper is not None
    finally:
        watch.close()
