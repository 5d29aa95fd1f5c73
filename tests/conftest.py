"""Same conditions wherever the tests run."""

import os

import pytest

# Workers of pytest-xdist get the width of the terminal; rich takes it when a console is made, at import.
os.environ.pop("COLUMNS", None)


def pytest_addoption(parser):
    group = parser.getgroup("conformance", "controllers that tests/conformance talks to")
    group.addoption("--host", help="address of a UR controller or URSim; without it, emulated ones are started")
    group.addoption("--family", choices=("cb3", "e-series"), help="its family; without --host, only this one is tested")
    group.addoption("--moves", action="store_true", help="let the arm at --host move and be stopped, too")


def pytest_configure(config):
    if config.getoption("--host") and not config.getoption("--family"):
        raise pytest.UsageError("--host needs --family, either cb3 or e-series")


@pytest.fixture(scope="session", autouse=True)
def _state_home(tmp_path_factory):
    """Faults and locks of cells are kept in a folder of this test run, never in the user's home."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("XDG_STATE_HOME", str(tmp_path_factory.mktemp("state")))
        yield
