"""Same conditions wherever the tests run."""

import os
import threading
import time

import pytest

# Workers of pytest-xdist get the width of the terminal; rich takes it when a console is made, at import.
os.environ.pop("COLUMNS", None)

_BUSY = (
    "this machine is too busy",
    "does nothing any more",
    "stood still",
    "RTDE jitter",
    "RTDE rate",
    "round trip",
)
_EMULATED = ("conformance", "faults", "test_cli_cell.py", "test_demo.py", "test_testing.py")
_REAL_TIME = (
    "faults",
    "test_arm_process.py",
    "test_cli_cell.py",
    "test_demo.py",
    "test_grasp.py",
    "test_official_examples.py",
    "test_parity.py",
    "test_rtde_cell.py",
    "test_testing.py",
    "test_ur_rtde.py",
)
_TRIES = 3
_STILL_S = 0.03  # four control periods of a CB3, fifteen of an e-Series


def pytest_addoption(parser):
    group = parser.getgroup("conformance", "controllers that tests/conformance talks to")
    group.addoption("--host", help="address of a UR controller or URSim; without it, emulated ones are started")
    group.addoption("--family", choices=("cb3", "e-series"), help="its family; without --host, only this one is tested")
    group.addoption("--moves", action="store_true", help="let the arm at --host move and be stopped, too")


def pytest_configure(config):
    if config.getoption("--host") and not config.getoption("--family"):
        raise pytest.UsageError("--host needs --family, either cb3 or e-series")


def pytest_itemcollected(item):
    """Mark tests of emulated controllers, and those of them that stream to arms: `make test` runs them apart."""
    names = {item.path.parent.name, item.path.name}
    if names & set(_EMULATED) or any(name in vars(item.module) for name in ("EmulatedCell", "Lab")):
        item.add_marker(pytest.mark.emulated)
    if names & set(_REAL_TIME):
        item.add_marker(pytest.mark.real_time)


@pytest.fixture(scope="session", autouse=True)
def _state_home(tmp_path_factory):
    """Faults and locks of cells are kept in a folder of this test run, never in the user's home."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("XDG_STATE_HOME", str(tmp_path_factory.mktemp("state")))
        yield


class _Pulse(threading.Thread):
    """Notices when this machine stands still: what is asked to wake up soon then wakes up late."""

    def __init__(self):
        super().__init__(name="pulse", daemon=True)
        self.misses = 0

    def run(self):
        sleep, clock = time.sleep, time.monotonic  # tests put others in their place
        before = clock()
        while True:
            sleep(0.01)
            now = clock()
            self.misses += now - before > _STILL_S
            before = now


_pulse = _Pulse()


def pytest_sessionstart(session):
    _pulse.start()


@pytest.hookimpl(tryfirst=True)
def pytest_pyfunc_call(pyfuncitem):
    """Try again where this machine could not keep up: emulated controllers and their clients run in real time.

    With a `tests.faults.lab.Lab`: where arms were stopped because of it. With others: where it stood still meanwhile.
    What fails for another reason fails every time. What was sent to an arm that must not be is never tried again.
    """
    labs = [each for each in pyfuncitem.funcargs.values() if hasattr(each, "busy")]
    names = pyfuncitem._fixtureinfo.argnames
    if not labs:
        return _again(pyfuncitem, names) if pyfuncitem.get_closest_marker("emulated") else None
    for _ in range(_TRIES - 1):
        starved = [lab.busy() for lab in labs]
        try:
            pyfuncitem.obj(**{name: pyfuncitem.funcargs[name] for name in names})
        except Exception as error:
            if getattr(error, "never_retried", False):
                raise
            for lab in labs:
                lab.audit()  # nothing is tried again that was not safe
            faults = [fault.text for fault in (lab.latch.read() for lab in labs) if fault is not None]
            told = any(word in text for word in _BUSY for text in (str(error), *faults))
            if not told and [lab.busy() for lab in labs] == starved:
                raise
            for lab in labs:
                lab.mend()
            _rest(pyfuncitem)
        else:
            return True
    return None


def _again(pyfuncitem, names):
    """A test of emulated controllers, as often as it fails while the machine stands still, but for the last time."""
    for _ in range(_TRIES - 1):
        missed = _pulse.misses
        try:
            pyfuncitem.obj(**{name: pyfuncitem.funcargs[name] for name in names})
        except Exception as error:
            told = any(word in str(error) for word in _BUSY)
            if getattr(error, "never_retried", False) or not (told or _pulse.misses > missed):
                raise
            _rest(pyfuncitem)
        else:
            return True
    return None


def _rest(pyfuncitem):
    """Wait, as what keeps the machine busy may be over then. What a test finds in its folder is its own again."""
    time.sleep(2.0)
    path = pyfuncitem.funcargs.get("tmp_path")
    if path is not None:
        pyfuncitem.funcargs["tmp_path"] = path.with_name(f"{path.name}-again")
        pyfuncitem.funcargs["tmp_path"].mkdir()
