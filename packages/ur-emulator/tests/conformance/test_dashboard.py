"""Dashboard server, port 29999: commands of UR's articles, and the answers that clients expect."""

import re
from unittest.mock import MagicMock

import pytest

from tests.conformance.wire import Dashboard, Rtde
from ur_emulator.ports import dashboard as command_server
from ur_emulator.profile import PROFILES

EVER = (5, 0), (3, 0)

MODES = "NO_CONTROLLER|DISCONNECTED|CONFIRM_SAFETY|BOOTING|POWER_OFF|POWER_ON|IDLE|BACKDRIVE|RUNNING"
SAFETY = "NORMAL|REDUCED|PROTECTIVE_STOP|RECOVERY|SAFEGUARD_STOP|SYSTEM_EMERGENCY_STOP|ROBOT_EMERGENCY_STOP|VIOLATION"

COMMANDS = [
    # Command, its answer, e-Series and CB3 software that brought it.
    ("PolyscopeVersion", r"URSoftware \d+\.\d+\.\d+\.\d+ \(.+\)", *EVER),
    ("version", r"\d+\.\d+\.\d+\.\d+", (5, 0), None),
    ("robotmode", f"Robotmode: ({MODES})", *EVER),
    ("safetymode", f"Safetymode: ({SAFETY}|FAULT)", *EVER),
    ("safetystatus", f"Safetystatus: ({SAFETY}|FAULT|.*STOP)", (5, 4), (3, 11)),
    ("programState", r"(STOPPED|PLAYING|PAUSED) .+", *EVER),
    ("running", "Program running: (true|false)", *EVER),
    ("isProgramSaved", r"(true|false) .+", *EVER),
    ("get loaded program", r"(Loaded program: .+|No program loaded)", *EVER),
    ("get serial number", r"\d+", (5, 6), (3, 12)),
    ("get robot model", r"UR\d+e?", (5, 6), (3, 12)),
    ("is in remote control", "(true|false)", (5, 6), None),
    ("get operational mode", "(MANUAL|AUTOMATIC|NONE)", (5, 6), None),
    ("popup conformance", "showing popup", *EVER),
    ("close popup", "closing popup", *EVER),
    ("addToLog conformance", "Added log message", *EVER),
    ("close safety popup", "closing safety popup", (5, 0), (3, 1)),
    ("setUserRole programmer", "Setting user role: programmer", None, (3, 1)),
    ("setUserRole juggler", "Failed setting user role: juggler", None, (3, 1)),
    ("load no_such_file.urp", r"(File not found|Error while loading program): .*no_such_file\.urp", *EVER),
    ("load installation no_such_file.installation", "(File not found|Failed to load installation): .*", (5, 0), (3, 2)),
    ("stop", "(Stopped|Failed to execute: stop)", *EVER),
    ("pause", "(Pausing program|Failed to execute: pause)", *EVER),
    ("power on", "Powering on", *EVER),
    ("brake release", "Brake releasing", *EVER),
    ("unlock protective stop", "Protective stop releasing", (5, 0), (3, 1)),
]

ELSEWHERE = {"quit", "power off"}
"""Commands that have tests of their own."""

NOT_TRIED = {
    "shutdown": "it switches the controller off",
    "restart safety": "it takes the arm's power",
    "play": "it runs whatever program is loaded",
    "set operational mode": "it takes the choice from the pendant",
    "clear operational mode": "it gives it back",
    "getuserrole": "its answer is not documented",
    "generate flight report": "it takes minutes",
    "generate support file": "it takes minutes",
    "savelog": "it writes to the controller's disk",
}


def test_a_greeting_comes_first(controller):
    with Dashboard(controller.host) as dashboard:
        assert dashboard.greeting.rstrip("\r") == "Connected: Universal Robots Dashboard Server"
        assert dashboard.silent


@pytest.mark.parametrize(("command", "answer", "e_series", "cb3"), COMMANDS, ids=[each[0] for each in COMMANDS])
def test_a_command_is_answered_where_it_exists(controller, command, answer, e_series, cb3):
    with Dashboard(controller.host) as dashboard:
        line = dashboard.ask(command)
        assert dashboard.silent
        if controller.has(e_series, cb3):
            assert re.fullmatch(answer, line), line
        else:
            assert line.startswith("could not understand"), line


