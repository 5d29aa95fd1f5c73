import dataclasses
from collections.abc import Callable

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tests.soak import scaled
from tests.ur_emulator.ticking import Bench
from ur_core.errors import OperationRefusedError, UnknownNameError
from ur_core.protocol.modes import RobotMode, RuntimeState, SafetyMode
from ur_emulator.controller.pendant import Pendant
from ur_emulator.ports.dashboard import GREETING, LOCAL_MODE, Dashboard
from ur_emulator.profile import PROFILES, ControllerProfile

CB3, E_SERIES = PROFILES["cb3"], PROFILES["e-series"]
REFUSABLE = (
    "power_on",
    "power_off",
    "release_brakes",
    "unlock_protective_stop",
    "restart_safety",
    "play",
    "pause",
    "stop",
)


class Robot:
    """Fake robot that records calls, and refuses them on request."""

    def __init__(self) -> None:
        self.robot_mode: int = RobotMode.RUNNING
        self.safety_mode: int = SafetyMode.NORMAL
        self.runtime_state: int = RuntimeState.STOPPED
        self.remote_control: bool | None = True
        self.loaded_program = ""
        self.program_saved = True
        self.operational_mode = "NONE"
        self.user_role = "none"
        self.refuses = False
        self.calls: list[str] = []

    def _note(self, text: str) -> None:
        if self.refuses:
            raise OperationRefusedError(f"not now:\n{text}")
        self.calls.append(text)

    def __getattr__(self, name: str) -> Callable[[], None]:
        assert callable(getattr(Pendant, name))
        return lambda: self._note(name)

    def load(self, name: str) -> None:
        if name == "none.urp":
            raise UnknownNameError("program", name, ("some.urp",))
        self._note(f"load {name}")
        self.loaded_program = f"/programs/{name}"

    def load_installation(self, name: str) -> None:
        if name == "none.installation":
            raise UnknownNameError("installation", name, ("default.installation",))
        self._note(f"load_installation {name}")

    def popup(self, text: str) -> None:
        self._note(f"popup {text}")

    def add_to_log(self, text: str) -> None:
        self._note(f"add_to_log {text}")

    def set_operational_mode(self, mode: str) -> None:
        self._note(f"set_operational_mode {mode}")
        self.operational_mode = mode

    def flight_report(self, kind: str) -> int:
        self._note(f"flight_report {kind}")
        return 1

    def set_user_role(self, role: str) -> None:
        self._note(f"set_user_role {role}")
        self.user_role = role


def connect(profile: ControllerProfile = E_SERIES) -> tuple[Dashboard, Robot]:
    robot = Robot()
    return Dashboard(profile, robot), robot


def older(profile: ControllerProfile, minor: int) -> ControllerProfile:
    return dataclasses.replace(profile, version=(profile.version[0], minor, 0, 1))


@pytest.mark.parametrize("profile", [CB3, E_SERIES])
@pytest.mark.parametrize(
    ("line", "answer", "call"),
    [
        ("power on", "Powering on", "power_on"),
        ("power off", "Powering off", "power_off"),
        ("brake release", "Brake releasing", "release_brakes"),
        ("unlock protective stop", "Protective stop releasing", "unlock_protective_stop"),
        ("close safety popup", "closing safety popup", "close_safety_popup"),
        ("restart safety", "Restarting safety", "restart_safety"),
        ("play", "Starting program", "play"),
        ("pause", "Pausing program", "pause"),
        ("stop", "Stopped", "stop"),
        ("STOP", "Stopped", "stop"),
        ("stop\r", "Stopped", "stop"),
        ("load some.urp", "Loading program: some.urp", "load some.urp"),
        ("load a/My Program.urp", "Loading program: a/My Program.urp", "load a/My Program.urp"),
        (
            "load installation default.installation",
            "Loading installation: default.installation",
            "load_installation default.installation",
        ),
        ("popup Hello  World", "showing popup", "popup Hello  World"),
        ("close popup", "closing popup", "close_popup"),
        ("addToLog A line", "Added log message", "add_to_log A line"),
        ("shutdown", "Shutting down", "shutdown"),
    ],
)
def test_commands_act_and_answer(profile, line, answer, call):
    dashboard, robot = connect(profile)
    assert dashboard.answer(line) == answer
    assert robot.calls == [call]


def test_greeting_and_end():
    dashboard, _ = connect()
    assert dashboard.greeting == GREETING == "Connected: Universal Robots Dashboard Server"
    assert not dashboard.closed
    assert dashboard.answer("quit") == "Disconnected"
    assert dashboard.closed
    dashboard, robot = connect()
    robot.refuses = True
    dashboard.answer("shutdown")
    assert not dashboard.closed
    robot.refuses = False
    dashboard.answer("shutdown")
    assert dashboard.closed


