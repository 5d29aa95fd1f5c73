"""Connections that programs open, on a network in memory and by control periods."""

import math
import struct
from pathlib import Path

import pytest

from tests.ur_emulator.ticking import PLAYS, Bench, program
from ur_emulator.controller.script_sockets import SOCKETS_MAX
from ur_emulator.virtual.virtual_system import VirtualProcess, VirtualSystem, World

HOST, PORT = "127.0.0.9", 50001
OPEN = f'socket_open("{HOST}", {PORT}, "s")\n'


class Net:
    """Controller whose programs connect to a listener in memory."""

    def __init__(self):
        world = World()
        self.system = VirtualSystem(VirtualProcess(world, None, "controller"), Path())
        peer = VirtualSystem(VirtualProcess(world, None, "peer"), Path())
        self.listener = peer.listen(HOST, PORT, 4096)
        self.bench = Bench("e-series", system=self.system)
        self.client = None

    def run(self, body, ticks=1, sent=b""):
        """Start a program, accept its connection, and send bytes to it."""
        self.bench.run(program(body))
        self.bench.tick()
        self.client = self.listener.accept_now()
        if sent:
            self.client.send_now(sent)
        self.bench.tick(ticks)

    @property
    def received(self):
        return self.client.receive_now(1 << 16)

    @property
    def texts(self):
        """Texts of all messages so far: those of textmsg, and those of errors."""
        found = [bytes(message) for message in self.bench.controller.messages]
        self.bench.controller.messages.clear()
        return b"".join(found).decode("latin-1")


@pytest.fixture
def net():
    return Net()


def say(expression):
    return f'textmsg("<", str_cat({expression}, ">"))\n'


def ends(net, body):
    """Check that an error ends a program which would wait otherwise."""
    net.bench.run(program(f"{body}\nsleep(9)"))
    net.bench.tick(2)
    assert net.bench.state not in PLAYS


def test_open_reports_success_and_failure(net):
    net.run(say(f'socket_open("{HOST}", {PORT})') + say(f'socket_open("{HOST}", {PORT + 1}, "b")'))
    assert net.texts.count("<True>") == 1
    assert net.client is not None


@pytest.mark.parametrize("host", ["192.168.56.1", "10.0.0.1", "8.8.8.8", "example.com", "0.0.0.0", "::1", ""])
def test_only_loopback_addresses_are_connected_to(net, host):
    ends(net, f'socket_open("{host}", {PORT})')
    assert "is no loopback address" in net.texts
    assert not len(net.bench.controller.sockets)


@pytest.mark.parametrize("arguments", ['"127.0.0.9", 0', '"127.0.0.9", 65536', '"127.0.0.9", "1"', "127, 5"])
def test_a_wrong_address_ends_the_program(net, arguments):
    ends(net, f"socket_open({arguments})")


def test_localhost_is_this_machine(net):
    net.bench.run(program(say(f'socket_open("localhost", {PORT})')))
    net.bench.tick(2)
    assert "<False>" in net.texts  # nothing listens at 127.0.0.1


@pytest.mark.parametrize(
    ("call", "bytes_"),
    [
        ('socket_send_int(-2, "s")', b"\xff\xff\xff\xfe"),
        ('socket_send_byte(255, "s")', b"\xff"),
        ('socket_send_line("hallo", "s")', b"hallo\n"),
        ('socket_send_string("a" , "s")', b"a"),
        ('socket_send_string([1, 2.5], "s")', b"[1, 2.5]"),
        ('socket_set_var("POS", 7, "s")', b"SET POS 7\n"),
    ],
)
def test_sent_bytes(net, call, bytes_):
    net.run(OPEN + call + "\nsleep(1)")
    assert net.received == bytes_


@pytest.mark.parametrize(
    ("call", "sent", "said"),
    [
        ('socket_read_binary_integer(2, "s")', struct.pack(">2i", 7, -8), "[2, 7, -8]"),
        ('socket_read_byte_list(3, "s")', b"\x00\x01\xff", "[3, 0, 1, 255]"),
        ('socket_read_ascii_float(3, "s")', b"junk (1.5, -2 , 3e2)", "[3, 1.5, -2, 300]"),
        ('socket_read_ascii_float(3, "s")', b"(1, 2)", "[2, 1, 2, nan]"),
        ('socket_read_ascii_float(1, "s")', b"(a)", "[0, nan]"),
        ('socket_read_line("s")', b"one\r\ntwo\n", "one"),
        ('socket_read_string("s")', b"all of it\n", "all of it\n"),
        ('socket_read_string("s", prefix="<<", suffix=";")', b"x<<y;z", "y"),
        ('socket_read_string("s", suffix="\\n", interpret_escape=True)', b"y\nz", "y"),
        ('socket_read_string("s", suffix="\\n")', b"y\\nz", "y"),
        ('socket_get_var("POS", "s")', b"POS 42\n", "42"),
        ('socket_get_var("POS", "s")', b"PRE 42\n", "0"),
    ],
)
def test_read_values(net, call, sent, said):
    net.run(OPEN + say(call), sent=sent)
    assert f"<{said}>" in net.texts


def test_a_variable_of_more_than_32_bits_ends_the_program(net):
    net.run(OPEN + say('socket_get_var("POS", "s")'), sent=b"POS 2147483648\n")
    assert "at most 32 bits" in net.texts


def test_the_rest_of_the_bytes_waits_for_the_next_read(net):
    net.run(OPEN + say('socket_read_line("s")') + say('socket_read_byte_list(2, "s")'), sent=b"ab\ncd")
    assert "<ab>" in (texts := net.texts)
    assert "<[2, 99, 100]>" in texts


