"""Everything that reads bytes of others, as functions of bytes: no files, no sockets, no processes.

A target names the exceptions that its readers document. Any other exception is a defect, and so is a property that
does not hold (`AssertionError`). Where a checksum would hide the reader behind it, the target fills it in.
"""

from __future__ import annotations

import contextlib
import copy
import dataclasses
import json
import struct
import zlib
from collections.abc import Callable, Iterator
from io import BytesIO
from pathlib import Path
from threading import Event
from typing import Any, Final

import numpy as np

from dual_ur10.errors import (
    CalibrationError,
    CellFileError,
    CheckpointError,
    PolicyServerError,
    RecordingError,
    TrajectoryError,
)
from dual_ur10.policies.learned import schema
from dual_ur10.policies.learned.checkpoint import _networks
from dual_ur10.policies.learned.manifest import FORMAT, _checksum, parse
from dual_ur10.policies.remote.wire import packed, unpacked
from dual_ur10.sim2real.calibration import data_file
from dual_ur10.sim2real.cell_file.cell_file import examine_text
from dual_ur10.sim2real.cell_file.tables import EmulatedTrackerEntry
from dual_ur10.sim2real.peripherals.gripper_link import RobotiqLink
from dual_ur10.sim2real.peripherals.object_tracker import CameraTracker, Flanges
from dual_ur10.sim2real.recording import mcap_records as mcap
from dual_ur10.sim2real.recording.cdr import HEAD
from dual_ur10.sim2real.recording.encoding import Encoder, single_record
from dual_ur10.sim2real.recording.header import from_metadata, mounts_of
from dual_ur10.sim2real.recording.reader import _WANTED, _run
from dual_ur10.sim2real.recording.scan import _Scan
from dual_ur10.sim2real.recording.schemas import BEGIN, EVENT, SENT_COLUMNS, SINGLE, STATE_COLUMNS, STEP, TOPICS
from dual_ur10.sim2real.trajectory.files import Format, _csv_of, parse_trajectory
from tests.policies.learned.checkpoints import parts
from tests.sim2real.recording.runs import header
from ur_core.errors import LinkError, OperationRefusedError, ProtocolError, ScriptError, SettingsError, UnknownNameError
from ur_core.kinematics.ur10 import NOMINAL_DH
from ur_core.links.dashboard_link import DashboardLink
from ur_core.links.json_link import JsonLink
from ur_core.links.primary_link import _Reader
from ur_core.links.rtde_link import RtdeLink
from ur_core.links.rtde_stream import RtdeStream
from ur_core.processes.system import LOCAL
from ur_core.protocol.primary_messages import error_code_message, popup_message, text_message
from ur_core.protocol.primary_packet import PrimaryPacket
from ur_core.protocol.rtde import TYPES, FrameReader
from ur_core.protocol.text_lines import LineReader
from ur_emulator.builtins.table import builtins_of
from ur_emulator.controller.controller import Controller
from ur_emulator.controller.pendant import Pendant
from ur_emulator.controller.registers import Registers
from ur_emulator.controller.reported_values import ArmReading
from ur_emulator.controller.rtde_variables import zero_values
from ur_emulator.injection.fault_injection import FaultInjection
from ur_emulator.ports.arm_server import ArmServer, DashboardPeer, LinePeer
from ur_emulator.ports.dashboard import Dashboard
from ur_emulator.ports.link_faults import LinkFaults
from ur_emulator.ports.realtime_packet import RealtimePacket
from ur_emulator.ports.robotiq import RobotiqGripper
from ur_emulator.ports.rtde_session import RtdePort
from ur_emulator.profile import PROFILES
from ur_emulator.script import Machine, Splitter, library
from ur_emulator.script.compiled import _read
from ur_emulator.script.machine import _FAULTS

HERE: Final = "127.0.0.1"
HOME: Final = np.array([0.0, -1.57, 1.57, -1.57, -1.57, 0.0])
PROFILE: Final = PROFILES["e-series"]
RESTING: Final = ArmReading(HOME, np.zeros(6), np.zeros(6), np.zeros(6), None)


