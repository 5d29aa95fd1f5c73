"""Same conditions wherever the tests run."""

import os
from pathlib import Path

import pytest

from tests.busy_machine import BusyMachine

# Workers of pytest-xdist get the width of the terminal; rich takes it when a console is made, at import.
os.environ.pop("COLUMNS", None)

_EMULATED = ("conformance", "live", "cli/test_cell.py", "cli/test_demo.py", "test_testing.py")
_REAL_TIME = (
    "live",
    "cli/test_cell.py",
    "cli/test_demo.py",
    "sim2real/analysis/test_parity.py",
    "sim2real/emulator/test_grasp.py",
    "sim2real/emulator/test_official_examples.py",
    "sim2real/emulator/test_ur_rtde.py",
    "sim2real/runtime/test_arm_process.py",
    "sim2real/runtime/test_rtde_cell.py",
    "test_testing.py",
)


def pytest_addoption(parser):
    group = parser.getgroup("conformance", "controllers that tests/conformance talks to")
    group.addoption("--host", help="address of a UR controller or URSim; without it, emulated ones are started")
    group.addoption("--family", choices=("cb3", "e-series"), help="its family; without --host, only this one is tested")
    group.addoption("--moves", action="store_true", help="let the arm at --host move and be stopped, too")


def pytest_configure(config):
    config.pluginmanager.register(BusyMachine())
    if config.getoption("--host") and not config.getoption("--family"):
        raise pytest.UsageError("--host needs --family, either cb3 or e-series")


def pytest_itemcollected(item):
    """Mark tests of emulated controllers, and those of them that stream to arms: `make test` runs them apart."""
    path = item.path.relative_to(Path(__file__).parent).as_posix()
    if path.startswith(_EMULATED) or any(name in vars(item.module) for name in ("EmulatedCell", "Lab")):
        item.add_marker(pytest.mark.emulated)
        item.add_marker(BusyMachine.mark())
    if path.startswith(_REAL_TIME):
        item.add_marker(pytest.mark.real_time)


@pytest.fixture(scope="session", autouse=True)
def _state_home(tmp_path_factory):
    """Faults and locks of cells are kept in a folder of this test run, never in the user's home."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("XDG_STATE_HOME", str(tmp_path_factory.mktemp("state")))
        yield
