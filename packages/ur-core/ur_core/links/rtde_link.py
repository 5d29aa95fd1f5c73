"""Read-only client of RTDE, which observes an arm independently of the program that commands it.

It needs no thread, and once made it never waits. After the start it sends nothing, so that it cannot disturb, and it
does not reconnect. The timestamp in its data is the only sign of life of a controller: an open connection is none, nor
are packages that repeat themselves.
"""

from __future__ import annotations

import math
import re
import struct
from collections.abc import Sequence
from typing import Final, NoReturn

from ur_core.errors import LinkError, ProtocolError, SettingsError
from ur_core.kinematics.ur10 import TICK_S
from ur_core.links.link_socket import LinkSocket, SocketClient, check_timeout
from ur_core.links.rtde_stream import TIMESTAMP, RtdeStream, Sample
from ur_core.processes.system import LOCAL, System
from ur_core.protocol.rtde import TYPES, DataType, FrameReader, Kind, frame, split_names

PORT: Final = 30004

_PROTOCOL: Final = 2
_CB3: Final = 3  # last major version of its software
_MOST_BYTES: Final = 1 << 20  # that one poll takes, however much there is
_NOT_FOUND: Final = "NOT_FOUND"
_UNFIT: Final = "this is no UR controller of a known version, or something between changes what it sends"


class RtdeClient:
    """RTDE connection before its start: one request, one answer.

    Args:
        name: Name of the arm, for messages.
        host: IPv4 address.
        port: Port number.
        deadline_s: Deadline for the controller's version, on the system's clock.
        system: Clock and network.

    Attributes:
        version: Major, minor, bugfix and build of the controller's software.

    Raises:
        LinkError: It did not answer in time, or does not speak version 2 of the protocol.
    """

    def __init__(self, name: str, host: str, port: int, deadline_s: float, *, system: System = LOCAL) -> None:
        self._clock = system.clock
        self.socket = LinkSocket(name, "RTDE", host, port, deadline_s, system=system)
        self._frames = FrameReader()
        with self.socket.closed_on_error():
            answer = self.request(Kind.REQUEST_PROTOCOL_VERSION, struct.pack(">H", _PROTOCOL), deadline_s)
            if answer != b"\1":
                raise self.socket.error(
                    f"protocol version {_PROTOCOL} was not accepted", "update the controller's software"
                )
            self.version = self.ask_version(deadline_s)

    @property
    def rate_hz(self) -> float:
        """Rate at which the controller computes its state, by its version."""
        return 1.0 / TICK_S["cb3" if self.version[0] <= _CB3 else "e-series"]

    def ask_version(self, deadline_s: float) -> tuple[int, int, int, int]:
        """Ask for the version of the controller's software.

        Raises:
            LinkError: There is no answer in time, or it is not valid.
        """
        answer = self.request(Kind.GET_URCONTROL_VERSION, b"", deadline_s)
        if len(answer) != 16:
            raise self.socket.error(f"{len(answer)} bytes as its version", _UNFIT)
        major, minor, bugfix, build = struct.unpack(">4I", answer)
        return major, minor, bugfix, build

    def round_trips_s(self, count: int, deadline_s: float) -> list[float]:
        """Measure the duration of `count` requests, s.

        Raises:
            LinkError: There are no answers in time.
        """
        found = []
        for _ in range(count):
            begin = self._clock.now_s()
            self.ask_version(deadline_s)
            found.append(self._clock.now_s() - begin)
        return found

    def request(self, kind: Kind, payload: bytes, deadline_s: float) -> bytes:
        """Send a request, and return its answer.

        Raises:
            LinkError: There is no answer in time, or it is not valid.
        """
        self.socket.send(frame(kind, payload), deadline_s)
        while True:
            data = self.socket.receive(deadline_s)
            try:
                frames = [each for each in self._frames.feed(data) if each[0] != Kind.TEXT_MESSAGE]
            except ProtocolError as error:
                raise self.socket.error(str(error), _UNFIT) from error
            if len(frames) == 1 and frames[0][0] == kind:
                return frames[0][1]
            if frames:
                kinds = ", ".join(str(each) for each, _ in frames)
                raise self.socket.error(f"packages of kind {kinds} as the answer to one of kind {int(kind)}", _UNFIT)

    def set_up(self, kind: Kind, names: Sequence[str], prefix: bytes, deadline_s: float) -> tuple[int, list[str]]:
        """Set up a recipe.

        Args:
            kind: Setup of outputs or inputs.
            names: Variables.
            prefix: Bytes before the names.
            deadline_s: Deadline of the answer.

        Returns:
            Number of the recipe, 0 if it was refused, and for each name its type or the reason of the refusal.

        Raises:
            LinkError: There is no answer in time, or it does not fit.
        """
        answer = self.request(kind, prefix + ",".join(names).encode("ascii"), deadline_s)
        types = split_names(answer[1:])
        if len(types) != len(names):
            raise self.socket.error(f"{len(types)} types for {len(names)} variables", _UNFIT)
        return answer[0], types


