"""Learning curves are noted and not drawn: that takes longer than the trainings of these tests."""

from __future__ import annotations

from pathlib import Path

import pytest

from dual_ur10.policies.training import folder


@pytest.fixture(autouse=True)
def drawn(monkeypatch: pytest.MonkeyPatch) -> list[Path]:
    """Return the files of the learning curves so far. Fixtures of modules draw theirs."""
    paths: list[Path] = []
    monkeypatch.setattr(folder, "draw_curve", lambda path, *_: paths.append(path))
    return paths