@dataclasses.dataclass(frozen=True)
class Target:
    """One reader.

    Attributes:
        read: Function of the bytes.
        allowed: Exceptions that the reader documents.
        longest: Longest input that is tried, bytes.
        words: Words of the format, for mutations.
    """

    read: Callable[[bytes], None]
    allowed: tuple[type[Exception], ...]
    longest: int
    words: tuple[str, ...]

    def __call__(self, data: bytes) -> bool:
        """Read the bytes. Return False if they were refused as documented; any other exception is a defect."""
        try:
            self.read(data)
        except self.allowed:
            return False
        return True


TARGETS: Final[dict[str, Target]] = {}

Read = Callable[[bytes], None]


def target(*allowed: type[Exception], longest: int = 4096, words: str = "") -> Callable[[Read], Read]:
    def add(read: Read) -> Read:
        TARGETS[read.__name__] = Target(read, allowed, longest, tuple(words.split()))
        return read

    return add


def pieces(data: bytes, width: int = 1) -> Iterator[bytes]:
    """Yield the pieces in which a stream arrives, each behind its length in `width` bytes."""
    at = 0
    while at < len(data):
        size = int.from_bytes(data[at : at + width], "little")
        if piece := data[at + width : at + width + size]:
            yield piece
        at += width + size


def in_pieces(*parts: bytes, width: int = 1) -> bytes:
    """Return the input that `pieces` cuts into these parts, or smaller ones where a part is too long."""
    most = 256**width - 1
    cut = [part[at : at + most] for part in parts for at in range(0, len(part), most)]
    return b"".join(len(each).to_bytes(width, "little") + each for each in cut)


class Peer:
    """Peer of a client, which sends the next piece whenever the client waits, and then ends.

    Args:
        data: Pieces.
        streams: Send whatever is left also to a client that does not wait.
    """

    def __init__(self, data: bytes, *, streams: bool = False) -> None:
        self.clock = self
        self._coming, self._streams, self._waited = [*pieces(data)][::-1], streams, False

    # The system of the client.

    def connect(self, host: str, port: int, within_s: float) -> Peer:
        return self

    def event(self) -> Event:
        return Event()

    def thread(self, work: Callable[[], None], name: str) -> Peer:
        return self

    def join(self) -> None:
        pass

    # Its clock.

    def now_s(self) -> float:
        return 0.0

    def wait(self, readers: Any, until_s: float, writers: Any = ()) -> None:
        self._waited = True

    # Its transport.

    def fileno(self) -> int:
        return -1

    def send_now(self, data: Any) -> int:
        return len(data)

    def receive_now(self, size: int) -> bytes | None:
        waited, self._waited = self._waited, False
        if self._coming and (waited or self._streams):
            return self._coming.pop()
        return b"" if waited else None

    def close(self) -> None:
        pass


def controller_of(family: str) -> Controller:
    """Return a controller whose programs may fail, but not by a defect of a builtin."""
    made = Controller("left", PROFILES[family], HOME, 4, dh=NOMINAL_DH, builtins=builtins_of)
    made.program._failed = _expected
    return made


def _expected(error: ScriptError) -> None:
    assert error.__cause__ is None or isinstance(error.__cause__, _FAULTS), repr(error.__cause__)


# RTDE.

_STREAMED: Final = [
    ("timestamp", TYPES["DOUBLE"]),
    ("actual_q", TYPES["VECTOR6D"]),
    ("robot_mode", TYPES["INT32"]),
    ("output_bit_registers0_to_31", TYPES["UINT32"]),
]


@target(ProtocolError)
def rtde_frames(data: bytes) -> None:
    """Frames do not depend on the pieces, and no more than one is kept."""
    reader, found = FrameReader(1000), []
    for piece in pieces(data):
        found += reader.feed(piece)
        assert len(reader._buffer) < 1000
    assert found == [*FrameReader(1000).feed(b"".join(pieces(data)))]


