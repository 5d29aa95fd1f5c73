"""An emulated cell: two controllers, their sockets, and one simulation of both arms, on one thread in real time."""

from __future__ import annotations

import contextlib
import dataclasses
import gc
import json
import logging
import os
import select
import sys
import threading
import time
import tomllib
from collections import deque
from collections.abc import Mapping
from pathlib import Path
from typing import Any, Final

import numpy as np

from dual_ur10.envs.rendering.viewer import Viewer
from dual_ur10.errors import AddressError, DualUR10Error, SettingsError
from dual_ur10.files import write_text
from dual_ur10.ids import env_id_of, task_name
from dual_ur10.kinematics.ur10 import ARMS
from dual_ur10.sim2real.config.cell import CellConfig
from dual_ur10.sim2real.config.cell_file_text import toml_text
from dual_ur10.sim2real.control.servoj import ServojProfile
from dual_ur10.sim2real.emulator.addresses import checked_address, free_address
from dual_ur10.sim2real.emulator.arm_server import ArmServer, LinePeer
from dual_ur10.sim2real.emulator.builtins import builtins_of
from dual_ur10.sim2real.emulator.controller import Controller
from dual_ur10.sim2real.emulator.fault_injection import FaultInjection
from dual_ur10.sim2real.emulator.mujoco_world import EmulatedWorld, PlantOptions
from dual_ur10.sim2real.emulator.profile import profile_of
from dual_ur10.sim2real.emulator.robotiq import RobotiqGripper
from dual_ur10.sim2real.emulator.sockets import Hub
from dual_ur10.sim2real.processes.child_process import hasten
from dual_ur10.sim2real.protocol.modes import RobotMode, SafetyMode

log = logging.getLogger(__name__)

MOST_BEHIND_S: Final = 0.25
"""If the machine stood still for longer, the time is lost instead of made up for."""

