"""Facts that a controller reports on its primary interface: version, model, calibration and safety settings."""

from __future__ import annotations

import struct
from collections.abc import Iterator
from typing import Final, NamedTuple

from ur_core.errors import ProtocolError
from ur_core.kinematics.ur10 import DHParameters
from ur_core.links.link_socket import LinkSocket, check_timeout
from ur_core.processes.system import LOCAL, System
from ur_core.protocol.primary_messages import ROBOT_MESSAGE
from ur_core.protocol.primary_packet import ROBOT_STATE

PORT: Final = 30001

# Layouts: UR's client interface article, and the parsers of Universal Robots' client library. The layout of the safety
# data is not published. They begin with the checksum of the safety settings, and are sent once these are applied:
# Universal Robots' forum, topic 988.
_HEADER: Final = struct.Struct(">iB")
_VERSION: Final = 3  # kind of message
_KINEMATICS, _CONFIGURATION, _SAFETY = 5, 6, 10  # kinds of sub-packages
_KINEMATICS_DATA: Final = struct.Struct(">6I24d")
_BEFORE_TYPE: Final = 53 * 8 + 2 * 4  # of the configuration: limits, defaults and lengths, masterboard and box
_LARGEST: Final = 1 << 16  # of a packet; a robot state has about 1.4 KiB
_MOST_PACKETS: Final = 200  # 20 s of them


class PrimaryFacts(NamedTuple):
    """Facts about a controller and its arm.

    Attributes:
        version: Major, minor, bugfix and build of the controller's software.
        robot_type: UR's number of the model: see `RobotModel.robot_type`.
        checksums: (6,) checksums of the calibration, one per joint.
        theta_rad, a_m, d_m, alpha_rad: (6,) Denavit-Hartenberg parameters as calibrated.
        safety_checksum: Checksum of the safety settings: 32 bits, not the text on the pendant. None: not reported.
    """

    version: tuple[int, int, int, int]
    robot_type: int
    checksums: tuple[int, ...]
    theta_rad: tuple[float, ...]
    a_m: tuple[float, ...]
    d_m: tuple[float, ...]
    alpha_rad: tuple[float, ...]
    safety_checksum: int | None = None

    def dh(self, robot: str) -> DHParameters:
        """Return the parameters of this arm.

        Args:
            robot: Its model.

        Raises:
            SettingsError: They are not those of this model.
        """
        return DHParameters(self.a_m, self.d_m, self.alpha_rad, self.theta_rad, robot=robot)


def read_primary(
    host: str, timeout_s: float = 2.0, port: int = PORT, *, name: str = "", system: System = LOCAL
) -> PrimaryFacts:
    """Connect, read the first packets, and close. Nothing is sent.

    Args:
        host: IPv4 address.
        timeout_s: Time limit. Robot states come ten times a second.
        port: Port number.
        name: Name of the arm, for messages.
        system: Clock and network.

    Raises:
        SettingsError: An argument is not legal.
        LinkError: There is no primary interface, or its data are incomplete in time or not valid.
    """
    deadline_s = system.clock.now_s() + check_timeout(timeout_s)
    with LinkSocket(name, "primary interface", host, port, deadline_s, system=system) as socket:
        reader = _Reader()
        while reader.facts is None:
            data = socket.receive(deadline_s)
            try:
                reader.feed(data)
            except ProtocolError as error:
                raise socket.error(
                    str(error), "this is no UR controller of a known version: check the address"
                ) from error
        return reader.facts


class _Reader:
    """Parser that takes bytes until all facts are there."""

    def __init__(self) -> None:
        self._buffer = bytearray()
        self._packets = 0
        self._version: tuple[int, int, int, int] | None = None
        self._kinematics: tuple[float, ...] | None = None
        self._robot_type: int | None = None
        self._safety_checksum: int | None = None

    @property
    def facts(self) -> PrimaryFacts | None:
        """Facts, once they are complete."""
        flat = self._kinematics
        if self._version is None or flat is None or self._robot_type is None:
            return None
        checksums = tuple(map(int, flat[:6]))
        theta, a, d, alpha = (flat[start : start + 6] for start in range(6, 30, 6))
        return PrimaryFacts(self._version, self._robot_type, checksums, theta, a, d, alpha, self._safety_checksum)

    def feed(self, data: bytes) -> None:
        """Take bytes of the stream.

        Raises:
            ProtocolError: They are not those of a primary interface.
        """
        buffer = self._buffer
        buffer += data
        while len(buffer) >= _HEADER.size:
            size, kind = _HEADER.unpack_from(buffer)
            if not _HEADER.size <= size <= _LARGEST:
                raise ProtocolError(f"packet of {size} bytes: {_HEADER.size} to {_LARGEST} are possible")
            if len(buffer) < size:
                return
            self._packet(kind, bytes(buffer[_HEADER.size : size]))
            del buffer[:size]

    def _packet(self, kind: int, body: bytes) -> None:
        self._packets += 1
        if self._packets > _MOST_PACKETS:
            raise ProtocolError(f"{_MOST_PACKETS} packets without version, configuration and kinematics")
        try:
            if kind == ROBOT_MESSAGE and len(body) > 10 and body[9] == _VERSION:
                major, minor, bugfix, build = struct.unpack_from(">BBii", body, 11 + body[10])
                self._version = major, minor, bugfix, build
            elif kind == ROBOT_STATE:
                for which, data in _sub_packages(body):
                    if which == _KINEMATICS:
                        self._kinematics = _KINEMATICS_DATA.unpack_from(data)
                    elif which == _CONFIGURATION:
                        (self._robot_type,) = struct.unpack_from(">I", data, _BEFORE_TYPE)
                    elif which == _SAFETY:
                        (self._safety_checksum,) = struct.unpack_from(">I", data)
        except struct.error as error:
            raise ProtocolError(f"packet of kind {kind} is too short: {error}") from error


def _sub_packages(body: bytes) -> Iterator[tuple[int, bytes]]:
    place = 0
    while place < len(body):
        size, kind = _HEADER.unpack_from(body, place)
        if not _HEADER.size <= size <= len(body) - place:
            raise ProtocolError(f"sub-package {kind} of {size} bytes, in a packet that has {len(body) - place} left")
        yield kind, body[place + _HEADER.size : place + size]
        place += size
