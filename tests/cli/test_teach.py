"""The command `teach`: options and typed requests; `tests/virtual/test_teaching.py` guides arms."""

import os
from types import SimpleNamespace

import pytest

from dual_ur10.cli import teach
from dual_ur10.sim2real.cell_file.reference import starting_text
from dual_ur10.sim2real.teaching.teaching import TeachKey
from tests.cli.command import run


@pytest.fixture
def lab(tmp_path):
    path = tmp_path / "lab.toml"
    path.write_text(starting_text("emulated", "127.0.0.8", "127.0.0.9"))
    return path


@pytest.mark.parametrize(
    ("name", "options", "text"),
    [
        ("points.csv", ("--arm", "middle"), "'left', 'right'"),
        ("points.csv", ("--continuous", "26"), "more than 0, at most 25"),
        ("points.csv", ("--continuous", "0"), "0.0 Hz: allowed is more than 0, at most 25"),
        ("points.csv", ("--continuous", "nan"), "more than 0, at most 25"),
        ("points.json", (), "suffix must be .csv"),
        ("old.csv", (), "exists: choose another name"),
        ("points.csv", (), "127.0.0.8"),  # no controller is there
    ],
)
def test_nothing_begins_and_nothing_is_left(lab, name, options, text):
    old = lab.with_name("old.csv")
    old.write_text("precious")
    before = sorted(lab.parent.iterdir())
    code, printed = run("teach", str(lab.with_name(name)), "--cell", str(lab), *options)
    assert code == 2
    assert text in " ".join(printed.split())
    assert sorted(lab.parent.iterdir()) == before
    assert old.read_text() == "precious"


def test_lines_are_requests_and_the_end_ends(monkeypatch):
    theirs, ours = os.pipe()
    monkeypatch.setattr(teach.sys, "stdin", SimpleNamespace(fileno=lambda: theirs))
    interrupted = []
    keys = teach._TypedRequests(lambda: bool(interrupted))
    assert keys() is None
    os.write(ours, b"\n\n  Q \n")
    assert [keys() for _ in range(4)] == [TeachKey.RECORD, TeachKey.RECORD, TeachKey.END, None]
    os.write(ours, b"\nrest")
    assert [keys(), keys()] == [TeachKey.RECORD, None]
    interrupted.append(True)
    assert keys() is TeachKey.END
    interrupted.clear()
    os.close(ours)
    assert [keys(), keys()] == [TeachKey.END, TeachKey.END]
    os.close(theirs)
