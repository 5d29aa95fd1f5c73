"""What can be done to an emulated cell from outside: faults, the camera, and a look at what it received.

One JSON object a line, `{"do": "stop", "arm": "left", "mode": 3}`, answered by one: `{"ok": true, "value": ...}` or
`{"ok": false, "error": "..."}`. `docs/emulated_cell.md` lists all requests.
"""

from __future__ import annotations

import dataclasses
import inspect
import itertools
import json
import math
import random
from collections import deque
from collections.abc import Callable, Mapping, Sequence
from typing import Any, Final, Protocol

import numpy as np

from dual_ur10.errors import DualUR10Error, SettingsError, UnknownNameError
from dual_ur10.kinematics.rotations import quat_from_rotvec, quat_multiply
from dual_ur10.kinematics.ur10 import ARMS, DHParameters
from dual_ur10.sim2real.emulator.arm_server import ArmServer, RtdePeer
from dual_ur10.sim2real.emulator.mujoco_world import EmulatedWorld
from dual_ur10.sim2real.emulator.sockets import LinkFaults

_MOST_DELAY_S: Final = 2.0
_MOST_LATE_S: Final = 60.0  # of packets and programs: they are kept meanwhile
_MOST_MODE: Final = 255  # of the safety mode: what the primary interface can tell
_FARTHEST_M: Final = 10.0
_MOST_SETPOINTS: Final = 1000  # in one answer, which is not to keep a control period waiting
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
    """Whether the cell is to end."""

    @property
    def servers(self) -> Sequence[ArmServer]:
        """The controllers of the left and the right arm."""
        ...

    @property
    def world(self) -> EmulatedWorld:
        """What is around them."""
        ...

    @property
    def time_s(self) -> float:
        """Time since the start."""
        ...

    def info(self) -> dict[str, Any]:
        """How the cell does."""
        ...