@pytest.mark.parametrize("name", REFUSABLE)
def test_refusals(name):
    dashboard, robot = connect()
    robot.refuses = True
    command = {"release_brakes": "brake release"}.get(name, name.replace("_", " "))
    expected = (
        "not now: unlock_protective_stop" if name == "unlock_protective_stop" else f"Failed to execute: {command}"
    )
    assert dashboard.answer(command) == expected
    assert robot.calls == []


def test_programs_that_cannot_be_loaded():
    dashboard, robot = connect()
    assert dashboard.answer("load none.urp") == "File not found: none.urp"
    assert dashboard.answer("load installation none.installation") == "File not found: none.installation"
    robot.refuses = True
    assert dashboard.answer("load some.urp") == "Error while loading program: some.urp"
    assert dashboard.answer("load installation x") == "Failed to load installation: x"
    assert robot.calls == []


def test_state_of_the_program():
    dashboard, robot = connect()
    assert dashboard.answer("get loaded program") == "No program loaded"
    assert dashboard.answer("programState") == "STOPPED <unnamed>"
    dashboard.answer("load some.urp")
    assert dashboard.answer("get loaded program") == "Loaded program: /programs/some.urp"
    assert dashboard.answer("isProgramSaved") == "true some.urp"
    robot.program_saved = False
    assert dashboard.answer("isProgramSaved") == "false some.urp"
    states = {}
    for state in RuntimeState:
        robot.runtime_state = state
        states[state.name] = dashboard.answer("programState"), dashboard.answer("running")
    stopped = "STOPPED some.urp", "Program running: false"
    paused = "PAUSED some.urp", "Program running: false"
    playing = "PLAYING some.urp", "Program running: true"
    assert states == {
        "STOPPING": stopped,
        "STOPPED": stopped,
        "PLAYING": playing,
        "PAUSING": paused,
        "PAUSED": paused,
        "RESUMING": playing,
    }


def test_modes():
    dashboard, robot = connect()
    for mode in RobotMode:
        robot.robot_mode = mode
        assert dashboard.answer("robotmode") == f"Robotmode: {mode.name}"
    for safety in SafetyMode:
        robot.safety_mode = int(safety)
        assert dashboard.answer("safetystatus") == f"Safetystatus: {safety.name}"
        known = safety.name if safety < SafetyMode.AUTOMATIC_MODE_SAFEGUARD_STOP else "SAFEGUARD_STOP"
        assert dashboard.answer("safetymode") == f"Safetymode: {known}"
    robot.safety_mode = 21
    assert dashboard.answer("safetystatus") == "Safetystatus: 21"


def test_versions_and_names():
    e_series, cb3 = connect(E_SERIES)[0], connect(CB3)[0]
    assert e_series.answer("PolyscopeVersion") == "URSoftware 5.12.5.1101 (Nov 20 2023)"
    assert e_series.answer("version") == "5.12.5.1101"
    assert cb3.answer("PolyscopeVersion").startswith("URSoftware 3.15.8.106339 (")
    for dashboard, model in ((e_series, "UR10e"), (cb3, "UR10")):
        assert dashboard.answer("get robot model") == model
        assert dashboard.answer("get serial number").isdigit()


# First version of PolyScope 3 and of PolyScope 5 that has a command; a dash for never.
SINCE = {
    "load": "3.0 5.0",
    "play": "3.0 5.0",
    "stop": "3.0 5.0",
    "pause": "3.0 5.0",
    "quit": "3.0 5.0",
    "shutdown": "3.0 5.0",
    "running": "3.0 5.0",
    "robotmode": "3.0 5.0",
    "get loaded program": "3.0 5.0",
    "popup": "3.0 5.0",
    "close popup": "3.0 5.0",
    "addtolog": "3.0 5.0",
    "isprogramsaved": "3.0 5.0",
    "programstate": "3.0 5.0",
    "polyscopeversion": "3.0 5.0",
    "version": "- 5.0",
    "setuserrole": "3.1 -",
    "getuserrole": "3.1 -",
    "set operational mode": "- 5.0",
    "get operational mode": "- 5.6",
    "clear operational mode": "- 5.0",
    "power on": "3.0 5.0",
    "power off": "3.0 5.0",
    "brake release": "3.0 5.0",
    "safetymode": "3.0 5.0",
    "safetystatus": "3.11 5.4",
    "unlock protective stop": "3.1 5.0",
    "close safety popup": "3.1 5.0",
    "load installation": "3.2 5.0",
    "restart safety": "3.7 5.1",
    "is in remote control": "- 5.6",
    "get serial number": "3.12 5.6",
    "get robot model": "3.12 5.6",
    "generate flight report": "3.13 5.8",
    "generate support file": "3.13 5.8",
    "savelog": "3.13 5.8",
}


