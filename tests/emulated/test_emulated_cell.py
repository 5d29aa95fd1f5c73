"""Process of an emulated cell: start, refused options, and its end in all cases."""

import dataclasses
import os
import re
import shlex
import signal
import socket
import subprocess
import sys
import time
import tomllib
from pathlib import Path

import numpy as np
import psutil
import pytest
from typer.testing import CliRunner

from dual_ur10.assets.prop import Prop
from dual_ur10.cli import main as cli
from dual_ur10.emulated.cell_emulator import CellEmulator, CellOptions, write_cell_file
from dual_ur10.emulated.emulated_cell import EmulatedCell
from dual_ur10.envs.core.setup import EnvSetup
from dual_ur10.errors import DualUR10Error
from dual_ur10.sim2real.cell_file.cell_file import CellFile, load_cell_file
from tests.emulated.ticking import Cell
from tests.ur_emulator.served import served
from ur_core.errors import AddressError, ClosedError, EmulatorError, SettingsError, UnknownNameError
from ur_core.tools.generic_140 import GENERIC_140
from ur_emulator import emulated_controller
from ur_emulator.addresses import free_address, is_free

ROOT = Path(__file__).parents[2]
POST = '<mujoco><worldbody><body><geom type="sphere" size="0.02"/></body></worldbody></mujoco>'
ENVIRONMENT = {**os.environ, "PYTHONPATH": str(ROOT), "COLUMNS": "200"}


def gone(pid, within_s=10.0):
    end = time.monotonic() + within_s
    while time.monotonic() < end:
        try:
            if psutil.Process(pid).status() == psutil.STATUS_ZOMBIE:
                return True
        except psutil.NoSuchProcess:
            return True
        time.sleep(0.01)
    return False


def test_a_cell_lives_as_long_as_its_block():
    children = len(psutil.Process().children())
    with EmulatedCell(plant="nominal", seed=1) as cell:
        pid = cell.process.pid
        assert cell.description["emulator"]["pid"] == pid
        first = cell.ask("info")
        time.sleep(0.1)
        assert cell.ask("info")["ticks"] > first["ticks"]
        cell.wait_until("right", "robot_mode", 7)
        with pytest.raises(EmulatorError, match="is 7 after"):
            cell.wait_until("right", "robot_mode", 3, within_s=0.05)
        with pytest.raises(EmulatorError, match="unknown request 'nothing'"):
            cell.ask("nothing")
        assert cell.ask("state", arm="left", names=["robot_mode"]) == {"robot_mode": 7}
        # It is a session of its own, so that Ctrl-C in a terminal is not for it.
        assert os.getsid(pid) != os.getsid(0)
    assert cell.process.returncode == 0
    assert gone(pid)
    assert is_free(cell.left)
    assert is_free(cell.right)
    with pytest.raises(ClosedError):
        cell.ask("info")
    cell.close()
    assert len(psutil.Process().children()) == children


def test_a_cell_ends_when_its_block_fails():
    pids = []

    def block():
        with EmulatedCell() as cell:
            pids.append(cell.process.pid)
            raise ZeroDivisionError

    with pytest.raises(ZeroDivisionError):
        block()
    assert gone(pids[0])


def test_shutdown_ends_a_cell_and_is_reported():
    with EmulatedCell() as cell:
        cell.ask("shutdown")
        assert cell.process.wait(10.0) == 0
        with pytest.raises(EmulatorError, match="'info'"):
            cell.ask("info")


def test_a_cell_ends_when_both_controllers_are_shut_down():
    with EmulatedCell() as cell:
        for host in (cell.left, cell.right):
            time.sleep(0.3)
            assert cell.process.poll() is None  # the other one goes on
            with socket.create_connection((host, 29999), timeout=5.0) as client:
                client.sendall(b"shutdown\n")
                while client.recv(1000):
                    pass
        assert cell.process.wait(10.0) == 0


