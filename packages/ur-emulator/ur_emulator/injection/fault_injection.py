"""Fault injection of an emulated cell: faults, operator actions, the camera, and records of what it received.

One JSON object per line, `{"do": "stop", "arm": "left", "mode": 3}`, answered by one: `{"ok": true, "value": ...}` or
`{"ok": false, "error": "..."}`. `docs/reference/emulator.md` lists all requests.
"""

from __future__ import annotations

import dataclasses
import inspect
import itertools
import json
import math
import random
import reprlib
from collections import deque
from collections.abc import Callable, Sequence
from functools import cache
from typing import Annotated, Any, Final, Protocol, get_type_hints

import numpy as np
from annotated_types import Ge, Le
from pydantic import BaseModel, ConfigDict, Field, InstanceOf, ValidationError, create_model

from ur_core.errors import SettingsError, UnknownNameError, URError
from ur_core.kinematics.rotations import quat_from_rotvec, quat_multiply
from ur_emulator.ports.arm_server import ArmServer, RtdePeer
from ur_emulator.ports.link_faults import MAX_LATE_S, LinkFaults
from ur_emulator.world.world import SimulatedWorld

_MAX_DELAY_S: Final = 2.0
_MAX_DISTANCE_M: Final = 10.0
_MOST_N, _MOST_NM = 200.0, 20.0  # as much as a person pushes
_MAX_SETPOINTS: Final = 1000  # per answer, which must not delay a control period

_Delay = Annotated[float, Field(ge=0.0, le=_MAX_DELAY_S)]
_NoiseM = Annotated[float, Field(ge=0.0, le=1.0)]
_NoiseRad = Annotated[float, Field(ge=0.0, le=3.0)]
_Late = Annotated[float, Field(ge=0.0, le=MAX_LATE_S)]
_Mode = Annotated[int, Field(ge=0, le=255)]  # as far as the primary interface can encode it
_Since = Annotated[int, Field(le=2**53)]
_Version = Annotated[list[int], Field(min_length=4, max_length=4)]
_Text = InstanceOf[str]  # any text, also such as is no valid Unicode
_Wrench = Annotated[list[float], Field(min_length=6, max_length=6)]
_Push = Annotated[float, Field(ge=0.0, le=60.0)]
_PRESSES: Final = (
    "play",
    "resume",
    "pause",
    "stop",
    "power_on",
    "power_off",
    "release_brakes",
    "unlock_protective_stop",
)


class CellUnderTest(Protocol):
    """Emulated cell that requests act on."""

    ended: bool
    """Set to end the cell."""

    due_s: float
    """Time on the system's clock of the control period to which the present state of the world belongs."""

    @property
    def servers(self) -> Sequence[ArmServer]:
        """Its controllers."""
        ...

    @property
    def world(self) -> SimulatedWorld:
        """Simulation of the arms."""
        ...

    @property
    def time_s(self) -> float:
        """Time since the start."""
        ...

    def info(self) -> dict[str, Any]:
        """Return timing and condition of the cell."""
        ...


