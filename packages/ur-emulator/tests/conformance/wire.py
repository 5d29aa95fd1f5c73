"""Small client of UR's protocols, made of sockets and `struct`: it shares no code with the code under test.

Every wait is bounded by `DEADLINE_S`, which is long, since machines may be slow. Tests measure time by the controller's
own timestamps.
"""

import contextlib
import math
import re
import select
import socket
import struct
import time

DASHBOARD, PRIMARY, SECONDARY, REALTIME, RTDE = 29999, 30001, 30002, 30003, 30004

DEADLINE_S = 30.0

VERSION, TEXT, DATA, URCONTROL, OUTPUTS, INPUTS, START, PAUSE = 86, 77, 85, 118, 79, 73, 83, 80

FORMATS = {
    "BOOL": "?",
    "UINT8": "B",
    "UINT32": "I",
    "UINT64": "Q",
    "INT32": "i",
    "DOUBLE": "d",
    "VECTOR3D": "3d",
    "VECTOR6D": "6d",
    "VECTOR6INT32": "6i",
    "VECTOR6UINT32": "6I",
}


class Closed(AssertionError):
    """The controller closed the connection."""


class DeadlineMissed(AssertionError):
    """The expected data did not arrive in time."""


class Bounded:
    """Endless loop that ends with an error after `DEADLINE_S`."""

    def __init__(self, what):
        self.what, self.end = what, time.monotonic() + DEADLINE_S

    def __iter__(self):
        while time.monotonic() < self.end:
            yield
        raise DeadlineMissed(f"waited {DEADLINE_S:g} s for {self.what}")


class Client:
    """TCP connection with reads of exact length."""

    def __init__(self, host, port):
        self.sock = socket.create_connection((host, port), timeout=DEADLINE_S)
        self.sock.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        self.rest = b""

    def __enter__(self):
        return self

    def __exit__(self, *_):
        self.sock.close()

    def send(self, data):
        self.sock.sendall(data)

    def _more(self):
        try:
            data = self.sock.recv(1 << 16)
        except TimeoutError:
            raise DeadlineMissed(f"nothing came for {DEADLINE_S:g} s; there were {self.rest!r}") from None
        except ConnectionResetError:
            data = b""
        if not data:
            raise Closed(f"closed by the controller; there were {self.rest!r}")
        self.rest += data

    def exactly(self, count):
        while len(self.rest) < count:
            self._more()
        data, self.rest = self.rest[:count], self.rest[count:]
        return data

    def line(self):
        while b"\n" not in self.rest:
            self._more()
        line, self.rest = self.rest.split(b"\n", 1)
        return line.decode()

    @property
    def silent(self):
        """True if nothing has arrived."""
        return not self.rest and not select.select([self.sock], [], [], 0)[0]

    def until_closed(self):
        """Wait until the controller closes the connection, and drop the data before."""
        with contextlib.suppress(Closed):
            for _ in Bounded("the end of a connection"):
                self._more()


class Rtde(Client):
    """RTDE connection. Version 1, with which connections begin, is not requested."""

    def __init__(self, host, version=2):
        super().__init__(host, RTDE)
        self.version, self.fields, self.recipes = version, [], {}
        if version != 1:
            assert self.request(VERSION, struct.pack(">H", version)) == b"\1"

    def frame(self, kind, payload=b""):
        self.send(struct.pack(">HB", 3 + len(payload), kind) + payload)

    def receive(self):
        size, kind = struct.unpack(">HB", self.exactly(3))
        assert size >= 3
        return kind, self.exactly(size - 3)

    def request(self, kind, payload=b""):
        """Return the answer to a request, and drop data packages before it."""
        self.frame(kind, payload)
        for _ in Bounded(f"the answer to {chr(kind)}"):
            got, answer = self.receive()
            if got == kind:
                break
            assert got in (DATA, TEXT), f"{chr(got)} is no answer to {chr(kind)}"
        return answer

    def outputs(self, text, hz=None):
        """Return number of the recipe (None in version 1) and types of a list of variables."""
        payload = text.encode()
        if self.version > 1:
            payload = struct.pack(">d", 1e6 if hz is None else hz) + payload
        answer = self.request(OUTPUTS, payload)
        number = None
        if self.version > 1:
            number, answer = answer[0], answer[1:]
        types = answer.decode().split(",")
        names = [name for name in text.split(",") if name]
        self.fields = [(name, FORMATS[kind]) for name, kind in zip(names, types, strict=True) if kind in FORMATS]
        return number, types

    def inputs(self, text):
        """Return number and types of an input recipe."""
        answer = self.request(INPUTS, text.encode())
        types = answer[1:].decode().split(",")
        self.recipes[answer[0]] = ">" + "".join(FORMATS.get(kind, "") for kind in types)
        return answer[0], types

    def start(self):
        return self.request(START) == b"\1"

    def pause(self):
        return self.request(PAUSE) == b"\1"

    def write(self, recipe, *values):
        self.frame(DATA, bytes([recipe]) + struct.pack(self.recipes[recipe], *values))

    def data(self):
        """Return the next data package, by name."""
        for _ in Bounded("an RTDE data package"):
            kind, payload = self.receive()
            if kind == DATA:
                break
            assert kind == TEXT
        return self.unpack(payload)

    def unpack(self, payload):
        if self.version > 1:
            assert payload[0] == 1
            payload = payload[1:]
        assert len(payload) == sum(struct.calcsize(">" + code) for _, code in self.fields)
        found, place = {}, 0
        for name, code in self.fields:
            values = struct.unpack_from(">" + code, payload, place)
            found[name] = values[0] if len(values) == 1 else values
            place += struct.calcsize(">" + code)
        return found

    def until(self, condition, what):
        """Return all packages up to the first that fulfils a condition."""
        seen = []
        for _ in Bounded(what):
            seen.append(self.data())
            if condition(seen[-1]):
                break
        return seen

    def latest(self):
        """Return the newest package, and drop older ones. Waits for one if there is none."""
        newest = self.data()
        while not self.silent:
            newest = self.data()
        return newest


