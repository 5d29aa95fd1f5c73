"""One lab for each test module."""

import pytest

from tests.live.faults.lab import Lab


@pytest.fixture(scope="module")
def the_lab(tmp_path_factory):
    made = Lab(tmp_path_factory.mktemp("lab"))
    yield made
    made.close()


@pytest.fixture
def lab(the_lab):
    yield the_lab
    the_lab.audit()
    the_lab.mend()
