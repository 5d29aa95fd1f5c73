"""Child processes, whatever program starts them."""

from __future__ import annotations

import contextlib
import gc
import logging
import os
import pathlib
import pickle
import re
import signal
import subprocess
import sys
import threading
import time

import pytest

from ur_core.processes.child_process import LONGER_SLICE_S, LOST, NICE, SLICE_S, Child
from ur_core.processes.system import LOCAL

WITHIN_S = 30.0
PROGRAM = """
import os
import sys
from ur_core.processes.child_process import Child

print("begins", flush=True)
child = Child(os.mkdir, sys.argv[1])
assert child.wait(30.0)
print(child.code, flush=True)
"""

# Program that is interrupted at hundreds of instants, while it queries the end of its children.
INTERRUPTED = """
import random
import signal
import sys
import time
from ur_core.processes.child_process import Child


def interrupt(*heard):
    raise KeyboardInterrupt


signal.signal(signal.SIGALRM, interrupt)
chance = random.Random(0)
interrupted = 0


def during(work, within_s):
    global interrupted
    try:
        signal.setitimer(signal.ITIMER_REAL, chance.uniform(1e-6, within_s))
        while True:
            work()
    except KeyboardInterrupt:
        interrupted += 1
    finally:
        signal.setitimer(signal.ITIMER_REAL, 0.0)


child = Child(time.sleep, 600.0)
for _ in range(300):
    during(lambda: child.is_alive, 1e-3)
    during(lambda: child.wait(0.0), 1e-3)
    during(lambda: child.wait(5e-4), 3e-3)
assert child.is_alive
during(child.kill, 1e-3)
child.kill()
assert child.code == -signal.SIGKILL and child.wait(0.0)
print("interrupted", interrupted)
"""


def write(path: pathlib.Path, values: object) -> None:
    path.write_bytes(pickle.dumps((values, os.getpid(), os.getppid(), os.getsid(0), sys.stdin.read())))


def written(path: pathlib.Path, values: object = None, **more: object) -> tuple:
    child = Child(write, path, values)
    assert child.wait(WITHIN_S)
    assert (child.code, child.is_alive) == (0, False)
    return pickle.loads(path.read_bytes()), child


def test_it_runs_a_function_in_a_session_of_its_own(tmp_path):
    (values, pid, parent, session, rest), child = written(tmp_path / "out", {"a": (1, 2.5)})
    assert values == {"a": (1, 2.5)}
    assert pid == child.pid == session
    assert session != os.getsid(0)
    assert parent == os.getpid()
    assert rest == ""  # it does not read the terminal


def test_arguments_may_be_larger_than_a_pipe(tmp_path):
    values = bytes(range(256)) * 20_000
    assert written(tmp_path / "out", values)[0][0] == values


def test_arguments_that_cannot_be_pickled_start_no_process(monkeypatch):
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


def test_it_imports_modules_beside_the_program(tmp_path):
    """As in an interactive Python, whose path begins with "", the present folder."""
    (tmp_path / "beside.py").write_text("import pathlib\ndef work(name):\n    pathlib.Path(name).write_text('done')\n")
    code = (
        "import sys\nsys.path.insert(0, '')\nimport beside\n"
        "from ur_core.processes.child_process import Child\n"
        "child = Child(beside.work, 'out')\nassert child.wait(30.0)\nsys.exit(child.code)\n"
    )
    subprocess.run([sys.executable, "-P", "-c", code], cwd=tmp_path, check=True, timeout=60)
    assert (tmp_path / "out").read_text() == "done"


def test_kill_waits_for_the_end():
    child = Child(time.sleep, 60.0, name="left")
    end = time.monotonic() + WITHIN_S
    while not (shown := pathlib.Path(f"/proc/{child.pid}/cmdline").read_bytes()) and time.monotonic() < end:
        time.sleep(0.01)  # it is starting
    assert shown.split(b"\0")[-2:] == [b"left", b""]
    assert child.is_alive
    assert child.code is None
    assert not child.wait(0.05)
    child.kill()
    assert not child.is_alive
    assert child.code == -signal.SIGKILL
    assert child.wait(0.0)
    child.kill()  # it has ended already


