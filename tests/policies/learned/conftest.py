"""Checkpoints on disk for the tests of learned policies."""

from __future__ import annotations

import shutil
from pathlib import Path

import pytest

from dual_ur10.policies.learned import checkpoint
from tests.policies.learned.checkpoints import (
    parts,
)


@pytest.fixture(scope="module")
def master(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("checkpoints") / "sine"
    checkpoint.save(folder, *parts(action_latency_ticks=5, amplitude_m=0.08))
    return folder


@pytest.fixture
def saved(master: Path, tmp_path: Path) -> Path:
    return Path(shutil.copytree(master, tmp_path / "copy"))
