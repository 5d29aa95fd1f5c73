"""Virtual cell: two emulated controllers, and every process of the runner, in this process on a virtual clock."""

from __future__ import annotations

import contextlib
import tempfile
from collections.abc import Mapping
from pathlib import Path
from typing import Any, Self

from dual_ur10.emulated.cell_emulator import CellEmulator, CellOptions, cell_of
from dual_ur10.errors import DualUR10Error, SettingsError, UnknownNameError, VirtualCellError
from dual_ur10.sim2real.cell.cell_config import CellConfig
from dual_ur10.sim2real.cell_file.cell_file import VIRTUAL, CellFile
from dual_ur10.sim2real.runtime.latch import Fault, Latch
from ur_core.kinematics.ur10 import ARMS
from ur_core.links.json_link import JsonLink
from ur_emulator.injection.cell_requests import CellRequests
from ur_emulator.virtual.control import ScriptControl, control_script
from ur_emulator.virtual.virtual_system import VirtualProcess, VirtualSystem, World

_HOSTS = ("127.0.0.2", "127.0.0.3")
_IDLE_HOSTS = ("127.0.0.4", "127.0.0.5")
"""Addresses of controllers that nobody uses: the right one of the left arm's emulator, the left one of the other."""

_NOT_VIRTUAL = ("view", "cell")


