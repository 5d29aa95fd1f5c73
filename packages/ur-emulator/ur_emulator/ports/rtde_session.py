"""Server side of RTDE, UR's real-time data exchange (port 30004): bytes in, bytes out, no sockets.

Choices where UR's guide is silent:

* An output setup replaces the previous one. If it names an unknown variable, or none at all, the connection has no
  output recipe afterwards, and data stop.
* A refused setup has the number 0, and claims no variable.
* Packages of an unknown kind, and text messages of clients, are counted and not answered.
"""

from __future__ import annotations

import logging
import math
import struct
from collections.abc import Callable, Collection, Mapping, Sequence
from typing import Any, Final
from weakref import WeakValueDictionary

from ur_core.errors import ClosedError, ProtocolError, SettingsError
from ur_core.protocol.rtde import (
    DataType,
    FrameReader,
    Kind,
    TextKind,
    Value,
    frame,
    split_names,
    text_payload,
)
from ur_emulator.controller.registers import Registers
from ur_emulator.controller.rtde_variables import input_types, output_types, zero_values
from ur_emulator.ports.rtde_recipes import OUTPUT_RECIPE, InputRecipe, OutputRecipe
from ur_emulator.profile import ControllerProfile

log = logging.getLogger(__name__)

VERSIONS: Final = (1, 2)
"""Versions of the protocol. A connection starts with the first."""

MAX_INPUT_RECIPES: Final = 255
"""Limit of the recipe number, which is one byte; 0 means none."""

MAX_VARIABLES: Final = 1024
"""Most variables of a recipe. A controller has fewer than 600, and packages of 1024 vectors still fit into a frame."""

MAX_INPUTS: Final = 4 * MAX_VARIABLES
"""Most variables of all input recipes of a connection, each of which takes about 200 bytes."""

_LONGEST_DIVIDER: Final = 10**9

Answer = Callable[["RtdeSession", bytes], bytes]


class RtdePort:
    """State shared by the RTDE connections of one controller.

    Args:
        profile: Profile of the controller, whose version defines the variables.
        registers: Registers. Clients write the input registers at once, so the last one within a control period wins.
        values: All variables that are no registers, by name. They are read whenever a package is published.
        inputs: Callback for the variables of a package that are no registers, by name.
        written: Callback after every package, with the names of its recipe's variables.

    Raises:
        SettingsError: `values` lacks a variable.
    """

    def __init__(
        self,
        profile: ControllerProfile,
        registers: Registers,
        values: Mapping[str, Value],
        inputs: Callable[[Mapping[str, Any]], None],
        written: Callable[[Collection[str]], None] = lambda names: None,
    ) -> None:
        missing = zero_values(profile).keys() - values.keys()
        if missing:
            raise SettingsError(f"values lack {', '.join(sorted(missing))}: start from zero_values(profile)")
        self.profile, self.registers, self.values, self.inputs = profile, registers, values, inputs
        self.written = written
        self.output_types = output_types(profile)
        self.input_types = input_types(profile)
        self.rate_hz = 1.0 / profile.tick_s
        self.owners: dict[str, RtdeSession] = {}
        self._recipes: WeakValueDictionary[Any, OutputRecipe] = WeakValueDictionary()

    def output_recipe(self, variables: tuple[tuple[str, DataType], ...], *, numbered: bool) -> OutputRecipe:
        """Return the recipe of these variables: one for all connections that use it now."""
        recipe = self._recipes.get((variables, numbered))
        if recipe is None:
            recipe = OutputRecipe(variables, self.values, self.registers, numbered=numbered)
            self._recipes[variables, numbered] = recipe
        return recipe

    def open(self) -> RtdeSession:
        """Open a connection."""
        return RtdeSession(self)


