"""Program files: a folder of scripts that the dashboard loads."""

import pytest

from tests.ur_emulator.ticking import Bench, program
from ur_core.errors import SettingsError
from ur_emulator.controller.pendant import Pendant
from ur_emulator.controller.program_files import FILES_MAX, script_texts
from ur_emulator.ports.dashboard import Dashboard
from ur_emulator.script.splitter import PROGRAM_MAX

WAIT = program("write_output_integer_register(9, 7)\nsleep(9)", "wait_program")


@pytest.fixture
def folder(tmp_path):
    (tmp_path / "wait_program.script").write_text(WAIT)
    (tmp_path / "wrong.script").write_text("def wrong():\n  no_such_function()\nend\n")
    (tmp_path / "cell").mkdir()
    (tmp_path / "cell" / "My Program.script").write_text(WAIT)
    (tmp_path / "other.urp").write_bytes(b"\x1f\x8b")
    return tmp_path


@pytest.fixture
def dashboard(folder):
    bench = Bench("e-series")
    dashboard = Dashboard(bench.profile, Pendant(bench.controller, lambda: None, script_texts(folder)))
    dashboard.bench = bench
    return dashboard


@pytest.mark.parametrize(
    "name",
    [
        *("wait_program.urp", "wait_program.script", "/programs/wait_program.urp", "/ursim/programs/wait_program.urp"),
        *("cell/My Program.urp", "/programs/cell/My Program.urp"),
    ],
)
def test_a_program_is_loaded_played_paused_and_stopped(dashboard, name):
    short = name.rsplit("/", 1)[-1]
    assert dashboard.answer(f"load {name}") == f"Loading program: {name}"
    assert dashboard.answer("programState") == f"STOPPED {short}"
    assert dashboard.answer("get loaded program") == f"Loaded program: {name}"
    assert dashboard.answer("isProgramSaved") == f"true {short}"
    assert dashboard.answer("play") == "Starting program"
    dashboard.bench.tick(3)
    assert dashboard.bench.controller.registers.output_int[9] == 7
    assert dashboard.answer("programState") == f"PLAYING {short}"
    assert dashboard.answer("pause") == "Pausing program"
    dashboard.bench.tick(100)
    assert dashboard.answer("programState") == f"PAUSED {short}"
    assert dashboard.answer("play") == "Starting program"
    assert dashboard.answer("stop") == "Stopped"
    dashboard.bench.tick(3)
    assert dashboard.answer("programState") == f"STOPPED {short}"


@pytest.mark.parametrize("name", ["none.urp", "other.urp", "../wait_program.urp", "/etc/passwd", "wait_program", ""])
def test_what_is_not_there_is_not_found(dashboard, name, caplog, monkeypatch):
    """Without a search for the nearest name, which takes 3 ms for a hundred files: many requests come in one piece."""
    monkeypatch.setattr("ur_core.errors.difflib", None)
    caplog.set_level("INFO")
    assert dashboard.answer(f"load {name}") == f"File not found: {name}"
    assert "use one of 'cell/My Program.script', 'wait_program.script'" in caplog.text
    assert dashboard.answer("get loaded program") == "No program loaded"


def test_a_wrong_program_is_refused(dashboard, caplog):
    assert dashboard.answer("load wrong.urp") == "Error while loading program: wrong.urp"
    assert "no_such_function" in caplog.get_records("setup")[0].getMessage()
    assert dashboard.answer("get loaded program") == "No program loaded"


def test_a_wrong_folder_is_a_named_error(tmp_path):
    with pytest.raises(SettingsError, match="no folder"):
        script_texts(tmp_path / "none")
    (tmp_path / "a.script").write_bytes(b"\xff")
    with pytest.raises(SettingsError, match="cannot be read"):
        script_texts(tmp_path)
    (tmp_path / "a.script").write_text("#" * (PROGRAM_MAX + 1))
    with pytest.raises(SettingsError, match="at most"):
        script_texts(tmp_path)
    for number in range(FILES_MAX + 1):
        (tmp_path / f"{number}.script").write_text("")
    with pytest.raises(SettingsError, match="smaller folder"):
        script_texts(tmp_path)