class FaultInjection:
    """Answers requests.

    Args:
        cell: What they are about.
        seed: Of the camera's noise.
    """

    def __init__(self, cell: CellUnderTest, seed: int = 0) -> None:
        self._cell = cell
        self._random = random.Random(seed)
        self._seen: dict[str, deque[tuple[float, list[float], list[float]]]] = {}
        self._requests: dict[str, Callable[..., Any]] = {
            name.removeprefix("do_"): method for name, method in inspect.getmembers(self) if name.startswith("do_")
        }

    def answer(self, line: str) -> str:
        """The answer to one line. Nothing that is sent raises."""
        try:
            value = self._do(line)
        except (DualUR10Error, ValueError, TypeError, OverflowError, RecursionError) as error:
            return json.dumps({"ok": False, "error": " ".join(str(error).split())})
        return json.dumps({"ok": True, "value": value})

    def _do(self, line: str) -> Any:
        request = json.loads(line)
        if not isinstance(request, dict) or not isinstance(request.get("do"), str):
            raise SettingsError('a request is a JSON object with "do", such as {"do": "info"}')
        name = request.pop("do")
        if name not in self._requests:
            raise UnknownNameError("request", name, tuple(self._requests))
        return self._requests[name](**request)

    def _arm(self, arm: str) -> ArmServer:
        if arm not in ARMS:
            raise UnknownNameError("arm", str(arm), ARMS)
        return self._cell.servers[ARMS.index(arm)]

    def after_tick(self, time_s: float) -> None:
        """Remember what may be asked for late."""
        for body, seen in self._seen.items():
            position, quat = self._cell.world.pose(body)
            seen.append((time_s, position.tolist(), quat.tolist()))
            while seen[0][0] < time_s - _MOST_DELAY_S:
                seen.popleft()

    # A look at the cell.

    def do_info(self) -> dict[str, Any]:
        """How the cell does: time, lateness of its control periods, processor time."""
        return self._cell.info()

    def do_state(self, arm: str, names: Sequence[str] | None = None) -> dict[str, Any]:
        """What the controller tells its clients, by RTDE's names."""
        values = self._arm(arm).controller.values
        for name in names or ():
            if name not in values:
                raise UnknownNameError("variable", str(name), tuple(values))
        return {name: values[name] for name in (values if names is None else names)}

    def do_pose(
        self, body: str, noise_m: float = 0.0, noise_rad: float = 0.0, delay_s: float = 0.0
    ) -> dict[str, list[float]]:
        """Position and orientation (w, x, y, z) of a body in the cell frame, as a camera sees it."""
        for name, value, most in (
            ("noise_m", noise_m, 1.0),
            ("noise_rad", noise_rad, 3.0),
            ("delay_s", delay_s, _MOST_DELAY_S),
        ):
            if not 0.0 <= value <= most:
                raise SettingsError(f"{name} is {value!r}: allowed are 0 to {most:g}")
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
            turn = quat_from_rotvec([self._random.gauss(0.0, noise_rad) for _ in range(3)])
            quat = quat_multiply(turn, quat).tolist()
        return {"position_m": position, "quat": quat}

    def do_setpoints(self, arm: str, since: int = 0) -> dict[str, Any]:
        """Executed servoj targets from number `since`, at most 1000: tick, target, t, lookahead, gain."""
        controller = self._arm(arm).controller
        return _page("setpoints", controller.setpoints, controller.setpoints_count, since)

    def do_received(self, arm: str, since: int = 0) -> dict[str, Any]:
        """What the controller was sent that moves its arm: see `Received`.

        Of the packages with motion commands, those from number `since`, at most 1000: tick, command, six numbers.
        """
        received = self._arm(arm).controller.received
        return {
            **received.counts(),
            "tick": self._arm(arm).controller.ticks,
            **_page("packages", received.motion, received.motion_count, since),
        }

    def do_clients(self, arm: str) -> dict[str, list[dict[str, Any]]]:
        """Connections of every port, and what their RTDE sessions counted."""
        found = {}
        for name, port in self._arm(arm).ports.items():
            found[name] = [
                {"dropped": each.dropped, **(_counts(each.peer) if isinstance(each.peer, RtdePeer) else {})}
                for each in port.connections
            ]
        return found

    # What people, wires and things do.

    def do_stop(self, arm: str, mode: int, reason: str = "") -> None:
        """A condition comes to hold: any number of RTDE's `safety_mode` but 1 and 2."""
        if not 0 <= mode <= _MOST_MODE:
            raise SettingsError(f"a safety mode is {mode!r}: allowed are 0 to {_MOST_MODE}")
        controller = self._arm(arm).controller
        controller.safety.stop(int(mode), str(reason))
        controller.received.stop_tick = controller.ticks + 1

    def do_release(self, arm: str, mode: int) -> None:
        """It ends: a button is turned, a gate closed."""
        self._arm(arm).controller.safety.release(int(mode))

    def do_reduce(self, arm: str, on: bool = True) -> None:
        """Reduced mode."""
        self._arm(arm).controller.safety.reduce(bool(on))

    def do_press(self, arm: str, button: str) -> None:
        """An operator does something at the teach pendant."""
        if button not in _PRESSES:
            raise UnknownNameError("button", str(button), _PRESSES)
        getattr(self._arm(arm).pendant, button)()

    def do_slider(self, arm: str, fraction: float) -> None:
        """The speed slider is moved."""
        self._arm(arm).controller.io.set_slider(float(fraction))

    def do_remote(self, arm: str, on: bool) -> None:
        """Remote control is switched on or off (e-Series)."""
        self._arm(arm).controller.remote_control = bool(on)

    def do_input(self, arm: str, bit: int, on: bool) -> None:
        """A digital input: 0 to 7 standard, 8 to 15 configurable, 16 and 17 the tool's."""
        self._arm(arm).controller.io.set_input(int(bit), bool(on))

    def do_program(self, arm: str, name: str, text: str) -> None:
        """Put a program on the controller, for the dashboard's `load`."""
        self._arm(arm).pendant.keep(str(name), str(text))

    def do_place(self, position_m: Sequence[float], quat: Sequence[float]) -> None:
        """Put the object that the task handles somewhere, at rest."""
        pose = [float(each) for each in (*position_m, *quat)]
        if len(pose) != 7 or not all(map(math.isfinite, pose)) or abs(math.hypot(*pose[3:]) - 1.0) > 1e-3:
            raise SettingsError("an object is put at three coordinates with a unit quaternion (w, x, y, z)")
        if max(map(abs, pose[:3])) > _FARTHEST_M:
            raise SettingsError(f"an object cannot be put at {pose[:3]}: allowed are ±{_FARTHEST_M:g} m")
        self._cell.world.place(np.array(pose))

    # Faults.

    def do_link(self, arm: str, port: str, **faults: Any) -> None:
        """What goes wrong with a port's connections: see `LinkFaults`. What is not named stays."""
        for which in self._ports(arm, port):
            _apply(which.faults, faults)
            for connection in list(which.connections):
                connection.flush()

    def do_heal(self, arm: str, port: str = "all") -> None:
        """Nothing goes wrong with a port any more."""
        self.do_link(arm, port, **dataclasses.asdict(LinkFaults()))
        for which in self._ports(arm, port):
            which.listen()

    def do_drop(self, arm: str, port: str, reset: bool = False, writers: bool = False) -> None:
        """All connections of a port end, or those alone that write inputs, with a reset if asked for."""
        for which in self._ports(arm, port):
            which.disconnect(
                "a fault was asked for",
                reset=bool(reset),
                whose=lambda peer: not writers or (isinstance(peer, RtdePeer) and peer.session.writes),
            )

    def do_refuse(self, arm: str, port: str) -> None:
        """A port takes no new clients."""
        for which in self._ports(arm, port):
            which.refuse()

    def do_override(self, arm: str, **values: Any) -> None:
        """Clients are told these values, whatever is true; null ends it."""
        server = self._arm(arm)
        controller = server.controller
        for name, value in values.items():
            if name not in controller.values:
                raise UnknownNameError("variable", name, tuple(controller.values))
            now = controller.values[name]
            if value is not None and np.shape(value) != np.shape(now):
                raise SettingsError(f"{name} is {now!r}: {value!r} does not have its shape")
        told = {name: tuple(each) if isinstance(each, list) else each for name, each in values.items()}
        server.check({name: value for name, value in told.items() if value is not None})
        for name, value in told.items():
            controller.override(name, value)

    def do_watchdog(self, arm: str, on: bool) -> None:
        """Whether watchdogs of programs end or pause them, as they do on a controller."""
        self._arm(arm).controller.watchdog_acts = bool(on)

    def do_script_delay(self, arm: str, seconds: float) -> None:
        """Programs start late."""
        if not 0.0 <= seconds <= _MOST_LATE_S:
            raise SettingsError(f"script_delay is {seconds!r}: allowed are 0 to {_MOST_LATE_S:g} s")
        self._arm(arm).script_delay_s = float(seconds)

    def do_pretend(
        self,
        arm: str,
        version: Sequence[int] | None = None,
        model: str | None = None,
        serial_number: str | None = None,
        robot_type: int | None = None,
        safety_checksum: int | None = None,
    ) -> None:
        """New clients are told of another version, model or serial number, or of other safety settings."""
        given: dict[str, Any] = {
            "model": model,
            "serial_number": serial_number,
            "robot_type": robot_type,
            "safety_checksum": safety_checksum,
        }
        values = {name: value for name, value in given.items() if value is not None}
        for name, value in values.items():
            kind = str if name in ("model", "serial_number") else int
            if not isinstance(value, kind):
                raise SettingsError(f"{name} is {value!r}: it must be {'a number' if kind is int else 'text'}")
        if version is not None:
            if len(version) != 4:
                raise SettingsError(f"a version has four numbers, found {version!r}")
            numbers = tuple(int(each) for each in version)
            for each, most in zip(numbers, (255, 255, 2**31 - 1, 2**31 - 1), strict=True):
                if not 0 <= each <= most:
                    raise SettingsError(
                        f"a version's numbers are 0 to 255, twice, and 0 to 2147483647, found {version!r}"
                    )
            values["version"] = numbers
        server = self._arm(arm)
        server.pretend(dataclasses.replace(server.shown, **values), server.kinematics)

    def do_calibration(self, arm: str, error_m: float) -> None:
        """Clients are told of a calibration that is off by this much."""
        server = self._arm(arm)
        dh = server.controller.dh
        off = DHParameters(tuple(each + error_m * bool(each) for each in dh.a_m), dh.d_m, dh.alpha_rad, dh.theta_rad)
        server.pretend(server.shown, off)

    def do_shutdown(self) -> None:
        """The emulated cell ends."""
        self._cell.ended = True

    def _ports(self, arm: str, port: str) -> list[Any]:
        ports = self._arm(arm).ports
        if port == "all":
            return list(ports.values())
        if port not in ports:
            raise UnknownNameError("port", str(port), (*ports, "all"))
        return [ports[port]]


