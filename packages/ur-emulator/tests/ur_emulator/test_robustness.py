"""Misbehaving clients of one arm do not affect the client of the other arm."""

import contextlib
import itertools
import os
import random
import signal
import socket
import struct
import subprocess
import sys
import threading
import time
from pathlib import Path

import psutil
import pytest

from tests.soak import scaled
from tests.ur_emulator import rtde_bytes
from tests.ur_emulator.pairs import EmulatedPair
from tests.ur_emulator.ticking import COUNT, program
from ur_core.protocol.modes import RuntimeState

ROOT = Path(__file__).parents[2]  # of the tests of this package
PORTS = (29999, 30001, 30002, 30003, 30004)
TICK_S = 0.008
SERVE = program(COUNT + "q = get_actual_joint_positions()\nwhile True:\n  servoj(q, t=0.008)\nend")
WATCHED = ["timestamp", "runtime_state", "output_int_register_0", "safety_mode"]


class Watcher:
    """Well-behaved client of the right arm, in a thread: it streams and records everything it receives."""

    def __init__(self, host):
        with socket.create_connection((host, 30002), timeout=5.0) as scripts:
            scripts.sendall(SERVE.encode())
            time.sleep(0.2)
        self.sock = socket.create_connection((host, 30004), timeout=5.0)
        self.sock.sendall(rtde_bytes.VERSION_2 + rtde_bytes.outputs(WATCHED, 125.0) + rtde_bytes.message("S"))
        self.seen = []
        self.ended = None
        self.thread = threading.Thread(target=self._read, daemon=True)
        self.thread.start()

    def _read(self):
        stream = b""
        try:
            while data := self.sock.recv(1 << 16):
                stream += data
                while len(stream) >= 2 and len(stream) >= (size := struct.unpack_from(">H", stream)[0]):
                    if stream[2:3] == b"U":
                        self.seen.append(struct.unpack_from(">dIii", stream, 4))
                    stream = stream[size:]
        except OSError as error:
            self.ended = error

    def check(self, since):
        """Check that no package was missed and the program went on. Return the present number of packages."""
        end = time.monotonic() + 5.0
        while len(self.seen) < since + 30 and time.monotonic() < end:
            time.sleep(0.01)
        seen = self.seen[max(0, since - 1) :]
        assert len(seen) > 25, f"the other arm's client got nothing more; {self.ended}"
        for (time_0, _, count_0, _), (time_1, state, count_1, safety) in itertools.pairwise(seen):
            assert time_1 - time_0 == pytest.approx(TICK_S, abs=1e-6), "a gap"
            assert count_1 - count_0 == 1, "its program missed a control period"
            assert (state, safety) == (RuntimeState.PLAYING, 1)
        return len(self.seen)

    def close(self):
        with contextlib.suppress(OSError):
            self.sock.shutdown(socket.SHUT_RDWR)
        self.thread.join(5.0)
        self.sock.close()


@pytest.fixture(scope="module")
def cell():
    with EmulatedPair() as made:
        with client(made, 30003) as scripts:
            scripts.sendall(program("sync()").encode())
            # By then the process that compiles programs has started, with a file of its own.
            assert settled(lambda: made.ask("received", arm="left")["ended_tick"], 20.0)
        yield made


@pytest.fixture(scope="module")
def watcher(cell):
    made = Watcher(cell.right)
    made.check(0)
    yield made
    made.close()


@pytest.fixture
def undisturbed(cell, watcher):
    """Check that a test leaves the other arm and the process unchanged."""
    process = psutil.Process(cell.process.pid)
    cell.ask("info")  # its connection stays
    files, memory, since = process.num_fds(), process.memory_info().rss, len(watcher.seen)
    yield
    watcher.check(since)
    settled(lambda: process.num_fds() == files)
    assert process.num_fds() == files
    assert process.memory_info().rss - memory < 30 * 2**20
    assert process.is_running()


def settled(condition, within_s=5.0):
    end = time.monotonic() + within_s
    while not (found := condition()) and time.monotonic() < end:
        time.sleep(0.01)
    return found


def client(cell, port):
    made = socket.create_connection((cell.left, port), timeout=5.0)
    made.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
    return made


def is_closed(sock):
    """Return True if the cell closes a connection after its last answer."""
    sock.settimeout(2.0)
    try:
        while sock.recv(1 << 16):
            pass
    except ConnectionError:
        return True
    except TimeoutError:
        return False
    return True


def received(sock, until, at_most=1 << 16):
    """Receive until a condition of the data holds."""
    found = b""
    while not until(found):
        data = sock.recv(at_most - len(found) % at_most)
        assert data, f"the connection ended after {found!r}"
        found += data
    return found


def state(cell, name="runtime_state", arm="left"):
    return cell.ask("state", arm=arm, names=[name])[name]


def rests(cell):
    """Check that the left arm stands."""
    before = state(cell, "target_q")
    time.sleep(0.1)
    return all(abs(now - then) < 1e-5 for now, then in zip(state(cell, "target_q"), before, strict=True))


