"""Emulated cell with grippers, an object and a camera, and its cell file."""

import pytest

from dual_ur10.sim2real.config.cell_file import load_cell_file
from dual_ur10.sim2real.emulator.emulated_cell import EmulatedCell


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    path = tmp_path_factory.mktemp("cell") / "cell.toml"
    with EmulatedCell(task="Handover", plant="nominal", cell=str(path)) as cell:
        yield cell, load_cell_file(path)


@pytest.fixture
def cell(made):
    yield made[0]
    for arm in ("left", "right"):
        made[0].ask("heal", arm=arm)


@pytest.fixture
def file(made):
    return made[1]
