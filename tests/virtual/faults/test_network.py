"""Faults of the network: rows 17 to 27 of the fault table in docs/reference/faults.md."""

import contextlib

import pytest

from dual_ur10.errors import CellFaulted, CellFileError, LinkError, StartError
from dual_ur10.sim2real.runtime import runner
from tests import soak
from tests.virtual.faults.lab import ARMS
from ur_core.links.rtde_link import RtdeClient
from ur_core.protocol.rtde import Kind

PORTS = {"dashboard": 29999, "primary": 30001, "realtime": 30003, "rtde": 30004}
SILENT_TICKS = 17  # 0.1 s until a silent peer counts as lost, and packets in transit
# Until what was sent is farther ahead than a controller may be behind. Slow arms take long; in a whole period of the
# swing they are as fast as they get.
UNFOLLOWED_TICKS = 250
OTHER = {"left": "right", "right": "left"}


# At the start.


@pytest.mark.parametrize("port", PORTS)
def test_17_an_arm_without_connections_is_named(lab, port):
    lab.do("refuse", arm="right", port=port)
    with pytest.raises(StartError) as found:
        lab.make()
    for word in ("right", lab.cell.right, str(PORTS[port])):
        assert word in str(found.value)
    lab.assert_nothing_has_moved()
    lab.cell.ask("heal", arm="right")
    lab.make()  # nothing was left behind


@pytest.mark.parametrize("port", ["all", *PORTS])
def test_18_an_arm_that_never_answers_is_given_up(lab, port):
    lab.do("link", arm="left", port=port, half_open=True)
    # That programs are not read shows only where one is sent.
    kind, words = (LinkError, "control script") if port == "realtime" else (StartError, "no answer in time")
    with pytest.raises(kind, match=f"left.*{words}"):
        lab.make()
    lab.assert_nothing_has_moved((0, 1) if port == "realtime" else (0, 0))


def test_18_emulated_controllers_that_both_never_answer_are_a_matter_of_this_machine(lab):
    for arm in ARMS:
        lab.do("link", arm=arm, port="rtde", half_open=True)
    with pytest.raises(StartError, match=r"^this machine is too busy .*left.*no answer in time.*right.*no answer"):
        lab.make()
    lab.assert_nothing_has_moved()


def test_18_a_controller_without_the_control_script_is_given_up(lab, monkeypatch):
    monkeypatch.setattr(runner, "_READY_S", 3.0)
    lab.do("script_delay", arm="right", seconds=10.0)
    with pytest.raises(LinkError, match=f"right.*{lab.cell.right}"):
        lab.make()
    lab.assert_nothing_has_moved((1, 1))
    assert lab.latch.read() is None  # a start that failed is no stop


def test_22_a_network_that_is_too_slow_is_refused(lab):
    lab.do("link", arm="left", port="rtde", delay_s=0.02)
    with pytest.raises(StartError, match=r"too busy .*left, round trip: .* expected: at most 4 ms"):
        lab.make()
    lab.assert_nothing_has_moved()


def test_25_one_address_for_both_arms_is_refused(lab):
    with pytest.raises(CellFileError, match=f"{lab.cell.left}.*own"):
        lab.configure(right={"host": lab.cell.left})


@pytest.mark.parametrize("host", ["localhost", "left.lab", "127.0.0.300", "2130706433"])
def test_28_host_names_are_not_resolved(lab, host):
    with pytest.raises(CellFileError, match=r"left\.host"):
        lab.configure(left={"host": host})


def test_27_registers_in_use_are_refused(lab):
    deadline_s = lab.clock.now_s() + 20.0
    client = RtdeClient("", lab.cell.right, 30004, deadline_s, system=lab.system)
    client.set_up(Kind.SETUP_INPUTS, ["input_int_register_0"], b"", deadline_s)
    try:
        with pytest.raises(StartError, match="right, registers: in use: input_int_register_0"):
            lab.make()
    finally:
        client.socket.close_and_wait(deadline_s)
    lab.assert_nothing_has_moved()


# While the arms move.


@pytest.mark.parametrize("arm", ARMS if soak.SOAK else ["left"])
@pytest.mark.parametrize(("reset", "port"), [(True, "rtde"), (False, "all")])
def test_19_a_lost_connection_stops_both_and_stays_lost(lab, port, reset, arm):
    lab.begin()
    before = lab.programs()
    lab.do("drop", arm=arm, port=port, reset=reset)
    error = lab.step_until_faulted()
    gone = f"the controller is gone: {arm} at {getattr(lab.cell, arm)}"
    lab.assert_stopped(error, f"{arm}: " if port == "rtde" else gone, ramped=[OTHER[arm]])
    assert lab.programs() == before + 2  # one for each arm: none was started anew


def test_19_both_controllers_that_are_gone_are_the_root_cause(lab):
    lab.begin()
    lab.note()
    for arm in ARMS:
        lab.cell.ask("drop", arm=arm, port="all", reset=True)
    error = lab.step_until_faulted()
    where = f"left at {lab.cell.left} and right at {lab.cell.right}"
    lab.assert_stopped(error, f"both controllers are gone: {where}: all connections were closed")