def test_pieces_are_put_together(net):
    data = struct.pack(">3i", 1, 2, 3)
    net.run(OPEN + say('socket_read_binary_integer(3, "s", 0)') + "sleep(9)")
    for piece in (data[:5], data[5:11], data[11:]):
        assert "<" not in net.texts
        net.client.send_now(piece)
        net.bench.tick()
    assert "<[3, 1, 2, 3]>" in net.texts


@pytest.mark.parametrize(
    ("call", "failed"),
    [
        ("socket_read_binary_integer(2, {})", "[0, -1, -1]"),
        ("socket_read_byte_list(1, {})", "[0, -1]"),
        ("socket_read_ascii_float(1, {})", "[0, nan]"),
        ("socket_read_line({})", ""),
        ("socket_read_string({}, timeout={})", ""),
    ],
)
@pytest.mark.parametrize("timeout_s", [0.01, 0.1])
def test_a_read_waits_for_its_timeout_and_no_longer(net, call, failed, timeout_s):
    arguments = call.replace("{}", f'"s", {timeout_s}', 1) if call.count("{}") == 1 else call.format('"s"', timeout_s)
    ticks = round(timeout_s / net.bench.tick_s)
    net.run(OPEN + say(arguments) + "sleep(9)", ticks=ticks - 1)
    assert "<" not in net.texts
    net.bench.tick()
    assert f"<{failed}>" in net.texts


def test_waiting_for_a_peer_delays_neither_threads_nor_motion(net):
    count = "thread c():\n while True:\n  write_output_integer_register(0, read_output_integer_register(0) + 1)\n"
    net.run(
        count + "  sync()\n end\nend\nrun c()\n" + OPEN + 'enter_critical\nsocket_read_line("s", 0)\nexit_critical', 20
    )
    assert net.bench.controller.registers.output_int[0] == 21


def test_the_end_of_the_peer_ends_a_read_and_a_loop_of_reads_is_no_infinite_loop(net):
    net.run(OPEN + 'while True:\n write_output_integer_register(0, read_output_integer_register(0) + 1)\n'
            ' socket_read_binary_integer(1, "s", 0)\nend', 5)  # fmt: skip
    assert net.bench.controller.registers.output_int[0] == 1
    net.client.close()
    net.bench.tick(10)
    assert net.bench.state in PLAYS
    assert net.bench.controller.registers.output_int[0] == 11


def test_reads_and_sends_without_a_connection_fail(net):
    net.bench.run(
        program(say('socket_read_line("s", 0)') + say('socket_send_int(1, "s")') + say('socket_get_var("x")'))
    )
    net.bench.tick(5)
    assert "<>" in (texts := net.texts)
    assert "<False>" in texts
    assert "<0>" in texts


@pytest.mark.parametrize("end", ["pass", 'socket_close("s")\nsleep(9)', "halt", "a = 1 / 0"])
def test_a_connection_ends_with_its_program(net, end):
    net.run(OPEN + end, 2)
    assert net.received == b""
    assert not len(net.bench.controller.sockets)


def test_a_new_program_starts_without_connections(net):
    net.run(OPEN + "sleep(9)")
    old = net.client
    net.run(OPEN + "sleep(9)")
    assert old.receive_now(1) == b""
    assert net.received is None


def test_a_name_that_is_opened_again_has_the_new_connection(net):
    net.run(OPEN)
    net.run(OPEN + OPEN + 'socket_send_byte(7, "s")\nsleep(9)')
    assert net.received == b""
    net.client = net.listener.accept_now()
    assert net.received == b"\x07"


def test_a_peer_that_does_not_read_ends_the_connection_after_a_while(net):
    body = OPEN + 'ok = True\nwhile ok:\n ok = socket_send_string("' + 1000 * "x" + '", "s")\nend\n' + say("ok")
    net.run(body, 50)
    assert net.bench.state in PLAYS
    net.bench.passing(2.0)
    assert "<False>" in net.texts


def test_the_number_of_connections_is_limited(net):
    body = "".join(f'socket_open("{HOST}", {PORT}, "s{number}")\n' for number in range(SOCKETS_MAX + 1))
    ends(net, body)
    assert f"at most {SOCKETS_MAX} open sockets" in net.texts


@pytest.mark.parametrize(
    "call",
    ["socket_read_byte_list(0)", "socket_read_byte_list(31)", "socket_send_byte(256)", "socket_send_int(1.5)"],
)
def test_wrong_numbers_end_the_program(net, call):
    ends(net, call)


def test_secondary_programs_have_connections_too(net):
    net.bench.run(f'sec s():\n{OPEN} socket_send_byte(5, "s")\nend\n')
    net.bench.tick()
    net.client = net.listener.accept_now()
    assert net.received == b"\x05"
    assert net.received == b""


def test_speedj_without_acceleration_keeps_the_speed(net):
    bench = net.bench
    bench.run(program("speedj([0.1, 0, 0, 0, 0, 0], 1, 0.2)\nspeedj([0.3, 0, 0, 0, 0, 0], 0, 0.1)\nstopj(2)"))
    bench.passing(0.25)
    assert math.isclose(bench.qd[0], 0.1, abs_tol=1e-9)
    bench.until(lambda: bench.state not in PLAYS)
    bench.run(program("speedj([0.3, 0, 0, 0, 0, 0], 0)"))
    bench.tick(2)
    assert "a of speedj" in net.texts
