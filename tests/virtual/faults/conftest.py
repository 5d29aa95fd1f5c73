"""One lab for each test."""

import pytest

from tests.virtual.faults.lab import VirtualLab


@pytest.fixture
def lab():
    made = VirtualLab()
    yield made
    made.close()