@pytest.mark.parametrize(("profile", "column"), [(CB3, 0), (E_SERIES, 1)])
def test_commands_by_version(profile, column):
    since = {name: versions.split()[column] for name, versions in SINCE.items()}
    for minor in range(17):
        expected = {name for name, first in since.items() if first != "-" and int(first.split(".")[1]) <= minor}
        dashboard = connect(older(profile, minor))[0]
        assert set(dashboard.commands) == expected, minor
        for name in set(SINCE) - expected - {"load installation"}:
            assert dashboard.answer(name) == f"could not understand: '{name}'"


def test_operational_mode():
    dashboard, robot = connect()
    assert dashboard.answer("get operational mode") == "NONE"
    assert dashboard.answer("set operational mode manual") == "Operational mode MANUAL is set"
    assert dashboard.answer("get operational mode") == "MANUAL"
    assert dashboard.answer("set operational mode sleepy") == "Failed setting operational mode: sleepy"
    expected = "No longer controlling the operational mode. Current operational mode: 'MANUAL'."
    assert dashboard.answer("clear operational mode") == expected
    assert robot.calls == ["set_operational_mode MANUAL", "clear_operational_mode"]
    assert connect(CB3)[0].answer("set operational mode manual").startswith("could not understand")


def test_user_role():
    dashboard, robot = connect(CB3)
    assert dashboard.answer("setUserRole PROGRAMMER") == "Setting user role: PROGRAMMER"
    assert dashboard.answer("getUserRole") == "PROGRAMMER"
    assert dashboard.answer("setUserRole restricted key") == "Setting user role: restricted"
    assert dashboard.answer("setUserRole king") == "Failed setting user role: king"
    assert robot.calls == ["set_user_role programmer", "set_user_role restricted"]
    assert connect(E_SERIES)[0].answer("getUserRole").startswith("could not understand")


LOCAL = {"play", "stop", "pause", "load", "load installation", "shutdown", "power on", "power off", "brake release"} | {
    "unlock protective stop",
    "restart safety",
}


def test_local_mode_refuses_commands_that_move_the_arm():
    robot = Robot()
    robot.remote_control = False
    for name in Dashboard(E_SERIES, robot).commands:
        answer = Dashboard(E_SERIES, robot).answer(f"{name} x" if name.startswith("load") else name)
        assert (answer == LOCAL_MODE) == (name in LOCAL), name
    assert not {"play", "power_on", "stop", "shutdown"} & set(robot.calls)
    assert Dashboard(E_SERIES, robot).answer("is in remote control") == "false"


def test_remote_control_needs_a_new_connection():
    robot = Robot()
    robot.remote_control = False
    dashboard = Dashboard(E_SERIES, robot)
    robot.remote_control = True
    assert dashboard.answer("play") == LOCAL_MODE
    assert dashboard.answer("is in remote control") == "true"
    later = Dashboard(E_SERIES, robot)
    assert later.answer("play") == "Starting program"
    robot.remote_control = False
    assert later.answer("play") == LOCAL_MODE
    assert robot.calls == ["play"]


def test_settings_without_remote_control_refuse_nothing():
    robot = Robot()
    robot.remote_control = None
    dashboard = Dashboard(E_SERIES, robot)
    assert dashboard.answer("is in remote control") == "false"
    assert dashboard.answer("play") == "Starting program"


def test_a_cb3_has_no_local_mode():
    robot = Robot()
    robot.remote_control = False
    assert Dashboard(CB3, robot).answer("play") == "Starting program"


@pytest.mark.parametrize("line", ["", "plays", "play now", "power", "power on please", "getloadedprogram", "help"])
def test_unknown_commands(line):
    dashboard, robot = connect()
    assert dashboard.answer(line) == f"could not understand: '{line}'"
    assert robot.calls == []


def test_reports_and_logs_are_answered_in_the_words_of_the_dashboard():
    for profile in (CB3, E_SERIES):
        dashboard = Dashboard(profile, Bench("e-series").pendant)
        assert dashboard.answer("generate flight report system") == "Flight Report generated with id:1"
        assert dashboard.answer("generate flight report ") == "Flight Report generated with id:2"
        assert dashboard.answer("generate flight report all").startswith("Error: unknown flight report 'all'")
        assert dashboard.answer("generate support file .") == "Completed successfully: ./ursupport.zip"
        assert dashboard.answer("saveLog") == "Log saved to disk"
    assert connect()[0].answer("addToLog") == "No log message to add"


starts = st.sampled_from([*connect(CB3)[0].commands, *connect(E_SERIES)[0].commands])


@given(st.sampled_from([CB3, E_SERIES]), st.booleans(), st.booleans(), starts, st.text(max_size=20))
@settings(max_examples=scaled(4000, 40))
def test_no_line_raises(profile, remote, refuses, start, rest):
    robot = Robot()
    robot.remote_control, robot.refuses = remote, refuses
    dashboard = Dashboard(profile, robot)
    for line in (start + rest, rest, f"{start} {rest}"):
        line = line.replace("\n", " ")
        answer = dashboard.answer(line)
        assert answer
        assert "\n" not in answer