@target(ProtocolError)
def rtde_stream(data: bytes) -> None:
    """Samples of a client do not depend on the pieces, and the controller's time advances."""
    stream, found = RtdeStream(1, _STREAMED, 0.0), []
    for piece in pieces(data):
        found += stream.feed(piece, 0.0)
    times = [each.timestamp_s for each in found]
    assert times == sorted(times)
    again = RtdeStream(1, _STREAMED, 0.0).feed(b"".join(pieces(data)), 0.0)
    assert repr(again) == repr(found)  # as texts, NaN equals itself


@target(LinkError, words="DOUBLE VECTOR6D INT32 UINT32 NOT_FOUND IN_USE")
def rtde_client(data: bytes) -> None:
    """Answers to a client that sets up its outputs, and the data that follow."""
    peer: Any = Peer(data, streams=True)
    RtdeLink(HERE, ["actual_q", "robot_mode"], optional=["payload"], system=peer).poll(1.0)


_PORT: Final = RtdePort(PROFILE, Registers(), zero_values(PROFILE), lambda values: None)


@target(
    ProtocolError,
    words="timestamp actual_q robot_mode input_int_register_0 input_double_register_24 input_bit_registers0_to_31 "
    "input_bit_register_64 speed_slider_fraction external_force_torque output_bit_registers0_to_31",
)
def rtde_server(data: bytes) -> None:
    """Requests to an emulated controller, and the packages that it publishes meanwhile."""
    registers = _PORT.registers
    registers.input_int[:], registers.input_double[:] = [0] * 48, [0.0] * 48
    session = _PORT.open()
    try:
        for tick, piece in enumerate(pieces(data)):
            session.receive(piece)
            session.publish(tick)
    finally:
        session.close()
    assert not _PORT.owners


# Primary interface.


@target(ProtocolError, SettingsError)
def primary_client(data: bytes) -> None:
    """Version, model and calibration of a controller, as a client reads them."""
    reader = _Reader()
    for piece in pieces(data):
        reader.feed(piece)
        if reader.facts is not None:
            reader.facts.dh("ur10")


@target(SettingsError)
def primary_messages(data: bytes) -> None:
    """Texts that users put into messages: clients can read the messages."""
    text = data.decode("utf-8", "surrogateescape")
    title, _, rest = text.partition("\n")
    reader = _Reader()
    reader.feed(text_message(1.0, text))
    reader.feed(popup_message(1.0, title, rest))
    reader.feed(error_code_message(1.0, title, rest))
    assert not reader._buffer


# Lines.


@target(ProtocolError)
def text_lines(data: bytes) -> None:
    """Lines do not depend on the pieces, and no more than the longest is kept."""
    reader, found = LineReader(64), []
    for piece in pieces(data):
        found += reader.feed(piece)
        assert len(reader._rest) <= 64
    assert found == LineReader(64).feed(b"".join(pieces(data)))


_DASHBOARD: Final = (
    "load play stop pause quit shutdown running robotmode get loaded program popup close addtolog isprogramsaved "
    "programstate polyscopeversion version setuserrole getuserrole set operational mode clear power on off brake "
    "release safetymode safetystatus unlock protective stop safety restart installation is in remote control serial "
    "number robot model generate flight report support file default.installation automatic programmer"
)


@target(ProtocolError, words=_DASHBOARD)
def dashboard_server(data: bytes) -> None:
    """Commands to an emulated dashboard: each is answered by one line."""
    if b"\n" not in data:
        return  # no command: no controller is needed
    made = controller_of("cb3" if data[:1] < b"\x80" else "e-series")
    peer = DashboardPeer(Dashboard(made.profile, Pendant(made, lambda: None)))
    for piece in pieces(data[1:]):
        assert peer.received(piece).count(b"\n") == piece.count(b"\n")
        made.tick(RESTING)


