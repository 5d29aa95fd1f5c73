"""Power on: only without other faults, only with confirmation, and nothing but power and brakes."""

import functools

import pytest

from dual_ur10.errors import LinkError, OperationRefusedError
from dual_ur10.sim2real.commissioning import power
from dual_ur10.testing import VirtualCell
from ur_core.links.dashboard_link import DashboardLink

ARMS = ("left", "right")


@pytest.fixture(scope="module", params=["cb3", "e-series"])
def made(request):
    with VirtualCell(plant="nominal", powered=False, family=request.param) as cell:
        yield cell


@pytest.fixture
def cell(made):
    """Cell whose arms have no power."""
    cell = made
    yield cell
    for arm in ARMS:
        cell.ask("heal", arm=arm)
        cell.ask("override", arm=arm, robot_mode=None, runtime_state=None, safety_mode=None)
        for mode in range(3, 15):
            cell.ask("release", arm=arm, mode=mode)
        cell.ask("reduce", arm=arm, on=False)
        cell.ask("remote", arm=arm, on=True)
        cell.ask("press", arm=arm, button="power_off")
        cell.wait_until(arm, "robot_mode", 3)
    cell.clock.sleep(0.1)  # after an emergency stop, power is refused until the arm rests


@pytest.fixture
def file(made):
    return made.file


@pytest.fixture
def power_on(made):
    return functools.partial(power.power_on, system=made.system)


@pytest.fixture
def sent(monkeypatch):
    """Commands that are sent to dashboards, without queries."""
    found = []
    ask = DashboardLink.ask

    def listen(link, command):
        if command not in QUERIES:
            found.append((link.where.split()[0], command))
        return ask(link, command)

    monkeypatch.setattr(DashboardLink, "ask", listen)
    return found


QUERIES = ("PolyscopeVersion", "robotmode", "safetystatus", "safetymode", "programState", "is in remote control")


def modes(cell):
    return [cell.ask("state", arm=arm, names=["robot_mode"])["robot_mode"] for arm in ARMS]


def never(question):
    raise AssertionError(f"asked: {question}")


def test_both_arms_are_powered_and_their_brakes_released(cell, file, sent, power_on):
    questions = []
    file = file.replace(left=file.left.replace(payload_kg=1.5))
    assert power_on(file, lambda question: questions.append(question) or True)
    assert modes(cell) == [7, 7]
    assert len(questions) == 1
    assert "left arm (POWER_OFF) and the right arm (POWER_OFF)" in questions[0]
    assert "left 1.5 kg, right not said" in questions[0]
    assert sent == [
        ("left", "power on"),
        ("right", "power on"),
        ("left", "brake release"),
        ("right", "brake release"),
    ]
    sent.clear()
    assert not power_on(file, never)  # nothing to do, and no question
    assert sent == []


def test_only_the_arm_that_needs_it(cell, file, sent, power_on):
    cell.ask("press", arm="left", button="release_brakes")
    cell.ask("press", arm="right", button="power_on")
    cell.wait_until("left", "robot_mode", 7)
    cell.wait_until("right", "robot_mode", 5)
    questions = []
    assert power_on(file, lambda question: questions.append(question) or True)
    assert "left" not in questions[0]
    assert "right arm (IDLE)" in questions[0]
    assert sent == [("right", "brake release")]
    assert modes(cell) == [7, 7]


@pytest.mark.parametrize("answer", [False, None, "yes", 1])
def test_nothing_is_sent_without_confirmation(cell, file, sent, answer, power_on):
    with pytest.raises(OperationRefusedError, match="not confirmed: nothing was switched"):
        power_on(file, lambda question: answer)
    assert sent == []
    assert modes(cell) == [3, 3]


WRONG = [
    ("stop", {"mode": 3}, "right arm.*safety PROTECTIVE_STOP, expected is NORMAL"),
    ("stop", {"mode": 5}, "safety SAFEGUARD_STOP"),
    ("stop", {"mode": 6}, "safety SYSTEM_EMERGENCY_STOP"),
    ("stop", {"mode": 7}, "safety ROBOT_EMERGENCY_STOP"),
    ("stop", {"mode": 8}, "safety VIOLATION"),
    ("stop", {"mode": 9}, "safety FAULT"),
    ("reduce", {}, "safety REDUCED"),
    ("override", {"robot_mode": 2}, "robot mode BOOTING, expected are POWER_OFF, IDLE or RUNNING"),
    ("override", {"robot_mode": 1}, "robot mode CONFIRM_SAFETY"),
    ("override", {"robot_mode": 6}, "robot mode BACKDRIVE"),
    ("override", {"runtime_state": 2}, "program PLAYING.*stop it"),
    ("override", {"runtime_state": 4}, "program PAUSED.*stop it"),
]


