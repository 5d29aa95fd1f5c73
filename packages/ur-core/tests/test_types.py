"""Base of objects that close themselves."""

import pytest

from ur_core.types import Closing


class Door(Closing):
    closed = 0

    def close(self):
        self.closed += 1


def test_a_with_block_closes_at_its_end():
    with Door() as door:
        assert not door.closed
    assert door.closed


@pytest.mark.parametrize("error", [ValueError, KeyboardInterrupt, SystemExit])
def test_a_with_block_closes_on_an_error(error):
    door = Door()
    with pytest.raises(error), door:
        raise error
    assert door.closed


@pytest.mark.parametrize("error", [ValueError, KeyboardInterrupt, SystemExit])
def test_closed_on_error(error):
    door = Door()
    with door.closed_on_error():
        pass
    assert not door.closed
    with pytest.raises(error), door.closed_on_error():
        raise error
    assert door.closed == 1
