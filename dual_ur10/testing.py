"""Tools for tests of your own project: emulated and virtual cells as pytest fixtures, and a check of policies.

In a `conftest.py` at the top of the tests:

    pytest_plugins = ["dual_ur10.testing"]

and in a test:

    @pytest.mark.emulated_cell(task="Handover")
    def test_my_policy(emulated_cell):
        report = check_policy(MyPolicy(), "DualUR10/Handover-v0", cell=emulated_cell.path)
        assert report.cell_success

The fixture `virtual_cell` is the same on a virtual clock, several times as fast as real time and equal to the bit.

`check_policy` needs no pytest.
"""

from __future__ import annotations

import contextlib
import importlib.util
from pathlib import Path
from typing import TYPE_CHECKING, Any, Self

from dual_ur10.errors import DualUR10Error, SettingsError
from dual_ur10.policies.evaluation.check import PolicyReport, check_policy
from ur_emulator.emulated_cell import EmulatedCell

if TYPE_CHECKING:
    from collections.abc import Iterator

    import pytest

    from dual_ur10.sim2real.runtime.latch import Latch
    from ur_emulator.virtual.virtual_cell import VirtualCell

__all__ = ["CellForTests", "PolicyReport", "VirtualCell", "check_policy"]

MARKERS = ("emulated_cell", "virtual_cell")


def __getattr__(name: str) -> Any:
    if name == "VirtualCell":  # it needs the extra `virtual`
        from ur_emulator.virtual.virtual_cell import VirtualCell

        return VirtualCell
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")


def __dir__() -> list[str]:
    # pytest finds hooks and fixtures by it.
    return sorted({*__all__, *({"emulated_cell", "pytest_configure", "virtual_cell"} & globals().keys())})


class CellForTests(EmulatedCell):
    """Emulated cell with a cell file. Leaving the `with` block ends it and closes its environment.

    The fixture `emulated_cell` makes one for each test. For a cell that several tests share, define your own fixture:

        @pytest.fixture(scope="module")
        def cell(tmp_path_factory):
            with CellForTests(tmp_path_factory.mktemp("cell"), task="SyncCarry") as cell:
                yield cell

    Args:
        folder: Folder for its cell file and its log.
        **options: See `ur_emulator.emulator.EmulatorOptions`; without `cell`.

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
        from dual_ur10.sim2real.config.cell_file import load_cell_file
        from dual_ur10.sim2real.runtime.latch import Latch

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


def pytest_configure(config: pytest.Config) -> None:
    """Register the marker."""
    for name in MARKERS:
        config.addinivalue_line("markers", f"{name}(**options): options of the cell: task, family, plant, ...")


if importlib.util.find_spec("pytest") is not None:
    import pytest

    @pytest.fixture
    def emulated_cell(request: pytest.FixtureRequest, tmp_path: Path) -> Iterator[CellForTests]:
        """Run an emulated cell for one test, in real time.

        Its options come from `@pytest.mark.emulated_cell(task="Handover", family="e-series")`, or from a parameter:
        `@pytest.mark.parametrize("emulated_cell", [{"task": "SyncCarry"}], indirect=True)`.
        """
        from ur_emulator.testing import options_of  # late: pytest loads plugins itself

        with CellForTests(tmp_path, **options_of(request, "emulated_cell", "task='Handover'")) as cell:
            yield cell

    @pytest.fixture
    def virtual_cell(request: pytest.FixtureRequest) -> Iterator[VirtualCell]:
        """Run a virtual cell for one test. Its options come from `@pytest.mark.virtual_cell(...)` or a parameter."""
        from ur_emulator.testing import options_of
        from ur_emulator.virtual.virtual_cell import VirtualCell

        with VirtualCell(**options_of(request, "virtual_cell", "task='Handover'")) as cell:
            yield cell
