"""Control interface of virtual cells: it writes the same inputs as the unmodified `ur_rtde`, for the same calls."""

import inspect
import subprocess
import sys

import pytest

from dual_ur10.emulated.cell_emulator import CellEmulator, CellOptions
from dual_ur10.testing import VirtualCell
from ur_emulator.virtual.control import ScriptControl

pytestmark = pytest.mark.emulated

STOP_SCRIPT = [("input_int_register_0", 255)]
CLEAR = [("input_int_register_0", 0)]


def call(control, q_rad):
    control.setWatchdog(1.0)
    for step in range(8):
        control.servoJ([each + 1e-4 * step for each in q_rad], 0.1, 0.2, 0.008, 0.05, 500.0)
    control.kickWatchdog()
    control.servoStop(5.0)
    control.servoStop()
    control.setWatchdog(2.0)
    control.servoJ(q_rad, 0.0, 0.0, 0.008, 0.03, 2000.0)
    control.kickWatchdog()
    control.stopScript()


CLIENT = f"""import os, sys, rtde_control
{inspect.getsource(call)}
call(rtde_control.RTDEControlInterface(sys.argv[1]), [float(each) for each in sys.argv[2:]])
os._exit(0)
"""


def noted(controller):
    """Return a list that grows by the inputs of each package that a controller receives: names and values."""
    packages, received, registers = [], controller.received, controller.registers
    package = received.package

    def note(names, tick):
        package(names, tick)
        numbers = [(name, int(name.rpartition("_")[2])) for name in names]
        packages.append(
            [
                (name, registers.input_int[number] if "_int_" in name else registers.input_double[number])
                for name, number in numbers
            ]
        )

    received.package = note
    return packages


@pytest.mark.parametrize("family", ["cb3", "e-series"])
def test_it_writes_what_ur_rtde_writes(family):
    emulator = CellEmulator(CellOptions(family=family, plant="nominal"))
    controller = emulator.servers[0].controller
    q_rad = [float(each) for each in emulator.world.start_q_rad[0]]
    expected = noted(controller)
    client = subprocess.Popen([sys.executable, "-c", CLIENT, emulator.servers[0].host, *map(repr, q_rad)])
    try:
        while client.poll() is None:
            emulator.step()
    finally:
        client.kill()
        client.wait()
        emulator.close()
    assert client.returncode == 0
    with VirtualCell(family=family, plant="nominal") as cell:
        virtual = cell.emulator.servers[0].controller
        found = noted(virtual)
        call(ScriptControl(cell.left, cell.system, family), q_rad)
    assert controller.received.motion_count == virtual.received.motion_count == 9
    assert controller.received.uploads == virtual.received.uploads == 1
    assert controller.received.program == virtual.received.program
    assert controller.received.watchdog[1:] == virtual.received.watchdog[1:] == (2.0, "stop")
    # ur_rtde clears its command once more if it sees the end of the script in time.
    assert expected[-2:].count(STOP_SCRIPT) == 1
    assert expected[expected.index(STOP_SCRIPT) + 1 :] in ([], [CLEAR])
    assert found == expected[: expected.index(STOP_SCRIPT) + 1]