_FRAME_S: Final = 1 / 30
_SWITCH_S: Final = 0.0002  # for how long the thread that reads programs may keep a control period waiting
_LATE: Final = 200  # control periods that began more than a period late, whose numbers are kept
_LATENESS: Final = 20_000  # control periods whose lateness is kept
_LATENESS_LOOKED_AT: Final = 10_000
BOOT_S: Final = (1000.0, 2345.676)
"""What the controllers' clocks say at first: they agree with nothing, as on real ones."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class EmulatorOptions:
    """What is emulated.

    Attributes:
        left, right: Loopback addresses; None: free ones are found.
        family: Of both controllers.
        task: Id or name of the environment whose scene is simulated.
        plant: How the simulated plant differs from what is believed; see `PlantOptions`.
        seed: Of what is drawn of the plant, where the episode begins, and of faults left to chance.
        dh_error_m: Largest error of the arms' kinematics, m.
        powered: Whether the arms have power, and their brakes released, from the start.
        view: Whether MuJoCo's web viewer shows the cell.
        cell: Where to write the cell file; None: nowhere.
        phase_s: How long after whole multiples of a control period, by this machine's monotonic clock, control periods
            begin; None: whenever the cell begins to run. Two cells with an arm each are so two controllers that do not
            keep step.
    """

    left: str | None = None
    right: str | None = None
    family: str = "cb3"
    task: str = "SineTracking"
    plant: str = "mild"
    seed: int = 0
    dh_error_m: float = 0.0
    powered: bool = True
    view: bool = False
    cell: str | None = None
    phase_s: float | None = None

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
    """Two controllers and their world. It listens from the start, and moves on in `run`.

    Args:
        options: What is emulated.

    Raises:
        AddressError: An address cannot be used.
        DualUR10Error: An option is not legal.
    """

    def __init__(self, options: EmulatorOptions) -> None:
        profile = profile_of(options.family)
        self.options = options
        config = CellConfig(servoj=ServojProfile(family=profile.family))
        plant = PlantOptions(plant=options.plant, seed=options.seed, dh_error_m=options.dh_error_m)
        self.world = EmulatedWorld(config, task_name(env_id_of(options.task)), plant)
        self.tick_s = profile.tick_s
        self.ended = False
        self.ticks = 0
        self.lateness_s: deque[float] = deque(maxlen=_LATENESS)
        self.late_ticks: deque[int] = deque(maxlen=_LATE)
        self.lost_s = 0.0
        self._told = False
        self.servers: list[ArmServer] = []
        self._hub = Hub(options.seed)
        self._injection = FaultInjection(self, options.seed)
        self._viewer: Viewer | None = None
        self._drawn_s = 0.0
        mounts = (self.world.config.left, self.world.config.right)
        try:
            hosts = _addresses(options)
            for arm, name in enumerate(ARMS):
                serial_number = str(int(profile.serial_number) + arm)
                controller = Controller(
                    name,
                    dataclasses.replace(profile, serial_number=serial_number),
                    self.world.start_q_rad[arm],
                    self.world.substeps,
                    dh=mounts[arm].dh,
                    builtins=builtins_of,
                    lookahead_scale=float(self.world.lookahead_scale[arm]),
                    gripper_kg=self.world.gripper_kg,
                    powered=options.powered,
                    boot_s=BOOT_S[arm],
                )
                gripper = RobotiqGripper() if self.world.gripper_kg else None
                self.servers.append(ArmServer(self._hub, controller, hosts[arm], gripper, self._off))
            self._port = self._hub.add("fault injection", (hosts[0], 0), lambda: LinePeer(self._injection.answer))
            if options.view:
                self._viewer = Viewer(web=True)
                self._viewer.show(*self.world.draw())
            if options.cell is not None:
                write_cell_file(options.cell, self.description())
        except BaseException:
            self.close()
            raise

    @property
    def url(self) -> str | None:
        """Where a browser on this machine sees the cell."""
        return None if self._viewer is None else self._viewer.url

    def description(self) -> dict[str, Any]:
        """What a client needs to know, as the cell file says it."""
        config = self.world.config
        arms = {
            name: {
                "host": server.host,
                "family": self.options.family,
                "base_position_m": list(mount.position_m),
                "base_yaw_rad": mount.yaw_rad,
                **({"gripper": {"kind": "robotiq"}} if server.gripper is not None else {}),
            }
            for name, server, mount in zip(ARMS, self.servers, (config.left, config.right), strict=True)
        }
        return {
            "kind": "emulated",
            **arms,
            "emulator": {"task": env_id_of(self.options.task), "port": self._port.number, "pid": os.getpid()},
        }

    def run(self) -> None:
        """Move on in real time until the cell ends."""
        # What stands now stays: the collector need not look at it again in the middle of a control period.
        gc.collect()
        gc.freeze()
        hasten()
        sys.setswitchinterval(_SWITCH_S)
        due = time.monotonic()
        if self.options.phase_s is not None:
            due = (due // self.tick_s + 1) * self.tick_s + self.options.phase_s % self.tick_s
        while not self.ended:
            self._hub.poll(due)
            late = time.monotonic() - due
            self.lateness_s.append(late)
            if late > self.tick_s:
                self.late_ticks.append(self.ticks)
            if late > MOST_BEHIND_S:
                log.warning("the machine stood still for %.0f ms: the cell's time stood still, too", 1e3 * late)
                self.lost_s += late
                due += late
            self.tick()
            due += self.tick_s

    def tick(self) -> None:
        """One control period of both arms."""
        plans, openings = [], []
        for arm, server in enumerate(self.servers):
            server.before_tick()
            reading = self.world.read(arm)
            plans.append(server.controller.tick(reading))
            openings.append(_opening(server, self.tick_s, reading.gripper_m))
            try:
                server.publish()
            except Exception:  # a mistake of ours, or of who overrides values, must not end the other arm
                log.exception("%s: its clients are told nothing in this control period", server.controller.name)
        self.world.advance(plans, openings, [server.controller.payload.mass_kg for server in self.servers])
        if self.world.failed and not self._told:
            self._told = True
            log.error("the simulation diverged: the arms stand where they were last well; start the cell again")
            for server in self.servers:
                server.controller.safety.stop(SafetyMode.FAULT, "the simulation diverged")
        self.ticks += 1
        self._injection.after_tick(self.ticks * self.tick_s)
        if self._viewer is not None and self.ticks * self.tick_s - self._drawn_s >= _FRAME_S:
            self._drawn_s = self.ticks * self.tick_s
            self._viewer.show(*self.world.draw())

    @property
    def time_s(self) -> float:
        """Time since the start, as far as it was not lost."""
        return self.ticks * self.tick_s

    def info(self) -> dict[str, Any]:
        """How the cell does."""
        lateness = np.array(list(self.lateness_s)[-_LATENESS_LOOKED_AT:] or [0.0])
        return {
            "time_s": self.ticks * self.tick_s,
            "ticks": self.ticks,
            "tick_s": self.tick_s,
            "lateness_p50_s": float(np.quantile(lateness, 0.5)),
            "lateness_p99_s": float(np.quantile(lateness, 0.99)),
            "lateness_max_s": float(lateness.max()),
            "late_ticks": list(self.late_ticks),
            "lost_s": self.lost_s,
            "cpu_s": time.process_time(),
            "physics_failed": self.world.failed,
            "plant": {name: np.asarray(value).tolist() for name, value in self.world.drawn.items()},
            "url": self.url,
        }

    def _off(self) -> None:
        """A controller was shut down: the cell goes on until both are."""
        self.ended = all(each.controller.safety.robot_mode == RobotMode.DISCONNECTED for each in self.servers)

    def close(self) -> None:
        """End everything. May be called twice."""
        self.ended = True
        self._hub.close()
        if self._viewer is not None:
            self._viewer.close()
            self._viewer = None


def _opening(server: ArmServer, tick_s: float, opening_m: float | None) -> float | None:
    """What the gripper's server wants the opening to be. It has the arm's power."""
    gripper = server.gripper
    if gripper is None or opening_m is None:
        return None
    gripper.powered = server.controller.safety.robot_mode > RobotMode.POWER_OFF
    return gripper.tick(tick_s, opening_m)


def _addresses(options: EmulatorOptions) -> tuple[str, str]:
    given = [options.left, options.right]
    if given[0] is not None and given[0] == given[1]:
        raise AddressError(f"both arms have the address {given[0]}: each needs one of its own, as UR's ports are fixed")
    hosts = [None if host is None else checked_address(host) for host in given]
    for arm in range(2):
        if hosts[arm] is None:
            hosts[arm] = free_address([each for each in hosts if each is not None])
    return str(hosts[0]), str(hosts[1])


def write_cell_file(path: str | Path, description: Mapping[str, Any]) -> None:
    """Write a description as TOML.

    Args:
        path: Where to. A file of an emulated cell is replaced; any other is left alone.
        description: Tables by name, with plain values, or plain values.

    Raises:
        SettingsError: There is another file.
        DualUR10Error: The place cannot be written to.
    """
    path = Path(path)
    if path.exists():
        try:
            kind = tomllib.loads(path.read_text()).get("kind")
        except (OSError, ValueError, RecursionError):
            kind = None
        if kind != "emulated":
            raise SettingsError(
                f"{path} exists and is no file of an emulated cell: it was left as it is. Name another with --cell"
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
    print(json.dumps(emulator.description()), flush=True)  # noqa: T201  # the answer that the starter waits for
    threading.Thread(target=_end_with_input, args=(emulator,), daemon=True).start()
    with contextlib.suppress(KeyboardInterrupt):
        emulator.run()
    emulator.close()


def _end_with_input(emulator: Emulator) -> None:
    """The cell never outlives the program that started it."""
    while not emulator.ended:
        ready, _, _ = select.select([sys.stdin], [], [], 1.0)
        if ready and not os.read(sys.stdin.fileno(), 1024):
            emulator.ended = True


if __name__ == "__main__":
    main()