def test_interrupts_at_any_instant_spoil_neither_query_nor_kill():
    done = subprocess.run([sys.executable, "-c", INTERRUPTED], capture_output=True, text=True, timeout=60, check=False)
    assert (done.stdout.split(), done.stderr) == (["interrupted", "901"], "")


def test_an_interrupt_during_the_start_leaves_no_process():
    started = []

    class Noted(subprocess.Popen):
        def __init__(self, *given, **more):
            super().__init__(*given, **more)
            started.append(self.pid)
            signal.raise_signal(signal.SIGINT)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(subprocess, "Popen", Noted)
        with pytest.raises(KeyboardInterrupt):
            Child(time.sleep, 60.0)
    (pid,) = started
    with pytest.raises(ProcessLookupError):
        os.kill(pid, 0)


def test_a_process_whose_end_somebody_else_has_collected():
    child = Child(time.sleep, 0.0)
    os.waitpid(child.pid, 0)
    assert (child.wait(WITHIN_S), child.code) == (True, LOST)
    child.kill()


def test_a_process_that_nobody_has_collected_does_not_run():
    with subprocess.Popen([sys.executable, "-c", "input()"], stdin=subprocess.PIPE) as process:
        assert LOCAL.is_running(process.pid)
        process.kill()
        os.waitid(os.P_PID, process.pid, os.WEXITED | os.WNOWAIT)
        assert not LOCAL.is_running(process.pid)
    assert not LOCAL.is_running(process.pid)


def test_the_wait_for_a_killed_process_is_bounded(monkeypatch, caplog):
    child = Child(time.sleep, 60.0)
    with monkeypatch.context() as patch:
        patch.setattr(os, "kill", lambda *_: None)
        child.kill(0.01)
    assert f"process {child.pid} was killed and has not ended" in caplog.text
    assert child.is_alive
    child.kill()
    assert not child.is_alive


@pytest.mark.parametrize(("function", "argument", "code"), [(sys.exit, 3, 3), (os._exit, 7, 7), (sys.exit, 0, 0)])
def test_exit_codes(function, argument, code):
    child = Child(function, argument)
    assert child.wait(WITHIN_S)
    assert child.code == code


def test_an_error_is_a_code_and_a_traceback(capfd):
    child = Child(os.listdir, "/nowhere/at/all")
    assert child.wait(WITHIN_S)
    assert child.code == 1
    assert "/nowhere/at/all" in capfd.readouterr().err


def print_and_fail() -> None:
    os.write(1, b"from C, ")  # as a library does that does not know Python's streams
    os.write(2, b"both streams\nwithout an end")
    raise SystemExit(3)


def test_all_that_a_process_prints_can_be_read(capfd):
    lines: list[str] = []
    child = Child(print_and_fail, output=lines.append)
    assert child.wait(WITHIN_S)
    assert (child.code, lines) == (3, ["from C, both streams", "without an end"])
    failed = Child(os.listdir, "/nowhere/at/all", output=lines.append)
    assert failed.wait(WITHIN_S)
    assert any("/nowhere/at/all" in line for line in lines)  # its traceback
    assert capfd.readouterr() == ("", "")


def print_much() -> None:
    for _ in range(100):
        with contextlib.suppress(BlockingIOError):
            os.write(2, bytes(10_000))


def log_much() -> None:
    for _ in range(100):
        logging.getLogger("much").warning("x" * 10_000)


@pytest.mark.parametrize("talk", [print_much, log_much])
def test_a_process_is_not_held_up_by_somebody_who_does_not_read(talk):
    goes_on = threading.Event()
    child = Child(talk, output=lambda line: goes_on.wait())
    assert child.wait(WITHIN_S)
    assert child.code == 0
    goes_on.set()


@pytest.mark.parametrize("output", [None, print])
def test_no_file_stays_open(output):
    gc.collect()
    before = len(os.listdir("/proc/self/fd"))
    child = Child(time.sleep, 60.0, output=output)
    child.kill()
    assert child._reader is None or not child._reader.is_alive()
    assert len(os.listdir("/proc/self/fd")) <= before  # files of earlier tests may close meanwhile


