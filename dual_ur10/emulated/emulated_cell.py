"""Two emulated controllers of a cell in a process of their own."""

from __future__ import annotations

import contextlib
from pathlib import Path
from types import ModuleType
from typing import Any, ClassVar, Self

from dual_ur10 import errors
from dual_ur10.errors import DualUR10Error, SettingsError
from dual_ur10.sim2real.cell_file.cell_file import load_cell_file
from dual_ur10.sim2real.runtime.latch import Latch
from ur_emulator.emulated_controller import EmulatorProcess


class EmulatedCell(EmulatorProcess):
    """Two emulated controllers and their simulated arms, for the duration of a `with` block.

    Args:
        log: Log file of the cell; None keeps the log until the cell is closed.
        options: See `dual_ur10.emulated.cell_emulator.CellOptions`.

    Attributes:
        left, right: Addresses of the controllers.

    Raises:
        DualUR10Error: See `EmulatorProcess`.
    """

    module: ClassVar[str] = "dual_ur10.emulated.cell_emulator"
    errors: ClassVar[ModuleType] = errors

    def __init__(self, *, log: str | Path | None = None, **options: Any) -> None:
        super().__init__(log, options)
        self.left, self.right = self.hosts.values()


class CellForTests(EmulatedCell):
    """Emulated cell with a cell file. Leaving the `with` block ends it and closes its environment.

    The fixture `emulated_cell` makes one for each test. For a cell that several tests share, define your own fixture:

        @pytest.fixture(scope="module")
        def cell(tmp_path_factory):
            with CellForTests(tmp_path_factory.mktemp("cell"), task="SyncCarry") as cell:
                yield cell

    Args:
        folder: Folder for its cell file and its log.
        **options: See `dual_ur10.emulated.cell_emulator.CellOptions`; without `cell`.

    Attributes:
        path: Path of the cell file: `gym.make(..., cell=cell.path)`.
        left, right: Addresses of the controllers.

    Raises:
        SettingsError: `cell` is among the options.
        DualUR10Error: See `EmulatedCell`.
    """

    def __init__(self, folder: str | Path, **options: Any) -> None:
        if "cell" in options:
            raise SettingsError("an emulated cell in tests writes its own cell file: leave out `cell`")
        self.path = str(Path(folder) / "emulated_cell.toml")
        self._env: Any = None
        super().__init__(log=Path(folder) / "emulated_cell.log", **{**options, "cell": self.path})

    def make(self, env_id: str, **keywords: Any) -> Any:
        """Make an environment on this cell, and close the previous one, which uses the same arms.

        Raises:
            DualUR10Error: As raised by `gym.make`.
        """
        import gymnasium as gym

        self._close_env()
        self._env = gym.make(env_id, cell=self.path, **keywords)
        return self._env

    @property
    def fault(self) -> str:
        """Reason of the latched stop; "": there is none."""
        found = self._latch.read()
        return "" if found is None else found.text

    def clear(self) -> None:
        """Clear the latched stop, as `cell clear` does. A stopped environment must be made again."""
        self._latch.clear()

    @property
    def _latch(self) -> Latch:
        return Latch(load_cell_file(self.path))

    def __enter__(self) -> Self:
        return self

    def _close_env(self) -> None:
        env, self._env = self._env, None
        if env is not None:
            env.close()

    def close(self) -> None:
        """Close the environment, end the process and clear the fault. May be called twice."""
        try:
            self._close_env()
        finally:
            super().close()
            with contextlib.suppress(DualUR10Error):  # without a start there is no file
                self.clear()
