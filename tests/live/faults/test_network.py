"""Faults of the network: rows 17 to 24 of the fault table in docs/reference/faults.md."""

import time

import pytest

from tests import soak
from tests.live.faults.lab import ARMS

pytestmark = pytest.mark.streams

SILENT_TICKS = 17  # 0.1 s until a silent peer counts as lost, and packets in transit


@pytest.mark.parametrize("trial", range(soak.scaled(60)))
def test_19_ur_rtde_does_not_restart_a_lost_connection(lab, trial):
    """What it would do by itself: connect again, start its script anew and send its last command, all without a
    watchdog. The other connections of an arm's process stand, and notice nothing."""
    arm = ARMS[trial % 2]
    lab.begin()
    before = lab.programs()
    lab.do("drop", arm=arm, port="rtde", writers=True, reset=bool(trial // 2 % 2))
    error = lab.step_until_faulted()
    lab.assert_stopped(error, f"{arm}: ")
    time.sleep(0.5)
    assert lab.programs() == before + 2


def test_23_a_network_that_stalls_stops_both(lab):
    lab.begin()
    lab.turn("link", {"mute": False, "frozen": False}, arm="left", port="rtde", mute=True, frozen=True)
    time.sleep(0.2)
    count = lab.cell.ask("setpoints", arm="left")["count"]
    lab.cell.ask("heal", arm="left")
    error = lab.step_until_faulted()
    lab.assert_at_rest()
    assert lab.cell.ask("setpoints", arm="left")["count"] - count <= 3
    lab.assert_stopped(error, "left: ", seen_ticks=SILENT_TICKS)
