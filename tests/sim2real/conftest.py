"""Virtual cells that the tests of a module share."""

import pytest

from dual_ur10.testing import VirtualCell
from tests.ur_emulator.restored import restored


@pytest.fixture(scope="module")
def started_cb3():
    with VirtualCell(plant="nominal") as cell:
        yield cell


@pytest.fixture(scope="module")
def started_e_series():
    with VirtualCell(plant="nominal", family="e-series") as cell:
        yield cell


@pytest.fixture
def cb3(started_cb3):
    return restored(started_cb3)


@pytest.fixture
def e_series(started_e_series):
    return restored(started_e_series)
