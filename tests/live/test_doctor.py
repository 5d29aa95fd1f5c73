"""The doctor checks emulated controllers in a process of their own."""

import re

from typer.testing import CliRunner

from dual_ur10.cli import main as cli
from dual_ur10.emulated.emulated_cell import EmulatedCell
from dual_ur10.sim2real.commissioning import doctor


def test_a_cell_file_states_what_is_expected(tmp_path, monkeypatch):
    monkeypatch.setattr("dual_ur10.sim2real.commissioning.findings.MOST_ROUND_TRIP_S", 10.0)
    monkeypatch.setattr(doctor, "stream_findings", lambda *_, **__: [])
    file = tmp_path / "cell.toml"
    with EmulatedCell(plant="nominal", cell=str(file)) as cell:
        done = CliRunner().invoke(cli.app, ["doctor", "--cell", str(file)], env={"COLUMNS": "250"})
        assert done.exit_code == 0, done.output
        file.write_text(re.sub(r'serial_number = "[^"]*"', 'serial_number = "12345"', file.read_text(), count=1))
        done = CliRunner().invoke(cli.app, ["doctor", "--cell", str(file)], env={"COLUMNS": "250"})
        assert done.exit_code == 1
        assert "12345" in done.output
        for arguments in (["--left", cell.left], ["--cell", str(file), "--left", cell.left]):
            assert CliRunner().invoke(cli.app, ["doctor", *arguments]).exit_code == 2
