"""Emulated controllers, their sockets, and the simulation of their arms, on one thread in real time."""

from __future__ import annotations

import contextlib
import dataclasses
import ipaddress
import json
import logging
import os
import sys
import threading
from collections import deque
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from typing import TYPE_CHECKING, Any, Final, Self

import numpy as np

from ur_core.errors import AddressError, SettingsError, URError
from ur_core.kinematics.robots import robot_model
from ur_core.processes.system import LOCAL, System
from ur_core.protocol.modes import RobotMode, SafetyMode
from ur_emulator.addresses import checked_address, free_address
from ur_emulator.builtins.table import builtins_of
from ur_emulator.controller.controller import Controller
from ur_emulator.controller.program_files import script_texts
from ur_emulator.injection.fault_injection import FaultInjection
from ur_emulator.ports.arm_server import ArmServer, LinePeer
from ur_emulator.ports.grippers import EmulatedGripper
from ur_emulator.ports.sockets import Hub
from ur_emulator.profile import profile_for
from ur_emulator.world.plant import PlantOptions
from ur_emulator.world.world import SimulatedWorld

if TYPE_CHECKING:
    from ur_core.viewing.viewer import Viewer

log = logging.getLogger(__name__)

MAX_STALL_S: Final = 0.25
"""Longest stall of the machine that is caught up with. The time of longer stalls is lost."""

_FRAME_S: Final = 1 / 30
_SWITCH_S: Final = 0.0002  # longest wait of a control period for a thread that reads a program
_LATE: Final = 200  # kept numbers of control periods that began more than a period late
_LATENESS: Final = 20_000  # kept latenesses
_LATENESS_REPORTED: Final = 10_000
_LOOPBACK: Final = 127 << 24  # 127.0.0.0
BOOT_S: Final = (1000.0, 2345.676)
"""Initial clocks of the controllers: unrelated, as on real ones."""


