"""Control interface of a virtual cell: commands, refusals, and the loss of script or controller."""

import numpy as np
import pytest

from dual_ur10.sim2real.commissioning.doctor import REGISTERS
from dual_ur10.testing import VirtualCell
from ur_core.links.rtde_link import RtdeClient
from ur_core.protocol.rtde import Kind
from ur_emulator.virtual.control import ScriptControl

TICK_S = 0.008


@pytest.fixture
def control(cell):
    return ScriptControl(cell.left, cell.system, "cb3")


def state(cell, name):
    return cell.ask("state", arm="left", names=[name])[name]


def servo(control, q_rad):
    return control.servoJ(q_rad, 0.0, 0.0, TICK_S, 0.03, 2000.0)


def test_targets_are_executed_one_in_each_control_period(cell, control):
    home, since = np.array(state(cell, "actual_q")), cell.ask("setpoints", arm="left")["count"]
    targets = [home + 1e-4 * step for step in range(20)]
    for target in targets:
        assert servo(control, target)
        cell.clock.sleep(TICK_S)
    assert control.servoStop()
    rows = cell.setpoints("left", since)
    np.testing.assert_array_equal([row[1] for row in rows], targets)
    assert set(np.diff([row[0] for row in rows])) == {1}
    assert control.isConnected()


def test_a_watchdog_that_is_fed_keeps_the_script_and_one_that_is_not_ends_it(cell, control):
    assert control.setWatchdog(10.0)
    for _ in range(10):
        cell.clock.sleep(0.05)
        assert control.kickWatchdog()
    assert state(cell, "runtime_state") == 2
    fed_s = cell.now_s
    cell.wait_until("left", "runtime_state", 1)
    assert 0.1 <= cell.now_s - fed_s <= 0.13
    assert not control.kickWatchdog()
    assert not servo(control, state(cell, "actual_q"))
    assert control.isConnected()


def test_a_stopped_script_takes_no_more(cell, control):
    control.stopScript()
    assert state(cell, "runtime_state") == 1
    assert not control.setWatchdog(10.0)
    assert not control.servoStop()


def test_a_second_interface_is_refused(cell, control):
    control.stopScript()  # which frees nothing: the registers belong to the connection
    with pytest.raises(RuntimeError, match="already in use"):
        ScriptControl(cell.left, cell.system, "cb3")


def test_registers_of_another_client_are_refused(cell):
    deadline_s = cell.now_s + 1.0
    client = RtdeClient("", cell.left, 30004, deadline_s, system=cell.system)
    client.set_up(Kind.SETUP_INPUTS, REGISTERS[:1], b"", deadline_s)
    with pytest.raises(RuntimeError, match="already in use"):
        ScriptControl(cell.left, cell.system, "cb3")


def test_a_program_that_runs_is_stopped_first(cell):
    script = cell.system.connect(cell.left, 30002, 1.0)
    script.send_now(b"def p():\n while True:\n  sync()\n end\nend\n")
    cell.wait_until("left", "runtime_state", 2)
    control = ScriptControl(cell.left, cell.system, "cb3")
    assert control.setWatchdog(10.0)
    assert cell.ask("received", arm="left")["uploads"] == 2


def test_local_control_is_refused():
    with VirtualCell(family="e-series", plant="nominal") as cell:
        cell.ask("remote", arm="left", on=False)
        with pytest.raises(RuntimeError, match="remote control"):
            ScriptControl(cell.left, cell.system, "e-series")
        assert cell.ask("received", arm="left")["uploads"] == 0


@pytest.mark.parametrize("port", ["rtde", "realtime", "dashboard"])
def test_a_closed_port_is_refused(cell, port):
    cell.ask("refuse", arm="left", port=port)
    with pytest.raises(RuntimeError, match=r"refused|no connection"):
        ScriptControl(cell.left, cell.system, "cb3")


def test_a_stopped_arm_starts_no_script(cell):
    cell.ask("stop", arm="left", mode=3)
    cell.clock.sleep(0.1)
    with pytest.raises(RuntimeError, match="did not start within 5 s"):
        ScriptControl(cell.left, cell.system, "cb3")


def test_a_lost_controller_is_noticed_and_not_reached_again(cell, control):
    cell.ask("drop", arm="left", port="rtde")
    cell.clock.sleep(0.1)
    assert not control.isConnected()
    assert not control.kickWatchdog()
    control.stopScript()  # and does not hang
    cell.ask("heal", arm="left")
    cell.clock.sleep(1.0)
    assert not control.isConnected()
    assert cell.ask("clients", arm="left")["rtde"] == []


@pytest.mark.parametrize(("lookahead_s", "gain"), [(0.02, 300.0), (0.21, 300.0), (0.1, 99.0), (0.1, 2001.0)])
def test_lookahead_and_gain_have_bounds(cell, control, lookahead_s, gain):
    with pytest.raises(ValueError, match="not within"):
        control.servoJ(state(cell, "actual_q"), 0.0, 0.0, TICK_S, lookahead_s, gain)
    assert cell.packages("left") == []
