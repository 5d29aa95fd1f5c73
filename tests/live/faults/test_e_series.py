"""Two e-Series controllers: row 29 of the table of faults in `docs/reference/faults.md`."""

import pytest

from tests.live.faults.lab import Lab

pytestmark = pytest.mark.streams


@pytest.fixture
def lab(tmp_path):
    made = Lab(tmp_path, family="e-series")
    yield made
    made.audit()
    made.close()


def test_29_an_e_series_arm_that_stops_stops_both(lab):
    lab.begin()
    lab.assert_within_limits()
    lab.do("stop", arm="right", mode=3)
    lab.assert_stopped(
        lab.step_until_faulted(),
        "right: safety mode 3 (PROTECTIVE_STOP)",
        arms=["left"],
        ramped=["left"],
        seen_ticks=15,
    )
