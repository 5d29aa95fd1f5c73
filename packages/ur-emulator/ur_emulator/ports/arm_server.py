"""Ports of one emulated controller, and the data that its clients receive in every control period."""

from __future__ import annotations

import logging
import struct
from collections import deque
from collections.abc import Callable, Mapping
from concurrent.futures import Future
from typing import Any, Final

from ur_core.errors import OperationRefusedError, ProtocolError, ScriptError, SettingsError
from ur_core.kinematics.ur10 import DHParameters
from ur_core.protocol.primary_messages import version_message
from ur_core.protocol.primary_packet import RATE_HZ, PrimaryPacket
from ur_core.protocol.text_lines import LineReader, refuse_http
from ur_emulator.addresses import PORTS
from ur_emulator.controller.controller import Controller
from ur_emulator.controller.pendant import Pendant
from ur_emulator.controller.program_reader import ProgramReader
from ur_emulator.ports.dashboard import GREETING, Dashboard
from ur_emulator.ports.grippers import EmulatedGripper
from ur_emulator.ports.realtime_packet import RealtimePacket
from ur_emulator.ports.rtde_recipes import OutputRecipe
from ur_emulator.ports.rtde_session import RtdePort, RtdeSession
from ur_emulator.ports.sockets import Hub, Port
from ur_emulator.profile import ControllerProfile
from ur_emulator.script import Program, Splitter

log = logging.getLogger(__name__)

_MAX_SCRIPTS: Final = 64  # programs waiting for their start


class RtdePeer:
    """Client of the RTDE port."""

    finished = False

    def __init__(self, session: RtdeSession) -> None:
        self.session = session

    def received(self, data: bytes) -> bytes:
        """Answer received bytes."""
        return self.session.receive(data)

    def closed(self) -> None:
        """Release its inputs."""
        self.session.close()


class LinePeer:
    """Client that sends lines and gets one answer for each.

    Args:
        answer: Function from a line to its answer.
        end: End of every answer.
    """

    finished = False

    def __init__(self, answer: Callable[[str], str], end: str = "\n") -> None:
        self._answer, self._lines, self._end = answer, LineReader(), end

    def received(self, data: bytes) -> bytes:
        """Answer received bytes."""
        answers = []
        for line in self._lines.feed(data):
            refuse_http(line)
            answers.append(self._answer(line) + self._end)
        return "".join(answers).encode("utf-8", "replace")

    def closed(self) -> None:
        """Do nothing: the peer has no state."""


class DashboardPeer(LinePeer):
    """Client of the dashboard server."""

    def __init__(self, dashboard: Dashboard) -> None:
        super().__init__(dashboard.answer)
        self._dashboard = dashboard

    @property
    def finished(self) -> bool:  # type: ignore[override]  # read only here
        """True after the client has quit."""
        return self._dashboard.closed


class ScriptPeer:
    """Client of a port that takes programs.

    Args:
        run: Function that takes a program.
    """

    finished = False

    def __init__(self, run: Callable[[str], None]) -> None:
        self._run, self._splitter = run, Splitter()

    def received(self, data: bytes) -> bytes:
        """Run the completed programs. Nothing is answered."""
        for text in self._splitter.feed(data):
            self._run(text)
        return b""

    def closed(self) -> None:
        """Drop an incomplete program."""


_COMMANDS: Final[dict[str, Callable[[Pendant], None]]] = {
    "power on": Pendant.power_on,
    "power off": Pendant.power_off,
    "set robotmode run": Pendant.release_brakes,
    "set unlock protective stop": lambda pendant: pendant.unlock_protective_stop(primary=True),
    "stop program": Pendant.stop,
}
"""Lines on the script ports that are no programs: what UR's C++ client library sends to the primary interface."""


