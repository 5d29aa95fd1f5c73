"""Latched faults, and the lock of one program per arm."""

from __future__ import annotations

import json
import os
import signal
import stat
import subprocess
import sys
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import pytest

from dual_ur10.errors import CellBusyError, CellFaulted, SettingsError
from dual_ur10.sim2real.cell_file.cell_file import CellFile, load_cell_file
from dual_ur10.sim2real.cell_file.tables import EmulatorEntry
from dual_ur10.sim2real.runtime import latch
from dual_ur10.sim2real.runtime.latch import CellLock, Claim, Latch
from ur_core.processes.system import LOCAL

TEXT = 'kind = "emulated"\n[left]\nhost = "{}"\n[right]\nhost = "{}"\n'


@pytest.fixture(autouse=True)
def home(tmp_path, monkeypatch):
    monkeypatch.setenv("XDG_STATE_HOME", str(tmp_path / "state"))
    return tmp_path / "state"


@pytest.fixture
def cell(tmp_path) -> CellFile:
    return made(tmp_path)


def made(tmp_path: Path, left: str = "127.0.0.2", right: str = "127.0.0.3") -> CellFile:
    path = tmp_path / "lab.toml"
    path.write_text(TEXT.format(left, right))
    return load_cell_file(path)


# The folder.


def test_the_folder_is_for_its_user_alone(home):
    old = os.umask(0)
    try:
        folder = LOCAL.state_folder()
    finally:
        os.umask(old)
    assert folder == home / "dual_ur10"
    assert stat.S_IMODE(folder.stat().st_mode) == 0o700
    folder.chmod(0o777)
    assert stat.S_IMODE(LOCAL.state_folder().stat().st_mode) == 0o700


@pytest.mark.parametrize("value", ["", "relative/folder"])
def test_without_a_folder_of_the_systems_it_is_in_the_home(tmp_path, monkeypatch, value):
    monkeypatch.setenv("XDG_STATE_HOME", value)
    monkeypatch.setenv("HOME", str(tmp_path))
    assert LOCAL.state_folder() == tmp_path / ".local" / "state" / "dual_ur10"


def test_a_folder_that_cannot_be_or_is_anothers_is_refused(home, monkeypatch):
    home.mkdir()
    (home / "dual_ur10").write_text("a file")
    with pytest.raises(SettingsError, match=r"cannot keep faults.*XDG_STATE_HOME"):
        LOCAL.state_folder()
    (home / "dual_ur10").unlink()
    monkeypatch.setattr(os, "getuid", lambda: os.geteuid() + 1)
    with pytest.raises(SettingsError, match="belongs to another user"):
        LOCAL.state_folder()


# Faults.


def test_a_fault_stays_until_it_is_cleared(cell, home):
    Latch(cell).check()
    Latch(cell).set("left: größer als erlaubt")
    again = Latch(cell)
    fault = again.read()
    assert fault is not None
    assert (fault.text, fault.arm) == ("left: größer als erlaubt", "left")
    assert len(fault.when_utc) == len("2026-01-01 00:00:00")
    with pytest.raises(CellFaulted, match=r"größer als erlaubt.*cell clear .*lab\.toml"):
        again.check()
    files = list((home / "dual_ur10").iterdir())
    assert len(files) == 2
    assert {stat.S_IMODE(each.stat().st_mode) for each in files} == {0o600}
    again.clear()
    again.clear()
    assert Latch(cell).read() is None
    again.check()


def test_a_fault_outlives_the_program_that_notes_it(cell, tmp_path):
    code = (
        "import sys, os\nfrom dual_ur10.sim2real.runtime.latch import Latch\n"
        "from dual_ur10.sim2real.cell_file.cell_file import load_cell_file\n"
        "Latch(load_cell_file(sys.argv[1])).set('stopped')\nos._exit(1)\n"
    )
    subprocess.run([sys.executable, "-c", code, str(tmp_path / "lab.toml")], check=False, timeout=60)
    with pytest.raises(CellFaulted, match="stopped"):
        Latch(cell).check()


@pytest.fixture
def synced(monkeypatch):
    """Return what `os.fsync` puts on the disk: the content of a file, or the names in a folder."""
    found, fsync = {}, os.fsync

    def noted(number):
        path = Path(f"/proc/self/fd/{number}").resolve()
        found[path.name] = sorted(each.name for each in path.iterdir()) if path.is_dir() else path.read_text()
        fsync(number)

    monkeypatch.setattr(os, "fsync", noted)
    return found


