"""Controller under test: emulated, or at a given host."""

import itertools
import struct
from dataclasses import dataclass

import pytest

from tests.conformance import wire
from tests.conformance.wire import Bounded, Dashboard, Rtde
from ur_core.kinematics.robots import MODEL_OF_FAMILY
from ur_emulator.emulated_controller import EmulatedController
from ur_emulator.profile import PROFILES

STATE = "timestamp,runtime_state,robot_mode,safety_mode,actual_q"


@dataclass(frozen=True)
class Controller:
    """Controller under test."""

    host: str
    family: str
    version: tuple[int, int, int, int]
    process: EmulatedController | None = None

    @property
    def emulated(self):
        return self.process is not None

    @property
    def tick_s(self):
        return 0.008 if self.family == "cb3" else 0.002

    @property
    def assumed(self):
        """Assumptions about controllers of this family."""
        return PROFILES[self.family].assumptions

    def has(self, e_series, cb3):
        """Return True from these versions on; None: never."""
        since = cb3 if self.family == "cb3" else e_series
        return since is not None and self.version >= since

    def rtde(self, names=STATE, version=2, hz=None):
        """Return a started RTDE connection."""
        rtde = Rtde(self.host, version)
        _, types = rtde.outputs(names, hz)
        assert "NOT_FOUND" not in types, dict(zip(names.split(","), types, strict=True))
        assert rtde.start()
        return rtde

    def run(self, text, port=wire.SECONDARY):
        wire.run(self.host, text, port)

    def call(self, text):
        """Run the body of a program."""
        self.run(f"def conformance():\n{text}\nend\n")


def pytest_generate_tests(metafunc):
    if "controller" not in metafunc.fixturenames:
        return
    family = metafunc.config.getoption("--family")
    families = [family] if family else ["cb3", "e-series"]
    # Scope "session" keeps tests of one family together, so that one emulated controller runs at a time.
    metafunc.parametrize("controller", families, indirect=True, scope="session")


def pytest_collection_modifyitems(config, items):
    if config.getoption("--host") and not config.getoption("--moves"):
        for item in items:
            if item.get_closest_marker("moves"):
                item.add_marker(pytest.mark.skip(reason="--moves is needed: it moves or stops the arm"))


@pytest.fixture(scope="session")
def controller(request):
    family, host = request.param, request.config.getoption("--host")
    if host:
        yield _asked(host, family)
        return
    with EmulatedController(MODEL_OF_FAMILY[family], plant="nominal") as process:
        yield _asked(process.host, family, process)


def _asked(host, family, process=None):
    with Rtde(host) as rtde:
        version = struct.unpack(">4I", rtde.request(wire.URCONTROL))
    return Controller(host, family, version, process)


@pytest.fixture(autouse=True)
def idle(request):
    """Leave an arm that is ready, and no program, for the next test."""
    if "controller" not in request.fixturenames:
        return
    controller = request.getfixturevalue("controller")
    with controller.rtde() as rtde, Dashboard(controller.host) as dashboard:
        for _ in Bounded("a controller that is ready: power on, release the brakes, allow remote control"):
            state = rtde.latest()
            if (state["runtime_state"], state["robot_mode"], state["safety_mode"]) == (1, 7, 1):
                break
            if state["runtime_state"] in (2, 4):
                dashboard.ask("stop")
            elif state["safety_mode"] == 3 and controller.emulated:
                controller.process.ask("release", mode=3)  # at once, not after five seconds
            elif state["safety_mode"] == 3:
                dashboard.ask("unlock protective stop")
            elif state["safety_mode"] == 1 and (controller.emulated or request.config.getoption("--moves")):
                dashboard.ask("brake release")
            rtde.until(lambda now, since=state["timestamp"]: now["timestamp"] > since + 0.02, "time to pass")


# Programs of the tests count in the same registers, by some thousands: a token must never be what one has left there.
_TOKENS = itertools.count(1_000_000)


@pytest.fixture
def token():
    """Number that no register holds yet."""
    return next(_TOKENS)
