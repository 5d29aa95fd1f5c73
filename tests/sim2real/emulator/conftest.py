"""Fixtures of the emulator's tests."""

import pytest

from tests.sim2real.emulator.ticking import Bench


@pytest.fixture
def bench():
    return Bench()
