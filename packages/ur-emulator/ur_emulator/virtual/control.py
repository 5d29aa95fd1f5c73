"""Control interface of a virtual cell: it commands a controller as `ur_rtde` 1.6.5 does, by `ur_rtde`'s own script."""

from __future__ import annotations

import functools
import math
import struct
import subprocess
import sys
from collections.abc import Sequence
from typing import Final

from ur_core.errors import LinkError, MissingExtraError, VirtualCellError
from ur_core.kinematics.robots import MODEL_OF_FAMILY
from ur_core.links.dashboard_link import DashboardLink
from ur_core.links.rtde_link import PORT, RtdeClient, RtdeLink
from ur_core.processes.system import System
from ur_core.protocol.modes import RuntimeState
from ur_core.protocol.rtde import Kind, frame
from ur_emulator.emulator import ControllerOptions, Emulator

_SCRIPT_PORT: Final = 30003
_OUTPUTS: Final = ("runtime_state", "output_int_register_0")
_READY, _DONE = 1, 2  # of the script, in output register 0
_SERVOJ, _SERVO_STOP, _WATCHDOG, _KICK, _STOP_SCRIPT = 11, 16, 35, 0, 255
_INT: Final = "input_int_register_0"
_RECIPES: Final = {
    "command": (_INT,),
    "number": (_INT, "input_double_register_0"),
    "servo": (_INT, *(f"input_double_register_{number}" for number in range(11))),
}
_PLAYS_S: Final = 5.0  # limits and periods of ur_rtde
_ANSWER_S: Final = 4.0
_POLL_S: Final = 0.01
_CONNECT_S: Final = 2.5
_LOOKAHEAD_S: Final = (0.03, 0.2)
_GAIN: Final = (100.0, 2000.0)
_CAPTURE_S: Final = 30.0


