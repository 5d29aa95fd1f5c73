"""Dashboard client: its queries, the commands it refuses to send, and its errors."""

import select
import threading

import pytest

from tests.links.fake_servers import DEADLINE_S, serving, until_closed
from ur_core.errors import ClosedError, LinkError, OperationRefusedError, SettingsError
from ur_core.links.dashboard_link import FORBIDDEN, DashboardLink
from ur_core.links.primary_link import read_primary

HERE = "127.0.0.1"
GREETING = b"Connected: Universal Robots Dashboard Server\n"


def test_queries_to_a_cb3(cb3):
    with DashboardLink(cb3.left, name="left", system=cb3.system) as link:
        assert link.where == f"left arm, dashboard at {cb3.left}:29999"
        assert link.version() == (3, 15, 8, 106339)
        assert link.robot_mode() == "RUNNING"
        assert link.safety() == "NORMAL"
        assert link.program_state().split()[0] == "STOPPED"
        assert link.remote_control() is None
        assert link.model() == "UR10"
        assert link.serial_number().isdigit()
        cb3.ask("stop", arm="left", mode=5)
        cb3.wait_until("left", "safety_mode", 5)
        assert link.safety() == "SAFEGUARD_STOP"
    cb3.ask("release", arm="left", mode=5)


def test_remote_control_of_an_e_series_controller(e_series):
    with DashboardLink(e_series.left, system=e_series.system) as link:
        assert link.remote_control() is True
        e_series.ask("remote", arm="left", on=False)
        assert link.remote_control() is False
        with pytest.raises(OperationRefusedError, match=r"Remote Control.*pendant"):
            link.stop()
    e_series.ask("remote", arm="left", on=True)


def test_queries_that_a_version_lacks_are_none(cb3):
    cb3.ask("pretend", arm="right", version=[3, 10, 0, 1])
    with DashboardLink(cb3.right, system=cb3.system) as link:
        assert link.version() == (3, 10, 0, 1)
        assert (link.model(), link.serial_number(), link.remote_control()) == (None, None, None)
        assert link.safety() == "NORMAL"
        assert link.robot_mode() == "RUNNING"
    cb3.ask("pretend", arm="right", version=[3, 15, 8, 106339])


def test_stop_stops_the_program(cb3):
    cb3.ask("program", arm="right", name="wait.urp", text="while True:\n sync()\nend\n")
    with DashboardLink(cb3.right, system=cb3.system) as link:
        cb3.ask("press", arm="right", button="stop")
        cb3.wait_until("right", "runtime_state", 1)
        program = cb3.system.connect(cb3.right, 30002, DEADLINE_S)
        program.send_now(b"def p():\n while True:\n  sync()\n end\nend\n")
        cb3.wait_until("right", "runtime_state", 2)
        link.stop()
        cb3.wait_until("right", "runtime_state", 1)
        program.close()


def test_a_command_has_one_line(cb3):
    before = cb3.ask("state", arm="left", names=["robot_mode"])
    with DashboardLink(cb3.left, system=cb3.system) as link:
        for command in ("robotmode\npower off", "power off\r", "power off\0", "", "ä", "x" * 1025, "a\x85power off"):
            with pytest.raises(SettingsError, match="one line"):
                link.ask(command)
        assert link.ask("robotmode") == "Robotmode: RUNNING"
    assert cb3.ask("state", arm="left", names=["robot_mode"]) == before


def test_commands_that_resume_motion_are_not_sent():
    sent = []

    def talk(connection):
        connection.sendall(GREETING)
        sent.append(until_closed(connection))

    with serving(talk) as port, DashboardLink(HERE, port=port) as link:
        for command in (*FORBIDDEN, "PLAY", " play ", "unlock  protective stop", "load x.urp", "play now"):
            with pytest.raises(OperationRefusedError, match="person"):
                link.ask(command)
    assert sent == [b""]
    for name in ("play", "unlock", "unlock_protective_stop", "load", "restart_safety"):
        assert not hasattr(DashboardLink, name)
    # Whole words count.
    with serving(answering(b"1\n")) as port, DashboardLink(HERE, port=port) as link:
        assert link.ask("playful") == "1"


def answering(*answers):
    def talk(connection):
        connection.sendall(GREETING)
        for answer in answers:
            assert connection.recv(1000).endswith(b"\n")
            connection.sendall(answer)
        until_closed(connection)

    return talk


