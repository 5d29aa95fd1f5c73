"""Functions in processes of their own, whatever program starts them."""

from __future__ import annotations

import os
import pathlib
import pickle
import signal
import subprocess
import sys
import time

import pytest

from dual_ur10.sim2real.child import Child

WITHIN_S = 30.0
PROGRAM = """
import os
import sys
from dual_ur10.sim2real.child import Child

print("begins", flush=True)
child = Child(os.mkdir, sys.argv[1])
assert child.wait(30.0)
print(child.code, flush=True)
"""


def write(path: pathlib.Path, values: object) -> None:
    path.write_bytes(pickle.dumps((values, os.getpid(), os.getppid(), os.getsid(0), sys.stdin.read())))


def told(path: pathlib.Path, values: object = None, **more: object) -> tuple:
    child = Child(write, path, values)
    assert child.wait(WITHIN_S)
    assert (child.code, child.is_alive) == (0, False)
    return pickle.loads(path.read_bytes()), child


def test_it_runs_a_function_with_its_arguments_in_a_session_of_its_own(tmp_path):
    (values, pid, parent, session, rest), child = told(tmp_path / "out", {"a": (1, 2.5)})
    assert values == {"a": (1, 2.5)}
    assert pid == child.pid == session
    assert session != os.getsid(0)
    assert parent == os.getpid()
    assert rest == ""  # it waits for nobody to type


def test_arguments_may_be_larger_than_a_pipe(tmp_path):
    values = bytes(range(256)) * 20_000
    assert told(tmp_path / "out", values)[0][0] == values


def test_what_cannot_be_told_starts_no_process(monkeypatch):
    monkeypatch.setattr(subprocess, "Popen", lambda *_, **__: pytest.fail("a process was started"))
    with pytest.raises((TypeError, pickle.PicklingError, AttributeError)):
        Child(write, lambda: None)


@pytest.mark.parametrize("how", ["script", "stdin", "argument"])
def test_the_program_needs_no_guard_and_no_file(tmp_path, how):
    script, out = tmp_path / "program.py", tmp_path / "out"
    script.write_text(PROGRAM)
    command = {"script": [str(script)], "stdin": ["-"], "argument": ["-c", PROGRAM]}[how]
    given = {"input": PROGRAM} if how == "stdin" else {}
    done = subprocess.run(
        [sys.executable, *command, str(out)], capture_output=True, text=True, timeout=60, check=False, **given
    )
    assert (done.stdout.split(), done.stderr) == (["begins", "0"], "")  # once: the child does not run the program
    assert out.is_dir()


def test_it_finds_what_the_program_finds_in_the_folder_it_is_in(tmp_path):
    """As in a terminal's Python, whose path begins with "", the folder it is in."""
    (tmp_path / "beside.py").write_text("import pathlib\ndef work(name):\n    pathlib.Path(name).write_text('done')\n")
    code = (
        "import sys\nsys.path.insert(0, '')\nimport beside\nfrom dual_ur10.sim2real.child import Child\n"
        "child = Child(beside.work, 'out')\nassert child.wait(30.0)\nsys.exit(child.code)\n"
    )
    subprocess.run([sys.executable, "-P", "-c", code], cwd=tmp_path, check=True, timeout=60)
    assert (tmp_path / "out").read_text() == "done"


def test_it_is_killed_and_waited_for():
    child = Child(time.sleep, 60.0)
    assert child.is_alive
    assert child.code is None
    assert not child.wait(0.05)
    child.kill()
    assert not child.is_alive
    assert child.code == -signal.SIGKILL
    assert child.wait(0.0)
    child.kill()  # it has ended already


@pytest.mark.parametrize(("function", "argument", "code"), [(sys.exit, 3, 3), (os._exit, 7, 7), (sys.exit, 0, 0)])
def test_its_code_is_told(function, argument, code):
    child = Child(function, argument)
    assert child.wait(WITHIN_S)
    assert child.code == code


def test_an_error_is_a_code_and_said(capfd):
    child = Child(os.listdir, "/nowhere/at/all")
    assert child.wait(WITHIN_S)
    assert child.code == 1
    assert "/nowhere/at/all" in capfd.readouterr().err


def test_one_that_ends_before_it_has_read_is_dead_and_no_error(tmp_path, monkeypatch):
    monkeypatch.setattr(sys, "executable", "/bin/false")
    child = Child(write, tmp_path / "out", bytes(1 << 20))
    assert child.wait(WITHIN_S)
    assert child.code == 1


def test_an_orphan_does_nothing(tmp_path):
    """The program has ended before its child has come to read what to do."""
    out = tmp_path / "out"
    work = pickle.dumps(("tests.test_child", "write", os.getpid() + 1, (out, None)))
    command = [sys.executable, "-m", "dual_ur10.sim2real.child"]
    subprocess.run(command, input=work, check=True, timeout=60)
    assert not out.exists()
