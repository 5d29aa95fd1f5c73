"""The command `new-task`: a project that installs, and whose own tests pass."""

from __future__ import annotations

import errno
import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from tests import scripts
from tests.cli.command import run

PRINTED = (
    "pip install -e {}",
    "python -m dual_ur10 evaluate Lab/ReachBoth-v0",
    "pytest {}",
    "python -m dual_ur10 audit Lab/ReachBoth-v0",
)
INSTALL = ("--quiet", "--no-deps", "--no-index", "--no-build-isolation", "--no-compile")
RUN = "import runpy, site, sys; site.addsitedir(sys.argv.pop(1)); runpy.run_module(sys.argv.pop(1), None, '__main__')"


@pytest.fixture(scope="module")
def project(tmp_path_factory):
    folder = tmp_path_factory.mktemp("new") / "reach_both"
    code, text = run("new-task", "ReachBoth", "--out", str(folder), "--namespace", "Lab")
    assert code == 0
    assert " ".join(text.split()).endswith("; ".join(PRINTED).format(folder, folder))
    return folder


@pytest.mark.parametrize("editable", [False, True], ids=["installed", "editable"])
def test_the_printed_commands_work_in_a_process_that_has_not_imported_it(project, tmp_path, editable):
    install = [sys.executable, "-m", "pip", "install", *INSTALL, "--target", str(tmp_path)]
    subprocess.run([*install, str(project)], check=True, timeout=120, capture_output=True)
    if editable:  # as pip leaves it, whose --editable needs a package from the network
        shutil.rmtree(tmp_path / "reach_both")
        (tmp_path / "reach_both.pth").write_text(f"{project}\n")
    script = tmp_path / "run.py"
    script.write_text(RUN)
    for command, option, text in (
        (PRINTED[1], "--episodes=2", "2 of 2"),
        (PRINTED[3], "--quick", "0 errors, 0 warnings"),
    ):
        arguments = [str(tmp_path), *command.split()[2:], option]
        assert text in scripts.run(script, *arguments, folder=tmp_path, output=tmp_path / "output")


def test_its_own_tests_pass(project, tmp_path):
    scripts.run_tests(project / "tests", project, folder=tmp_path)


def test_it_is_as_well_kept_as_this_package(project):
    pytest.importorskip("ruff")
    ruff = [sys.executable, "-m", "ruff"]
    select = ["--select", "E,F,W,UP,B,D", "--ignore", "D103,D105,D107"]
    select += ["--config", 'lint.pydocstyle.convention="google"']
    for command in (["check", *select], ["format", "--check"]):
        rest = ["--line-length", "120", "--isolated", str(project)]
        done = subprocess.run([*ruff, *command, *rest], capture_output=True, text=True)
        assert done.returncode == 0, done.stdout


@pytest.mark.parametrize(
    ("arguments", "text"),
    [
        (["peg"], "a capital letter first"),
        (["Peg-v1"], "use letters and digits"),
        (["Handover", "--namespace", "DualUR10"], "another one than DualUR10"),
        (["Peg", "--out", "."], "name a folder that does not"),
        (["Peg", "--out", "/dev/null/peg"], "cannot make /dev/null/peg: Not a directory"),
        (["Start"], "is that of something else"),
        (["Json"], "is that of something else"),
        (["Class"], "is that of something else"),
    ],
)
def test_bad_names_are_refused(arguments, text, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    code, found = run("new-task", *arguments)
    assert code == 2
    assert text in " ".join(found.split())
    assert not list(tmp_path.iterdir())


def test_a_full_disk_leaves_no_part_of_a_project(tmp_path, monkeypatch):
    def full(self, *_):
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    monkeypatch.setattr(Path, "write_text", full)
    code, found = run("new-task", "Peg", "--out", str(tmp_path / "peg"))
    assert code == 2
    assert "No space left on device" in " ".join(found.split())
    assert not list(tmp_path.iterdir())
