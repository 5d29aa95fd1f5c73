"""Same conditions wherever the tests run: a plugin of pytest."""

import functools
import inspect
import os
import random
import signal

import hypothesis
import numpy as np
import pytest
from hypothesis.internal.conjecture import providers

from tests.busy_machine import BusyMachine
from tests.progress import Progress
from tests.soak import SOAK

# Workers of pytest-xdist get the width of the terminal; rich takes it when a console is made, at import.
os.environ.pop("COLUMNS", None)

# A shell lets its jobs in the background ignore Ctrl-C, and what they start inherits that.
if signal.getsignal(signal.SIGINT) is signal.SIG_IGN:
    signal.signal(signal.SIGINT, signal.default_int_handler)

# Properties see the same examples in every run, on any machine: those that their source gives. A soak and
# `--hypothesis-seed` draw others, and each failure prints the decorator that replays it. How long an example takes is
# the machine's affair.
_COMMON = {
    "database": None,
    "deadline": None,
    "print_blob": True,
    "suppress_health_check": [hypothesis.HealthCheck.too_slow],
}
hypothesis.settings.register_profile("repeated", derandomize=True, max_examples=50, **_COMMON)
hypothesis.settings.register_profile("fresh", derandomize=False, **_COMMON)
hypothesis.settings.load_profile("fresh" if SOAK else "repeated")


def _constants_of_modules(found=providers._get_local_constants):
    """Return the constants that Hypothesis tries beside what it draws: those of modules that happen to be imported."""
    return providers._local_constants if hypothesis.settings.default.derandomize else found()


providers._get_local_constants = _constants_of_modules


@pytest.hookimpl(tryfirst=True)
def pytest_runtest_setup(item):
    """Let what is drawn without a seed be the same in every run; a soak draws anew."""
    if not SOAK:
        np.random.bit_generator.randbits = random.Random(0).getrandbits


_STARTERS = {"EmulatedCell", "CellForTests", "EmulatedController", "EmulatedPair", "Lab", "measure_emulated"}
_STARTERS |= {"emulated_cell", "ur_controller"}
"""Names of what starts emulated controllers."""


def pytest_addoption(parser):
    group = parser.getgroup("conformance", "controllers that the conformance tests talk to")
    group.addoption("--host", help="address of a UR controller or URSim; without it, emulated ones are started")
    group.addoption("--family", choices=("cb3", "e-series"), help="its family; without --host, only this one is tested")
    group.addoption("--moves", action="store_true", help="let the arm at --host move and be stopped, too")


def pytest_configure(config):
    if config.getoption("--hypothesis-seed") is not None:
        hypothesis.settings.load_profile("fresh")
    config.pluginmanager.register(BusyMachine())
    if not hasattr(config, "workerinput"):  # of a worker of pytest-xdist
        config.pluginmanager.register(Progress())
    if config.getoption("--host") and not config.getoption("--family"):
        raise pytest.UsageError("--host needs --family, either cb3 or e-series")


def _names(function, seen):
    """Return the names that a function of the tests uses, and those of the functions of its module that it calls."""
    code = getattr(inspect.unwrap(function), "__code__", None)
    if code is None or code in seen:
        return set()
    seen.add(code)
    codes = [code, *(each for each in code.co_consts if inspect.iscode(each))]
    names = {name for each in codes for name in (*each.co_names, *each.co_freevars)}
    here = inspect.unwrap(function).__globals__
    called = [here[name] for name in names if inspect.isfunction(here.get(name))]
    return names.union(*(_names(each, seen) for each in called if each.__module__ == function.__module__))


@functools.cache
def _is_starter(function):
    return not _names(function, set()).isdisjoint(_STARTERS)


def starts_controllers(item):
    """Check whether a test, one of its fixtures or a helper in their modules starts emulated controllers."""
    fixtures = [each.func for found in item._fixtureinfo.name2fixturedefs.values() for each in found]
    return not _STARTERS.isdisjoint(item.fixturenames) or any(map(_is_starter, (item.function, *fixtures)))


def pytest_itemcollected(item):
    """Mark tests of emulated controllers, and those of them that stream targets: `make test` runs them apart."""
    if isinstance(item, pytest.Function) and starts_controllers(item):
        item.add_marker(pytest.mark.emulated)
        if not item.get_closest_marker("smoke"):
            item.add_marker(BusyMachine.mark())
        if item.get_closest_marker("streams"):
            item.add_marker(pytest.mark.real_time)


@pytest.fixture(scope="session", autouse=True)
def _share_of_processors():
    """Workers of pytest-xdist divide the processors: as many threads in each are slower than one after the other."""
    processors, workers = os.cpu_count() or 1, int(os.environ.get("PYTEST_XDIST_WORKER_COUNT", "1"))
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(os, "cpu_count", lambda: max(1, processors // workers))
        yield


@pytest.fixture(scope="session", autouse=True)
def _state_home(tmp_path_factory):
    """Faults and locks of cells are kept in a folder of this test run, never in the user's home."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("XDG_STATE_HOME", str(tmp_path_factory.mktemp("state")))
        yield