@target(LinkError, OperationRefusedError, words="Connected Robotmode: Safetystatus: Safetymode: Stopped URSoftware")
def dashboard_client(data: bytes) -> None:
    """Answers of a dashboard."""
    peer: Any = Peer(data)
    link = DashboardLink(HERE, system=peer)
    link.version()
    link.robot_mode()
    link.safety()
    link.program_state()
    link.remote_control()
    link.serial_number()
    link.model()
    link.stop()


@target(ProtocolError, words="SET GET ACT GTO ATR ARD POS SPE FOR SID STA OBJ FLT PRE 255")
def gripper_server(data: bytes) -> None:
    """Commands to an emulated gripper, whose fingers stay within their stroke."""
    gripper = RobotiqGripper()
    peer = LinePeer(gripper.answer, end="")
    width_m = gripper.stroke_m
    for piece in pieces(data):
        peer.received(piece)
        for _ in range(8):
            width_m = gripper.tick(0.05, width_m)
            assert 0.0 <= width_m <= gripper.stroke_m


@target(LinkError, words="STA POS FLT OBJ ack ?")
def gripper_client(data: bytes) -> None:
    """Answers of a gripper."""
    peer: Any = Peer(data)
    link = RobotiqLink(HERE, 63352, system=peer)
    link.read()
    link.command(0.02)
    link.needs_activation()


# URScript.


@target(ProtocolError, words="def sec thread while if switch end # $")
def script_splitter(data: bytes) -> None:
    """Programs do not depend on the pieces, and nothing is lost."""
    splitter, found = Splitter(), []
    for piece in pieces(data):
        found += splitter.feed(piece)
    whole = Splitter()
    assert found == whole.feed(b"".join(pieces(data)))
    assert splitter.rest == whole.rest


_WORDS: Final = (
    "def thread sec end if elif else while global local return kill join run break continue halt pass enter_critical "
    "exit_critical not True False and or xor == != <= >= ( ) [ ] : , = p[ sync() sleep(0.01) norm( length( to_str( "
    "str_cat( str_sub( to_num( pose_trans( pose_inv( binary_list_to_integer( integer_to_binary_list( floor( pow( 1e308"
)
_LIBRARY: Final = library(PROFILE.tick_s)


@target(ScriptError, words=_WORDS)
def script_program(data: bytes) -> None:
    """Programs without a robot: parsed, checked, compiled, and run for a few control periods."""
    program = _read(data.decode("utf-8", "replace"), _LIBRARY)
    machine = Machine(program, _LIBRARY, steps_per_tick=200)
    try:
        for _ in range(8):
            machine.tick()
    except ScriptError as error:
        _expected(error)
    finally:
        machine.kill()


_PRIMARY: Final = PrimaryPacket(PROFILE, NOMINAL_DH)
_REALTIME: Final = RealtimePacket(PROFILE)


@target(
    ProtocolError,
    words=_WORDS + " movej( movel( movec( servoj( speedj( speedl( stopj( stopl( force_mode( set_tcp( set_payload( "
    "get_actual_joint_positions() get_inverse_kin( get_forward_kin() textmsg( popup( rtde_set_watchdog( a= v= t= r= "
    "write_output_integer_register( read_input_float_register( set_digital_out( protective_stop()",
)
def script_controller(data: bytes) -> None:
    """Programs on a controller: motion stays finite, and clients can be sent its state."""
    made, splitter, ticks = controller_of("e-series"), Splitter(), 0
    reading = RESTING
    for piece in pieces(data, 2):
        for text in splitter.feed(piece + b"\n")[:4]:
            made.run_script(text)
        for _ in range(4):
            plan = made.tick(reading)
            assert np.isfinite(plan).all()
            end = plan[-1]
            reading = RESTING._replace(q_rad=end[0].copy(), qd_rad_s=end[1].copy())
            ticks += 1
            if ticks == 40:
                return
        _PRIMARY.state(made.values)
        _REALTIME.pack(made.values)


# JSON.


_CAMERA: Final = EmulatedTrackerEntry(prop="block")
_FLANGES: Final = Flanges(np.zeros((2, 3)), np.zeros((2, 4)))