@pytest.mark.parametrize("reset", [True, False] if soak.SOAK else [False])
def test_19_a_lost_connection_of_commands_stays_lost(lab, reset):
    """The other connections of an arm's process stand, and notice nothing."""
    lab.begin()
    before = lab.programs()
    lab.do("drop", arm="right", port="rtde", writers=True, reset=reset)
    error = lab.step_until_faulted()
    lab.assert_stopped(error, "right: ")
    assert lab.programs() == before + 2


@pytest.mark.parametrize("arm", ARMS if soak.SOAK else ["right"])
def test_19_the_loss_of_the_backup_stop_is_noticed(lab, arm):
    lab.begin()
    lab.do("drop", arm=arm, port="dashboard")
    error = lab.step_until_faulted()
    lab.assert_stopped(error, "the backup stop is lost", f"{arm} arm, dashboard")


@pytest.mark.parametrize("arm", ARMS if soak.SOAK else ["left"])
def test_20_a_controller_that_falls_silent_stops_both(lab, arm):
    lab.begin()
    lab.do("link", arm=arm, port="rtde", mute=True)
    error = lab.step_until_faulted()
    assert "too busy" not in str(error)  # the other one went on, and this machine was on time
    lab.assert_stopped(error, f"{arm}: ", "stalled", seen_ticks=SILENT_TICKS, ramped=[OTHER[arm]])


@pytest.mark.parametrize("arm", ARMS if soak.SOAK else ["right"])
def test_21_23_a_deaf_controller_stops_both(lab, arm):
    lab.begin()
    starved = lab.starved()
    lab.do("watchdog", arm=arm, on=False)  # it would act, too: this shows the other stop
    lab.do("link", arm=arm, port="rtde", frozen=True)
    error = lab.step_until_faulted()
    lab.assert_at_rest()
    count = lab.cell.ask("setpoints", arm=arm)["count"]
    lab.cell.ask("heal", arm=arm)  # what was underway arrives now
    lab.clock.sleep(0.3)
    assert lab.cell.ask("setpoints", arm=arm)["count"] == count
    lab.assert_stopped(error, f"{arm}: ", "the controller does not follow", seen_ticks=UNFOLLOWED_TICKS)
    assert lab.starved() == starved, "its watchdog came before"


def test_23_a_network_that_stalls_stops_both(lab):
    lab.begin()
    lab.do("link", arm="left", port="rtde", mute=True, frozen=True)
    lab.clock.sleep(0.2)
    count = lab.cell.ask("setpoints", arm="left")["count"]
    lab.cell.ask("heal", arm="left")
    error = lab.step_until_faulted()
    lab.assert_at_rest()
    assert lab.cell.ask("setpoints", arm="left")["count"] - count <= 3
    lab.assert_stopped(error, "left: ", seen_ticks=SILENT_TICKS)


def test_22_a_network_that_becomes_slow_stops_both(lab):
    lab.begin()
    lab.do("link", arm="right", port="rtde", delay_s=0.09)
    error = lab.step_until_faulted()
    lab.assert_at_rest()
    lab.clock.sleep(0.2)  # what is underway arrives, and nothing reads it
    words = "right: ", "from those sent", "the controller does not follow"
    lab.assert_stopped(error, *words, seen_ticks=UNFOLLOWED_TICKS)


BROKEN = {"short": "RTDE data package of recipe ", "long": "RTDE frame of ", "foreign": "RTDE data package of recipe "}


@pytest.mark.parametrize("damage", BROKEN)
@pytest.mark.parametrize("arm", ARMS if soak.SOAK else ["right"])
def test_24_damaged_packets_stop_both(lab, arm, damage):
    lab.begin()
    lab.do("link", arm=arm, port="rtde", **{damage: 1000})
    error = lab.step_until_faulted()
    lab.assert_stopped(error, f"{arm}: ", BROKEN[damage], "check the controller and the network", ramped=[OTHER[arm]])


@pytest.mark.parametrize("corrupt", [1, 1000])
@pytest.mark.parametrize("arm", ARMS if soak.SOAK else ["left"])
def test_24_changed_bytes_stop_both_or_are_ignored(lab, arm, corrupt):
    lab.begin()
    lab.do("link", arm=arm, port="rtde", corrupt=corrupt)
    with contextlib.suppress(CellFaulted):
        lab.step(10)
    if lab.latch.read() is None:  # changes of unused numbers may go unnoticed
        assert corrupt < 1000
        lab.do("stop", arm=arm, mode=3)
    lab.assert_stopped(lab.step_until_faulted(), f"{arm}: ")


def test_24_lost_packets_are_no_fault_and_many_are(lab):
    lab.begin()
    lab.do("link", arm="left", port="rtde", lose=6)
    lab.step(10)
    lab.do("link", arm="left", port="rtde", lose=100)
    lab.assert_stopped(lab.step_until_faulted(), "left: ", "stalled", seen_ticks=SILENT_TICKS)
