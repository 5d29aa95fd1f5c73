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
import tomllib
from collections import deque
from collections.abc import Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from dual_ur10.assets.settings import default_mount
from dual_ur10.errors import AddressError, DualUR10Error, SettingsError
from dual_ur10.ids import env_id_of
from dual_ur10.sim2real.config.cell import CellConfig
from dual_ur10.sim2real.config.cell_file_tables import Gripper, NoGripper
from dual_ur10.sim2real.config.cell_file_text import toml_text
from dual_ur10.sim2real.runtime.latch import clear_ended
from ur_core.files import check_target, write_text
from ur_core.kinematics.robots import robot_model
from ur_core.kinematics.ur10 import ARMS
from ur_core.processes.system import LOCAL, System
from ur_core.protocol.modes import RobotMode, SafetyMode
from ur_core.servoj import ServojProfile
from ur_emulator.addresses import checked_address, free_address
from ur_emulator.arm_server import ArmServer, LinePeer
from ur_emulator.builtins import builtins_of
from ur_emulator.controller import Controller
from ur_emulator.fault_injection import FaultInjection
from ur_emulator.grippers import entry_of, gripper_of
from ur_emulator.profile import profile_for, profile_of, profile_of_version
from ur_emulator.program_files import script_texts
from ur_emulator.sockets import Hub
from ur_emulator.world import PlantOptions, SimulatedWorld

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


@dataclasses.dataclass(frozen=True, kw_only=True)
class EmulatorOptions:
    """Options of an emulated cell, or of one controller.

    Attributes:
        alone: True for one controller instead of two: its arm stands by itself. `left` is its address, and `right`,
            `task`, `family`, `tools` and `cell` cannot be set.
        left, right: Loopback addresses; None finds free ones.
        family: Family of both controllers; None: that of `robot`.
        robot: Model of both arms, or of the left and the right one; None: a UR10, or a UR10e of the e-Series.
        polyscope: PolyScope version of both controllers, a key of `POLYSCOPES`; None: the tested one of the family.
        task: Id or name of the environment whose scene is simulated; None: two arms on a table, of any model.
        tools: Tool of both arms, or of the left and the right one, by name or as "module:NAME", driven by the first
            of its `drivers`; None: those of the task.
        plant: Deviation of the plant from its nominal model; see `PlantOptions`.
        seed: Seed of the sampled plant, the start of a task's episode, and random faults.
        dh_error_m: Largest error of the arms' kinematics, m.
        powered: Whether the arms have power, and their brakes released, from the start.
        view: Whether MuJoCo's web viewer shows the cell.
        cell: Path of the cell file to write, or None.
        programs: Folder of the program files that the dashboard loads, or None.
        phase_s: Phase of the control periods relative to whole multiples of a control period on this machine's
            monotonic clock; None: any. With it, two cells with one arm each behave like two controllers with
            unsynchronised clocks.
        drift_ppm: Relative deviation of the controllers' control period from its nominal length on this machine's
            clock, parts per million.
    """

    alone: bool = False
    left: str | None = None
    right: str | None = None
    family: str | None = None
    robot: str | Sequence[str] | None = None
    polyscope: str | None = None
    task: str | None = None
    tools: str | Sequence[str] | None = None
    plant: str = "mild"
    seed: int = 0
    dh_error_m: float = 0.0
    powered: bool = True
    view: bool = False
    cell: str | None = None
    programs: str | None = None
    phase_s: float | None = None
    drift_ppm: float = 0.0

    @classmethod
    def from_mapping(cls, values: Mapping[str, Any]) -> EmulatorOptions:
        """Build from plain values.

        Raises:
            SettingsError: A name is unknown.
        """
        known = {each.name for each in dataclasses.fields(cls)}
        unknown = sorted(values.keys() - known)
        if unknown:
            raise SettingsError(f"unknown options of the emulated cell: {', '.join(unknown)}; known: {sorted(known)}")
        return cls(**values)