class RtdeSession:
    """One client's connection.

    Send the result of `receive` before any later result of `publish`: nothing may reach a client before the answer to
    its START.

    Args:
        port: State shared with the controller's other connections.

    Attributes:
        started: Whether data are published.
        version: Version of the protocol.
        divider: Control periods per published package.
        data_packages: Received data packages.
        short_packages, long_packages: Of these, packages shorter or longer than their recipe.
        unknown_packages: Received packages of a kind that RTDE does not have.
        text_messages: Received text messages.
        published: Published packages.
    """

    def __init__(self, port: RtdePort) -> None:
        self._port = port
        self._frames = FrameReader()
        self._closed = False
        self._outputs: OutputRecipe | None = None
        self._inputs: list[InputRecipe] = []
        self._due: int | None = None
        self.started = False
        self.version = VERSIONS[0]
        self.divider = 1
        self.data_packages = self.short_packages = self.long_packages = 0
        self.unknown_packages = self.text_messages = self.published = 0

    def receive(self, data: bytes) -> bytes:
        """Process received bytes, in pieces of any size.

        Returns:
            The answers to send.

        Raises:
            ProtocolError: The bytes violate RTDE. The session is closed; close the connection, too.
            ClosedError: The session was closed.
        """
        if self._closed:
            raise ClosedError("this RTDE session was closed: open another")
        answers = []
        try:
            for kind, payload in self._frames.feed(data):
                if kind == Kind.DATA_PACKAGE:
                    self._take_data(payload)
                elif kind in _ANSWERS:
                    answers.append(_ANSWERS[kind](self, payload))
                elif kind == Kind.TEXT_MESSAGE:
                    self.text_messages += 1
                    log.info("RTDE client sent the text %r", payload[:255])
                else:
                    self.unknown_packages += 1
        except ProtocolError:
            self.close()
            raise
        return b"".join(answers)

    def publish(self, tick: int, packages: dict[OutputRecipe, bytes] | None = None) -> bytes:
        """Return the data package of a control period, or nothing if none is due.

        Args:
            tick: Number of the control period. The first one after START is always due.
            packages: Packages of this control period that connections have encoded so far; this one's is added.
        """
        if not self.started or self._outputs is None:
            return b""
        due = self._due
        if due is None or tick > due or due - tick > self.divider:  # ticks were skipped, or restarted
            due = tick
        if tick < due:
            return b""
        self._due = due + self.divider
        self.published += 1
        if self._outputs.numbered != (self.version > 1):  # not when it is requested: a recipe takes milliseconds
            self._outputs = self._output_recipe(self._outputs.variables)
        if packages is None:
            return self._outputs.package()
        package = packages.get(self._outputs)
        if package is None:
            package = packages[self._outputs] = self._outputs.package()
        return package

    def text(self, message: str, source: str = "", kind: TextKind = TextKind.INFO) -> bytes:
        """Encode a text message; nothing unless data are published, since other clients expect answers only.

        Args:
            message: Text, of which 255 bytes are sent.
            source: Sender.
            kind: Severity.
        """
        if not self.started:
            return b""
        return frame(Kind.TEXT_MESSAGE, text_payload(message, source, kind, self.version))

    @property
    def writes(self) -> bool:
        """True if it has set up inputs."""
        return bool(self._inputs)

    def close(self) -> None:
        """End the session and release its inputs. May be called twice."""
        self._closed, self.started = True, False
        owners = self._port.owners
        for name in [name for name, owner in owners.items() if owner is self]:
            del owners[name]

    def _take_data(self, payload: bytes) -> None:
        number = payload[0] if payload else 0
        if not 1 <= number <= len(self._inputs):
            raise ProtocolError(
                f"RTDE data package for input recipe {number if payload else '(none)'}: this connection set up "
                f"{len(self._inputs)} of them, numbered from 1"
            )
        recipe = self._inputs[number - 1]
        values = payload[1:]
        self.data_packages += 1
        if len(values) != recipe.size:
            if len(values) < recipe.size:
                self.short_packages += 1
            else:
                self.long_packages += 1
        others = recipe.apply(values)
        if others:
            self._port.inputs(others)
        self._port.written(recipe.names)

    def _request_version(self, payload: bytes) -> bytes:
        (wanted,) = _unpack(">H", payload, "a protocol version")
        if wanted in VERSIONS:
            self.version = wanted
        return frame(Kind.REQUEST_PROTOCOL_VERSION, bytes([wanted in VERSIONS]))

    def _report_version(self, payload: bytes) -> bytes:
        return frame(Kind.GET_URCONTROL_VERSION, struct.pack(">4I", *self._port.profile.version))

    def _set_up_outputs(self, payload: bytes) -> bytes:
        frequency_hz = self._port.rate_hz
        if self.version > 1:
            (frequency_hz,) = _unpack(">d", payload, "a frequency")
            payload = payload[8:]
        names = _names(payload)
        types = [self._port.output_types.get(name) for name in names]
        variables = [(name, kind) for name, kind in zip(names, types, strict=True) if kind is not None]
        valid = bool(names) and len(variables) == len(names)
        self._outputs = self._output_recipe(variables) if valid else None
        self.started = self.started and valid
        self.divider, self._due = _divider(self._port.rate_hz, frequency_hz), None
        answer = ",".join("NOT_FOUND" if kind is None else kind.name for kind in types).encode("ascii")
        number = bytes([OUTPUT_RECIPE if valid else 0]) if self.version > 1 else b""
        return frame(Kind.SETUP_OUTPUTS, number + answer)

    def _output_recipe(self, variables: Sequence[tuple[str, DataType]]) -> OutputRecipe:
        return self._port.output_recipe(tuple(variables), numbered=self.version > 1)

    def _set_up_inputs(self, payload: bytes) -> bytes:
        port, names = self._port, _names(payload)
        variables = []
        answers = []
        for name in names:
            kind = port.input_types.get(name)
            if kind is None:
                answers.append("NOT_FOUND")
            elif port.owners.get(name, self) is not self:
                answers.append("IN_USE")
            else:
                answers.append(kind.name)
                variables.append((name, kind))
        number = 0
        if names and len(variables) == len(names):
            if len(self._inputs) == MAX_INPUT_RECIPES:
                raise ProtocolError(f"more than {MAX_INPUT_RECIPES} RTDE input recipes on one connection")
            if sum(each.count for each in self._inputs) + len(names) > MAX_INPUTS:
                raise ProtocolError(f"more than {MAX_INPUTS} variables in the RTDE input recipes of one connection")
            self._inputs.append(InputRecipe(variables, port.registers))
            number = len(self._inputs)
            port.owners.update(dict.fromkeys(names, self))
        return frame(Kind.SETUP_INPUTS, bytes([number]) + ",".join(answers).encode("ascii"))

    def _start(self, payload: bytes) -> bytes:
        self.started, self._due = self._outputs is not None, None
        return frame(Kind.START, bytes([self.started]))

    def _pause(self, payload: bytes) -> bytes:
        self.started = False
        return frame(Kind.PAUSE, b"\x01")


