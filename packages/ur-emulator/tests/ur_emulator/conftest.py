"""Fixtures of the emulator's tests."""

import pytest

from tests.ur_emulator.ticking import Bench


@pytest.fixture
def bench():
    return Bench()
