"""What `ur_rtde` prints, in the words of this package."""

import logging

import pytest

from dual_ur10.sim2real.runtime.arm_process import UrRtdeOutput

NOT_RUNNING = "RTDEControlInterface: RTDE control script is not running!"
KILLED = """\
RTDEControlInterface: Could not receive data from robot...
RTDEControlInterface Exception: Connection reset by peer
Reconnecting...
RTDEControlInterface: Robot is disconnected, reconnecting...
RTDEControlInterface Exception: open: Too many open files"""


def passed(lines, capsys, caplog):
    """Return what is logged, and what goes to standard error."""
    output = UrRtdeOutput("left")
    with caplog.at_level(logging.INFO):
        for line in lines:
            output(line)
    return [each.getMessage() for each in caplog.records], capsys.readouterr().err.splitlines()


def test_each_fact_is_logged_once(capsys, caplog):
    logged, printed = passed([NOT_RUNNING] * 3, capsys, caplog)
    assert logged == ["left, ur_rtde: its control script no longer runs"]
    assert printed == []


def test_the_end_of_a_controller(capsys, caplog):
    logged, printed = passed(KILLED.splitlines(), capsys, caplog)
    assert [each.partition(": ")[2][:35] for each in logged] == [
        "it receives no data",
        "Connection reset by peer",
        "it wanted to connect again, which it must not"[:35],
    ]
    assert printed == []


def test_the_exception_on_the_line_after_a_lost_connection_belongs_to_it(capsys, caplog):
    lines = ["RTDEControlInterface: Lost connection to robot...", "write_some: Broken pipe", "write_some: Broken pipe"]
    logged, printed = passed(lines, capsys, caplog)
    assert logged == ["left, ur_rtde: it has lost the controller", "left, ur_rtde: write_some: Broken pipe"]
    assert printed == ["write_some: Broken pipe"]


@pytest.mark.parametrize(
    "line", ["", "Traceback (most recent call last):", "RTDEControlInterface: Successfully reconnected!", "ü\ufffd"]
)
def test_everything_else_passes_on(capsys, caplog, line):
    assert passed([line, line], capsys, caplog) == ([], [line, line])


@pytest.mark.parametrize("stream", [None, "closed"])
def test_nobody_may_be_there_to_read_it(monkeypatch, tmp_path, stream):
    if stream is not None:
        with (tmp_path / "out").open("w") as stream:
            pass
    monkeypatch.setattr("sys.stderr", stream)
    UrRtdeOutput("left")("unknown")