_ANSWERS: Final[dict[int, Answer]] = {
    Kind.REQUEST_PROTOCOL_VERSION: RtdeSession._request_version,
    Kind.GET_URCONTROL_VERSION: RtdeSession._report_version,
    Kind.SETUP_OUTPUTS: RtdeSession._set_up_outputs,
    Kind.SETUP_INPUTS: RtdeSession._set_up_inputs,
    Kind.START: RtdeSession._start,
    Kind.PAUSE: RtdeSession._pause,
}


def _unpack(layout: str, payload: bytes, what: str) -> tuple[Any, ...]:
    if len(payload) < struct.calcsize(layout):
        raise ProtocolError(f"RTDE request with {len(payload)} bytes: it must begin with {what}")
    return struct.unpack_from(layout, payload)


def _names(payload: bytes) -> list[str]:
    names = split_names(payload)
    if len(names) > MAX_VARIABLES:
        raise ProtocolError(f"RTDE recipe with {len(names)} variables: at most {MAX_VARIABLES} are allowed")
    return names


def _divider(rate_hz: float, frequency_hz: float) -> int:
    """Return the control periods per package. An invalid frequency means the highest."""
    if math.isnan(frequency_hz) or frequency_hz <= 0.0:
        return 1
    return max(1, round(min(rate_hz / frequency_hz, _LONGEST_DIVIDER)))