class FaultInjection:
    """Server of the fault-injection port: one method `do_<name>` per request.

    A request is validated strictly against the parameters of its method: an unknown key, a missing one, a value of
    another type and a number out of bounds are refused. The arm may be left out where there is one.

    Args:
        cell: The cell that requests act on.
        seed: Seed of the camera noise.
    """

    def __init__(self, cell: CellUnderTest, seed: int = 0) -> None:
        self._cell = cell
        self._random = random.Random(seed)
        self._seen: dict[str, deque[tuple[float, list[float], list[float]]]] = {}
        self._requests: dict[str, Callable[..., Any]] = {
            name.removeprefix("do_"): method for name, method in inspect.getmembers(self) if name.startswith("do_")
        }
        self._models = _models()

    def answer(self, line: str) -> str:
        """Answer one line. No input raises."""
        try:
            value = self._do(line)
        except (URError, ValueError, TypeError, OverflowError, RecursionError) as error:
            return json.dumps({"ok": False, "error": " ".join(str(error).split())})
        return json.dumps({"ok": True, "value": value})

    def _do(self, line: str) -> Any:
        request = json.loads(line)
        if not isinstance(request, dict) or not isinstance(request.get("do"), str):
            raise SettingsError('a request is a JSON object with "do", such as {"do": "info"}')
        name = request.pop("do")
        if name not in self._requests:
            raise UnknownNameError("request", name, tuple(self._requests))
        if len(self._cell.world.names) == 1 and "arm" in self._models[name].model_fields:
            request.setdefault("arm", self._cell.world.names[0])
        try:
            values = self._models[name].model_validate(request)
        except ValidationError as error:
            raise _refusal(name, self._models[name], error) from error
        given = values.model_fields_set
        return self._requests[name](**{key: value for key, value in values if key in given})

    def _index(self, arm: str) -> int:
        names = self._cell.world.names
        if arm not in names:
            raise UnknownNameError("arm", arm, names)
        return names.index(arm)

    def _arm(self, arm: str) -> ArmServer:
        return self._cell.servers[self._index(arm)]

    def after_tick(self, time_s: float) -> None:
        """Record the poses that may be requested with a delay."""
        for body, seen in self._seen.items():
            position, quat = self._cell.world.pose(body)
            seen.append((time_s, position.tolist(), quat.tolist()))
            while seen[0][0] < time_s - _MAX_DELAY_S:
                seen.popleft()

    # Queries.

    def do_info(self) -> dict[str, Any]:
        """Return time, lateness of the control periods, and processor time."""
        return self._cell.info()

    def do_state(self, arm: str, names: list[str] | None = None) -> dict[str, Any]:
        """Return the values that the controller reports to its clients, by RTDE name."""
        values = self._arm(arm).controller.values
        for name in names or ():
            if name not in values:
                raise UnknownNameError("variable", name, tuple(values))
        return {name: values[name] for name in (values if names is None else names)}

    def do_pose(
        self, body: str, noise_m: _NoiseM = 0.0, noise_rad: _NoiseRad = 0.0, delay_s: _Delay = 0.0
    ) -> dict[str, Any]:
        """Return position and orientation (w, x, y, z) of a body in the cell frame, as a camera measures them.

        A prop is a body by its name, too; the answer has the present positions of its joints.
        """
        position, quat = (each.tolist() for each in self._cell.world.pose(body))
        if delay_s:
            now = self._cell.time_s
            seen = self._seen.setdefault(body, deque())
            old = [each for each in seen if each[0] <= now - delay_s]
            if seen:
                _, position, quat = old[-1] if old else seen[0]
        if noise_m:
            position = [each + self._random.gauss(0.0, noise_m) for each in position]
        if noise_rad:
            rotation = quat_from_rotvec([self._random.gauss(0.0, noise_rad) for _ in range(3)])
            quat = quat_multiply(rotation, quat).tolist()
        joints = self._cell.world.joints(body)
        return {"position_m": position, "quat": quat, **({"joints": joints} if joints else {})}

    def do_positions(self) -> dict[str, Any]:
        """Return positions of MuJoCo's model, poses of placed bodies, and their time on this machine's clock."""
        qpos, mocap = self._cell.world.positions()
        return {"qpos": qpos.tolist(), "mocap": mocap.tolist(), "at_s": self._cell.due_s}

    def do_setpoints(self, arm: str, since: _Since = 0) -> dict[str, Any]:
        """Return executed servoj targets from number `since`, at most 1000: tick, target, t, lookahead, gain."""
        controller = self._arm(arm).controller
        return _page("setpoints", controller.setpoints, controller.setpoints_count, since)

    def do_received(self, arm: str, since: _Since = 0) -> dict[str, Any]:
        """Return counts and packages of received motion commands; see `Received`.

        Packages are those from number `since`, at most 1000: tick, command, six numbers.
        """
        received = self._arm(arm).controller.received
        return {
            **received.counts(),
            "tick": self._arm(arm).controller.ticks,
            **_page("packages", received.motion, received.motion_count, since),
        }

    def do_clients(self, arm: str) -> dict[str, list[dict[str, Any]]]:
        """Return the connections of every port, with the counters of their RTDE sessions."""
        found = {}
        for name, port in self._arm(arm).ports.items():
            found[name] = [
                {"dropped": each.dropped, **(_counts(each.peer) if isinstance(each.peer, RtdePeer) else {})}
                for each in port.connections
            ]
        return found

    # Operator, wiring and objects.

    def do_stop(self, arm: str, mode: _Mode, reason: _Text = "") -> None:
        """Raise a stop condition: any number of RTDE's `safety_mode` except 1 and 2."""
        controller = self._arm(arm).controller
        controller.stop(mode, reason)
        controller.received.stop_tick = controller.ticks + 1

    def do_release(self, arm: str, mode: int) -> None:
        """Clear a stop condition: a button is released, a gate closed."""
        self._arm(arm).controller.safety.release(mode)

    def do_reduce(self, arm: str, on: bool = True) -> None:
        """Switch reduced mode."""
        self._arm(arm).controller.safety.reduce(on)

    def do_press(self, arm: str, button: str) -> None:
        """Perform an operator action at the teach pendant."""
        if button not in _PRESSES:
            raise UnknownNameError("button", button, _PRESSES)
        getattr(self._arm(arm).pendant, button)()

    def do_slider(self, arm: str, fraction: float) -> None:
        """Move the speed slider."""
        self._arm(arm).controller.io.set_slider(fraction)

    def do_remote(self, arm: str, on: bool | None) -> None:
        """Switch remote control (e-Series); null: the controller's settings offer none, as those of URSim do."""
        self._arm(arm).controller.remote_control = on

    def do_input(self, arm: str, bit: int, on: bool) -> None:
        """Set a digital input: 0 to 7 standard, 8 to 15 configurable, 16 and 17 of the tool."""
        self._arm(arm).controller.io.set_input(bit, on)

    def do_program(self, arm: str, name: _Text, text: _Text) -> None:
        """Store a program on the controller, for the dashboard's `load`."""
        self._arm(arm).pendant.keep(name, text)

    def do_place(self, position_m: list[float], quat: list[float], prop: _Text = "") -> None:
        """Place an object of the task, at rest: the one of this name, or the only one."""
        pose = [*position_m, *quat]
        if len(pose) != 7 or abs(math.hypot(*pose[3:]) - 1.0) > 1e-3:
            raise SettingsError("an object needs three coordinates and a unit quaternion (w, x, y, z)")
        if max(map(abs, pose[:3])) > _MAX_DISTANCE_M:
            raise SettingsError(f"an object cannot be put at {pose[:3]}: allowed are ±{_MAX_DISTANCE_M:g} m")
        self._cell.world.place(np.array(pose, dtype=np.float64), prop)

    def do_set_joints(self, values: dict[str, float]) -> None:
        """Put joints of the task's objects at positions, at rest."""
        if any(abs(value) > _MAX_DISTANCE_M for value in values.values()):
            raise SettingsError(f"joints cannot be put at {values}: allowed are ±{_MAX_DISTANCE_M:g} rad or m")
        self._cell.world.set_joints(values)

    def do_push(self, arm: str, wrench: _Wrench, seconds: _Push) -> None:
        """Push an arm's flange by hand: force and torque along the axes of its `base`. In freedrive it yields."""
        for values, most, unit in ((wrench[:3], _MOST_N, "N"), (wrench[3:], _MOST_NM, "N·m")):
            if max(map(abs, values)) > most:
                raise SettingsError(f"a hand cannot push with {values} {unit}: allowed are ±{most:g} {unit}")
        self._cell.world.push(self._index(arm), np.array(wrench), seconds)

    # Faults.

    def do_link(self, arm: str, port: str, **faults: Any) -> None:
        """Inject link faults into a port; see `LinkFaults`. Faults that are not named stay as they are."""
        for which in self._ports(arm, port):
            which.inject(**faults)
            for connection in list(which.connections):
                connection.flush()

    def do_heal(self, arm: str, port: str = "all") -> None:
        """Remove all faults of a port."""
        self.do_link(arm, port, **dataclasses.asdict(LinkFaults()))
        for which in self._ports(arm, port):
            which.listen()

    def do_drop(self, arm: str, port: str, reset: bool = False, writers: bool = False) -> None:
        """Close the connections of a port, or only those that write inputs; optionally with a TCP reset."""
        for which in self._ports(arm, port):
            which.disconnect(
                "a fault was injected",
                reset=reset,
                whose=lambda peer: not writers or (isinstance(peer, RtdePeer) and peer.session.writes),
            )

    def do_refuse(self, arm: str, port: str) -> None:
        """Refuse new clients of a port."""
        for which in self._ports(arm, port):
            which.refuse()

    def do_override(self, arm: str, **values: Any) -> None:
        """Report these values to clients instead of the true ones; null ends it."""
        server = self._arm(arm)
        controller = server.controller
        for name, value in values.items():
            if name not in controller.values:
                raise UnknownNameError("variable", name, tuple(controller.values))
            now = controller.values[name]
            if value is not None and np.shape(value) != np.shape(now):
                raise SettingsError(f"{name} is {now!r}: {value!r} has another shape")
        reported = {name: tuple(each) if isinstance(each, list) else each for name, each in values.items()}
        server.check({name: value for name, value in reported.items() if value is not None})
        for name, value in reported.items():
            controller.override(name, value)

    def do_watchdog(self, arm: str, on: bool) -> None:
        """Enable or disable the watchdogs of programs."""
        self._arm(arm).controller.watchdog_acts = on

    def do_script_delay(self, arm: str, seconds: _Late) -> None:
        """Delay the start of programs."""
        self._arm(arm).script_delay_s = seconds

    def do_pretend(
        self,
        arm: str,
        version: _Version | None = None,
        model: _Text | None = None,
        serial_number: _Text | None = None,
        robot_type: int | None = None,
        safety_checksum: int | None = None,
    ) -> None:
        """Report another version, model, serial number or safety checksum to new clients."""
        given: dict[str, Any] = {
            "model": model,
            "serial_number": serial_number,
            "robot_type": robot_type,
            "safety_checksum": safety_checksum,
        }
        values = {name: value for name, value in given.items() if value is not None}
        if version is not None:
            for each, most in zip(version, (255, 255, 2**31 - 1, 2**31 - 1), strict=True):
                if not 0 <= each <= most:
                    raise SettingsError(
                        f"a version's numbers are 0 to 255, twice, and 0 to 2147483647, found {version!r}"
                    )
            values["version"] = tuple(version)
        server = self._arm(arm)
        server.pretend(dataclasses.replace(server.shown, **values), server.kinematics)

    def do_calibration(self, arm: str, error_m: float) -> None:
        """Report a calibration by which the flange is off by this much in every configuration: the upper arm is."""
        server = self._arm(arm)
        dh = server.controller.dh
        shoulder, upper_arm, *others = dh.a_m
        a_m = (shoulder, upper_arm + error_m, *others)
        server.pretend(server.shown, dataclasses.replace(dh, a_m=a_m))

    def do_shutdown(self) -> None:
        """End the emulated cell."""
        self._cell.ended = True

    def _ports(self, arm: str, port: str) -> list[Any]:
        ports = self._arm(arm).ports
        if port == "all":
            return list(ports.values())
        if port not in ports:
            raise UnknownNameError("port", port, (*ports, "all"))
        return [ports[port]]