class Emulator:
    """Controllers and their world. It listens from the start, and advances in `run`.

    Args:
        options: Options of the cell, or of one controller.
        config: Cell of both arms; None: that of the arms that the options name.
        grippers: Entries of a cell file for the grippers of both arms; None: those of the cell's tools.
        hub: Sockets that emulators share which take turns; None: its own.
        system: Clock and network.

    Raises:
        AddressError: An address cannot be used.
        DualUR10Error: An option is invalid.
    """

    def __init__(
        self,
        options: EmulatorOptions,
        *,
        config: CellConfig | None = None,
        grippers: Sequence[Gripper] | None = None,
        hub: Hub | None = None,
        system: System = LOCAL,
    ) -> None:
        self._system, self._clock = system, system.clock
        self.options = options
        self.world: SimulatedWorld = _world_of(options, config)
        self._grippers = _grippers_of(options, self.world, grippers)
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
            hosts = _addresses(options, system)
            programs = {} if options.programs is None else script_texts(options.programs)
            for arm, (name, mount) in enumerate(zip(self.world.names, self.world.mounts, strict=True)):
                profile = profile_for(mount.robot, options.polyscope)
                # No two of a cell, and no two by themselves at other addresses, have the same.
                number = int(ipaddress.IPv4Address(hosts[arm])) - _LOOPBACK if options.alone else arm
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
                gripper = gripper_of(self._grippers[arm], partial(getattr, controller.io, "outputs"))
                self.servers.append(ArmServer(self._hub, controller, hosts[arm], gripper, self._off, programs))
            self._port = self._hub.add("fault injection", (hosts[0], 0), lambda: LinePeer(self._injection.answer))
            if options.view:
                from ur_core.viewing.viewer import Viewer

                self._viewer = Viewer(web=True)
                self._viewer.show(*self.world.draw())
            if options.cell is not None:
                write_cell_file(options.cell, self.description())
        except BaseException:
            self.close()
            raise

    @property
    def url(self) -> str | None:
        """Address of the web viewer on this machine, or None."""
        return None if self._viewer is None else self._viewer.url

    def description(self) -> dict[str, Any]:
        """Return the content of the cell file."""
        arms = {
            name: {
                "host": server.host,
                "family": server.controller.profile.family,
                "model": mount.robot,
                "base_position_m": list(mount.position_m),
                "base_yaw_rad": mount.yaw_rad,
                **_serial_number(server.controller),
                **({"gripper": entry.mapping()} if server.gripper is not None else {}),
            }
            for name, server, mount, entry in zip(
                self.world.names, self.servers, self.world.mounts, self._grippers, strict=True
            )
        }
        task = {} if self.options.task is None else {"task": env_id_of(self.options.task)}
        return {
            "kind": "emulated",
            **arms,
            "emulator": {**task, "port": self._port.number, "pid": self._system.pid},
        }

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
    with contextlib.suppress(SettingsError):  # without a state folder there is nothing to clear away
        clear_ended(system)
    system.dedicate()
    sys.setswitchinterval(_SWITCH_S)
    for each in emulators:
        each.begin()
    while running := [each for each in emulators if not each.ended]:
        min(running, key=_due).step()


def _due(emulator: Emulator) -> float:
    return emulator.due_s


def _world_of(options: EmulatorOptions, config: CellConfig | None) -> SimulatedWorld:
    """Return the world of the arms that options name."""
    plant = PlantOptions(plant=options.plant, seed=options.seed, dh_error_m=options.dh_error_m)
    if not options.alone:
        from ur_emulator.cell_world import CellWorld  # which loads environments

        return CellWorld(cell_of(options) if config is None else config, options.task, plant)
    from ur_emulator.lone_arm import LoneArm

    for name in ("right", "task", "family", "tools", "cell"):
        if getattr(options, name) is not None:
            raise SettingsError(f"a controller by itself has no {name!r}: leave it out, or emulate a cell")
    if not isinstance(options.robot, str):
        raise SettingsError(f"robot is {options.robot!r}: name the model of a controller by itself, such as 'ur5e'")
    return LoneArm(options.robot, plant)