class ScriptControl:
    """Part of `ur_rtde`'s `RTDEControlInterface` that moves arms.

    Its inputs have a connection of their own. It never reconnects: a process of an arm prevents `ur_rtde` from it, too.

    Args:
        host: Address of the controller.
        system: Clock and network.
        family: Family of the controller, "cb3" or "e-series", whose script is uploaded.

    Raises:
        RuntimeError: The controller refuses it.
    """

    def __init__(self, host: str, system: System, family: str) -> None:
        self._clock = system.clock
        self._connected = True
        deadline_s = self._clock.now_s() + _CONNECT_S
        try:
            self._link = RtdeLink(host, _OUTPUTS, system=system)
            self._inputs = RtdeClient("", host, PORT, deadline_s, system=system)
            self._dashboard = DashboardLink(host, _CONNECT_S, system=system)
            if self._dashboard.remote_control() is False:
                raise RuntimeError("please enable remote control on the robot")
            self._recipes = {}
            for name, variables in _RECIPES.items():
                number, types = self._inputs.set_up(Kind.SETUP_INPUTS, variables, b"", deadline_s)
                if "IN_USE" in types:
                    raise RuntimeError("one of the RTDE input registers is already in use")
                self._recipes[name] = number
            self._script = system.connect(host, _SCRIPT_PORT, _CONNECT_S)
            self._send("command", 0)
            if self._plays():
                self.stopScript()
                self._dashboard.stop()
            text = control_script(family).encode()
            while text:
                text = text[self._script.send_now(text) :]
        except OSError as error:
            raise RuntimeError(str(error)) from error
        end = self._clock.now_s() + _PLAYS_S
        while not self._plays():
            if self._clock.now_s() > end:
                raise RuntimeError(f"the control script did not start within {_PLAYS_S:g} s")
            self._clock.sleep(_POLL_S)

    # State.

    def _poll(self) -> None:
        if self._connected:
            try:
                self._link.poll()
                if self._inputs.socket.receive_now() == b"":
                    self._connected = False
            except LinkError:
                self._connected = False

    def _value(self, name: str) -> int:
        """Return a value of the newest sample that was polled."""
        sample = self._link.latest
        return -1 if sample is None else int(sample.values[name])  # type: ignore[arg-type]  # a number, by its type

    def _plays(self) -> bool:
        self._poll()
        return self._value("runtime_state") == RuntimeState.PLAYING

    def _wait_for(self, state: int) -> bool:
        """Wait for a state of the script; return False if it ends, or after ur_rtde's time limit."""
        end = self._clock.now_s() + _ANSWER_S
        while self._value("output_int_register_0") != state:
            if not self._plays() or not self._connected or self._clock.now_s() > end:
                return False
            self._clock.wait((self._link.fileno(),), end)
            self._poll()
        return True

    # Commands.

    def _send(self, recipe: str, command: int, numbers: Sequence[float] = ()) -> None:
        payload = struct.pack(f">Bi{len(numbers)}d", self._recipes[recipe], command, *numbers)
        self._inputs.socket.send(frame(Kind.DATA_PACKAGE, payload), self._clock.now_s() + _CONNECT_S)

    def _command(self, recipe: str, command: int, numbers: Sequence[float] = (), *, blocks: bool = False) -> bool:
        try:
            if not self._plays() or not self._wait_for(_READY):
                self._send("command", 0)
                return False
            self._send(recipe, command, numbers)
            done = not blocks or self._wait_for(_DONE)
            if blocks:
                self._send("command", 0)
            return done
        except LinkError:
            self._connected = False
            return False

    def isConnected(self) -> bool:  # noqa: N802  # ur_rtde's name, like those below
        """Return False once the controller is lost."""
        self._poll()
        return self._connected

    def servoJ(  # noqa: N802
        self, q: Sequence[float], speed: float, acceleration: float, time: float, lookahead_time: float, gain: float
    ) -> bool:
        """Send a target, (6,) rad.

        Raises:
            ValueError: Lookahead time or gain are out of range.
        """
        for value, (least, most) in ((lookahead_time, _LOOKAHEAD_S), (gain, _GAIN)):
            if not least <= value <= most:
                raise ValueError(f"the value is not within [{least};{most}]")
        return self._command("servo", _SERVOJ, (*q, speed, acceleration, time, lookahead_time, gain))

    def servoStop(self, a: float = 10.0) -> bool:  # noqa: N802
        """End servoing with a deceleration, rad/s²."""
        return self._command("number", _SERVO_STOP, (a,), blocks=True)

    def setWatchdog(self, min_frequency: float) -> bool:  # noqa: N802
        """Arm the watchdog of the control script."""
        return self._command("number", _WATCHDOG, (min_frequency,), blocks=True)

    def kickWatchdog(self) -> bool:  # noqa: N802
        """Feed the watchdog."""
        return self._command("command", _KICK)

    def stopScript(self) -> None:  # noqa: N802
        """End the control script, and wait for that."""
        self._command("command", _STOP_SCRIPT)
        end = self._clock.now_s() + _PLAYS_S
        while self._plays() and self._connected and self._clock.now_s() < end:
            self._clock.wait((self._link.fileno(),), end)


@functools.cache
def control_script(family: str) -> str:
    """Return the control script that the installed `ur_rtde` uploads to an emulated controller.

    `ur_rtde` assembles it in its constructor, so one is made in a process of its own, for an emulated
    controller in real time.

    Raises:
        MissingExtraError: `ur_rtde` is not installed.
        VirtualCellError: It uploads none.
    """
    try:
        import rtde_control  # noqa: F401
    except ImportError:
        purpose = "its control script on a virtual clock"
        raise MissingExtraError("ur_rtde", "virtual", purpose, distribution="ur-emulator") from None
    emulator = Emulator(ControllerOptions(robot=MODEL_OF_FAMILY[family], plant="nominal"))
    server = emulator.servers[0]
    code = "import os, sys, rtde_control; rtde_control.RTDEControlInterface(sys.argv[1]); os._exit(0)"
    client = subprocess.Popen(
        [sys.executable, "-c", code, server.host], stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL
    )
    try:
        for _ in range(math.ceil(_CAPTURE_S / emulator.tick_s)):
            emulator.step()
            if server.controller.received.program:
                return server.controller.received.program
    finally:
        client.kill()
        client.wait()
        emulator.close()
    raise VirtualCellError(f"ur_rtde has uploaded no control script within {_CAPTURE_S:g} s: install ur_rtde 1.6.5")