@target(LinkError, OperationRefusedError, words='"ok" "value" "error" true false null "position_m" "quat" NaN')
def json_client(data: bytes) -> None:
    """Answers of a camera."""
    peer: Any = Peer(data)
    with CameraTracker(JsonLink("camera", HERE, 1, system=peer), "bar", _CAMERA, system=peer) as tracker:
        pose = tracker.pose(0.0, _FLANGES)
    assert np.isfinite(pose.position_m).all()
    assert np.isfinite(pose.quat).all()


class _Client:
    """Client of a port of an emulated controller, without a socket."""

    dropped = 0

    def __init__(self, peer: Any) -> None:
        self.peer = peer

    def send(self, data: bytes, *, droppable: bool = False) -> None:
        pass

    def flush(self) -> None:
        pass


class _Port:
    """Port of an emulated controller, without a socket."""

    def __init__(self, peer: Any) -> None:
        self.faults = LinkFaults()
        self.connections = [_Client(peer)]

    def inject(self, **faults: Any) -> None:
        for name, value in faults.items():
            setattr(self.faults, name, value)

    def broadcast(self, encode: Callable[[], bytes]) -> None:
        encode()

    def disconnect(self, reason: str, *, reset: bool, whose: Callable[[Any], bool]) -> None:
        self.connections = [each for each in self.connections if not whose(each.peer)]

    def refuse(self) -> None:
        pass

    def listen(self) -> None:
        pass


class _Hub:
    """Ports without sockets, and the system that gives a thread for programs."""

    system = LOCAL

    def add(self, name: str, address: Any, accept: Callable[[], Any], greeting: Callable[[], bytes]) -> _Port:
        greeting()
        return _Port(accept())


class _World:
    """World of one body that can be placed."""

    names = ("left", "right")

    def pose(self, body: str) -> Any:
        if body != "block":
            raise UnknownNameError("body", body, ("block",))
        return np.zeros(3), np.array([1.0, 0.0, 0.0, 0.0])

    def joints(self, prop: str) -> dict[str, float]:
        return {}

    def positions(self) -> Any:
        return np.zeros(3), np.zeros((1, 7))

    def place(self, pose: Any, prop: str = "") -> None:
        assert np.isfinite(pose).all()

    def push(self, arm: int, wrench: Any, duration_s: float) -> None:
        assert np.abs(wrench).max() <= 200.0
        assert 0.0 <= duration_s <= 60.0


class _Cell:
    """Cell for fault injection, whose only controller stands for both and is made when it is needed."""

    def __init__(self) -> None:
        self.ended, self.time_s, self.due_s, self.world, self._made = False, 1.0, 1.0, _World(), []

    def info(self) -> dict[str, Any]:
        return {}

    @property
    def servers(self) -> list[ArmServer]:
        if not self._made:
            server = ArmServer(_Hub(), controller_of("e-series"), HERE, None, lambda: None)  # type: ignore[arg-type]
            for client in server.ports["rtde"].connections:
                client.peer.received(b"\0\5V\0\2" + _OUTPUTS + b"\0\3S")
            self._made = [server] * 2
        return self._made

    def tick(self) -> None:
        for server in self._made[:1]:
            server.before_tick()
            server.controller.tick(RESTING)
            server.publish()
        self.time_s += PROFILE.tick_s


_NAMES: Final = b"timestamp,actual_q,robot_mode,safety_mode,runtime_state,speed_scaling,actual_TCP_pose"
_OUTPUTS: Final = struct.pack(">HBd", 11 + len(_NAMES), ord("O"), 500.0) + _NAMES
_INJECTION: Final = FaultInjection(_Cell())  # type: ignore[arg-type]


