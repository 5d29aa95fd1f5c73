"""Fixtures of tests on virtual cells."""

import pytest

from dual_ur10.testing import VirtualCell


@pytest.fixture
def cell():
    with VirtualCell(plant="nominal") as cell:
        yield cell