class VirtualCell(CellRequests):
    """Cell for `gym.make(..., cell=...)` on which time passes as fast as it is computed, the same to the bit each time.

    The program, both arms' processes, the supervisor, the recorder and both emulated controllers are the code of a
    cell of real processes. They take turns in the thread that makes the cell. Computing takes no virtual time: an
    action is late only if the program sleeps on `clock`.

    Args:
        file: Keys of the cell file that differ from those of the emulated cell, such as `speed_factor`.
        right: Options of the right controller that differ, such as `phase_s` and `drift_ppm`: it then has a clock and a
            world of its own. None: both controllers share them.
        **options: See `dual_ur10.emulated.cell_emulator.CellOptions`; without `view` and `cell`.

    Attributes:
        file: Cell file of environments that are made from now on.
        system: Operating system of the program.
        clock: Its clock.
        emulator: Both controllers and their world, or those of the left arm.
        emulators: Emulator of each arm: twice the same one, or two.

    Raises:
        MissingExtraError: `ur_rtde` is not installed, whose control script is run.
        VirtualCellError: An option asks for what only real processes show.
        DualUR10Error: An option is invalid.
    """

    def __init__(
        self, *, file: Mapping[str, Any] | None = None, right: Mapping[str, Any] | None = None, **options: Any
    ) -> None:
        asked = [name for name in _NOT_VIRTUAL if {**options, **(right or {})}.get(name) not in (None, False)]
        if asked:
            raise VirtualCellError(f"a virtual cell has no {asked[0]!r}: leave it out, or use an emulated cell")
        family = cell_of(CellOptions.from_mapping(options)).servoj.family
        control_script(family)
        self._folder = tempfile.TemporaryDirectory()
        self._closed = False
        self._env: Any = None
        self._world = World()
        program = VirtualProcess(self._world, None, "program", self._world.scheduler.program)
        self.system = VirtualSystem(
            program, Path(self._folder.name), lambda host, system: ScriptControl(host, system, family)
        )
        self.clock = self.system.clock
        hosts = dict(zip(ARMS, _HOSTS, strict=True))
        try:
            if right is None:
                self.emulators = [self._emulator("emulated cell", {**hosts, **options})] * len(ARMS)
            else:
                self.emulators = [
                    self._emulator("left controller", {**hosts, "right": _IDLE_HOSTS[0], **options}),
                    self._emulator("right controller", {**hosts, "left": _IDLE_HOSTS[1], **options, **right}),
                ]
            self.emulator = self.emulators[0]
            if right is not None and self.emulator.world.has_object:
                raise VirtualCellError(
                    "two controllers with worlds of their own cannot hold one object, as "
                    f"{self.emulator.options.task} requires: leave out `right`"
                )
            self.description = self.emulator.description()
            self.description[ARMS[1]] = self.emulators[1].description()[ARMS[1]]
            self.file = CellFile.read({**self.description, **(file or {})}, VIRTUAL)
        except BaseException:
            self._folder.cleanup()
            raise
        self.left, self.right = (each.servers[arm].host for arm, each in enumerate(self.emulators))
        self._links = [self._injection_link(each) for each in self.emulators]
        self._injection = self._links[0]

    def _emulator(self, name: str, options: Mapping[str, Any]) -> CellEmulator:
        """Make an emulator, and the process that runs it."""
        machine = VirtualProcess(self._world, None, name)
        system = VirtualSystem(machine, Path(self._folder.name))
        emulator = CellEmulator(CellOptions.from_mapping(options), system=system)

        def run() -> None:
            code = 1
            try:
                emulator.run()
                code = 0
            finally:
                machine.finish(code)

        self._world.scheduler.start(run, machine.group, name)
        return emulator

    def _injection_link(self, emulator: CellEmulator) -> JsonLink:
        port = emulator.description()["emulator"]["port"]
        return JsonLink("fault injection", emulator.servers[0].host, port, system=self.system)

    def ask(self, do: str, **values: Any) -> Any:
        """See `CellRequests`. The emulator of the arm answers."""
        self._injection = self._links[ARMS.index(values["arm"]) if values.get("arm") in ARMS else 0]
        return super().ask(do, **values)

    def config(self) -> CellConfig:
        """Return the configuration of the cell, for `gym.make`."""
        return self.file.config()

    @property
    def now_s(self) -> float:
        """Time of the virtual clock, s."""
        return self.clock.now_s()

    def stall(self, process: str, duration_s: float) -> None:
        """Keep a process from running for a duration, as a busy machine does.

        Args:
            process: "left", "right", "supervisor" or "recorder"; or "emulated cell", and with two of them "left
                controller" or "right controller".
            duration_s: Duration from now on.

        Raises:
            UnknownNameError: There is no such process.
        """
        self._process(process).stall(duration_s)

    def end(self, process: str) -> None:
        """End a process at once, with its connections, as SIGKILL does.

        Raises:
            UnknownNameError: There is no such process.
        """
        self._process(process).kill()

    def _process(self, name: str) -> VirtualProcess:
        running = {each.name: each for each in self._world.processes.values() if each.is_alive}
        if name not in running:
            raise UnknownNameError("process of the virtual cell", name, tuple(running))
        if name == "program":
            raise VirtualCellError("the program cannot be stalled from inside: sleep on `clock`, or close the cell")
        return running[name]

    @property
    def latch(self) -> Latch:
        """Latch of the cell."""
        return Latch(self.file, self.system)

    @property
    def fault(self) -> str:
        """Reason of the latched stop; "": there is none."""
        found: Fault | None = self.latch.read()
        return "" if found is None else found.text

    def make(self, env_id: str, **keywords: Any) -> Any:
        """Make an environment on this cell, and close the previous one, which uses the same arms.

        Raises:
            DualUR10Error: As raised by `gym.make`.
        """
        import gymnasium as gym

        self._close_env()
        self._env = gym.make(env_id, cell=self, **keywords)
        return self._env

    def _close_env(self) -> None:
        env, self._env = self._env, None
        if env is not None:
            env.close()

    def clear(self) -> None:
        """Clear the latched stop, as `cell clear` does. A stopped environment must be made again."""
        self.latch.clear()

    def __repr__(self) -> str:
        return f"VirtualCell(task={self.emulator.options.task!r})"

    def __deepcopy__(self, memo: Any) -> Self:
        """Return itself: Gymnasium copies the keywords of environments."""
        return self

    def __reduce__(self) -> Any:
        raise SettingsError("a virtual cell cannot be pickled: its processes run here. Make one where it is used")

    def close(self) -> None:
        """Close the environment that `make` made, and end all processes but the program. May be called twice.

        Raises:
            VirtualCellError: A process has failed that must not, such as that of the controllers.
        """
        if self._closed:
            return
        with contextlib.suppress(DualUR10Error):  # it was stopped, which the program knows
            self._close_env()
        self._closed = True
        for link in self._links:
            link.close()
        for process in list(self._world.processes.values()):
            if process.group is not self._world.scheduler.program:
                process.kill()
        self._folder.cleanup()
        if self._world.scheduler.failures:
            name, error = self._world.scheduler.failures[0]
            raise VirtualCellError(f"{name} has failed: {type(error).__name__}: {error}") from error