class RtdeLink(SocketClient):
    """Reader of RTDE output variables of one controller.

    Args:
        host: IPv4 address.
        variables: RTDE output variables. `timestamp` is always read.
        frequency_hz: Rate of the samples; None: the controller's own rate.
        port: Port number.
        timeout_s: Time limit of the start, all phases together.
        optional: Variables that are read if this version of the controller has them.
        name: Name of the arm, for messages.
        system: Clock and network.

    Attributes:
        version: Major, minor, bugfix and build of the controller's software.
        frequency_hz: Requested rate of the samples.
        variables: Names of the variables that are read.

    Raises:
        SettingsError: An argument is not legal.
        LinkError: There is no controller, its answers are late or not valid, or it lacks a variable.
    """

    def __init__(
        self,
        host: str,
        variables: Sequence[str],
        frequency_hz: float | None = None,
        port: int = PORT,
        timeout_s: float = 2.0,
        *,
        optional: Sequence[str] = (),
        name: str = "",
        system: System = LOCAL,
    ) -> None:
        self._clock = system.clock
        wanted, optional = _check_names(variables, frequency_hz), _check_names(optional, None)[1:]
        deadline_s = self._clock.now_s() + check_timeout(timeout_s)
        client = RtdeClient(name, host, port, deadline_s, system=system)
        self._socket = client.socket
        self._fault = ""
        with self._socket.closed_on_error():
            self.version = client.version
            self.frequency_hz = client.rate_hz if frequency_hz is None else float(frequency_hz)
            names = [*wanted, *(each for each in optional if each not in wanted)]
            recipe, kinds = _set_up_outputs(client, names, set(optional) - set(wanted), self.frequency_hz, deadline_s)
            self.variables = tuple(each for each, _ in kinds)
            self._stream = RtdeStream(recipe, kinds, self._clock.now_s(), self._socket.where)
            self._begin(deadline_s)

    def _begin(self, deadline_s: float) -> None:
        """Start the stream. Data may arrive together with the answer."""
        self._socket.send(frame(Kind.START), deadline_s)
        while not self._stream.started:
            data = self._socket.receive(deadline_s)
            self._take(data, self._clock.now_s())

    @property
    def latest(self) -> Sample | None:
        """Newest sample, or None before the first."""
        return self._stream.latest

    @property
    def count(self) -> int:
        """Number of samples so far."""
        return self._stream.count

    def age_s(self, now_s: float) -> float:
        """Return the time since the controller's time last advanced, as known here, s.

        Args:
            now_s: Time of the clock.
        """
        return now_s - self._stream.alive_s

    def poll(self, now_s: float | None = None) -> list[Sample]:
        """Return the samples since the last poll. It does not wait.

        Args:
            now_s: Time of the clock; None: read it.

        Raises:
            LinkError: The link is broken: the stream has ended, holds data of no such recipe, or the controller's time
                went back. It stays broken; the newest sample before that is `latest`.
            ClosedError: The link was closed.
        """
        if self._fault:
            raise LinkError(self._fault)
        arrival_s = self._clock.now_s() if now_s is None else now_s
        samples: list[Sample] = []
        taken = 0
        while taken < _MOST_BYTES:
            try:
                data = self._socket.receive_now()
            except LinkError as error:
                self._break(error)
            if data is None:
                break
            if not data:
                self._break(self._socket.ended())
            samples += self._take(data, arrival_s)
            taken += len(data)
        return samples

    def _take(self, data: bytes, arrival_s: float) -> list[Sample]:
        try:
            return self._stream.feed(data, arrival_s)
        except ProtocolError as error:
            self._break(self._socket.error(str(error), "check the controller and the network, then start again"))

    def _break(self, error: LinkError) -> NoReturn:
        self._fault = str(error)
        self._socket.close()
        raise error


def _check_names(names: Sequence[str], frequency_hz: float | None) -> list[str]:
    """Return the names, after the timestamp.

    Raises:
        SettingsError: A name or the frequency is not legal, or a name is there twice.
    """
    for name in names:
        if not isinstance(name, str) or re.fullmatch(r"[A-Za-z0-9_]{1,64}", name) is None:
            raise SettingsError(f"RTDE variable {name!r}: names have letters, digits and underscores only")
    if isinstance(names, str) or len(set(names)) != len(names):
        raise SettingsError(f"RTDE variables {names!r}: give a list of distinct names")
    if frequency_hz is not None and not (math.isfinite(frequency_hz) and frequency_hz > 0.0):
        raise SettingsError(f"frequency_hz is {frequency_hz!r}: it must be positive and finite")
    return [TIMESTAMP, *(name for name in names if name != TIMESTAMP)]


def _set_up_outputs(
    client: RtdeClient, names: list[str], optional: set[str], frequency_hz: float, deadline_s: float
) -> tuple[int, list[tuple[str, DataType]]]:
    """Set up the output recipe, without optional variables that this version lacks.

    Returns:
        Number, names and types of the recipe.

    Raises:
        LinkError: It is refused.
    """
    prefix = struct.pack(">d", frequency_hz)
    recipe, types = client.set_up(Kind.SETUP_OUTPUTS, names, prefix, deadline_s)
    missing = [name for name, kind in zip(names, types, strict=True) if kind == _NOT_FOUND]
    if missing and optional.issuperset(missing):
        names = [name for name in names if name not in missing]
        recipe, types = client.set_up(Kind.SETUP_OUTPUTS, names, prefix, deadline_s)
        missing = [name for name, kind in zip(names, types, strict=True) if kind == _NOT_FOUND]
    version = ".".join(map(str, client.version))
    if missing:
        raise client.socket.error(
            f"software {version} has no RTDE variables {', '.join(missing)}", "update the controller's software"
        )
    unknown = sorted(set(types) - set(TYPES))
    if unknown or not recipe:
        raise client.socket.error(f"output recipe {recipe} with types {', '.join(types)[:200]}", _UNFIT)
    return recipe, [(name, TYPES[kind]) for name, kind in zip(names, types, strict=True)]