def works(cell):
    """Check that the left arm serves a well-behaved client."""
    with client(cell, 30004) as rtde:
        rtde.sendall(rtde_bytes.VERSION_2)
        assert rtde.recv(100) == b"\x00\x04V\x01"
    with client(cell, 29999) as dashboard:
        dashboard.sendall(b"robotmode\n")
        assert received(dashboard, lambda all_: all_.count(b"\n") == 2).endswith(b"Robotmode: RUNNING\n")
    with client(cell, 30003) as realtime:
        assert struct.unpack(">i", realtime.recv(4, socket.MSG_WAITALL)) == (1220,)


MALFORMED = {
    "no size": b"\x00\x00V",
    "a size below a header": b"\x00\x02V",
    "too long": b"\xff\xffV" + bytes(70_000),
    "data for no recipe": rtde_bytes.data(9, "i", 1),
    "cut version": b"\x00\x03V",
    "cut frequency": rtde_bytes.VERSION_2 + rtde_bytes.message("O", b"\x01\x02"),
    "thousands of names": rtde_bytes.message("I", b"a," * 20_000),
    "too many recipes": rtde_bytes.VERSION_2 + rtde_bytes.inputs(["input_int_register_1"]) * 300,
}


@pytest.mark.parametrize("name", MALFORMED)
@pytest.mark.usefixtures("undisturbed")
def test_malformed_rtde_ends_that_connection(cell, name):
    with client(cell, 30004) as sock:
        with contextlib.suppress(ConnectionError):
            sock.sendall(MALFORMED[name])
        assert is_closed(sock)
    works(cell)


@pytest.mark.usefixtures("undisturbed")
def test_unknown_rtde_commands_and_cut_data_are_survived(cell):
    with client(cell, 30004) as sock:
        sock.sendall(rtde_bytes.VERSION_2 + rtde_bytes.message("Q", b"?") + rtde_bytes.inputs(["input_int_register_1"]))
        sock.sendall(rtde_bytes.data(1, "B", 1) + rtde_bytes.message("v"))
        received(sock, lambda all_: all_.endswith(struct.pack(">4I", 3, 15, 8, 106339)))
    works(cell)


