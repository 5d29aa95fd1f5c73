"""Tests on a busy machine are tried again, but never what was sent to an arm that must not be."""

import math

import pytest

from tests import busy_machine

pytest_plugins = ["pytester"]

CONFTEST = """
import pytest
from tests.busy_machine import BusyMachine

def pytest_configure(config):
    config.pluginmanager.register(BusyMachine())

def pytest_itemcollected(item):
    item.add_marker(BusyMachine.mark())

class Lab:
    tries = 0  # of all labs

    def __init__(self):
        self.starved, self.latch = 0, self

    def busy(self):
        return self.starved

    def read(self):
        return None

    def audit(self):
        if UNSAFE:
            raise ViolationError("too fast")

class ViolationError(AssertionError):
    pass

@pytest.fixture
def lab(tmp_path):
    assert not list(tmp_path.iterdir())
    (tmp_path / "a run").touch()
    Lab.tries += 1
    return Lab()
"""


STILL = """
def fail_once():
    if Lab.tries == 1:
        time.sleep(0.05)
        ctypes.PyDLL(None).usleep(200_000)  # which holds up all threads
        raise AssertionError
"""


@pytest.fixture
def outcomes(pytester, monkeypatch):
    monkeypatch.setattr(busy_machine, "_REST_S", 0.0)

    def run(code, unsafe=False, still_s=math.inf):  # however busy this machine is
        monkeypatch.setattr(busy_machine, "_STILL_S", still_s)
        pytester.makeini("[pytest]")  # that of no folder above
        pytester.makeconftest(CONFTEST.replace("UNSAFE", str(unsafe)))
        pytester.makepyfile(f"import ctypes, pytest, time\nfrom conftest import Lab, ViolationError\n\n{code}")
        found = pytester.runpytest_inprocess("-p", "no:cacheprovider", "-p", "no:xdist").parseoutcomes()
        return {word.rstrip("s"): count for word, count in found.items() if "warning" not in word}

    return run


def test_what_fails_once_because_arms_were_starved_is_tried_again_with_fixtures_made_anew(outcomes):
    code = """
def test(lab):
    assert lab.starved == 0
    lab.starved += Lab.tries == 1
    assert not lab.starved
"""
    assert outcomes(code) == {"passed": 1, "rerun": 1}


def test_what_fails_once_while_the_machine_stands_still_is_tried_again(outcomes):
    code = """
def test(lab):
    fail_once()
"""
    assert outcomes(STILL + code, still_s=busy_machine._STILL_S) == {"passed": 1, "rerun": 1}


def test_fixtures_that_fail_once_while_the_machine_stands_still_are_made_again(outcomes):
    code = """
@pytest.fixture
def made(lab):
    fail_once()

def test(made):
    pass
"""
    assert outcomes(STILL + code, still_s=busy_machine._STILL_S) == {"passed": 1, "rerun": 1}


def test_what_an_error_says_is_believed(outcomes):
    assert outcomes("def test(lab):\n  assert Lab.tries == 2, 'its RTDE stood still'") == {"passed": 1, "rerun": 1}


def test_what_always_fails_fails(outcomes):
    assert outcomes("def test(lab):\n  assert False, 'its RTDE stood still'") == {"failed": 1, "rerun": 7}


def test_what_fails_for_another_reason_is_not_tried_again(outcomes):
    assert outcomes("def test(lab):\n  assert Lab.tries == 2") == {"failed": 1}


def test_fixtures_that_fail_for_another_reason_are_not_made_again(outcomes):
    code = """
@pytest.fixture
def made(lab):
    assert Lab.tries == 2

def test(lab, made):
    pass
"""
    assert outcomes(code) == {"error": 1}


def test_what_was_not_safe_is_told_at_the_first_time(outcomes):
    assert outcomes("def test(lab):\n  raise ViolationError('sent after it stood still')") == {"failed": 1}


def test_what_was_not_safe_is_told_though_something_else_failed(outcomes):
    assert outcomes("def test(lab):\n  assert False, 'its RTDE stood still'", unsafe=True) == {"failed": 1}