@target(
    ProtocolError,
    words='"do" "arm" "left" "mode" "info" "state" "names" "pose" "body" "block" "noise_m" "noise_rad" "delay_s" '
    '"place" "position_m" "quat" "push" "wrench" "setpoints" "since" "received" "clients" "stop" "reason" "release" '
    '"reduce" "on" "press" "button" "play" "slider" "fraction" "remote" "input" "bit" "program" "name" "text" "link" '
    '"port" "rtde" "all" "mute" "lose" "jitter_s" "heal" "drop" "reset" "writers" "refuse" "override" "actual_q" '
    '"watchdog" "script_delay" "seconds" "pretend" "version" "model" "serial_number" "robot_type" "safety_checksum" '
    '"calibration" "error_m" "shutdown" true null NaN 1e999 : ,',
)
def fault_injection(data: bytes) -> None:
    """Requests to an emulated cell: each is answered by one line of JSON, and the cell goes on."""
    cell = _Cell()
    _INJECTION._cell, _INJECTION._seen = cell, {}
    peer = LinePeer(_INJECTION.answer)
    for piece in pieces(data, 2):
        for line in peer.received(piece).splitlines():
            assert json.loads(line)["ok"] in (True, False)
        cell.tick()
        _INJECTION.after_tick(cell.time_s)
    for server in cell._made[:1]:
        server._reader.close()


# Files.


@target(
    CellFileError,
    words='kind = "real" "emulated" name task speed_factor commissioned allow_reduced_mode rt_priority [left] [right] '
    "host family base_position_m base_yaw_rad base_uncertainty_m tcp_position_m payload_kg payload_cog_m serial_number "
    "calibration checksum gripper servoj lookahead_s gain limits speed_rad_s measured latency_s [emulator] [[tracker]] "
    "[gains] kp_nm_rad kv_nms_rad "
    '[[camera]] "v4l2" "file" "pattern" "own" device position_m target_m fovy_rad '
    '[[obstacle]] "plane" "box" "capsule" normal point_m """ nan inf 1979-05-27',
)
def cell_file(data: bytes) -> None:
    """Cell files: what is accepted can be written, read again and used."""
    try:
        text = data.decode()
    except UnicodeDecodeError:
        return
    cell, findings = examine_text(text)
    assert (cell is None) == bool(findings)
    assert all(each.isprintable() for each in findings)
    if cell is not None:
        assert examine_text(cell.text()).cell == cell
        cell.notes()
        cell.config()
        cell.simulated()


@target(
    TrajectoryError,
    words="header: stamp: sec: nanosec: frame_id joint_names points positions velocities accelerations effort "
    "time_from_start time_s left/elbow_joint right_elbow_joint .speed .acceleration {} [] - --- & * !! << .nan 1e999",
)
def trajectory_file(data: bytes) -> None:
    """Files of trajectories; the first byte chooses the format. What is accepted can be written and read again."""
    if data:
        found = parse_trajectory(data[1:], FORMATS[data[0] % len(FORMATS)])
        again = parse_trajectory(_csv_of(found).encode(), "csv")
        assert np.array_equal(again.q_rad, found.q_rad)
        assert np.array_equal(again.time_s, found.time_s)


FORMATS: Final[tuple[Format, ...]] = ("json", "yaml", "csv")


@target(
    CalibrationError,
    words='"observations" "kind" "touch" "bar" "board" "left_q_rad" "right_q_rad" "left_tcp_m" "right_tcp_m" "grasp" '
    '"camera_on" "board_on" "fixed" "image" "position_m" "rotation_rad" "noise" "cameras" "left" "right" "time" null '
    "NaN 1e999",
)
def calibration_data(data: bytes) -> None:
    """Data files of calibrations without images: what is accepted can be written and read again."""
    found = data_file.parse(data)
    assert data_file.parse(found.model_dump_json(exclude_none=True).encode()) == found
    found.standard_deviations()
    if not any(isinstance(each, data_file.ViewEntry) and each.image is not None for each in found.observations):
        assert len(found.measured(Path())) == len(found.observations)