@pytest.mark.parametrize("family", list(PROFILES))
def test_every_dashboard_command_is_tested_or_excluded(family):
    known = command_server.Dashboard(PROFILES[family], MagicMock()).commands
    tried = " ".join(each[0].lower() for each in COMMANDS)
    assert {each for each in known if each not in tried} == {
        each for each in NOT_TRIED.keys() | ELSEWHERE if each in known
    }
    assert not [each for each in NOT_TRIED if each in tried]


@pytest.mark.parametrize("line", ["dance", "robotmodes", "safety mode", "power", "42", "unlock"])
def test_unknown_commands_are_not_understood(controller, line):
    with Dashboard(controller.host) as dashboard:
        assert dashboard.ask(line).startswith("could not understand")
        assert dashboard.ask("robotmode") == "Robotmode: RUNNING"


def test_commands_are_answered_in_order(controller):
    with Dashboard(controller.host) as dashboard:
        dashboard.send(b"robotmode\nrunning\nsafetymode\nrobot")
        assert dashboard.line() == "Robotmode: RUNNING"
        assert dashboard.line() == "Program running: false"
        assert dashboard.line() == "Safetymode: NORMAL"
        assert dashboard.silent
        dashboard.send(b"mode\r\n")
        assert dashboard.line() == "Robotmode: RUNNING"


def test_quit_ends_the_connection_and_no_other(controller):
    with Dashboard(controller.host) as one, Dashboard(controller.host) as other:
        assert one.ask("quit") == "Disconnected"
        one.until_closed()
        assert other.ask("robotmode") == "Robotmode: RUNNING"


def test_the_dashboard_reports_the_same_program_as_rtde(controller):
    controller.call("while True:\n sync()\nend")
    with Dashboard(controller.host) as dashboard, controller.rtde() as rtde:
        rtde.until(lambda now: now["runtime_state"] == 2, "the program to run")
        assert dashboard.ask("running") == "Program running: true"
        assert dashboard.ask("programState").startswith("PLAYING ")
        assert dashboard.ask("pause") == "Pausing program"
        rtde.until(lambda now: now["runtime_state"] == 4, "the program to pause")
        assert dashboard.ask("running") == "Program running: false"
        assert dashboard.ask("programState").startswith("PAUSED ")
        assert dashboard.ask("play") == "Starting program"
        rtde.until(lambda now: now["runtime_state"] == 2, "the program to go on")
        assert dashboard.ask("stop") == "Stopped"
        rtde.until(lambda now: now["runtime_state"] == 1, "the program to end")
        assert dashboard.ask("running") == "Program running: false"
        assert dashboard.ask("programState").startswith("STOPPED ")


@pytest.mark.moves
@pytest.mark.assumption("power_on_s")
@pytest.mark.assumption("brake_release_s")
def test_powering_up_takes_at_least_the_assumed_time(controller):
    with Dashboard(controller.host) as dashboard, Rtde(controller.host) as rtde:
        rtde.outputs("timestamp,robot_mode,robot_status_bits")
        rtde.start()
        since = {}

        def until(mode):
            for each in rtde.until(lambda now: now["robot_mode"] == mode, f"robot mode {mode}"):
                assert bool(each["robot_status_bits"] & 1) == (each["robot_mode"] in (4, 5, 7))
                since.setdefault(each["robot_mode"], each["timestamp"])

        assert dashboard.ask("power off") == "Powering off"
        until(3)
        since.clear()
        assert dashboard.ask("power on") == "Powering on"
        until(5)
        assert dashboard.ask("robotmode") == "Robotmode: IDLE"
        idle_until = rtde.latest()["timestamp"]
        assert dashboard.ask("brake release") == "Brake releasing"
        until(7)
    power_s, brake_s = since[5] - since[4], since[7] - idle_until
    assert power_s > controller.assumed.power_on_s - 2 * controller.tick_s
    assert brake_s > controller.assumed.brake_release_s - 2 * controller.tick_s
    if controller.emulated:
        assert power_s < controller.assumed.power_on_s + 2 * controller.tick_s


def test_many_connections_are_served_concurrently(controller):
    clients = [Dashboard(controller.host) for _ in range(8)]
    try:
        for client in clients:
            client.send(b"robotmode\n")
        assert {client.line() for client in clients} == {"Robotmode: RUNNING"}
    finally:
        for client in clients:
            client.sock.close()
