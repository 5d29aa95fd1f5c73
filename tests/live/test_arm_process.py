"""Two arms moved by their processes through the unmodified `ur_rtde`, against emulated controllers."""

import pytest

from dual_ur10.emulated.emulated_cell import EmulatedCell
from tests.sim2real.runtime.pair import Pair, assert_rests_on_path, assert_stops_both

pytestmark = pytest.mark.streams


@pytest.fixture(scope="module")
def cell():
    with EmulatedCell(plant="nominal") as cell:
        yield cell


@pytest.fixture
def pair(cell):
    made = Pair(cell)
    yield made
    made.close()


def test_controllers_execute_the_written_targets(pair):
    assert_stops_both(pair, 300)
    whole = [bool((memory.sent()[0].index[:30] % 1.0 == 0.0).all()) for memory in pair.memories]
    assert all(whole), "this machine is too busy to tell when control periods begin: the arms are out of step"
    for arm in range(2):
        put = {tuple(target): k for k, target in enumerate(pair.put[arm])}
        executed = [tuple(each) for each in pair.executed(arm)]
        known = [put[each] for each in executed if each in put]
        # Bit for bit, in order; what slows the arm down comes behind.
        assert known == sorted(known)
        # A busy machine delivers two in one control period, of which one is executed.
        assert len(set(known)) + pair.memories[arm].skipped >= 0.7 * (max(known) + 1)
        assert all(each in put for each in executed[: len(known) - 1])
        assert_rests_on_path(pair, arm)
    pair.stand()


def test_ur_rtde_does_not_print_what_a_stop_is_reported_by(pair, capfd, caplog):
    pair.begin()
    pair.move(60)
    with caplog.at_level("INFO"):
        for arm in pair.arms:
            pair.cell.ask("press", arm=arm.connection.name, button="stop")
        for arm in pair.arms:
            assert arm.process.wait(20.0)
    assert capfd.readouterr() == ("", "")
    told = [each.getMessage() for each in caplog.records if "ur_rtde" in each.getMessage()]
    assert "left, ur_rtde: its control script no longer runs" in told
    assert len(told) == len(set(told))
    pair.stand()
