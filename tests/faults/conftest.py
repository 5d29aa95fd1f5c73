"""A lab for each file of tests."""

import time

import pytest

from tests.faults.lab import Lab

_BUSY = (
    "this machine is too busy",
    "does nothing any more",
    "has stood still for",
    "RTDE jitter",
    "RTDE rate",
    "round trip",
)
_TRIES = 3


@pytest.fixture(scope="module")
def the_lab(tmp_path_factory):
    made = Lab(tmp_path_factory.mktemp("lab"))
    yield made
    made.close()


@pytest.fixture
def lab(the_lab):
    yield the_lab
    the_lab.mend()


@pytest.hookimpl(tryfirst=True)
def pytest_pyfunc_call(pyfuncitem):
    """Try again where the arms were stopped because this machine could not keep up with them."""
    labs = [each for each in pyfuncitem.funcargs.values() if isinstance(each, Lab)]
    names = pyfuncitem._fixtureinfo.argnames
    for _ in range(_TRIES - 1):
        if not labs:
            break
        starved = [lab.busy() for lab in labs]
        try:
            pyfuncitem.obj(**{name: pyfuncitem.funcargs[name] for name in names})
        except Exception as error:
            faults = [fault.text for fault in (lab.latch.read() for lab in labs) if fault is not None]
            told = any(word in text for word in _BUSY for text in (str(error), *faults))
            if not told and [lab.busy() for lab in labs] == starved:
                raise
            for lab in labs:
                lab.mend()
            time.sleep(2.0)  # what keeps the machine busy may be over then
        else:
            return True
    return None