GripperOf = Callable[[Callable[[], int]], EmulatedGripper | None]
"""Factory of an arm's gripper, of a function that returns the bits of its controller's digital outputs."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class EmulatorOptions(PlantOptions):
    """Options of all emulated controllers. Its seed is also that of random faults.

    Attributes:
        polyscope: PolyScope version of the controllers, a key of `POLYSCOPES`; None: the tested one of the family.
        powered: Whether the arms have power, and their brakes released, from the start.
        view: Whether MuJoCo's web viewer shows them.
        programs: Folder of the program files that the dashboard loads, or None.
        phase_s: Phase of the control periods relative to whole multiples of a control period on this machine's
            monotonic clock; None: any. With it, two emulators with one arm each behave like two controllers with
            unsynchronised clocks.
        drift_ppm: Relative deviation of the controllers' control period from its nominal length on this machine's
            clock, parts per million.
    """

    polyscope: str | None = None
    powered: bool = True
    view: bool = False
    programs: str | None = None
    phase_s: float | None = None
    drift_ppm: float = 0.0

    @classmethod
    def from_mapping(cls, values: Mapping[str, Any]) -> Self:
        """Build from plain values.

        Raises:
            SettingsError: A name is unknown.
        """
        known = {each.name for each in dataclasses.fields(cls)}
        unknown = sorted(values.keys() - known)
        if unknown:
            raise SettingsError(
                f"unknown options of emulated controllers: {', '.join(unknown)}; known: {sorted(known)}"
            )
        return cls(**values)


@dataclasses.dataclass(frozen=True, kw_only=True)
class ControllerOptions(EmulatorOptions):
    """Options of one controller, whose arm stands by itself.

    Attributes:
        robot: Model of the arm, a name in `ur_core.kinematics.robots.ROBOTS`.
        host: Loopback address; None finds a free one.
    """

    robot: str = "ur5e"
    host: str | None = None


class Emulator:
    """Controllers and their world. It listens from the start, and advances in `run`.

    Args:
        options: Options of one controller, or of all those of `world`.
        world: World of the arms; None: that of one arm by itself.
        hosts: Loopback address of each controller, None for a free one; empty: that of the options.
        grippers: Function for the gripper of each arm; empty: there are none.
        hub: Sockets that emulators share which take turns; None: its own.
        system: Clock and network.

    Raises:
        AddressError: An address cannot be used.
        URError: An option is invalid.
    """

    def __init__(
        self,
        options: EmulatorOptions,
        *,
        world: SimulatedWorld | None = None,
        hosts: Sequence[str | None] = (),
        grippers: Sequence[GripperOf] = (),
        hub: Hub | None = None,
        system: System = LOCAL,
    ) -> None:
        self._system, self._clock = system, system.clock
        self.options = options
        self.world: SimulatedWorld = _lone_arm(options) if world is None else world
        self.tick_s = self.world.tick_s
        self._period_s = self.tick_s * (1.0 + 1e-6 * options.drift_ppm)
        self.due_s = self._clock.now_s()
        self.ended = False
        self.ticks = 0
        self.lateness_s: deque[float] = deque(maxlen=_LATENESS)
        self.late_ticks: deque[int] = deque(maxlen=_LATE)
        self.lost_s = 0.0
        self._diverged = False
        self.servers: list[ArmServer] = []
        self._hub = Hub(options.seed, system=system) if hub is None else hub
        self._injection = FaultInjection(self, options.seed)
        self._viewer: Viewer | None = None
        self._rendered_s = 0.0
        try:
            addresses = _addresses(hosts or [getattr(options, "host", None)], system)
            programs = {} if options.programs is None else script_texts(options.programs)
            for arm, (name, mount) in enumerate(zip(self.world.names, self.world.mounts, strict=True)):
                profile = profile_for(mount.robot, options.polyscope)
                # No two of a cell, and no two by themselves at other addresses, have the same.
                number = arm if len(addresses) > 1 else int(ipaddress.IPv4Address(addresses[arm])) - _LOOPBACK
                serial_number = str(int(profile.serial_number) + number)
                controller = Controller(
                    name,
                    dataclasses.replace(profile, serial_number=serial_number),
                    self.world.start_q_rad[arm],
                    self.world.substeps,
                    dh=mount.dh,
                    builtins=builtins_of,
                    lookahead_scale=float(self.world.lookahead_scale[arm]),
                    gripper_kg=self.world.gripper_kg[arm],
                    powered=options.powered,
                    boot_s=BOOT_S[arm],
                    system=system,
                )
                gripper = grippers[arm](partial(getattr, controller.io, "outputs")) if grippers else None
                self.servers.append(ArmServer(self._hub, controller, addresses[arm], gripper, self._off, programs))
            self._port = self._hub.add("fault injection", (addresses[0], 0), lambda: LinePeer(self._injection.answer))
            if options.view:
                from ur_core.viewing.viewer import Viewer

                self._viewer = Viewer(web=True)
                self._viewer.show(*self.world.draw())
        except BaseException:
            self.close()
            raise

    @property
    def url(self) -> str | None:
        """Address of the web viewer on this machine, or None."""
        return None if self._viewer is None else self._viewer.url

    def description(self) -> dict[str, Any]:
        """Return tables of plain values for clients: each controller by its name, and `emulator`."""
        arms = {
            name: {
                "host": server.host,
                "family": server.controller.profile.family,
                "model": mount.robot,
                "base_position_m": list(mount.position_m),
                "base_yaw_rad": mount.yaw_rad,
                **_serial_number(server.controller),
            }
            for name, server, mount in zip(self.world.names, self.servers, self.world.mounts, strict=True)
        }
        return {"kind": "emulated", **arms, "emulator": {"port": self._port.number, "pid": self._system.pid}}

    def prepare(self) -> None:
        """Clear away, before the first control period, what earlier emulators have left. There is nothing."""

    def run(self) -> None:
        """Advance in real time until the cell ends."""
        run([self], self._system)

    def begin(self) -> None:
        """Let the first control period begin now, or at its phase."""
        self.due_s = self._clock.now_s()
        if self.options.phase_s is not None:
            self.due_s = (self.due_s // self.tick_s + 1) * self.tick_s + self.options.phase_s % self.tick_s

    def step(self) -> None:
        """Serve the clients until the next control period is due, and advance by it."""
        self._hub.poll(self.due_s)
        late = self._clock.now_s() - self.due_s
        self.lateness_s.append(late)
        if late > self.tick_s:
            self.late_ticks.append(self.ticks)
        if late > MAX_STALL_S:
            log.warning("the machine stalled for %.0f ms: the cell's time stalled, too", 1e3 * late)
            self.lost_s += late
            self.due_s += late
        self.tick()
        self.due_s += self._period_s

    def tick(self) -> None:
        """Advance all arms by one control period."""
        plans, widths = [], []
        for arm, server in enumerate(self.servers):
            server.before_tick()
            reading = self.world.read(arm)
            plans.append(server.controller.tick(reading))
            widths.append(_gripper_width(server, self.tick_s, reading.gripper_m))
            try:
                server.publish()
            except Exception:  # a bug, or a bad override, must not end the other arm
                log.exception("%s: nothing was sent to its clients in this control period", server.controller.name)
        controllers = [server.controller for server in self.servers]
        payloads, torques = [each.payload.mass_kg for each in controllers], [each.torques for each in controllers]
        self.world.advance(plans, widths, payloads, torques)
        if self.world.failed and not self._diverged:
            self._diverged = True
            log.error("the simulation diverged: the arms hold their last valid state; start the cell again")
            for server in self.servers:
                server.controller.stop(SafetyMode.FAULT, "the simulation diverged")
        self.ticks += 1
        self._injection.after_tick(self.ticks * self.tick_s)
        if self._viewer is not None and self.ticks * self.tick_s - self._rendered_s >= _FRAME_S:
            self._rendered_s = self.ticks * self.tick_s
            self._viewer.show(*self.world.draw())

    @property
    def time_s(self) -> float:
        """Time since the start, without time lost in stalls."""
        return self.ticks * self.tick_s

    def info(self) -> dict[str, Any]:
        """Return timing and condition of the cell."""
        lateness = np.array(list(self.lateness_s)[-_LATENESS_REPORTED:] or [0.0])
        return {
            "time_s": self.ticks * self.tick_s,
            "ticks": self.ticks,
            "tick_s": self.tick_s,
            "lateness_p50_s": float(np.quantile(lateness, 0.5)),
            "lateness_p99_s": float(np.quantile(lateness, 0.99)),
            "lateness_max_s": float(lateness.max()),
            "late_ticks": list(self.late_ticks),
            "lost_s": self.lost_s,
            "cpu_s": sum(os.times()[:2]),
            "physics_failed": self.world.failed,
            "plant": {name: np.asarray(value).tolist() for name, value in self.world.sampled.items()},
            "url": self.url,
        }

    def _off(self) -> None:
        """Shut one controller down. The cell goes on until all are off."""
        self.ended = all(each.controller.safety.robot_mode == RobotMode.DISCONNECTED for each in self.servers)

    def close(self) -> None:
        """End everything. May be called twice."""
        self.ended = True
        for server in self.servers:
            server.close()
        self._hub.close()
        if self._viewer is not None:
            self._viewer.close()
            self._viewer = None


def run(emulators: Sequence[Emulator], system: System = LOCAL) -> None:
    """Advance emulators that share their sockets in real time, until all have ended."""
    for each in emulators:
        each.prepare()
    system.dedicate()
    sys.setswitchinterval(_SWITCH_S)
    for each in emulators:
        each.begin()
    while running := [each for each in emulators if not each.ended]:
        min(running, key=_due).step()


def _due(emulator: Emulator) -> float:
    return emulator.due_s


def _lone_arm(options: EmulatorOptions) -> SimulatedWorld:
    from ur_emulator.world.lone_arm import LoneArm  # which loads MuJoCo

    robot = getattr(options, "robot", None)
    if not isinstance(robot, str):
        raise SettingsError(f"robot is {robot!r}: name the model of a controller by itself, such as 'ur5e'")
    robot_model(robot)
    return LoneArm(robot, options)


def _serial_number(controller: Controller) -> dict[str, str]:
    """Return the key of the cell file by which swapped addresses are found, where the dashboard reports it."""
    profile = controller.profile
    return {"serial_number": profile.serial_number} if profile.at_least((5, 6), (3, 12)) else {}


def _gripper_width(server: ArmServer, tick_s: float, width_m: float | None) -> float | None:
    """Return the width that the gripper commands, if there is one. It has the arm's power."""
    gripper = server.gripper
    if gripper is None or width_m is None:
        return None
    gripper.powered = server.controller.safety.robot_mode > RobotMode.POWER_OFF
    return gripper.tick(tick_s, width_m)