def test_a_silent_server_is_an_error_and_its_late_answer_is_ignored(cb3):
    link = DashboardLink(cb3.left, 2.0, name="left", system=cb3.system)
    cb3.ask("link", arm="left", port="dashboard", mute=True)
    with pytest.raises(LinkError, match=r"left arm, dashboard at .*: no answer in time; "):
        link.ask("robotmode")
    cb3.ask("heal", arm="left")
    with pytest.raises(ClosedError):
        link.ask("safetymode")
    cb3.ask("link", arm="left", port="dashboard", half_open=True)
    with pytest.raises(LinkError, match="no answer in time"):
        DashboardLink(cb3.left, 2.0, system=cb3.system)
    cb3.ask("refuse", arm="left", port="dashboard")
    with pytest.raises(LinkError, match="no connection"):
        DashboardLink(cb3.left, system=cb3.system)
    cb3.ask("heal", arm="left")
    link = DashboardLink(cb3.left, system=cb3.system)
    cb3.ask("drop", arm="left", port="dashboard")
    with pytest.raises(LinkError, match=r"closed the connection|broke"):
        link.ask("robotmode")
    link.close()


def test_an_interrupted_query_closes_the_connection(monkeypatch):
    with serving(answering(b"Robotmode: IDLE\n")) as port:
        link = DashboardLink(HERE, port=port)

        def interrupted(deadline_s):
            raise KeyboardInterrupt

        monkeypatch.setattr(link, "_line", interrupted)
        with pytest.raises(KeyboardInterrupt):
            link.ask("robotmode")
        monkeypatch.undo()
        with pytest.raises(ClosedError):
            link.ask("safetymode")


@pytest.mark.parametrize(
    ("answer", "text"),
    [
        (b"a\nb\n", "2 lines"),
        (b"x" * 5000, "5000 bytes or more|4[0-9]{3} bytes or more"),
        (b"Robotmode RUNNING\n", "answers 'Robotmode RUNNING' to 'robotmode'"),
        (b"\n", "answers '' to 'robotmode'"),
        (b"", "no answer in time"),
        (b"Robotmode: RUN", "no answer in time"),
    ],
)
def test_answers_that_are_not_valid(answer, text):
    with (
        serving(answering(answer)) as port,
        DashboardLink(HERE, 0.5, port, name="left") as link,
        pytest.raises(LinkError, match=text),
    ):
        link.robot_mode()


@pytest.mark.parametrize(("query", "name"), [("version", "PolyscopeVersion"), ("remote_control", "is in remote")])
def test_a_version_or_remote_mode_that_is_not_valid(query, name):
    first = () if query == "version" else (b"URSoftware 5.12.5\n",)
    with (
        serving(answering(*first, b"perhaps\n")) as port,
        DashboardLink(HERE, port=port) as link,
        pytest.raises(LinkError, match=f"answers 'perhaps' to '{name}"),
    ):
        getattr(link, query)()


def test_unasked_lines_are_not_taken_for_an_answer():
    asked = threading.Event()

    def talk(connection):
        connection.sendall(GREETING)
        connection.recv(1000)
        connection.sendall(b"one\n")
        assert asked.wait(DEADLINE_S)
        connection.sendall(b"unasked\n")
        until_closed(connection)

    with serving(talk) as port, DashboardLink(HERE, port=port) as link:
        assert link.ask("a") == "one"
        asked.set()
        assert select.select([link], [], [], DEADLINE_S)[0]
        with pytest.raises(LinkError, match=r"sent b'unasked.*' unasked"):
            link.ask("b")
        with pytest.raises(ClosedError):
            link.ask("b")


@pytest.mark.parametrize("greeting", [b"220 mail\n", b"\n", b"x" * 10_000])
def test_another_server_is_named(greeting):
    def talk(connection):
        connection.sendall(greeting)
        until_closed(connection)

    with serving(talk) as port, pytest.raises(LinkError, match="no dashboard server"):
        DashboardLink(HERE, port=port)


@pytest.mark.parametrize("connect", [DashboardLink, read_primary])
@pytest.mark.parametrize(("host", "timeout_s", "words"), [("robot.local", 1.0, "IPv4"), (HERE, 0.0, "timeout_s")])
def test_arguments_that_are_not_legal(connect, host, timeout_s, words):
    with pytest.raises(SettingsError, match=words):
        connect(host, timeout_s)
