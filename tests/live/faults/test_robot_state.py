"""Stop of one arm by its controller: row 29 of the table of faults in `docs/explanation/safety.md`."""

import pytest

pytestmark = pytest.mark.streams


def test_29_a_stop_of_one_arm_stops_both_and_stays(lab):
    lab.begin()
    lab.do("stop", arm="left", mode=3)
    error = lab.step_until_faulted()
    lab.cell.ask("release", arm="left", mode=3)
    lab.clock.sleep(0.1)
    lab.assert_stopped(error, "left: ", "safety mode 3 (", ramped=["right"])