@target(CheckpointError)
def checkpoint_manifest(data: bytes) -> None:
    """Manifests, with the checksum that belongs to them: what is accepted can be written and read again."""
    value = schema.loads(data, "manifest")
    if isinstance(value, dict):
        value = {**{name: each for name, each in value.items() if name != "sha256"}, "format": FORMAT}
        found = parse(json.dumps({**value, "sha256": _checksum(value)}).encode())
        assert parse(found.text().encode()) == found


NETWORKS, MANIFEST = parts(agents="shared", hidden=2)


@target(CheckpointError, words="dtype shape data_offsets __metadata__ F32 F64 BF16 policy.0.weight policy.1.bias")
def checkpoint_weights(data: bytes) -> None:
    """Weights in the form of safetensors."""
    for layers in _networks(data, MANIFEST, "weights"):
        for weight, bias in layers:
            assert np.isfinite(weight).all()
            assert np.isfinite(bias).all()


HEADER: Final = header(period_ticks=1)
PREAMBLE: Final = Encoder(HEADER, STATE_COLUMNS).preamble
_SCANNED: Final = _Scan(BytesIO(PREAMBLE), len(PREAMBLE), _WANTED)
_SCANNED.run()


@target(RecordingError, longest=8192)
def record_file(data: bytes) -> None:
    """Files of records as they are, which checksums protect, after the same with checksums that are right."""
    mended = _mended(data)
    with contextlib.suppress(RecordingError):
        _run(_Scan(BytesIO(mended), len(mended), _WANTED).run(), allow_partial=len(data) % 2 == 0)
    _run(_Scan(BytesIO(data), len(data), _WANTED).run(), allow_partial=len(data) % 4 < 2)


def _mended(data: bytes) -> bytes:
    """Return the file with right checksums of chunks and data, so that what lies behind them is reached."""
    found, at = bytearray(data), 8
    while at + 9 <= len(found):
        code, length = struct.unpack_from("<BQ", found, at)
        end = at + 9 + length
        if end > len(found):
            break
        if code == mcap.CHUNK and length >= 40:
            struct.pack_into("<I", found, at + 9 + 24, zlib.crc32(found[at + 49 : end]))
        if code == mcap.DATA_END and length == 4:
            struct.pack_into("<I", found, at + 9, zlib.crc32(found[:at]))
        at = end
    return bytes(found)


@target(RecordingError)
def record_messages(data: bytes) -> None:
    """Messages of records within a valid file: the first byte of each names its topic, and rows are filled up."""
    records, counts = [], [0] * len(TOPICS)
    for piece in pieces(data, 2):
        number = piece[0] % len(TOPICS)
        body = piece[1:]
        if TOPICS[number] not in SINGLE and body:
            columns = STATE_COLUMNS if TOPICS[number].endswith("/state") else SENT_COLUMNS
            size = 8 * sum(size for _, size in columns)
            body = HEAD + (body * (size // len(body) + 1))[:size]
        records.append(single_record(number + 1, counts[number], 0, body))
        counts[number] += 1
    scan = copy.copy(_SCANNED)  # as if the messages followed the preamble in a chunk
    scan._next = dict.fromkeys(scan._channels, 0)
    scan._found = dataclasses.replace(scan._found, messages={topic: [] for topic in scan._found.messages})
    scan._messages(b"".join(records), 0)
    _run(scan._found, allow_partial=True)


@target(RecordingError)
def record_header(data: bytes) -> None:
    """Headers of records, with the checksum that belongs to them."""
    line = data.decode("utf-8", "replace")
    mounts_of(from_metadata({"format": "1", "header": line, "crc32": str(zlib.crc32(line.encode()))}))


@target(RecordingError)
def record_cdr(data: bytes) -> None:
    """Messages in CDR; the first byte chooses the definition."""
    if data:
        (BEGIN, STEP, EVENT)[data[0] % 3].decode(data[1:])


@target(PolicyServerError, words="__ndarray__ __npgeneric__ data dtype shape actions observation <f4 |u1 |O")
def policy_message(data: bytes) -> None:
    """Messages of policy servers and their clients; what is read can be sent."""
    packed(unpacked(data, "fuzzing"))
