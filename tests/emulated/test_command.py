"""`ur-emulator --cell`: the two controllers that a cell file names."""

import pytest
import tomlkit

from dual_ur10.cli import main
from dual_ur10.emulated.of_file import of_cell
from tests.emulated.ticking import Cell
from tests.ur_emulator.test_command import invoke
from ur_core.errors import SettingsError
from ur_emulator.addresses import free_address


@pytest.fixture
def lab(tmp_path):
    """Return the file of a real cell of two UR5e."""
    path = tmp_path / "lab.toml"
    arguments = ["cell", "new", str(path), "--left", "192.168.10.11", "--right", "192.168.10.12", "--robot", "ur5e"]
    code, text = invoke(*arguments, command=main.app)
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
    code, output = invoke("--cell", str(lab.with_name("none.toml")))
    assert (code, "none.toml" in output) == (2, True)
    code, output = invoke("--cell", str(lab), "--address", "127.0.0.1")
    assert (code, "2 controllers with --address 127.0.0.1" in output) == (2, True)
