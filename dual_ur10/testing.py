"""Tools for tests of your own project: emulated and virtual cells as pytest fixtures, checks of policies and of tasks.

In a `conftest.py` at the top of the tests:

    pytest_plugins = ["dual_ur10.testing"]

and in a test:

    @pytest.mark.emulated_cell(task="Handover")
    def test_my_policy(emulated_cell):
        report = check_policy(MyPolicy(), "DualUR10/Handover-v0", cell=emulated_cell.path)
        assert report.cell_success

The fixture `virtual_cell` is the same on a virtual clock, several times as fast as real time and equal to the bit.

`check_policy` and `audit` need no pytest.
"""

from __future__ import annotations

import importlib
import importlib.util
from typing import TYPE_CHECKING, Any

from dual_ur10.policies.evaluation.audit.audit import audit
from dual_ur10.policies.evaluation.audit.report import AuditFinding, AuditReport
from dual_ur10.policies.evaluation.check import PolicyReport, check_policy

if TYPE_CHECKING:
    from collections.abc import Iterator
    from pathlib import Path

    import pytest

    from dual_ur10.emulated.emulated_cell import CellForTests
    from dual_ur10.emulated.virtual_cell import VirtualCell

__all__ = ["AuditFinding", "AuditReport", "CellForTests", "PolicyReport", "VirtualCell", "audit", "check_policy"]

MARKERS = ("emulated_cell", "virtual_cell")


_CELLS = {"CellForTests": "dual_ur10.emulated.emulated_cell", "VirtualCell": "dual_ur10.emulated.virtual_cell"}


def __getattr__(name: str) -> Any:
    if name in _CELLS:  # they need the extras `emulator` and `virtual`
        return getattr(importlib.import_module(_CELLS[name]), name)
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")


def __dir__() -> list[str]:
    # pytest finds hooks and fixtures by it.
    return sorted({*__all__, *({"emulated_cell", "pytest_configure", "virtual_cell"} & globals().keys())})


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
        from dual_ur10.emulated.emulated_cell import CellForTests
        from ur_emulator.testing import options_of  # late: pytest loads plugins itself

        with CellForTests(tmp_path, **options_of(request, "emulated_cell", "task='Handover'")) as cell:
            yield cell

    @pytest.fixture
    def virtual_cell(request: pytest.FixtureRequest) -> Iterator[VirtualCell]:
        """Run a virtual cell for one test. Its options come from `@pytest.mark.virtual_cell(...)` or a parameter."""
        from dual_ur10.emulated.virtual_cell import VirtualCell
        from ur_emulator.testing import options_of

        with VirtualCell(**options_of(request, "virtual_cell", "task='Handover'")) as cell:
            yield cell