class Dashboard(Client):
    """The dashboard server."""

    def __init__(self, host):
        super().__init__(host, DASHBOARD)
        self.greeting = self.line()

    def ask(self, command):
        self.send(command.encode() + b"\n")
        return self.line()


REALTIME_OFFSETS = {
    "timestamp": (4, 1),
    "target_q": (12, 6),
    "actual_q": (252, 6),
    "actual_qd": (300, 6),
    "actual_TCP_pose": (444, 6),
    "robot_mode": (756, 1),
    "safety_mode": (812, 1),
    "actual_digital_output_bits": (1044, 1),
    "runtime_state": (1052, 1),
}
"""First byte and count of doubles. Program state and what follows came later."""


class Realtime(Client):
    """The stream of port 30003."""

    def __init__(self, host):
        super().__init__(host, REALTIME)
        self.length = 0

    def packet(self):
        (self.length,) = struct.unpack(">i", self.exactly(4))
        assert 500 <= self.length <= 4000
        assert (self.length - 4) % 8 == 0
        data = b"\0" * 4 + self.exactly(self.length - 4)
        found = {}
        for name, (offset, count) in REALTIME_OFFSETS.items():
            if offset + 8 * count <= self.length:
                values = struct.unpack_from(f">{count}d", data, offset)
                found[name] = values[0] if count == 1 else values
        return found


ROBOT_STATE, ROBOT_MESSAGE = 16, 20

ROBOT_MODE_DATA, JOINT_DATA, TOOL_DATA, MASTERBOARD_DATA, CARTESIAN_DATA = 0, 1, 2, 3, 4


class Primary(Client):
    """The stream of ports 30001 and 30002."""

    def __init__(self, host, port=PRIMARY):
        super().__init__(host, port)

    def packet(self):
        size, kind = struct.unpack(">iB", self.exactly(5))
        assert 5 <= size <= 1 << 16
        return kind, self.exactly(size - 5)

    def message(self, kind):
        """Return the next message of a kind: source and content."""
        for _ in Bounded(f"a message of kind {kind}"):
            packet, body = self.packet()
            if packet == ROBOT_MESSAGE and body[9] == kind:
                break
        return struct.unpack_from(">b", body, 8)[0], body[10:]

    def state(self):
        """Return the next robot state: bytes of its sub-packages by type."""
        for _ in Bounded("a robot state"):
            packet, body = self.packet()
            if packet == ROBOT_STATE:
                break
        return sub_packages(body)


def sub_packages(body):
    found, place = {}, 0
    while place < len(body):
        size, kind = struct.unpack_from(">iB", body, place)
        assert 5 <= size <= len(body) - place, f"sub-package {kind} says that it has {size} bytes"
        assert kind not in found
        found[kind] = body[place + 5 : place + size]
        place += size
    assert place == len(body)
    return found


def robot_mode_data(data):
    """Return the fields of the robot mode data that all versions since 3.5 have."""
    names = (
        "timestamp_us",
        "connected",
        "enabled",
        "power_on",
        "emergency_stopped",
        "protective_stopped",
        "program_running",
        "program_paused",
        "robot_mode",
        "control_mode",
        "target_speed_fraction",
        "speed_scaling",
        "limit",
    )
    return dict(zip(names, struct.unpack_from(">Q7?BBddd", data), strict=True))


def joint_data(data):
    """Return actual positions, targets and actual speeds of the joints."""
    rows = [struct.unpack_from(">ddd", data, 41 * joint) for joint in range(6)]
    return tuple(zip(*rows, strict=True))


def quaternion(rotvec):
    angle = math.hypot(*rotvec)
    if angle < 1e-12:
        return (1.0, 0.0, 0.0, 0.0)
    return (math.cos(angle / 2), *(math.sin(angle / 2) * each / angle for each in rotvec))


def pose_distance(one, other):
    """Return distance in m, and angle in rad: a rotation by π has two rotation vectors."""
    p, q = quaternion(one[3:]), quaternion(other[3:])
    sign = math.copysign(1.0, sum(a * b for a, b in zip(p, q, strict=True)))
    chord = math.hypot(*(a - sign * b for a, b in zip(p, q, strict=True)))
    return math.dist(one[:3], other[:3]), 4 * math.asin(min(1.0, chord / 2))


def version_of(text):
    """Return the four numbers in an answer of `PolyscopeVersion`."""
    return tuple(map(int, re.search(r"(\d+)\.(\d+)\.(\d+)\.(\d+)", text).groups()))


def run(host, text, port=SECONDARY):
    """Send a program, and close the connection once the controller has seen its end, or after a second."""
    with Client(host, port) as client:
        client.send(text.encode() if text.endswith("\n") else text.encode() + b"\n")
        client.sock.shutdown(socket.SHUT_WR)
        # Closing with unread data would send a reset, and the program could be lost.
        client.sock.settimeout(1.0)
        end = time.monotonic() + 1.0
        try:
            while time.monotonic() < end and client.sock.recv(1 << 16):
                pass
        except (TimeoutError, ConnectionResetError):
            pass