def test_a_cell_ends_with_the_program_that_started_it():
    code = "import time\nfrom dual_ur10.emulated.emulated_cell import EmulatedCell\n"
    code += "cell = EmulatedCell()\nprint(cell.process.pid, flush=True)\ntime.sleep(60)\n"
    starter = subprocess.Popen([sys.executable, "-c", code], env=ENVIRONMENT, stdout=subprocess.PIPE)
    try:
        pid = int(starter.stdout.readline())
        assert psutil.pid_exists(pid)
        os.kill(starter.pid, signal.SIGKILL)
        assert gone(pid)
    finally:
        starter.kill()
        starter.wait()
        starter.stdout.close()


def test_a_stalled_cell_is_reported_and_continues(tmp_path):
    with EmulatedCell(log=tmp_path / "log") as cell:
        cell.ask("info")
        os.kill(cell.process.pid, signal.SIGSTOP)
        cell._injection.timeout_s = 0.4
        with pytest.raises(EmulatorError, match="no answer to 'state'"):
            cell.ask("state", arm="left", names=["robot_mode"])
        os.kill(cell.process.pid, signal.SIGCONT)
        # The answer of now, and not the one that was not waited for.
        info = cell.ask("info")
        assert info["lost_s"] > 0.25
        assert cell.ask("state", arm="left", names=["safety_mode"]) == {"safety_mode": 1}
        assert "stalled" in (tmp_path / "log").read_text()


def test_a_cell_that_does_not_end_is_killed(monkeypatch):
    monkeypatch.setattr(emulated_controller, "_END_S", 0.2)
    cell = EmulatedCell()
    os.kill(cell.process.pid, signal.SIGSTOP)
    cell.close()
    assert cell.process.returncode == -signal.SIGKILL


def test_two_cells_at_once_are_apart(tmp_path):
    with EmulatedCell(log=tmp_path / "log") as first, EmulatedCell() as second:
        assert len({first.left, first.right, second.left, second.right}) == 4
        first.ask("stop", arm="left", mode=3)
        first.wait_until("left", "safety_mode", 3)
        assert second.ask("state", arm="left", names=["safety_mode"])["safety_mode"] == 1


STRANGE = dataclasses.replace(GENERIC_140, name="strange", drivers=("steam",))


@pytest.mark.parametrize(
    ("options", "kind", "text"),
    [
        ({"tools": "generic_140"}, SettingsError, "this scene has no grippers: name a task that has"),
        ({"tools": ["generic_140"], "task": "Handover"}, SettingsError, "name one, or one for each arm"),
        ({"tools": "robotiq", "task": "Handover"}, UnknownNameError, "did you mean 'robotiq_2f85'"),
        ({"tools": f"{__name__}:STRANGE", "task": "Handover"}, SettingsError, "driven by 'steam', and no cell file"),
        ({"right": "192.168.0.1"}, AddressError, "127.0.0.0/8"),
        ({"left": "127.0.0.9", "right": "127.0.0.9"}, AddressError, "both arms"),
        ({"family": "g-series"}, UnknownNameError, "'e-series'"),
        ({"task": "Juggling"}, UnknownNameError, "SineTracking"),
        ({"plant": "wild"}, UnknownNameError, "'nominal', 'mild', 'wide'"),
        ({"dh_error_m": 1.0}, SettingsError, "dh_error_m"),
        ({"seed": -1}, SettingsError, "seed is -1"),
        ({"seed": "x"}, SettingsError, "seed is 'x'"),
        ({"speed": 3}, SettingsError, "unknown options.*speed"),
        ({"left": 127}, AddressError, "127"),
    ],
)
def test_unknown_options_are_named(options, kind, text):
    with pytest.raises(kind, match=text):
        CellEmulator(CellOptions.from_mapping(options))


@pytest.mark.parametrize(
    ("options", "kind", "text"),
    [
        ({"left": "0.0.0.0"}, AddressError, "127.0.0.0/8"),
        ({"dh_error_m": "x"}, DualUR10Error, "str"),
        ({"plant": "wild"}, SettingsError, "'nominal', 'mild', 'wide'"),
        ({"speed": 3}, SettingsError, "unknown options.*speed"),
    ],
)
def test_errors_of_its_process_are_raised_here(options, kind, text):
    children = len(psutil.Process().children())
    with pytest.raises(kind, match=text) as caught:
        EmulatedCell(**options)
    assert "Traceback" not in str(caught.value)
    assert len(psutil.Process().children()) == children