def test_a_fault_survives_a_power_cut(cell, synced):
    Latch(cell).set("stopped")
    names = ["fault-127.0.0.2.json", "fault-127.0.0.3.json"]
    assert synced["dual_ur10"] == names
    assert [json.loads(synced[name])["text"] for name in names] == ["stopped"] * 2


def test_the_note_of_moving_arms_survives_a_power_cut(cell, synced):
    lock = CellLock(cell)
    lock.note_moving()
    names = ["lock-127.0.0.2", "lock-127.0.0.3"]
    assert synced["dual_ur10"] == names
    assert [synced[name] for name in names] == [f"{os.getpid()} moving {name[5:]}\n" for name in names]
    lock.release()
    assert [synced[name] for name in names] == [f"{os.getpid()}\n"] * 2


def test_the_first_fault_stays(cell):
    Latch(cell).set("first")
    Latch(cell).set("second")
    fault = Latch(cell).read()
    assert fault is not None
    assert fault.text == "first"


def test_many_at_once_leave_one_whole_fault(cell):
    with ThreadPoolExecutor(8) as pool:
        list(pool.map(lambda number: Latch(cell).set(f"{number}" * 1000), range(8)))
    fault = Latch(cell).read()
    assert fault is not None
    assert len(set(fault.text)) == 1
    assert len(fault.text) == 1000


def test_a_fault_is_that_of_each_controller(cell, tmp_path):
    """Neither arm may move in another cell."""
    Latch(cell).set("stopped")
    for left, right, arm in (("127.0.0.2", "127.0.0.9", "left"), ("127.0.0.9", "127.0.0.3", "right")):
        fault = Latch(made(tmp_path, left, right)).read()
        assert fault is not None
        assert fault.arm == arm
    assert Latch(made(tmp_path, "127.0.0.8", "127.0.0.9")).read() is None
    # Swapped, they are the same ones.
    assert Latch(made(tmp_path, "127.0.0.3", "127.0.0.2")).read() is not None


def test_an_emulator_that_was_started_anew_has_no_faults(cell):
    first, second = (cell.replace(emulator=EmulatorEntry(port=5000, pid=pid)) for pid in (100, 101))
    Latch(first).set("stopped")
    assert Latch(first).read() is not None
    assert Latch(second).read() is None
    assert Latch(cell).read() is None


def test_files_of_emulators_that_have_ended_are_cleared_away(cell, tmp_path, home):
    ended = subprocess.run([sys.executable, "-c", "import os; print(os.getpid())"], capture_output=True, check=True)
    old, new = (cell.replace(emulator=EmulatorEntry(port=5000, pid=pid)) for pid in (int(ended.stdout), os.getpid()))
    handwritten = made(tmp_path, "127.0.0.6", "127.0.0.7")
    for each in (old, new, handwritten):
        Latch(each).set("stopped")
        lock = CellLock(each)
        lock.note_moving()
        lock.release(in_order=False)
    held = CellLock(made(tmp_path, "127.0.0.8", "127.0.0.9"))
    CellLock(made(tmp_path, "127.0.0.10", "127.0.0.11")).release()
    folder = home / "dual_ur10"
    others = ["lock-192.168.1.10", "fault-192.168.1.10.json", "lock-127.0.0.x", "fault-127.0.0.2-x.json"]
    for name in others:
        (folder / name).write_text("7\n")
    (folder / "lock-127.0.0.20").symlink_to(folder / "lock-192.168.1.10")
    latch.clear_ended(LOCAL)
    kept = {path.name for path in folder.iterdir()}
    arms = [f"127.0.0.{arm}" for arm in (2, 3)]
    assert kept == {
        *(f"lock-{host}" for host in arms),  # of the emulator that runs: they say that its arms moved
        *(f"fault-{host}-{os.getpid()}.json" for host in arms),
        *(f"{kind}-127.0.0.{arm}{end}" for arm in (6, 7) for kind, end in (("lock", ""), ("fault", ".json"))),
        "lock-127.0.0.8",
        "lock-127.0.0.9",
        "lock-127.0.0.20",
        *others,
    }
    assert Latch(old).read() is None
    assert Latch(new).read() is not None
    held.release()
    latch.clear_ended(LOCAL)
    assert kept - {path.name for path in folder.iterdir()} == {"lock-127.0.0.8", "lock-127.0.0.9"}


