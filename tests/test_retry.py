"""Tests on a busy machine are tried again, but never what was sent to an arm that must not be."""

from types import SimpleNamespace

import pytest

from tests.conftest import pytest_pyfunc_call
from tests.faults.wire import ViolationError


class Starved:
    """A lab whose controllers hear too little of us in every try."""

    def __init__(self, unsafe=False):
        self.unsafe, self.tries = unsafe, 0
        self.latch = SimpleNamespace(read=lambda: None)

    def busy(self):
        return self.tries

    def audit(self):
        if self.unsafe:
            raise ViolationError("too fast")

    def mend(self):
        pass


def tried(lab, error, monkeypatch, **others):
    monkeypatch.setattr("time.sleep", lambda seconds: None)

    def test(lab, tmp_path=None):
        if tmp_path is not None:
            assert not list(tmp_path.iterdir())
            (tmp_path / "run").touch()
        lab.tries += 1
        if lab.tries == 1:
            raise error

    values = {"lab": lab, **others}
    item = SimpleNamespace(
        funcargs=values, obj=test, _fixtureinfo=SimpleNamespace(argnames=tuple(values)), path=SimpleNamespace()
    )
    return pytest_pyfunc_call(item)


def test_what_a_busy_machine_spoils_is_tried_again(monkeypatch):
    lab = Starved()
    assert tried(lab, AssertionError("late"), monkeypatch) is True
    assert lab.tries == 2


def test_every_try_has_a_folder_of_its_own(monkeypatch, tmp_path):
    lab = Starved()
    assert tried(lab, AssertionError("late"), monkeypatch, tmp_path=tmp_path) is True
    assert lab.tries == 2


def test_what_was_not_safe_is_told_at_the_first_time(monkeypatch):
    lab = Starved()
    with pytest.raises(ViolationError, match="sent after"):
        tried(lab, ViolationError("sent after the fault"), monkeypatch)
    assert lab.tries == 1


def test_what_was_not_safe_is_told_though_something_else_failed(monkeypatch):
    lab = Starved(unsafe=True)
    with pytest.raises(ViolationError, match="too fast"):
        tried(lab, AssertionError("late"), monkeypatch)
    assert lab.tries == 1
