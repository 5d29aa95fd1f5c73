"""The commands for cell files, as a user meets them."""

from __future__ import annotations

import functools
import re
from pathlib import Path

import pytest

from dual_ur10.sim2real.cell_file.cell_file import load_cell_file
from dual_ur10.sim2real.commissioning.findings import Finding
from dual_ur10.sim2real.runtime.latch import Latch
from tests.cli import command

HOSTS = ("--left", "192.168.1.10", "--right", "192.168.1.11")


run = functools.partial(command.run, "cell")


@pytest.mark.parametrize(
    ("names", "words"),
    [
        ((), ("new", "check", "show")),
        (("new",), ("FILE", "--kind", "--left", "--right", "--family", "--task", "ever overwritten")),
        (("check",), ("FILE", "Connects to nothing")),
        (("show",), ("FILE", "defaults")),
    ],
)
def test_help_lists_commands_and_options(names: tuple[str, ...], words: tuple[str, ...]) -> None:
    code, text = run(*names, "--help")
    assert code == 0
    for word in words:
        assert word in text


def test_a_new_file_can_be_checked_and_shown(tmp_path: Path) -> None:
    path = tmp_path / "lab.toml"
    code, text = run("new", str(path), *HOSTS, "--task", "SyncCarry")
    assert code == 0
    assert f"wrote {path}" in text
    assert f"cell check {path}" in text
    cell = load_cell_file(path)
    assert (cell.kind, cell.left.host, cell.right.host) == ("real", "192.168.1.10", "192.168.1.11")
    assert cell.task == "DualUR10/SyncCarry-v0"
    code, text = run("check", str(path))
    assert code == 0
    *notes, last = text.splitlines()
    assert last == f"{path} is a legal real cell"
    assert [each.removeprefix("note: ") for each in notes] == cell.notes()
    code, text = run("show", str(path))
    assert code == 0
    rows = [[each.strip() for each in line.split("│")[1:-1]] for line in text.splitlines() if line.startswith("│")]
    assert ["host", "192.168.1.10", "192.168.1.11"] in rows
    assert ["base_position_m", "[-0.75, 0.6, 0.0]", "[-0.75, -0.6, 0.0]"] in rows
    assert ["speed_factor", "0.25"] in rows
    assert ["model", "ur10", "ur10"] in rows
    assert cell.sha256 in text


def test_a_new_emulated_cell_needs_no_addresses(tmp_path: Path) -> None:
    path = tmp_path / "cell.toml"
    code, text = run("new", str(path), "--kind", "emulated", "--family", "e-series")
    assert (code, text) == (0, f"wrote {path}\n")
    assert load_cell_file(path).right.family == "e-series"
    assert run("check", str(path)) == (0, f"{path} is a legal emulated cell\n")


def test_show_prints_all_kinds_of_values(tmp_path: Path) -> None:
    path = tmp_path / "cell.toml"
    run("new", str(path), "--kind", "emulated")
    text = path.read_text().replace('kind = "none"', 'kind = "digital_output"\noutput = 3\nopen_level = true', 1)
    text += '[[obstacle]]\nname = "post"\nkind = "capsule"\nfrom_m = [1, 0, 0]\nto_m = [1, 0, 1]\nradius_m = 0.1\n'
    path.write_text(text)
    code, text = run("show", str(path))
    assert code == 0
    rows = [[each.strip() for each in line.split("│")[1:-1]] for line in text.splitlines() if line.startswith("│")]
    assert ["gripper.output", "3", "—"] in rows
    assert ["gripper.open_level", "true", "—"] in rows
    assert ["obstacle[0].kind", "capsule"] in rows
    assert ["obstacle[0].radius_m", "0.1"] in rows


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (("--left", "192.168.1.10"), "the address of the right arm is missing"),
        (("--kind", "reel"), "unknown kind of cell 'reel' (did you mean 'real'?): use one of 'real', 'emulated'"),
        ((*HOSTS, "--family", "cb4"), 'left.family is "cb4": allowed is "cb3" or "e-series"'),
        ((*HOSTS, "--task", "Juggling"), "unknown environment 'Juggling'"),
        ((*HOSTS, "--kind", "emulated"), "left.host is 192.168.1.10 with kind"),
        (("--left", "10.0.0.1", "--right", "10.0.0.1"), "right.host is 10.0.0.1, as left.host is"),
        (("--left", "10.0.0.1\nx", "--right", "10.0.0.1"), 'left.host is "10.0.0.1\\nx"'),
    ],
)
def test_new_with_bad_values_leaves_no_file(tmp_path: Path, arguments: tuple[str, ...], message: str) -> None:
    path = tmp_path / "lab.toml"
    code, text = run("new", str(path), *arguments)
    assert code == 2
    assert text.startswith("error: ")
    assert message in text
    assert text.count("\n") == 1
    assert not path.exists()


