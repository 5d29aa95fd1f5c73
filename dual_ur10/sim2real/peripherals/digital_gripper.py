"""Gripper that a digital output of the arm's controller opens and closes, through RTDE.

Commands go over an RTDE connection of their own. Its only inputs are the mask and value of one group of outputs, so
that the registers of `ur_rtde`'s control script stay free. A second connection only reads the outputs.
"""

from __future__ import annotations

from contextlib import ExitStack
from typing import Final

from dual_ur10.sim2real.cell_file.tables import DigitalGripper
from dual_ur10.sim2real.peripherals.gripper_link import GripperLink, GripperReading
from ur_core.links.link_socket import check_timeout
from ur_core.links.rtde_link import PORT, RtdeClient, RtdeLink
from ur_core.processes.system import LOCAL, System
from ur_core.protocol.rtde import Kind, frame
from ur_core.tools.tool import tool_named

OUTPUTS: Final = "actual_digital_output_bits"

STALE_S: Final = 0.5
"""Longest time for which the controller's time may stall."""

CHANGE_S: Final = 0.5
"""Time within which a command must show in the outputs."""

_RATE_HZ: Final = 25.0
_IN_USE: Final = "IN_USE"
_OPEN_ABOVE, _CLOSED_BELOW = 0.55, 0.45  # of the stroke; hysteresis: noise does not make it chatter
_GROUPS: Final = (("standard", 0, 8), ("configurable", 8, 16), ("tool", 16, 18))  # UR's RTDE guide: bits of `OUTPUTS`


class DigitalGripperLink(GripperLink):
    """Client that opens above 55 % of the tool's stroke, closes below 45 %, and keeps its state in between.

    Its readings are the state of the output: nothing measures these fingers.

    Args:
        host: IPv4 address of the controller.
        gripper: Output of the gripper, and the level that opens it.
        timeout_s: Time limit of the connections.
        port: RTDE port.
        name: Name of the arm, for messages.
        system: Clock and network.

    Raises:
        SettingsError: An argument is not legal.
        LinkError: There is no controller, or its outputs are in use by another program.
    """

    def __init__(
        self,
        host: str,
        gripper: DigitalGripper,
        timeout_s: float = 2.0,
        port: int = PORT,
        *,
        name: str = "",
        system: System = LOCAL,
    ) -> None:
        self._clock, self.tool = system.clock, tool_named(gripper.tool)
        group, first = next((group, first) for group, first, end in _GROUPS if gripper.output < end)
        self._bit = gripper.output - first
        self._mask, self._gripper = 1 << gripper.output, gripper
        self._commanded: bool | None = None
        self._due_s = 0.0
        deadline_s = self._clock.now_s() + check_timeout(timeout_s)
        with ExitStack() as stack:
            self._reader = stack.enter_context(
                RtdeLink(host, [OUTPUTS], _RATE_HZ, port, timeout_s, name=name, system=system)
            )
            self._sender = RtdeClient(name, host, port, deadline_s, system=system)
            stack.callback(self._sender.socket.close)
            names = (f"{group}_digital_output_mask", f"{group}_digital_output")
            self._recipe = self._take_outputs(group, names, deadline_s)
            while not self._reader.poll() and self._reader.latest is None:
                if self._clock.now_s() >= deadline_s:
                    raise self._sender.socket.error("no state of its outputs in time", "check the controller")
                self._clock.sleep(0.005)
            self._connections = stack.pop_all()

    def _take_outputs(self, group: str, names: tuple[str, str], deadline_s: float) -> int:
        recipe, kinds = self._sender.set_up(Kind.SETUP_INPUTS, names, b"", deadline_s)
        if _IN_USE in kinds:
            raise self._sender.socket.error(
                f"{group} digital outputs are in use", "end other programs and fieldbuses that set outputs there"
            )
        if not recipe or kinds != ["UINT8", "UINT8"]:
            raise self._sender.socket.error(
                f"{group} digital outputs of types {', '.join(kinds)}", "update the controller's software"
            )
        return recipe

    @property
    def where(self) -> str:
        """Arm, gripper and address, for messages."""
        return f"{self._sender.socket.where}, gripper at output {self._gripper.output}"

    def read(self) -> GripperReading:
        """See `GripperLink`. The opening is that of the output; it is lost if the controller's time stalls."""
        self._check()
        is_open = self._is_open()
        fault = ""
        if self._commanded is not None and is_open != self._commanded and self._clock.now_s() > self._due_s:
            wanted = "open" if self._commanded else "close"
            fault = (
                f"output {self._gripper.output} does not {wanted} the gripper, as commanded {CHANGE_S:g} s ago: check "
                "what else sets it, and that no action is assigned to it on the pendant"
            )
        return GripperReading(self.tool.stroke_m if is_open else 0.0, fault, None)

    def _is_open(self) -> bool:
        sample = self._reader.latest
        bits = 0 if sample is None else sample.values[OUTPUTS]
        return bool(int(bits) & self._mask) == self._gripper.open_level  # type: ignore[arg-type]  # a number, by its type

    def _check(self) -> None:
        self._reader.poll()
        age_s = self._reader.age_s(self._clock.now_s())
        if age_s > STALE_S:
            raise self._sender.socket.error(
                f"its time stalls for {age_s:.1f} s", "check the controller and the network"
            )
        data = self._sender.socket.receive_now()  # text messages are ignored; the end is not
        if data == b"":
            raise self._sender.socket.ended()

    def command(self, opening_m: float) -> bool:
        """See `GripperLink`. The output is set if its state differs from the last command."""
        ratio = opening_m / self.tool.stroke_m
        if _CLOSED_BELOW <= ratio <= _OPEN_ABOVE:
            return False
        wanted = ratio > _OPEN_ABOVE
        if wanted == self._commanded:
            return False
        level = wanted == self._gripper.open_level
        payload = bytes((self._recipe, 1 << self._bit, level << self._bit))
        self._sender.socket.send(frame(Kind.DATA_PACKAGE, payload), self._clock.now_s() + CHANGE_S)
        self._commanded, self._due_s = wanted, self._clock.now_s() + CHANGE_S
        return True

    def forget(self) -> None:
        """See `GripperLink`."""
        self._commanded = None

    def needs_activation(self) -> bool:
        """Return False."""
        return False

    def activate(self, within_s: float) -> None:
        """Do nothing."""

    def close(self) -> None:
        """End both connections; the output keeps its state. May be called twice."""
        self._connections.close()