def test_a_taken_address_is_named():
    host = free_address()
    with socket.create_server((host, 30003)), pytest.raises(AddressError, match=f"{host}:30003 is taken"):
        EmulatedCell(left=host)


# The cell file.


def test_the_cell_file_describes_the_cell(tmp_path):
    path = tmp_path / "cell.toml"
    cell = Cell(cell=str(path), family="e-series", task="Handover", tools=("generic_140", "robotiq_2f85"))
    try:
        found = tomllib.loads(path.read_text())
        assert found == cell.emulator.description()
        assert found["kind"] == "emulated"
        assert [found[arm]["host"] for arm in ("left", "right")] == [each.host for each in cell.emulator.servers]
        assert found["left"]["family"] == "e-series"
        tools = [(found[arm]["gripper"]["kind"], found[arm]["gripper"]["tool"]) for arm in ("left", "right")]
        assert tools == [("robotiq", "generic_140"), ("robotiq", "robotiq_2f85")]
        assert load_cell_file(path).config().tools == cell.emulator.world.tools
        assert found["emulator"]["pid"] == os.getpid()
        with socket.create_connection((found["left"]["host"], found["emulator"]["port"]), timeout=2.0):
            pass
    finally:
        cell.close()
    Cell(cell=str(path)).close()  # its own kind is replaced
    assert tomllib.loads(path.read_text())["left"]["family"] == "cb3"


def test_keywords_of_the_task_decide_the_scene(tmp_path, monkeypatch):
    monkeypatch.setattr("dual_ur10.cli.emulate.serve", lambda emulators, **_: made.extend(emulators))
    path, made = tmp_path / "cell.toml", []
    code, text = run("emulate", "--task", "Handover", "--set", "grip_force_n=80", "--cell", str(path))
    assert code == 0, text
    (emulator,) = made
    try:
        assert emulator.world.config.equipment.grip_force_n == 80
        file = load_cell_file(path)
        assert file.emulated_scene == ("DualUR10/Handover-v0", {"grip_force_n": 80})
        assert CellFile.read(tomllib.loads(file.text())) == file
        EnvSetup.resolve("Handover", {"cell": str(path), "grip_force_n": 80, "duration_s": 10.0})
        EnvSetup.resolve("SineTracking", {"cell": str(path)})  # of another task nothing is compared
    finally:
        emulator.close()


@pytest.mark.parametrize("wanted", [{}, {"objects": ["block", "bar"]}, {"objects": ["block"], "grip_force_n": 50.0}])
def test_the_advice_on_another_scene_starts_a_cell_that_has_it(wanted, tmp_path, monkeypatch):
    monkeypatch.setattr("dual_ur10.cli.emulate.serve", lambda emulators, **_: made.extend(emulators))
    path, made = tmp_path / "cell.toml", []
    Cell(task="Free", settings={"objects": ["block", "bar"], "grip_force_n": 80.0}, cell=str(path)).close()
    keywords = {"cell": str(path), **wanted}
    with pytest.raises(SettingsError, match=r"another scene .* grip_force_n=80.0: ") as refused:
        EnvSetup.resolve("Free", keywords)
    (command,) = re.findall("`(.*)`", str(refused.value))
    code, text = run(*shlex.split(command), "--cell", str(path))
    assert code == 0, text
    made[0].close()
    EnvSetup.resolve("Free", keywords)


def test_an_object_that_no_command_names_is_advised_by_name(tmp_path):
    path = tmp_path / "cell.toml"
    Cell(task="Free", cell=str(path)).close()
    post = Prop(name="post", mjcf=POST)
    with pytest.raises(SettingsError, match=r'another scene .* or start the cell with such settings, in which "module'):
        EnvSetup.resolve("Free", {"cell": str(path), "objects": [post]})


