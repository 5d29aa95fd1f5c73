"""Two arms beside each other in one emulator: by ticks, on a virtual clock, and in a process of their own."""

from __future__ import annotations

import dataclasses
import pathlib
from collections.abc import Mapping, Sequence
from typing import Any, ClassVar

import numpy as np

from tests.ur_emulator.ticking import Ticked
from ur_core.kinematics.ur10 import ARMS
from ur_core.links.json_link import JsonLink
from ur_core.processes.system import LOCAL, System
from ur_emulator.emulated_controller import EmulatorProcess
from ur_emulator.emulator import ControllerOptions, Emulator, serve_json
from ur_emulator.injection.cell_requests import CellRequests
from ur_emulator.virtual.virtual_system import VirtualProcess, VirtualSystem
from ur_emulator.virtual.virtual_system import World as Machines
from ur_emulator.world.lone_arm import LoneArm
from ur_emulator.world.plant import PlantOptions


class TwoArms:
    """World of two arms of one model that do not feel each other; see `SimulatedWorld`."""

    names = ARMS
    gripper_kg = (0.0, 0.0)
    tools = (None, None)
    has_object = False

    def __init__(self, robot: str, options: PlantOptions) -> None:
        self.arms = [LoneArm(robot, dataclasses.replace(options, seed=2 * options.seed + arm)) for arm in range(2)]
        first = self.arms[0]
        self.tick_s, self.substeps = first.tick_s, first.substeps
        self.mounts = first.mounts * 2
        self.start_q_rad = np.concatenate([each.start_q_rad for each in self.arms])
        self.lookahead_scale = np.concatenate([each.lookahead_scale for each in self.arms])
        self.sampled = {name: np.array([each.sampled[name] for each in self.arms]) for name in first.sampled}
        self.pose, self.joints, self.place = first.pose, first.joints, first.place
        self.set_joints, self.draw = first.set_joints, first.draw

    @property
    def failed(self) -> bool:
        return any(each.failed for each in self.arms)

    def read(self, arm: int) -> Any:
        return self.arms[arm].read(0)

    def advance(self, *of_arms: Sequence[Any]) -> None:
        for arm, world in enumerate(self.arms):
            world.advance(*([each[arm]] for each in of_arms))

    def push(self, arm: int, wrench: Any, duration_s: float) -> None:
        self.arms[arm].push(0, wrench, duration_s)


def emulator_of(values: Mapping[str, Any], system: System = LOCAL) -> Emulator:
    """Return the emulator of both: UR10, unless `robot` is another, at addresses `left` and `right` or free ones."""
    values = {"robot": "ur10", "plant": "nominal", **values}
    hosts = [values.pop(arm, None) for arm in ARMS]
    options = ControllerOptions.from_mapping(values)
    return Emulator(options, world=TwoArms(options.robot, options), hosts=hosts, system=system)


class Pair(Ticked):
    """Both controllers in this process."""

    def __init__(self, **options: Any) -> None:
        super().__init__(emulator_of(options))


class VirtualPair(CellRequests):
    """Both controllers on a virtual clock, and the system of a program that talks to them."""

    def __init__(self, **options: Any) -> None:
        machines = Machines()
        program = VirtualProcess(machines, None, "program", machines.scheduler.program)
        self._machine = VirtualProcess(machines, None, "controllers")
        self.system = VirtualSystem(program, pathlib.Path())
        self.clock = self.system.clock
        hosts = {"left": "127.0.0.2", "right": "127.0.0.3"}
        self.emulator = emulator_of({**hosts, **options}, VirtualSystem(self._machine, pathlib.Path()))
        machines.scheduler.start(self.emulator.run, self._machine.group, "controllers")
        self.left, self.right = (each.host for each in self.emulator.servers)
        self.description = self.emulator.description()
        port = self.description["emulator"]["port"]
        self._injection = JsonLink("fault injection", self.left, port, system=self.system)

    def close(self) -> None:
        if not self._closed:
            self._closed = True
            self._machine.kill()
            self.emulator.close()


class EmulatedPair(EmulatorProcess):
    """Both controllers in a process of their own, in real time."""

    module: ClassVar[str] = __name__

    def __init__(self, **options: Any) -> None:
        super().__init__(None, options)
        self.left, self.right = self.hosts.values()


if __name__ == "__main__":
    serve_json(emulator_of)
