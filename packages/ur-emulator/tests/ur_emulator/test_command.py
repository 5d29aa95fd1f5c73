"""The command `ur-emulator`: what it prints, its end, its errors, and several controllers in one process."""

import re
import socket

import numpy as np
import pytest
from typer.testing import CliRunner

from tests.ur_emulator.served import served
from ur_core.kinematics.home import home_of
from ur_core.kinematics.robots import ROBOTS
from ur_core.links.rtde_link import RtdeLink
from ur_core.processes.system import LOCAL
from ur_emulator.addresses import PORTS, free_address
from ur_emulator.cli import app, by_themselves
from ur_emulator.emulator import run
from ur_emulator.virtual.virtual_system import VirtualProcess, VirtualSystem, World


@pytest.fixture(autouse=True)
def _not_served(monkeypatch):
    """A command of which an error is expected must not serve until Ctrl-C instead."""
    monkeypatch.setattr("ur_emulator.emulator.run", lambda emulators: pytest.fail("it serves"))


def invoke(*arguments, command=app):
    result = CliRunner().invoke(command, list(arguments), env={"COLUMNS": "200"})
    return result.exit_code, re.sub(r"\x1b\[[0-9;]*m", "", result.output)


@pytest.mark.emulated
def test_a_client_reads_one_controller_and_ctrl_c_ends_it():
    host = free_address()
    with served("ur_emulator", "--robot", "ur3e", "--address", host, "--plant", "nominal") as lines:
        ports = {name: number for name, number in PORTS.items() if name != "gripper"}
        assert lines[0] == f"{host} UR3e: {', '.join(f'{name} {number}' for name, number in ports.items())}\n"
        assert re.fullmatch(rf"fault injection {re.escape(host)}:\d+\n", lines[1])
        assert lines[2:] == ["emulated UR3e controller, not a real one. Ctrl-C ends it\n"]
        with RtdeLink(host, ("actual_q", "robot_mode"), timeout_s=20.0) as link:
            for _ in range(200):
                link.poll()
                if link.latest is not None:
                    break
                LOCAL.clock.wait((link.fileno(),), LOCAL.clock.now_s() + 0.1)
            np.testing.assert_allclose(link.latest.values["actual_q"], home_of("ur3e"), atol=1e-3)
            assert link.latest.values["robot_mode"] == 7


@pytest.mark.parametrize(
    ("arguments", "text"),
    [
        (("--robot", "ur6"), f"use one of {', '.join(map(repr, ROBOTS))}"),
        (("--address", "192.168.0.1"), "'192.168.0.1' is no loopback address"),
        (("--address", "0.0.0.0"), "'0.0.0.0' is no loopback address"),
        (("--address", "localhost"), "'localhost' is no loopback address"),
        (("--robot", "ur5e", "--robot", "ur3", "--address", "127.0.0.1"), "give each its own, or none"),
        (
            ("--robot", "ur3", "--robot", "ur3", "--address", "127.0.0.1", "--address", "127.0.0.1"),
            "give each its own, or none",
        ),
        (("--robot", "ur3", "--polyscope", "5.26"), "PolyScope 5.26 does not run on a UR3"),
        (("--plant", "wild"), "'nominal', 'mild', 'wide'"),
        (("--dh-error-mm", "50"), "dh_error_m is 0.05"),
        (("--cell", "lab.toml", "--robot", "ur3"), "leave out --robot"),
        (("--programs", "none"), "none"),
    ],
)
def test_errors_are_one_line_with_exit_code_2(arguments, text):
    code, output = invoke(*arguments)
    assert code == 2, output
    assert text in output
    assert "Traceback" not in output
    assert len(output.strip().splitlines()) == 1


def test_a_port_in_use_is_named():
    host = free_address()
    with socket.create_server((host, 30002)):
        code, output = invoke("--address", host)
    assert (code, output) == (
        2,
        f"error: {host}:30002 is taken by another program: stop it, or choose another address of 127.0.0.0/8\n",
    )


def test_controllers_of_both_families_take_turns(tmp_path):
    """Each has its own control period, serial number, plant and fault injection, and ends by itself."""
    world = World()
    program = VirtualSystem(VirtualProcess(world, None, "program", world.scheduler.program), tmp_path)
    machine = VirtualProcess(world, None, "controllers")
    system = VirtualSystem(machine, tmp_path)
    both = by_themselves(["ur5", "ur5e"], ["127.0.0.1", "127.0.0.2"], 3, {}, system)
    world.scheduler.start(lambda: run(both, system), machine.group, "controllers")
    program.clock.sleep(1.0)
    assert [each.ticks for each in both] == [pytest.approx(125, abs=1), pytest.approx(500, abs=1)]
    with RtdeLink("127.0.0.2", ("actual_q",), system=program) as link:
        assert link.version[0] == 5
    servers = [each.servers[0] for each in both]
    assert [each.controller.profile.serial_number for each in servers] == ["2010300002", "2021500003"]
    assert [len(each.description()) for each in both] == [3, 3]  # its kind, one controller, and the fault injection
    assert not np.array_equal(both[0].world.sampled["friction_nm"], both[1].world.sampled["friction_nm"])
    servers[0].pendant.shutdown()
    program.clock.sleep(1.0)
    assert both[0].ended
    assert both[1].ticks == pytest.approx(1000, abs=5)
    machine.kill()
    assert not world.scheduler.failures


def test_controllers_by_themselves_have_serial_numbers_of_their_own():
    hosts = [f"127.{number}.5" for number in ("70.1", "70.2", "71.2")]
    made = by_themselves(["ur5"] * 3, hosts, 0, {})
    numbers = [each.servers[0].controller.profile.serial_number for each in made]
    for each in made:
        each.close()
    assert len(set(numbers)) == 3
    assert all(len(each) == 10 for each in numbers)


def test_help_names_every_option():
    code, text = invoke("--help")
    assert code == 0
    for word in ("--robot", "--address", "--cell", "--polyscope", "--plant", "--seed", "--programs", "--view"):
        assert word in text