@pytest.mark.usefixtures("undisturbed")
def test_random_bytes_on_all_ports(cell):
    rng = random.Random(7)
    for _ in range(scaled(1500)):
        for port in (*PORTS, cell.port):
            with client(cell, port) as sock, contextlib.suppress(OSError):
                size = rng.choice([1, 7, 100, 3000])
                kind = rng.randrange(3)
                data = rng.randbytes(size)
                if kind == 1:
                    data = bytes(
                        rng.choice(b"def end(){}[]\n\t =+'\"while True: sync 0123456789.,") for _ in range(size)
                    )
                elif kind == 2:
                    data = b"".join(
                        rtde_bytes.message(rng.choice("VvUOISPM"), rng.randbytes(9)) for _ in range(size // 9)
                    )
                sock.sendall(data)
                sock.settimeout(0.001)
                sock.recv(1000)
    works(cell)


@pytest.mark.usefixtures("undisturbed")
def test_endless_lines_and_programs_end_the_connection(cell):
    for port, data in (
        (29999, b"x" * 100_000),
        (30001, b"def p():\n" + b"  x = 1\n" * 2_000_000),
        (cell.port, b"{" * 10**6),
    ):
        with client(cell, port) as sock:
            sock.settimeout(5.0)
            with contextlib.suppress(ConnectionError):
                sock.sendall(data)
            assert is_closed(sock), port
    works(cell)


@pytest.mark.usefixtures("undisturbed")
def test_a_request_of_a_browser_ends_the_connection_and_runs_nothing(cell):
    uploads = cell.ask("received", arm="left")["uploads"]
    body = b'def p():\n  popup("run")\nend\npower off\n{"do": "slider", "arm": "left", "fraction": 0.1}\n'
    for port in (29999, 30001, 30002, 30003, cell.port):
        with client(cell, port) as sock:
            sock.sendall(b"POST /x HTTP/1.1\r\nContent-Type: text/plain\r\n\r\n" + body)
            assert is_closed(sock), port
    assert cell.ask("received", arm="left")["uploads"] == uploads
    assert state(cell, "target_speed_fraction") == 1.0
    works(cell)


@pytest.mark.usefixtures("undisturbed")
def test_a_script_that_never_yields_is_stopped_on_its_arm(cell):
    with client(cell, 30001) as sock:
        sock.recv(1000)
        sock.sendall(program("x = 0\nwhile True:\n  x = x + 1\nend", "forever").encode())
        received(sock, lambda all_: b"infinite loop" in all_)
    assert settled(lambda: state(cell) == RuntimeState.STOPPED)
    works(cell)


@pytest.mark.usefixtures("undisturbed")
def test_half_a_program_is_never_run(cell):
    with client(cell, 30003) as sock:
        sock.sendall(b"def p():\n  set_standard_digital_out(5, True)\n  sync()\n")
        time.sleep(0.2)
        assert state(cell) == RuntimeState.STOPPED
    time.sleep(0.1)
    assert state(cell) == RuntimeState.STOPPED
    assert not state(cell, "actual_digital_output_bits") >> 5 & 1


@pytest.mark.usefixtures("undisturbed")
def test_a_flood_of_programs_ends_the_connection(cell):
    with client(cell, 30003) as sock:
        with contextlib.suppress(ConnectionError):
            sock.sendall(program("sync()").encode() * 1000)
        assert is_closed(sock)
    time.sleep(0.3)  # those that were taken are read meanwhile
    with client(cell, 30003) as sock:
        sock.sendall(program("set_standard_digital_out(6, True)").encode())
        assert settled(lambda: state(cell, "actual_digital_output_bits") >> 6 & 1)
    works(cell)


@pytest.mark.usefixtures("undisturbed")
def test_a_thousand_connections(cell):
    refused = 0
    for _ in range(10):
        socks = []
        for index in range(100):
            socks.append(client(cell, PORTS[index % 2 + 2]))  # more than one port serves at once
        refused += sum(is_closed_at_once(each) for each in socks)
        for sock in socks:
            sock.close()
        assert settled(lambda: not any(cell.ask("clients", arm="left").values()))
    assert refused == 10 * (100 - 2 * 32)
    works(cell)


def is_closed_at_once(sock):
    sock.settimeout(0.0)
    end = time.monotonic() + 1.0
    while time.monotonic() < end:
        try:
            return not sock.recv(1)
        except BlockingIOError:
            time.sleep(0.001)
        except ConnectionError:
            return True
    return False


@pytest.mark.usefixtures("undisturbed")
def test_a_client_that_asks_and_never_reads_is_disconnected(cell):
    with client(cell, 29999) as sock:
        sock.settimeout(0.5)
        with contextlib.suppress(OSError):
            for _ in range(2000):
                sock.sendall(b"programState\n" * 1000)
        assert settled(lambda: not cell.ask("clients", arm="left")["dashboard"])
    works(cell)


STREAM = """
import socket, struct, sys, time
sys.path.insert(0, {root!r})
from tests.ur_emulator import rtde_bytes
q = {q!r}
rtde = socket.create_connection(({host!r}, 30004))
rtde.sendall(rtde_bytes.VERSION_2 + rtde_bytes.inputs(rtde_bytes.SERVOJ) + rtde_bytes.outputs(rtde_bytes.RECEIVED))
rtde.sendall(rtde_bytes.message("S"))
time.sleep(0.1)
k = 0
while True:
    values = [q[0] + 0.001 * k, *q[1:], 0.008, 0.05, 400.0, 0.0, 0.0]
    rtde.sendall(rtde_bytes.data(1, "i11d", k + 1, *values))
    k += 1
    if k == 30:
        print("streams", flush=True)
    time.sleep(0.008)
"""

LISTENER = """def serve():
  last = 0
  while True:
    n = read_input_integer_register(0)
    q = [0, 0, 0, 0, 0, 0]
    i = 0
    while i < 6:
      q[i] = read_input_float_register(i)
      i = i + 1
    end
    if n > 0:
      servoj(q, t=0.008, lookahead_time=0.05, gain=400)
    else:
      sync()
    end
  end
end
"""


@pytest.mark.usefixtures("undisturbed")
def test_a_killed_streaming_client_frees_its_inputs_at_once(cell):
    with client(cell, 30002) as scripts:
        scripts.sendall(LISTENER.encode())
        cell.wait_until("left", "runtime_state", RuntimeState.PLAYING)
    q = list(state(cell, "target_q"))
    code = STREAM.format(root=str(ROOT), q=q, host=cell.left)
    process = subprocess.Popen([sys.executable, "-c", code], stdout=subprocess.PIPE)
    wanted = rtde_bytes.VERSION_2 + rtde_bytes.inputs(rtde_bytes.SERVOJ)
    try:
        assert process.stdout.readline() == b"streams\n"
        with client(cell, 30004) as second:
            second.sendall(wanted)
            assert b"IN_USE" in second.recv(1000)
        os.kill(process.pid, signal.SIGKILL)
    finally:
        process.kill()
        process.wait()
        process.stdout.close()
    with client(cell, 30004) as third:
        third.sendall(wanted)
        assert b"IN_USE" not in received(third, lambda all_: len(all_) > 40)
        # Its program goes on with the last target, and the arm stops there.
        assert settled(lambda: rests(cell))
        assert state(cell) == RuntimeState.PLAYING
        assert state(cell, "safety_mode") == 1
        assert state(cell, "target_q")[0] > q[0] + 0.02
    with client(cell, 29999) as dashboard:
        dashboard.recv(100)
        dashboard.sendall(b"stop\n")
        assert dashboard.recv(100) == b"Stopped\n"
    assert settled(lambda: state(cell) == RuntimeState.STOPPED)