def test_a_process_that_ends_before_it_reads_is_no_error(tmp_path, monkeypatch):
    monkeypatch.setattr(sys, "executable", "/bin/false")
    child = Child(write, tmp_path / "out", bytes(1 << 20))
    assert child.wait(WITHIN_S)
    assert child.code == 1


def test_an_orphan_does_nothing(tmp_path):
    """The parent has ended before its child has read the function."""
    out = tmp_path / "out"
    work = pickle.dumps(("tests.sim2real.processes.test_child_process", "write", os.getpid() + 1, (out, None)))
    command = [sys.executable, "-m", "ur_core.processes.child_process"]
    subprocess.run(command, input=work, check=True, timeout=60)
    assert not out.exists()


LINUX = tuple(map(int, re.findall(r"\d+", os.uname().release)[:2])) if sys.platform == "linux" else (0, 0)

_AUTOGROUP = pathlib.Path("/proc/self/autogroup")
SESSION_GROUP = _AUTOGROUP.read_text().split()[-1:] if _AUTOGROUP.exists() else []

# Program that reports niceness, time slice and the niceness of its session after `hasten`.
HASTENED = """
import ctypes
import os
import pathlib
from ur_core.processes.child_process import _SCHED_ATTR, hasten

hasten()
attributes = ctypes.create_string_buffer(_SCHED_ATTR.size)
ctypes.CDLL(None).syscall({"x86_64": 315, "aarch64": 275}[os.uname().machine], 0, attributes, _SCHED_ATTR.size, 0)
group = pathlib.Path("/proc/self/autogroup")  # empty where control groups decide instead
of_session = group.read_text().split()[-1:] if group.exists() else []
print(os.getpriority(os.PRIO_PROCESS, 0), _SCHED_ATTR.unpack(attributes)[5], *of_session)
"""


def hastened(*, own_session: bool, call: str = "hasten()") -> list[str]:
    """Return niceness, time slice and, where Linux groups processes by session, the niceness of that session."""
    run = subprocess.run(
        [sys.executable, "-c", HASTENED.replace("hasten()", call)],
        capture_output=True,
        text=True,
        check=True,
        start_new_session=own_session,
    )
    return run.stdout.split()


@pytest.mark.skipif(sys.platform != "linux", reason="time slices and groups of sessions are Linux's")
def test_a_process_with_deadlines_gets_the_priority_it_asks_for() -> None:
    nice, slice_ns, *of_session = hastened(own_session=True)
    if LINUX >= (6, 12):
        assert int(slice_ns) == round(1e9 * LONGER_SLICE_S)
        assert int(hastened(own_session=True, call=f"hasten(slice_s={SLICE_S})")[1]) == round(1e9 * SLICE_S)
    if os.geteuid() == 0 and int(nice) == NICE:
        assert of_session in ([str(NICE)], [])


def hurried(calls: str) -> tuple[int, int]:
    """Return niceness and time slice of a program after calls of the system."""
    program = HASTENED.replace("hasten()", f"from ur_core.processes.system import LOCAL; {calls}")
    run = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True)
    nice, slice_ns = run.stdout.split()[:2]
    return int(nice), int(slice_ns)


@pytest.mark.skipif(sys.platform != "linux", reason="time slices are Linux's")
def test_a_program_that_owes_actions_keeps_its_niceness():
    nice, slice_ns = hurried("LOCAL.hurry()")
    assert nice == os.getpriority(os.PRIO_PROCESS, 0)
    if LINUX >= (6, 12):
        assert slice_ns == round(1e9 * LONGER_SLICE_S)


@pytest.mark.skipif(sys.platform != "linux", reason="time slices are Linux's")
def test_a_program_that_owes_no_more_actions_is_scheduled_as_before():
    assert hurried("LOCAL.hurry()()") == hurried("pass")


@pytest.mark.skipif(not SESSION_GROUP, reason="this system groups no processes by session")
def test_the_session_of_a_terminal_keeps_its_priority() -> None:
    assert hastened(own_session=False)[2:] == SESSION_GROUP