def _addresses(given: Sequence[str | None], system: System) -> list[str]:
    if len(given) > 1 and given[0] is not None and given[0] == given[-1]:
        raise AddressError(f"both arms have the address {given[0]}: each needs one of its own, as UR's ports are fixed")
    hosts = [None if host is None else checked_address(host, system) for host in given]
    found: list[str] = []
    for host in hosts:
        taken = [each for each in (*hosts, *found) if each is not None]
        found.append(free_address(taken, system) if host is None else host)
    return found


def serve_json(make: Callable[[Mapping[str, Any]], Emulator]) -> None:
    """Run the process of emulated controllers: options come as JSON, and it ends with its input.

    Args:
        make: Function that makes the controllers of their options.
    """
    logging.basicConfig(level=logging.INFO, format="%(asctime)s %(levelname)s %(name)s: %(message)s", stream=sys.stderr)
    try:
        emulator = make(json.loads(sys.argv[1]))
    except (URError, TypeError) as error:
        print(json.dumps({"error": type(error).__name__, "text": str(error)}), flush=True)  # noqa: T201  # the answer
        return
    print(json.dumps(emulator.description()), flush=True)  # noqa: T201  # the answer that `EmulatorProcess` waits for
    threading.Thread(target=_end_with_input, args=(emulator,), daemon=True).start()
    with contextlib.suppress(KeyboardInterrupt):
        emulator.run()
    emulator.close()


def _end_with_input(emulator: Emulator) -> None:
    """End the cell with the program that started it."""
    while not emulator.ended:
        ready, _ = LOCAL.clock.wait([sys.stdin.fileno()], LOCAL.clock.now_s() + 1.0)
        if ready and not os.read(sys.stdin.fileno(), 1024):
            emulator.ended = True


if __name__ == "__main__":
    serve_json(lambda values: Emulator(ControllerOptions.from_mapping(values)))