def cell_of(options: EmulatorOptions) -> CellConfig:
    """Return the cell of the arms that options name.

    Raises:
        UnknownNameError: There is no such model or tool.
        SettingsError: Or one of its kinds: there is no such family or version, or they do not fit.
    """
    family, robots = options.family, _both("robot", options.robot, "ur5e")
    tools: Any = _both("tools", options.tools, "robotiq_2f85")
    if robots is None:
        if family is None and options.polyscope is not None:
            family = profile_of_version(options.polyscope).family
        return CellConfig(servoj=ServojProfile(profile_of(family or "cb3").family), tools=tools)
    for each in robots:
        robot_model(each)
    left, right = (default_mount(arm, robot) for arm, robot in enumerate(robots))
    if family is None:
        return CellConfig(left=left, right=right, tools=tools)
    return CellConfig(left=left, right=right, servoj=ServojProfile(profile_of(family).family), tools=tools)


def _both(name: str, value: str | Sequence[str] | None, example: str) -> Sequence[str] | None:
    """Return an option for both arms; None: it is not given.

    Raises:
        SettingsError: There are not two.
    """
    both = [value] * len(ARMS) if isinstance(value, str) else value
    if both is not None and (not isinstance(both, tuple | list) or len(both) != len(ARMS)):
        raise SettingsError(f"{name} is {value!r}: name one, or one for each arm, such as {example!r}")
    return both


def _grippers_of(
    options: EmulatorOptions, world: SimulatedWorld, entries: Sequence[Gripper] | None
) -> Sequence[Gripper]:
    """Return the entry of a cell file for the gripper of each arm.

    Raises:
        SettingsError: Options name tools, and the scene has no grippers; or nothing drives a tool.
    """
    named = _both("tools", options.tools, "")
    if named is not None and None in world.tools:
        raise SettingsError(
            f"tools is {options.tools!r}, and this scene has no grippers: name a task that has, such as Handover"
        )
    names = [None if tool is None else tool.name for tool in world.tools] if named is None else named
    return [
        NoGripper() if tool is None or name is None else entries[arm] if entries else entry_of(name, tool)
        for arm, (name, tool) in enumerate(zip(names, world.tools, strict=True))
    ]


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


def _addresses(options: EmulatorOptions, system: System) -> list[str]:
    given = [options.left] if options.alone else [options.left, options.right]
    if given[0] is not None and given[0] == given[-1] and len(given) > 1:
        raise AddressError(f"both arms have the address {given[0]}: each needs one of its own, as UR's ports are fixed")
    hosts = [None if host is None else checked_address(host, system) for host in given]
    found: list[str] = []
    for host in hosts:
        taken = [each for each in (*hosts, *found) if each is not None]
        found.append(free_address(taken, system) if host is None else host)
    return found


def write_cell_file(path: str | Path, description: Mapping[str, Any]) -> None:
    """Write a description as TOML.

    Args:
        path: Target file. Only a file of an emulated cell is replaced.
        description: Tables by name, with plain values, or plain values.

    Raises:
        SettingsError: Another file exists there.
        DualUR10Error: The file cannot be written.
    """
    path = check_target(path)
    if path.exists():
        try:
            kind = tomllib.loads(path.read_text()).get("kind")
        except (OSError, ValueError, RecursionError):
            kind = None
        if kind != "emulated":
            raise SettingsError(
                f"{path} exists and is no file of an emulated cell: it was not changed. Name another with --cell"
            )
    write_text(path, toml_text(description))


def main() -> None:
    """Run the process that `EmulatedCell` starts: options come as JSON, and it ends with its input."""
    logging.basicConfig(level=logging.INFO, format="%(asctime)s %(levelname)s %(name)s: %(message)s", stream=sys.stderr)
    try:
        emulator = Emulator(EmulatorOptions.from_mapping(json.loads(sys.argv[1])))
    except (DualUR10Error, TypeError) as error:
        print(json.dumps({"error": type(error).__name__, "text": str(error)}), flush=True)  # noqa: T201  # the answer
        return
    print(json.dumps(emulator.description()), flush=True)  # noqa: T201  # the answer that EmulatedCell waits for
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
    main()