def test_a_lock_that_is_cleared_away_while_it_is_opened_is_made_anew(cell, tmp_path, monkeypatch):
    """Otherwise two programs could hold one arm: one a file without a name, the other its successor."""
    flock, cleared = latch.fcntl.flock, []

    def clears_first(file, how):
        if not cleared:
            cleared.append(True)
            latch.clear_ended(LOCAL)
        flock(file, how)

    with monkeypatch.context() as patched:
        patched.setattr(latch.fcntl, "flock", clears_first)
        lock = CellLock(cell)  # its left arm's is cleared away
    with pytest.raises(CellBusyError, match="left arm"):
        CellLock(made(tmp_path, "127.0.0.2", "127.0.0.9"))
    lock.release()


@pytest.mark.parametrize(
    "content",
    [b"", b"{", b"\xff\xfe", b"[]", b"3", b'"text"', b"{}", b'{"text": "a"}', b"null", b"[" * 60_000, b" " * 70_000],
)
@pytest.mark.parametrize("arm", [0, 1])
def test_a_fault_that_cannot_be_read_is_one(cell, content, arm):
    latch = Latch(cell)
    latch._paths[arm].write_bytes(content)
    fault = latch.read()
    assert fault is not None
    assert "cannot be read" in fault.text
    assert fault.arm == ("left", "right")[arm]
    with pytest.raises(CellFaulted, match="cell clear"):
        latch.check()
    latch.clear()
    latch.check()


@pytest.mark.parametrize("target", ["nowhere", "/dev/zero", "a fault"])
def test_a_link_is_a_fault_and_not_followed(cell, tmp_path, target):
    """Otherwise a fault could be stored where no start reads it."""
    latch, path = Latch(cell), tmp_path / target
    if target == "a fault":
        path.write_text(json.dumps({"text": "elsewhere", "when_utc": "then"}))
    latch._paths[0].symlink_to(path)
    latch.set("stopped")
    latch._paths[1].unlink()
    fault = latch.read()
    assert fault is not None
    assert "cannot be read" in fault.text
    assert not (tmp_path / "nowhere").exists()
    latch.clear()
    latch.check()
    assert (tmp_path / "a fault").exists() == (target == "a fault")


def test_a_pipe_in_its_place_does_not_block_a_read(cell):
    latch = Latch(cell)
    os.mkfifo(latch._paths[0])
    assert latch.read() is not None  # and does not wait for a writer


# Locks.


def test_one_program_at_a_time_moves_an_arm(cell, tmp_path):
    lock = CellLock(cell)
    with pytest.raises(CellBusyError, match=r"left arm at 127\.0\.0\.2.*this program already"):
        CellLock(cell)
    with pytest.raises(CellBusyError, match=r"right arm at 127\.0\.0\.3") as caught:
        CellLock(made(tmp_path, "127.0.0.8", "127.0.0.3"))
    # A program that gets one of two locks releases it, also while the error is kept.
    assert caught.value.__traceback__ is not None
    CellLock(made(tmp_path, "127.0.0.8", "127.0.0.9")).release()
    lock.release()
    lock.release()
    CellLock(cell).release()


HOLDER = (
    "import sys, time\nfrom dual_ur10.sim2real.runtime.latch import CellLock\n"
    "from dual_ur10.sim2real.cell_file.cell_file import load_cell_file\n"
    "lock = CellLock(load_cell_file(sys.argv[1]))\nprint('locked', flush=True)\ntime.sleep(60)\n"
)


def test_the_lock_of_a_dead_process_is_taken_over(cell, tmp_path):
    command = [sys.executable, "-c", HOLDER, str(tmp_path / "lab.toml")]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as holder:
        assert holder.stdout is not None
        assert holder.stdout.readline() == "locked\n"
        with pytest.raises(CellBusyError, match=rf"process {holder.pid}\)"):
            CellLock(cell)
        holder.send_signal(signal.SIGKILL)
        holder.wait()
    lock = CellLock(cell)
    assert {path.read_text() for path in LOCAL.state_folder().glob("lock-*")} == {f"{os.getpid()}\n"}
    lock.release()


def test_the_note_of_moving_arms_stays_until_it_is_latched(cell, tmp_path):
    lock = CellLock(cell)
    assert not lock.left_moving
    lock.note_moving()
    lock.release(in_order=False)  # its program was killed, or could not note the fault
    for _ in range(2):  # and the next one was killed before it had noted it
        lock = CellLock(cell)
        assert lock.left_moving
        lock.release(in_order=False)
    other = made(tmp_path, left="127.0.0.2", right="127.0.0.4")
    holder = CellLock(made(tmp_path, left="127.0.0.5", right="127.0.0.4"))
    with pytest.raises(CellBusyError, match="right arm"):
        CellLock(other)  # it had the left one for an instant
    holder.release()
    lock = CellLock(cell)
    assert lock.left_moving
    lock.release(in_order=False)
    Latch(cell).clear()
    lock = CellLock(cell)
    assert not lock.left_moving
    lock.release()


