"""Lines on the script ports that are no programs, as UR's C++ client library sends them."""

import struct

import pytest

from tests.ur_emulator.pairs import VirtualPair


@pytest.fixture(scope="module")
def cell():
    with VirtualPair(robot="ur10e") as cell:
        yield cell


@pytest.fixture(params=[30001, 30002, 30003])
def send(request, cell):
    """Return a function that sends a line and waits for two control periods."""
    transport = cell.system.connect(cell.left, request.param, 1.0)

    def send(line):
        transport.send_now(f"{line}\n".encode())
        cell.clock.sleep(0.01)

    yield send
    transport.close()


def mode(cell, name):
    return cell.ask("state", arm="left", names=[name])[name]


def power_on(cell, send, release):
    send("power on")
    cell.wait_until("left", "robot_mode", 5)
    send(release)
    cell.wait_until("left", "robot_mode", 7)


def test_power_brakes_and_program(cell, send):
    send("power off")
    assert mode(cell, "robot_mode") == 3
    power_on(cell, send, "set  robotmode run")
    send("def wait():\n  sleep(100)\nend")
    assert mode(cell, "runtime_state") == 2
    send("stop program")
    assert mode(cell, "runtime_state") == 1


@pytest.mark.parametrize("send", [30002], indirect=True)
def test_a_protective_stop_is_unlocked_without_the_dashboards_wait(cell, send):
    """Three tests of UR's client library unlock at once, which only the dashboard refuses."""
    for after_s in (0.0, 6.0):
        cell.ask("stop", arm="left", mode=3)
        cell.clock.sleep(after_s)
        send("set unlock protective stop")
        assert mode(cell, "safety_mode") == 1


@pytest.mark.parametrize("phase_s", [0.0, 0.03, 0.07])
def test_the_state_of_a_stop_comes_before_its_messages(cell, phase_s):
    """UR's client library releases a stop at its message, and waits until the state no longer has it."""
    transport = cell.system.connect(cell.left, 30001, 1.0)
    cell.clock.sleep(0.2 + phase_s)
    cell.ask("stop", arm="left", mode=3)
    cell.clock.sleep(0.01)
    stream, found = transport.receive_now(1 << 20), []
    while stream:
        size, kind = struct.unpack_from(">iB", stream)
        # A message, or the bit of the robot mode data, which come first in a state.
        found.append({6: "error", 5: "mode"}.get(stream[14]) if kind == 20 else bool(stream[5 + 5 + 12]))
        stream = stream[size:]
    cell.ask("release", arm="left", mode=3)
    transport.close()
    at = found.index("error")
    assert found[at - 1 : at + 2] == [True, "error", "mode"]


@pytest.mark.parametrize("send", [30003], indirect=True)
def test_local_mode_refuses_them(cell, send):
    cell.ask("remote", arm="left", on=False)
    send("power off")
    assert mode(cell, "robot_mode") == 7
    cell.ask("remote", arm="left", on=True)
    send("power off")
    assert mode(cell, "robot_mode") == 3
    power_on(cell, send, "set robotmode run")