def _page(name: str, kept: deque[Any], count: int, since: int) -> dict[str, Any]:
    """Return the kept items from number `since` on, with the number of the first and the count of all."""
    first = count - len(kept)
    begin = max(0, since - first)
    chosen = [list(each) for each in itertools.islice(kept, begin, begin + _MAX_SETPOINTS)]
    return {"first": first + begin, "count": count, name: chosen}


@cache
def _models() -> dict[str, type[BaseModel]]:
    """Return the strict models of all requests by name."""
    methods = inspect.getmembers(FaultInjection, inspect.isfunction)
    return {name[3:]: _model(name[3:], method) for name, method in methods if name.startswith("do_")}


def _model(name: str, method: Callable[..., Any]) -> type[BaseModel]:
    """Return the strict model of a request, made of the parameters of its method."""
    fields: dict[str, Any] = {}
    extra: Any = "forbid"
    for each in inspect.signature(method, eval_str=True).parameters.values():
        if each.name == "self":
            continue
        if each.kind is not inspect.Parameter.VAR_KEYWORD:
            fields[each.name] = (each.annotation, ... if each.default is each.empty else each.default)
        elif name == "link":
            fields |= {fault: (kind, None) for fault, kind in get_type_hints(LinkFaults, include_extras=True).items()}
        else:
            extra = "allow"
    return create_model(name, __config__=ConfigDict(strict=True, extra=extra, allow_inf_nan=False), **fields)


def _refusal(name: str, model: type[BaseModel], error: ValidationError) -> URError:
    """Return the error that names what was found and what is allowed."""
    texts = []
    for each in error.errors(include_url=False, include_context=False):
        key = str(each["loc"][0]) if each["loc"] else name
        bounds = {type(bound): bound for bound in model.model_fields[key].metadata} if key in model.model_fields else {}
        if each["type"] == "extra_forbidden":
            return UnknownNameError(f"argument of {name}", key, tuple(model.model_fields))
        if each["type"] == "missing":
            texts.append(f"{key} is missing")
        elif {Ge, Le} <= bounds.keys():
            texts.append(f"{key} is {reprlib.repr(each['input'])}: allowed are {bounds[Ge].ge:g} to {bounds[Le].le:g}")
        else:
            texts.append(f"{key} is {reprlib.repr(each['input'])}: {each['msg'].replace('Input should', 'it must')}")
    return SettingsError(f"request {name!r}: {'; '.join(texts)}")


def _counts(peer: RtdePeer) -> dict[str, int]:
    session = peer.session
    names = ("data_packages", "short_packages", "long_packages", "unknown_packages", "published")
    return {name: getattr(session, name) for name in names}
