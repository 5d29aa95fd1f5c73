"""Faults of the network: rows 17 to 24 of the fault table in docs/reference/faults.md."""

import time

import pytest

from dual_ur10.errors import LinkError, StartError
from dual_ur10.sim2real.runtime import runner
from tests import soak
from tests.live.faults.lab import ARMS

pytestmark = pytest.mark.streams

SILENT_TICKS = 17  # 0.1 s until a silent peer counts as lost, and packets in transit


def test_17_an_arm_without_connections_is_named(lab):
    lab.turn("refuse", {}, arm="right", port="rtde")
    with pytest.raises(StartError) as found:
        lab.make()
    for word in ("right", lab.cell.right, "30004"):
        assert word in str(found.value)
    lab.assert_nothing_has_moved()
    lab.cell.ask("heal", arm="right")
    lab.make()  # nothing was left behind


def test_18_a_controller_without_the_control_script_is_given_up(lab, monkeypatch):
    monkeypatch.setattr(runner, "_READY_S", 3.0)
    lab.turn("script_delay", {"seconds": 0.0}, arm="right", seconds=8.0)
    with pytest.raises(LinkError, match=f"right.*{lab.cell.right}"):
        lab.make()
    lab.assert_nothing_has_moved((1, 1))
    assert lab.latch.read() is None  # a start that failed is no stop
    lab.cell.wait_until("right", "runtime_state", 2)  # its program starts all the same, and others would wait behind it
    lab.cell.ask("press", arm="right", button="stop")


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
