"""Fixtures of the emulator's tests."""

import pytest

from tests.ur_emulator.pairs import VirtualPair
from tests.ur_emulator.restored import restored
from tests.ur_emulator.ticking import Bench


@pytest.fixture
def bench():
    return Bench()


@pytest.fixture(scope="module")
def started_cb3():
    with VirtualPair() as pair:
        yield pair


@pytest.fixture(scope="module")
def started_e_series():
    with VirtualPair(robot="ur10e") as pair:
        yield pair


@pytest.fixture
def cb3(started_cb3):
    return restored(started_cb3)


@pytest.fixture
def e_series(started_e_series):
    return restored(started_e_series)


@pytest.fixture(params=["cb3", "e_series"])
def cell(request):
    """Two controllers of each family on a virtual clock."""
    return request.getfixturevalue(request.param)