def _page(name: str, kept: deque[Any], count: int, since: int) -> dict[str, Any]:
    """Some of what is kept of all that was counted, from number `since` on."""
    first = count - len(kept)
    begin = max(0, int(since) - first)
    chosen = [list(each) for each in itertools.islice(kept, begin, begin + _MOST_SETPOINTS)]
    return {"first": first + begin, "count": count, name: chosen}


def _apply(faults: LinkFaults, values: Mapping[str, Any]) -> None:
    known = {each.name: each.type for each in dataclasses.fields(LinkFaults)}
    checked = {}
    for name, value in values.items():
        if name not in known:
            raise UnknownNameError("fault", name, tuple(known))
        kind = type(getattr(faults, name))
        checked[name] = kind(value)
        if checked[name] < 0 or not math.isfinite(checked[name]):
            raise SettingsError(f"fault {name} is {value!r}: it must not be negative")
        if name in ("delay_s", "jitter_s") and checked[name] > _MOST_LATE_S:
            raise SettingsError(f"fault {name} is {value!r}: allowed are 0 to {_MOST_LATE_S:g} s")
    for name, value in checked.items():
        setattr(faults, name, value)


def _counts(peer: RtdePeer) -> dict[str, int]:
    session = peer.session
    names = ("data_packages", "short_packages", "long_packages", "unknown_packages", "published")
    return {name: getattr(session, name) for name in names}
