"""The command `ur-emulator`: what it prints, its end, its errors, and several controllers in one process."""

import re
import socket

import numpy as np
import pytest
import tomlkit
from typer.testing import CliRunner

from dual_ur10.assets.settings import default_mount, home_q_rad
from dual_ur10.cli import main as cli
from dual_ur10.emulated.of_file import of_cell
from tests.emulated.test_emulated_cell import served
from tests.emulated.ticking import Cell
from ur_core.errors import SettingsError
from ur_core.kinematics.robots import ROBOTS
from ur_core.links.rtde_link import RtdeLink
from ur_core.processes.system import LOCAL
from ur_emulator.cli import app, by_themselves
from ur_emulator.emulator import run
from ur_emulator.ports.addresses import PORTS, free_address
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
            np.testing.assert_allclose(
                link.latest.values["actual_q"], home_q_rad((default_mount(0, "ur3e"),))[0], atol=1e-3
            )
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
        (("--cell", "none.toml"), "none.toml"),
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


@pytest.fixture
def lab(tmp_path):
    """Return the file of a real cell of two UR5e."""
    path = tmp_path / "lab.toml"
    arguments = ["cell", "new", str(path), "--left", "192.168.10.11", "--right", "192.168.10.12", "--robot", "ur5e"]
    code, text = invoke(*arguments, command=cli.app)
    assert code == 0, text
    cell = tomlkit.parse(path.read_text())
    cell["left"]["serial_number"] = "20195500123"
    cell["right"]["base_position_m"] = [-0.5, -0.61, 0.02]
    path.write_text(tomlkit.dumps(cell))
    return path


@pytest.fixture
def gripped(lab):
    """Return the file with a gripper at an output on the right."""
    cell = tomlkit.parse(lab.read_text())
    cell["task"] = "DualUR10/Handover-v0"
    cell["left"]["gripper"] = {"kind": "robotiq", "port": 63353}
    cell["right"]["gripper"] = {"kind": "digital_output", "output": 5, "open_level": True, "tool": "generic_140"}
    lab.write_text(tomlkit.dumps(cell))
    return lab


@pytest.mark.parametrize("open_level", [True, False])
def test_a_cell_file_names_its_grippers(gripped, open_level):
    gripped.write_text(gripped.read_text().replace("open_level = true", f"open_level = {str(open_level).lower()}"))
    emulator = of_cell(gripped, [free_address(), free_address()], 0, {"plant": "nominal"})
    try:
        left, right = emulator.servers
        assert left.ports["gripper"].number == 63353
        assert "gripper" not in right.ports
        assert [tool.name for tool in emulator.world.tools] == ["robotiq_2f85", "generic_140"]
        for level, width_m in ((open_level, 0.14), (not open_level, 0.0), (open_level, 0.14)):
            right.controller.io.outputs = level << 5
            for _ in range(600):
                emulator.tick()
            assert emulator.world.read(1).gripper_m == pytest.approx(width_m, abs=1e-3)
        right.controller.io.outputs = (not open_level) << 5
        right.gripper.powered = False
        assert right.gripper.tick(1.0, 0.14) == pytest.approx(0.14, abs=1e-3)  # it keeps its hold
        assert emulator.world.read(0).gripper_m == pytest.approx(0.085, abs=1e-3)  # nobody moved the other
    finally:
        emulator.close()


@pytest.mark.parametrize("driver", ["", "x:Y"])
def test_an_arm_without_an_emulated_gripper(gripped, driver):
    """Fingers of a flange that the file leaves bare stay; a driver of one's own must name its emulated gripper."""
    cell = tomlkit.parse(gripped.read_text())
    own = {"kind": "own", "driver": "dual_ur10.sim2real.peripherals.gripper_link:GripperLink", "tool": "generic_140"}
    cell["right"]["gripper"] = own if driver else {"kind": "none"}
    gripped.write_text(tomlkit.dumps(cell))
    if driver:
        with pytest.raises(SettingsError, match="GripperLink names no emulated gripper"):
            of_cell(gripped, [free_address(), free_address()], 0, {"plant": "nominal"})
        return
    emulator = of_cell(gripped, [free_address(), free_address()], 0, {"plant": "nominal"})
    try:
        for _ in range(200):
            emulator.tick()
        assert emulator.world.read(1).gripper_m == pytest.approx(0.085, abs=1e-3)
    finally:
        emulator.close()


def test_a_cell_file_names_both_controllers(lab):
    hosts = [free_address(), free_address()]
    emulator = of_cell(lab, hosts, 0, {"plant": "nominal"})
    try:
        assert [each.host for each in emulator.servers] == hosts
        assert [each.controller.profile.model for each in emulator.servers] == ["UR5e", "UR5e"]
        assert emulator.servers[0].shown.serial_number == "20195500123"
        assert emulator.world.mounts[1].position_m == (-0.5, -0.61, 0.02)
    finally:
        emulator.close()


def test_cell_files_that_do_not_fit_are_refused(lab):
    Cell(cell=str(lab.with_name("emulated.toml"))).close()
    code, output = invoke("--cell", str(lab.with_name("emulated.toml")))
    assert (code, "is the file of an emulated cell" in output) == (2, True)
    code, output = invoke("--cell", str(lab), "--address", "127.0.0.1")
    assert (code, "2 controllers with --address 127.0.0.1" in output) == (2, True)


def test_help_names_every_option():
    code, text = invoke("--help")
    assert code == 0
    for word in ("--robot", "--address", "--cell", "--polyscope", "--plant", "--seed", "--programs", "--view"):
        assert word in text