def test_clear_names_what_still_prevents_a_start(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = tmp_path / "cell.toml"
    assert run("new", str(path), "--kind", "emulated")[0] == 0
    held = Finding("left", "safety mode", "fail", "7 (ROBOT_EMERGENCY_STOP)", "1 (NORMAL)", "release it")
    fine = Finding("right", "safety mode", "ok", "1 (NORMAL)")
    monkeypatch.setattr("dual_ur10.sim2real.commissioning.doctor.check_file", lambda cell: [held, fine])
    latch = Latch(load_cell_file(path))
    latch.set("left: safety mode 7 (ROBOT_EMERGENCY_STOP)")
    code, text = run("clear", str(path), "--yes")
    assert code == 0
    assert latch.read() is None
    assert text.splitlines()[-1] == f"it would be refused now: {held.message}"


def test_doctor_shows_problems_first_the_worst_before_the_others(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = tmp_path / "cell.toml"
    assert run("new", str(path), "--kind", "emulated")[0] == 0
    levels = {"first": "ok", "second": "warn", "third": "ok", "worst": "fail"}
    found = [Finding("left", name, level, "a", "b", "do it") for name, level in levels.items()]  # type: ignore[arg-type]
    monkeypatch.setattr("dual_ur10.sim2real.commissioning.doctor.check_file", lambda cell: found)
    code, text = command.run("doctor", "--cell", str(path))
    assert code == 1
    assert re.findall("first|second|third|worst", text) == ["worst", "second", "first", "third"]
    assert text.count("do it") == 2  # remedies of problems alone
    assert text.splitlines()[-1] == "3 ok, 1 warning, 1 failed"  # with the installation of MuJoCo


def test_new_overwrites_nothing(tmp_path: Path) -> None:
    path = tmp_path / "lab.toml"
    path.write_text("mine")
    code, text = run("new", str(path), *HOSTS)
    assert code == 2
    assert "exists: it was left as it is" in text
    assert path.read_text() == "mine"
    assert list(tmp_path.iterdir()) == [path]


def test_check_prints_a_line_per_finding(tmp_path: Path) -> None:
    path = tmp_path / "lab.toml"
    run("new", str(path), *HOSTS)
    text = path.read_text().replace("gain = 2000.0", "gian = 2000.0").replace("rt_priority = 0", "rt_priority = 99")
    path.write_text(text.replace("speed_factor = 0.25", 'speed_factor = "[bold]"'))
    code, text = run("check", str(path))
    assert code == 2
    lines = text.splitlines()
    assert [line.split()[:3] for line in lines] == [
        ["error:", f"{path}:", each]
        for each in ("speed_factor", "rt_priority", "left.servoj.gian", "right.servoj.gian")
    ]
    assert '"[bold]"' in lines[0]  # markup in a file is text
    code, text = run("show", str(path))
    assert code == 2
    assert "(3 more:" in text
    assert text.count("\n") == 1


def test_check_refuses_arms_of_two_families(tmp_path: Path) -> None:
    path = tmp_path / "lab.toml"
    run("new", str(path), *HOSTS)
    edited = path.read_text().replace('family = "cb3"', 'family = "e-series"', 1)
    path.write_text(edited)
    code, text = run("check", str(path))
    assert (code, text.count("\n")) == (2, 1)
    assert "left.model is 'ur10' and left.family is 'e-series': the controller of a UR10 is of the family 'cb3'" in text
    path.write_text(edited.replace('model = "ur10"', 'model = "ur10e"', 1))
    code, text = run("check", str(path))
    assert code == 2
    assert text.startswith(f"error: {path}: right.family is 'cb3' and left.family is 'e-series'")
    assert text.count(str(path)) == 1
    assert text.count("\n") == 1


@pytest.mark.parametrize("name", ["check", "show"])
@pytest.mark.parametrize("content", [None, "no toml ["])
def test_an_unreadable_file_is_one_line(tmp_path: Path, name: str, content: str | None) -> None:
    path = tmp_path / "lab.toml"
    if content is not None:
        path.write_text(content)
    code, text = run(name, str(path))
    assert code == 2
    assert text.startswith("error: ")
    assert str(path) in text
    assert text.count("\n") == 1
