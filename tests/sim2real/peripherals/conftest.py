"""Virtual cell with grippers, an object and a camera."""

import functools

import pytest

from dual_ur10.testing import VirtualCell
from tests import waiting


@pytest.fixture(scope="module")
def made():
    with VirtualCell(task="Handover", plant="nominal") as cell:
        yield cell


@pytest.fixture
def cell(made):
    yield made
    for arm in ("left", "right"):
        made.ask("heal", arm=arm)


@pytest.fixture
def file(made):
    return made.file


@pytest.fixture
def system(made):
    return made.system


@pytest.fixture
def clock(made):
    return made.clock


@pytest.fixture
def until(made):
    return functools.partial(waiting.until, clock=made.clock)