def full(*_):
    raise OSError(28, "No space left on device")


@pytest.mark.parametrize(
    ("ends", "found"),
    [
        (lambda claim: None, "ended without stopping them in order"),
        (lambda claim: claim.note_stopped(False), "ended without stopping them in order"),
        (lambda claim: claim.latch_stop("a hand was in the way"), "a hand was in the way"),
        (lambda claim: claim.note_stopped(), None),
    ],
)
def test_a_claim_ends_in_order_only_if_arms_rest_or_their_stop_is_latched(cell, ends, found):
    claim = Claim(cell)
    claim.note_moving()
    ends(claim)
    claim.release()
    if found is not None:
        for _ in range(2):
            with pytest.raises(CellFaulted, match=found):
                Claim(cell)
        Latch(cell).clear()
    claim = Claim(cell)
    claim.latch_stop("seen by nobody")
    claim.release()
    with pytest.raises(CellFaulted, match="seen by nobody"):
        Claim(cell)


def test_a_claim_that_cannot_latch_a_stop_keeps_the_note(cell, monkeypatch, caplog):
    claim = Claim(cell)
    claim.note_moving()
    claim.note_stopped()
    with monkeypatch.context() as patch:
        patch.setattr(latch.Latch, "set", full)
        claim.latch_stop("a hand was in the way")
        claim.release()
        assert "cannot be latched" in caplog.text
        with pytest.raises(OSError, match="No space"):
            Claim(cell)  # nor that of the program before: nobody holds the arms, and the note stays
    assert Latch(cell).read() is None
    with pytest.raises(CellFaulted, match="ended without stopping them in order"):
        Claim(cell)


def test_a_lock_that_cannot_be_written_is_released_all_the_same(cell, monkeypatch):
    lock = CellLock(cell)

    def full(file, text):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(latch, "_write", full)
    with pytest.raises(SettingsError, match=r"cannot note in .*state/dual_ur10 that arms move.*No space"):
        lock.note_moving()
    lock.release()
    monkeypatch.undo()
    CellLock(cell).release()


def test_processes_that_are_started_do_not_inherit_it(cell):
    lock = CellLock(cell)
    with subprocess.Popen(["sleep", "60"], close_fds=False) as child:
        lock.release()
        CellLock(cell).release()
        child.kill()


def test_a_link_in_its_place_is_refused_and_not_followed(cell, tmp_path):
    victim = tmp_path / "victim"
    victim.write_text("what is here")
    (LOCAL.state_folder() / "lock-127.0.0.3").symlink_to(victim)
    with pytest.raises(SettingsError, match=r"lock-127\.0\.0\.3"):
        CellLock(cell)
    assert victim.read_text() == "what is here"
    CellLock(made(tmp_path, "127.0.0.2", "127.0.0.9")).release()  # the other one was let go of


def test_a_forked_process_does_not_keep_the_lock(cell):
    """As by workers of a data loader."""
    lock = CellLock(cell)
    read, write = os.pipe()
    child = os.fork()
    if not child:
        os.close(write)
        os.read(read, 1)
        lock.release()  # it must not release the lock of the parent, which still moves the arms
        os._exit(0)
    try:
        os.close(read)
        lock.release()
        other = CellLock(cell)
        os.write(write, b"x")
        os.waitpid(child, 0)
        with pytest.raises(CellBusyError, match="is moved by this program already"):
            CellLock(cell)
        other.release()
        CellLock(cell).release()
    finally:
        os.close(write)


def test_a_stop_that_was_not_latched_is_not_forgotten_by_a_second_motion(cell, monkeypatch):
    claim = Claim(cell)
    claim.note_moving()
    with monkeypatch.context() as patch:
        patch.setattr(claim.latch, "set", lambda reason: (_ for _ in ()).throw(OSError("no space")))
        claim.latch_stop("an arm was too fast")
    with pytest.raises(CellFaulted, match="could not be latched: an arm was too fast"):
        claim.note_moving()
    claim.note_stopped()  # as after a motion that ends well
    claim.release()
    with pytest.raises(CellFaulted, match="ended without stopping them in order"):
        Claim(cell)