@pytest.mark.parametrize("settings", [3, {"objects": object()}, {"grip_force_n": float("nan")}])
def test_keywords_that_json_does_not_hold_are_refused(settings):
    with pytest.raises(SettingsError, match="values that JSON holds"):
        Cell(task="Free", settings=settings)


@pytest.mark.parametrize("value", [object(), np.float32(60.0)])
def test_an_emulator_of_options_that_json_does_not_hold_is_refused(value):
    with pytest.raises(SettingsError, match=r"values that JSON holds .* module:NAME"):
        EmulatedCell(task="Handover", settings={"grip_force_n": value})


@pytest.mark.parametrize("text", ["", "kind = 'real'\n", "[left]\nhost = '10.0.0.1'\n", "no toml [", b"\xff\xfe"])
def test_other_files_are_left_alone(tmp_path, text):
    path = tmp_path / "cell.toml"
    path.write_bytes(text if isinstance(text, bytes) else text.encode())
    before = path.read_bytes()
    host = free_address()
    with pytest.raises(SettingsError, match=r"cell\.toml exists.*--cell"):
        Cell(cell=str(path), left=host)
    assert path.read_bytes() == before
    assert is_free(host)


def test_an_unwritable_path_is_named(tmp_path):
    with pytest.raises(DualUR10Error, match="none"):
        Cell(cell=str(tmp_path / "none" / "cell.toml"))
    with pytest.raises(DualUR10Error):
        write_cell_file(tmp_path, {"kind": "emulated"})


# The command line.


def run(*arguments):
    result = CliRunner().invoke(cli.app, list(arguments), env={"COLUMNS": "200"})
    return result.exit_code, re.sub(r"\x1b\[[0-9;]*m", "", result.output)


def test_help():
    code, text = run("emulate", "--help")
    assert code == 0
    for word in ("left", "right", "family", "task", "set", "tool", "cell", "plant", "dh-error-mm", "seed", "view"):
        assert f"--{word}" in text


def test_ctrl_c_ends_it_well(tmp_path):
    path = tmp_path / "cell.toml"
    with served("dual_ur10", "emulate", "--cell", str(path), "--powered-off") as lines:
        text = "".join(lines)
        cell = tomllib.loads(path.read_text())
        for arm in ("left", "right"):
            assert re.search(rf"{arm} +{re.escape(cell[arm]['host'])}\n", text)
        assert f"{cell['left']['host']}:{cell['emulator']['port']}" in text
        with socket.create_connection((cell["right"]["host"], 29999), timeout=5.0) as client:
            client.sendall(b"robotmode\n")
            answer = b""
            while answer.count(b"\n") < 2 and (data := client.recv(1000)):
                answer += data
            assert answer.endswith(b"Robotmode: POWER_OFF\n")


@pytest.mark.parametrize(
    ("arguments", "word"),
    [
        (("--left", "192.168.0.1"), "loopback"),
        (("--right", "0.0.0.0"), "loopback"),
        (("--family", "cb2"), "e-series"),
        (("--task", "Juggling"), "SineTracking"),
        (("--plant", "wild"), "nominal"),
        (("--dh-error-mm", "50"), "dh_error_m"),
        (("--seed", "-1"), "seed is -1"),
        (("--set", "grip_force_n=80"), "no task"),
        (("--task", "Handover", "--set", "action_mode=tcp_delta"), "grip_force_n"),
    ],
)
def test_errors_are_one_line_with_exit_code_2(arguments, word):
    code, text = run("emulate", *arguments)
    assert code == 2, text
    assert word in text
    assert "Traceback" not in text
    assert len(text.strip().splitlines()) == 1


def test_error_lines_are_red():
    process = subprocess.run(
        [sys.executable, "-m", "dual_ur10", "emulate", "--left", "192.168.0.1"],
        env={**ENVIRONMENT, "FORCE_COLOR": "1"}, capture_output=True, text=True, timeout=60.0, check=False,
    )  # fmt: skip
    assert process.returncode == 2
    assert process.stdout == ""
    (line,) = process.stderr.strip().splitlines()
    assert re.match(r"\x1b\[(1;)?31m", line)
    assert "loopback" in line
