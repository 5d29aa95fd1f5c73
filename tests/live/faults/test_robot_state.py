"""Stop of one arm by its controller or another program: rows 29 and 63 of `docs/reference/faults.md`."""

import numpy as np
import pytest

pytestmark = pytest.mark.streams


def test_29_a_stop_of_one_arm_stops_both_and_stays(lab):
    lab.begin()
    lab.do("stop", arm="left", mode=3)
    error = lab.step_until_faulted()
    lab.cell.ask("release", arm="left", mode=3)
    lab.clock.sleep(0.1)
    lab.assert_stopped(error, "left: ", "safety mode 3 (", ramped=["right"])


def test_63_another_program_that_moves_an_arm_stops_both(lab):
    lab.begin()
    there = np.add(lab.ask("left", "actual_q")[0], 0.5).tolist()
    lab.replace("left", f"movej({there}, a=1.2, v=0.3)")
    error = lab.step_until_faulted()
    assert np.subtract(there, lab.ask("left", "actual_q")[0]).min() > 0.3  # it was stopped on its way
    lab.assert_stopped(error, "left: ", "another program replaced the control script", seen_ticks=30, ramped=["right"])