class ArmServer:
    """One controller on its standard ports.

    Args:
        hub: Sockets of the cell.
        controller: The controller.
        host: Its own loopback address.
        gripper: The gripper, or None.
        off: Callback for a shutdown through the dashboard.
        programs: Texts of its program files, by path.

    Attributes:
        ports: Ports by name, as in `PORTS`.
        script_delay_s: Injected delay of the start of programs.

    Raises:
        AddressError: The address cannot be used.
    """

    def __init__(
        self,
        hub: Hub,
        controller: Controller,
        host: str,
        gripper: EmulatedGripper | None,
        off: Callable[[], None],
        programs: Mapping[str, str] | None = None,
    ) -> None:
        self.controller, self.host, self.gripper = controller, host, gripper
        self.pendant = Pendant(controller, off, programs)
        self.script_delay_s = 0.0
        self._primary_ticks = round(1.0 / (RATE_HZ * controller.profile.tick_s))
        self._sent_mode = controller.safety.safety_mode
        self._scripts: deque[tuple[float, str, Future[Program | ScriptError]]] = deque()
        self._hub = hub
        self._reader = ProgramReader(hub.system, controller.name, controller.program.builtins)
        self._rtde = RtdePort(
            controller.profile,
            controller.registers,
            controller.values,
            controller.inputs,
            lambda names: controller.received.package(names, controller.ticks),
        )
        self._realtime = RealtimePacket(controller.profile)
        self.pretend(controller.profile, controller.dh)
        name = controller.name
        self.ports: dict[str, Port] = {}
        try:
            self._listen(name, gripper)
        except OSError:
            self.close()
            raise

    def pretend(self, profile: ControllerProfile, kinematics: DHParameters) -> None:
        """Report another version, model or calibration to clients from now on.

        Raises:
            SettingsError: It cannot be encoded.
        """
        try:
            primary = PrimaryPacket(profile, kinematics)
        except struct.error as error:
            raise SettingsError(f"no controller can report this: {error}") from error
        self.primary, self.shown, self.kinematics = primary, profile, kinematics
        self._rtde.profile = profile

    def check(self, values: Mapping[str, Any]) -> None:
        """Check that values can be reported to clients on every port.

        Args:
            values: Values by RTDE name.

        Raises:
            SettingsError: They cannot.
        """
        reported = {**self.controller.values, **values}
        try:
            for name, value in values.items():
                self._rtde.output_types[name].fit(name, value)
            self._realtime.pack(reported)
            self.primary.state(reported)
        except (struct.error, TypeError, ValueError, OverflowError) as error:
            raise SettingsError(f"clients cannot be sent {dict(values)!r}: {error}") from error

    def _listen(self, name: str, gripper: EmulatedGripper | None) -> None:
        numbers = {**PORTS, "gripper": None if gripper is None else gripper.port}

        def add(which: str, accept: Callable[[], object], greeting: Callable[[], bytes] = bytes) -> None:
            port = self._hub.add(f"{name} {which}", (self.host, numbers[which]), accept, greeting)  # type: ignore[arg-type]  # the peers of these ports
            self.ports[which] = port

        add("dashboard", lambda: DashboardPeer(Dashboard(self.shown, self.pendant)), lambda: f"{GREETING}\n".encode())
        for which in ("primary", "secondary"):
            add(which, self._script_peer, lambda: version_message(self.shown))
        add("realtime", self._script_peer)
        add("rtde", self._rtde_peer)
        if gripper is not None and gripper.port is not None:
            # The gripper's answers bring their own ends.
            add("gripper", lambda: LinePeer(gripper.answer, end=""))

    def _script_peer(self) -> ScriptPeer:
        self._reader.prepare()
        return ScriptPeer(self._take_script)

    def _rtde_peer(self) -> RtdePeer:
        self._reader.prepare()  # clients connect here before they send a program
        return RtdePeer(self._rtde.open())

    def _take_script(self, text: str) -> None:
        command = _COMMANDS.get(" ".join(text.split()))
        if command is not None:
            self._command(text.strip(), command)
            return
        self.controller.received.upload(self.controller.ticks, text)
        if len(self._scripts) >= _MAX_SCRIPTS:
            raise ProtocolError(f"{_MAX_SCRIPTS} programs are waiting already")
        found = self._reader.submit(text)
        self._scripts.append((self.controller.time_s, text, found))

    def _command(self, text: str, command: Callable[[Pendant], None]) -> None:
        if not self.controller.takes_scripts:
            self.controller.refuse(text, "the controller is in local mode")
            return
        try:
            command(self.pendant)
        except OperationRefusedError as error:
            self.controller.refuse(text, str(error))

    def before_tick(self) -> None:
        """Start the parsed programs, in order of arrival."""
        while self._scripts:
            arrived_s, text, found = self._scripts[0]
            if arrived_s + self.script_delay_s > self.controller.time_s or not found.done():
                break
            self._scripts.popleft()
            self.controller.run_script(text, found.result())

    def publish(self) -> None:
        """Send the data that are due in this control period."""
        controller, ports = self.controller, self.ports
        packages: dict[OutputRecipe, bytes] = {}
        for connection in tuple(ports["rtde"].connections):
            peer = connection.peer
            if isinstance(peer, RtdePeer):
                connection.send(peer.session.publish(controller.ticks, packages), droppable=True)
        ports["realtime"].broadcast(lambda: self._realtime.pack(self._rtde.values))
        # A stop is in the state before its messages come: the tests of UR's client library release it at its message,
        # and wait until the state no longer has it.
        mode, self._sent_mode = self._sent_mode, controller.safety.safety_mode
        if controller.ticks % self._primary_ticks == 0 or mode != self._sent_mode:
            for which in ("primary", "secondary"):
                ports[which].broadcast(lambda: self.primary.state(controller.values))
        while controller.messages:
            message = controller.messages.popleft()
            ports["primary"].broadcast(lambda: message)  # noqa: B023  # called at once

    def close(self) -> None:
        """Close all ports, and end what reads programs. May be called twice."""
        self._reader.close()
        self.controller.sockets.shut_down()
        for port in self.ports.values():
            port.close()
            self._hub.ports.remove(port)
        self.ports.clear()