@pytest.mark.parametrize(("do", "values", "text"), WRONG)
def test_any_other_fault_of_one_arm_keeps_both_off(cell, file, sent, do, values, text, power_on):
    cell.ask(do, arm="right", **values)
    with pytest.raises(OperationRefusedError, match=f"no arm was given power: .*{text}"):
        power_on(file, never)
    assert sent == []
    assert modes(cell)[0] == 3


def test_all_faults_are_named(cell, file, power_on):
    cell.ask("stop", arm="left", mode=3)
    cell.ask("stop", arm="right", mode=5)
    with pytest.raises(OperationRefusedError, match=r"left arm.*PROTECTIVE_STOP.*right arm.*SAFEGUARD_STOP"):
        power_on(file, never)


def test_local_mode(cell, file, sent, power_on):
    if file.left.family == "cb3":
        pytest.skip("a CB3 has no such mode")
    cell.ask("remote", arm="left", on=False)
    with pytest.raises(OperationRefusedError, match=r"left arm.*local mode.*Remote Control"):
        power_on(file, never)
    assert sent == []


def test_a_fault_during_the_question(cell, file, sent, power_on):
    def answer(question):
        cell.ask("stop", arm="left", mode=7)
        return True

    with pytest.raises(OperationRefusedError, match=r"no arm was given power: left arm.*ROBOT_EMERGENCY_STOP"):
        power_on(file, answer)
    assert sent == []
    assert modes(cell) == [3, 3]


def test_an_arm_that_was_not_in_the_question_is_left_alone(cell, file, sent, power_on):
    cell.ask("press", arm="right", button="release_brakes")
    cell.wait_until("right", "robot_mode", 7)

    def answer(question):
        assert "right" not in question.split("?")[0]
        cell.ask("press", arm="right", button="power_off")
        return True

    with pytest.raises(OperationRefusedError, match=r"right arm.*POWER_OFF, and RUNNING before the question"):
        power_on(file, answer)
    assert sent == []


def test_a_fault_after_power_on_releases_no_brakes(cell, file, sent, monkeypatch, power_on):
    wait = cell.clock.sleep

    def stopped(seconds):
        cell.ask("stop", arm="left", mode=5)
        wait(seconds)

    monkeypatch.setattr(cell.clock, "sleep", stopped)
    with pytest.raises(OperationRefusedError, match=r"left arm.*SAFEGUARD_STOP"):
        power_on(file, lambda question: True)
    assert {command for _, command in sent} == {"power on"}
    monkeypatch.undo()
    cell.wait_until("right", "robot_mode", 5)


def test_an_arm_that_boots_meanwhile(cell, file, monkeypatch, power_on):
    wait, modes_shown = cell.clock.sleep, [2, None]

    def boot(seconds):
        if modes_shown:
            cell.ask("override", arm="left", robot_mode=modes_shown.pop(0))
        wait(seconds)

    monkeypatch.setattr(cell.clock, "sleep", boot)
    assert power_on(file, lambda question: True)
    assert modes_shown == []
    monkeypatch.undo()
    assert modes(cell) == [7, 7]


@pytest.mark.parametrize("limit", ["POWER_S", "BRAKES_S"])
def test_an_arm_that_is_not_ready_in_time(cell, file, monkeypatch, limit, power_on):
    monkeypatch.setattr(power, limit, 0.0)
    expected = "IDLE" if limit == "POWER_S" else "RUNNING"
    with pytest.raises(LinkError, match=rf"robot mode \w+ after 0 s, expected is {expected}"):
        power_on(file, lambda question: True)


def test_a_controller_that_refuses(cell, file, monkeypatch, power_on):
    ask = DashboardLink.ask

    def refuse(link, command):
        return "Failed to execute: power on" if command == "power on" else ask(link, command)

    monkeypatch.setattr(DashboardLink, "ask", refuse)
    with pytest.raises(
        OperationRefusedError, match=r"answers 'Failed to execute: power on'.*expected is 'Powering on'"
    ):
        power_on(file, lambda question: True)


@pytest.mark.parametrize("fault", ["refuse", "mute", "drop"])
def test_a_dashboard_that_is_lost(cell, file, sent, fault, power_on):
    def break_it(question=""):
        if fault == "mute":
            cell.ask("link", arm="right", port="dashboard", mute=True)
        else:
            cell.ask("refuse", arm="right", port="dashboard")
            cell.ask("drop", arm="right", port="dashboard")
        return True

    confirm = break_it if fault == "drop" else never
    if fault != "drop":
        break_it()
    with pytest.raises(LinkError, match="right arm, dashboard"):
        power_on(file, confirm)
    assert sent == []
    assert modes(cell) == [3, 3]
