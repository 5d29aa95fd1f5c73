"""Grippers of a cell: links, threads that delay nothing, and the loss of a gripper."""

import contextlib
import dataclasses

import pytest
from hypothesis import given
from hypothesis import strategies as st

from dual_ur10.errors import ActionError, ClosedError, LinkError, OperationRefusedError, SettingsError
from dual_ur10.sim2real.cell_file.tables import DigitalGripper, NoGripper, OwnGripper
from dual_ur10.sim2real.peripherals.digital_gripper import OUTPUTS, DigitalGripperLink
from dual_ur10.sim2real.peripherals.gripper_link import (
    FAULTS,
    GripperLink,
    GripperReading,
    RobotiqLink,
    counts_of,
    force_counts,
    opening_of,
)
from dual_ur10.sim2real.peripherals.grippers import Grippers, GripperThread, link_to
from dual_ur10.testing import VirtualCell
from tests import waiting
from tests.links.fake_servers import exactly, serving, until_closed
from ur_core.links.rtde_link import RtdeClient
from ur_core.protocol.rtde import Kind
from ur_core.tools.generic_140 import GENERIC_140
from ur_core.tools.robotiq_2f85 import ROBOTIQ_2F85 as TOOL

HERE = "127.0.0.1"
WEAK = dataclasses.replace(TOOL, name="weak", force_n=(5.0, 50.0))


def yes(question):
    assert "keep hands away" in question
    return True


def never(question):
    raise AssertionError(f"asked: {question}")


@pytest.fixture
def grippers(cell, file, until, system):
    with Grippers(file, system=system, force_n=100.0) as grippers:
        grippers.activate(yes)
        grippers.command((TOOL.stroke_m, TOOL.stroke_m), 0.0)
        until(lambda: min(grippers.opening_m) > 0.98 * TOOL.stroke_m)
        yield grippers


@contextlib.contextmanager
def robotiq_link(answers, heard=None):
    with (
        serving(lambda connection: robotiq(connection, answers, heard)) as port,
        RobotiqLink(HERE, port, 127.5) as link,
    ):
        yield link


def register(link, name):
    return link._get(name, link._clock.now_s() + 1.0)


# Numbers.


@given(st.integers(0, 255))
def test_counts_and_openings_belong_together(counts):
    assert counts_of(opening_of(counts, TOOL.stroke_m), TOOL.stroke_m) == counts
    assert 0.0 <= opening_of(counts, TOOL.stroke_m) <= TOOL.stroke_m


@given(st.floats(-0.01, 0.1))
def test_an_opening_is_met_within_half_a_step(opening_m):
    met = min(max(opening_m, 0.0), TOOL.stroke_m)
    assert abs(opening_of(counts_of(opening_m, TOOL.stroke_m), TOOL.stroke_m) - met) <= TOOL.stroke_m / 510 + 1e-12


def test_forces():
    assert force_counts(TOOL.force_n[0], TOOL) == 0
    assert force_counts(TOOL.force_n[1], TOOL) == 255
    assert force_counts(127.5, TOOL) == 128
    for force in (19.9, 235.1, float("nan")):
        with pytest.raises(SettingsError, match="20 to 235 N"):
            force_counts(force, TOOL)


# On the emulated cell.


def test_nothing_is_sent_without_a_request():
    with VirtualCell(task="Handover", plant="nominal") as cell:
        with Grippers(cell.file, system=cell.system) as grippers:
            assert [each.needs_activation() for each in grippers.each] == [True, True]
            assert "left arm" in grippers.fault
            assert "not activated (STA 0, expected 3)" in grippers.fault
            with pytest.raises(OperationRefusedError, match=r"left gripper.*not confirmed"):
                grippers.activate(lambda question: False)
            with pytest.raises(OperationRefusedError):
                grippers.activate(lambda question: "yes")  # only True is
            # Refused activations changed nothing.
            assert [each.needs_activation() for each in grippers.each] == [True, True]
            # A command to an inactive gripper is a fault, and does not end the thread.
            grippers.command((0.02, None), 0.0)
            waiting.until(lambda: "FLT 7: it has to be activated" in grippers.fault, clock=cell.clock)
            asked = []
            grippers.activate(lambda question: asked.append(question) or True)
            assert len(asked) == 2
            assert grippers.fault == ""
            grippers.activate(never)  # active grippers are left alone
        with RobotiqLink(cell.left, 63352, system=cell.system) as link:
            assert not link.needs_activation()  # closing sent nothing


def test_a_command_is_sent_when_it_is_due(grippers, until, clock, system, cell):
    begin = clock.now_s()
    grippers.command((0.03, 0.02), begin + 0.4)
    assert clock.now_s() - begin < 0.3  # it did not wait
    with RobotiqLink(cell.left, 63352, system=system) as other:
        while clock.now_s() < begin + 0.3:
            assert register(other, "PRE") == 0
            clock.sleep(0.01)
        until(lambda: register(other, "PRE") == counts_of(0.03, TOOL.stroke_m))
        assert clock.now_s() >= begin + 0.4
        assert register(other, "FOR") == force_counts(100.0, TOOL)
    until(lambda: grippers.opening_m == pytest.approx((0.03, 0.02), abs=0.002))
    assert grippers.fault == ""
    assert all(each._read_s > begin for each in grippers.each)


def test_a_held_object_stays_held(cell, file, until, system):
    with Grippers(file, system=system) as grippers:
        grippers.activate(yes)
        grippers.command((0.02, TOOL.stroke_m), 0.0)
        until(lambda: abs(grippers.opening_m[0] - 0.02) < 0.001)
    with Grippers(file, system=system) as grippers:
        assert grippers.opening_m[0] == pytest.approx(0.02, abs=0.001)
        grippers.activate(never)
        assert grippers.fault == ""
        grippers.command((TOOL.stroke_m, TOOL.stroke_m), 0.0)


def test_a_gripper_without_power_needs_activation(grippers, cell, until):
    cell.ask("press", arm="left", button="power_off")
    try:
        until(lambda: "the controller does not reach its gripper" in grippers.fault)
        assert "right" not in grippers.fault
    finally:
        cell.ask("press", arm="left", button="release_brakes")
    cell.wait_until("left", "robot_mode", 7)
    until(lambda: "not activated" in grippers.fault)
    grippers.activate(yes)
    assert grippers.fault == ""


@pytest.mark.parametrize("reset", [False, True])
def test_a_lost_gripper_is_named_and_the_other_goes_on(grippers, cell, reset, until, clock):
    cell.ask("drop", arm="left", port="gripper", reset=reset)
    until(lambda: grippers.fault)
    assert "left arm, Robotiq gripper at" in grippers.fault
    assert "right" not in grippers.fault
    until(lambda: cell.ask("clients", arm="left")["gripper"] == [])
    grippers.command((0.01, 0.04), 0.0)  # no error here: `fault` reports it
    until(lambda: abs(grippers.opening_m[1] - 0.04) < 0.001)
    assert grippers.opening_m[0] > 0.08
    clock.sleep(0.1)
    assert cell.ask("clients", arm="left")["gripper"] == []  # nothing connects again
    with pytest.raises(LinkError, match="left arm, Robotiq gripper"):
        grippers.activate(never)


def test_a_silent_gripper_is_lost_and_delays_nothing(grippers, cell, until, clock):
    cell.ask("link", arm="right", port="gripper", mute=True)
    until(lambda: grippers.fault, within_s=5.0)
    assert "right arm, Robotiq gripper" in grippers.fault
    assert "no answer in time" in grippers.fault
    begin = clock.now_s()
    for _ in range(1000):
        grippers.command((0.05, 0.05), begin)
        assert grippers.fault
    assert grippers.each[0].fault == ""


def test_a_port_that_is_closed_connects_none(cell, file, until, system):
    cell.ask("refuse", arm="right", port="gripper")
    with pytest.raises(LinkError, match=r"right arm, Robotiq gripper.*refused"):
        Grippers(file, system=system)
    until(lambda: cell.ask("clients", arm="left")["gripper"] == [])


def test_no_gripper(file, system):
    arms = {name: getattr(file, name).replace(gripper=NoGripper()) for name in ("left", "right")}
    with Grippers(file.replace(**arms), system=system) as grippers:
        grippers.command((0.01, 0.01), 0.0)
        grippers.activate(never)
        assert grippers.opening_m == (None, None)
        assert grippers.fault == ""


# The Robotiq protocol, against faulty servers.


def robotiq(connection, answers, heard=None):
    """Answer GETs from a mapping, whose keys may end with the last value of ACT; acknowledge SETs."""
    rest, active = b"", ""
    while True:
        while b"\n" not in rest:
            data = connection.recv(1000)
            if not data:
                return
            rest += data
        line, rest = rest.split(b"\n", 1)
        verb, word, *values = line.decode().split()
        if verb == "GET":
            connection.sendall(answers.get(word + active, answers.get(word, f"{word} 0\n")).encode())
            continue
        active = values[0] if word == "ACT" else active
        if heard is not None:
            heard.append(line.decode())
        connection.sendall(answers["SET"].encode())


@pytest.mark.parametrize("ack", ["ack", "ack\n", "ack\r\n"])
def test_an_ack_with_or_without_an_end(ack):
    answers = {"STA": "STA 3\n", "POS": "POS 51\n", "OBJ": "OBJ 2\n", "SET": ack}
    with robotiq_link(answers) as link:
        for opening_m in (0.02, 0.03, 0.04):
            assert link.command(opening_m)
            assert link.read() == GripperReading(pytest.approx(0.8 * TOOL.stroke_m), "", True)


@pytest.mark.parametrize(
    ("name", "answer", "text"),
    [
        ("STA", "STA ?\n", None),
        ("STA", "STA 256\n", "expected is 'STA ' and a number"),
        ("STA", "POS 3\n", "expected is 'STA ' and a number"),
        ("STA", "STA -1\n", "expected is 'STA ' and a number"),
        ("STA", "x" * 300, "no Robotiq gripper"),
    ],
)
def test_an_answer_that_is_not_valid(name, answer, text):
    with serving(lambda connection: robotiq(connection, {name: answer, "SET": "ack"})) as port:
        if text is None:
            link = RobotiqLink(HERE, port)
            assert "does not reach its gripper" in link.read().fault
            link.close()
        else:
            with pytest.raises(LinkError, match=text):
                RobotiqLink(HERE, port)


def test_a_command_that_is_not_accepted():
    with robotiq_link({"SET": "?\n"}) as link, pytest.raises(LinkError, match=r"answers '\?' to 'SET POS"):
        link.command(0.01)


@pytest.mark.parametrize("code", [*sorted(FAULTS), 1, 0x53])
def test_faults_are_explained(code):
    with robotiq_link({"STA": "STA 3\n", "FLT": f"FLT {code}\n"}) as link:
        text = link.read().fault
        assert text.startswith(f"FLT {code}: ")
        assert ("does not list" in text) == (code & 15 not in FAULTS)
        assert link.needs_activation() == (code & 15 > 5)


def test_an_activation_that_does_not_end():
    with robotiq_link({"SET": "ack"}) as link, pytest.raises(LinkError, match=r"not active after 0.1 s"):
        link.activate(0.1)


def test_an_activation_begins_with_a_reset():
    heard = []
    answers = {"SET": "ack", "STA": "STA 3\n", "STA0": "STA 0\n", "STA1": "STA 3\n"}
    with robotiq_link(answers, heard) as link:
        link.activate(5.0)
    assert heard == ["SET ACT 0", "SET ACT 1"]


def test_a_command_is_sent_once_and_again_after_an_activation():
    heard = []
    answers = {"SET": "ack", "STA": "STA 3\n", "STA0": "STA 0\n", "STA1": "STA 3\n"}
    with robotiq_link(answers, heard) as link:
        step_m = TOOL.stroke_m / 255
        commands = (0.0, 0.4 * step_m, step_m, step_m, 0.0)
        assert [link.command(opening_m) for opening_m in commands] == [True, False, True, False, True]
        link.activate(5.0)
        assert link.command(0.0)
        link.forget()  # since somebody may have moved it
        assert link.command(0.0)
    positions = [line for line in heard if "POS" in line]
    assert positions == [f"SET POS {counts} SPE 255 FOR 128 GTO 1" for counts in (255, 254, 255, 255, 255)]


def test_an_interrupted_request_closes_the_connection(monkeypatch):
    answers = {"SET": "ack", "STA": "STA 3\n"}
    with serving(lambda connection: robotiq(connection, answers)) as port:
        link = RobotiqLink(HERE, port)

        def interrupted(deadline_s):
            raise KeyboardInterrupt

        monkeypatch.setattr(link._socket, "receive", interrupted)
        with pytest.raises(KeyboardInterrupt):
            link.needs_activation()
        monkeypatch.undo()
        with pytest.raises(ClosedError):
            link.read()


def test_nothing_else_is_sent():
    heard = []

    def talk(connection):
        heard.append(exactly(connection, 8))
        connection.sendall(b"STA 3\n")
        heard.append(until_closed(connection))

    with serving(talk) as port:
        RobotiqLink(HERE, port).close()
    assert heard == [b"GET STA\n", b""]


# The thread.


class Link:
    """Link that records commands, and fails on demand."""

    where, tool = "a gripper", TOOL

    def __init__(self, system):
        self.clock = system.clock
        self.sent, self.closed, self.error, self.fault = [], False, None, ""
        self.gate = system.event()
        self.gate.set()

    def read(self):
        self.gate.wait(10.0)
        if self.error is not None:
            raise self.error
        return GripperReading(0.05, self.fault, False)

    def command(self, opening_m):
        self.sent.append((opening_m, self.clock.now_s()))
        return True

    def forget(self):
        self.sent.clear()

    def needs_activation(self):
        return False

    def activate(self, within_s):
        self.clock.sleep(0.05)

    def close(self):
        self.closed = True


@pytest.fixture
def link(system):
    return Link(system)


@pytest.fixture
def thread(link, system):
    thread = GripperThread("left", link, 0.005, system=system)
    yield thread
    link.gate.set()
    thread.close()
    assert link.closed


def test_commands_are_sent_in_order(thread, link, until, clock):
    """Each is given before the one before it is due: none starves."""
    begin = clock.now_s()
    for number in range(5):
        thread.command(0.01 * number, begin + 0.1 + 0.05 * number)
    until(lambda: len(link.sent) == 5)
    assert [opening_m for opening_m, _ in link.sent] == pytest.approx([0.0, 0.01, 0.02, 0.03, 0.04])
    assert all(at_s >= begin + 0.1 + 0.05 * number for number, (_, at_s) in enumerate(link.sent))


def test_a_later_call_drops_commands_for_later(thread, link, until, clock):
    begin = clock.now_s()
    thread.command(0.01, begin + 0.2)
    thread.command(0.02, begin + 0.3)
    thread.command(0.03, begin + 0.15)
    until(lambda: link.sent)
    clock.sleep(max(0.0, begin + 0.35 - clock.now_s()))
    assert [opening_m for opening_m, _ in link.sent] == [0.03]


def test_of_several_that_are_due_the_last_is_sent(thread, link, until, clock):
    link.gate.clear()  # the gripper answers late
    clock.sleep(0.05)
    begin = clock.now_s()
    for number in range(100):
        thread.command(number * 1e-4, begin - 1.0 + number * 1e-3)
    link.gate.set()
    until(lambda: link.sent)
    clock.sleep(0.05)
    assert [opening_m for opening_m, _ in link.sent] == [99e-4]


def test_a_command_that_is_not_permitted_when_due_is_not_sent(link, until, clock, system):
    """As after a stop of both arms: a held object stays held."""
    allowed = True
    thread = GripperThread("left", link, 0.005, permitted=lambda: allowed, system=system)
    thread.command(0.01, clock.now_s())
    until(lambda: link.sent)
    thread.command(0.08, clock.now_s() + 0.1)
    allowed = False
    clock.sleep(0.2)
    allowed = True
    clock.sleep(0.05)
    assert [opening_m for opening_m, _ in link.sent] == [0.01]
    link.gate.set()
    thread.close()


def test_an_activation_drops_waiting_commands(thread, link, until, clock):
    thread.command(0.01, clock.now_s() + 0.02)
    thread.activate()
    clock.sleep(0.1)
    assert link.sent == []
    thread.command(0.02, 0.0)
    until(lambda: link.sent)


def test_a_stuck_gripper_is_reported_and_delays_nothing(thread, link, monkeypatch, until):
    monkeypatch.setattr("dual_ur10.sim2real.peripherals.grippers.STALE_S", 0.1)
    assert thread.fault == ""
    link.gate.clear()
    until(lambda: "not heard for" in thread.fault)
    thread.command(0.01, 0.0)
    link.gate.set()
    until(lambda: thread.fault == "")
    until(lambda: link.sent)


def test_a_fault_is_reported_as_long_as_it_lasts(thread, link, until):
    link.fault = "FLT 8: too hot"
    until(lambda: thread.fault == "a gripper: FLT 8: too hot")
    link.fault = ""
    until(lambda: thread.fault == "")


@pytest.mark.parametrize("error", [LinkError("gone"), RuntimeError("a mistake")])
def test_a_thread_that_ends_reports_its_reason(thread, link, error, until, clock):
    link.error = error
    until(lambda: thread.fault)
    assert str(error) in thread.fault
    link.error = None
    clock.sleep(0.05)
    assert str(error) in thread.fault
    with pytest.raises(LinkError, match=str(error)):
        thread.needs_activation()
    assert link.closed


@pytest.mark.parametrize("opening_m", [-0.001, 0.086, float("nan"), float("inf")])
def test_openings_that_are_not_legal(thread, link, opening_m):
    with pytest.raises(ActionError, match="left gripper"):
        thread.command(opening_m, 0.0)
    with pytest.raises(ActionError, match="finite time"):
        thread.command(0.01, float("nan"))
    assert link.sent == []


def test_a_closed_gripper(link, clock, system):
    thread = GripperThread("left", link, 0.005, system=system)
    thread.command(0.01, clock.now_s() + 0.05)
    thread.close()
    thread.close()
    clock.sleep(0.1)
    assert link.sent == []  # waiting commands included
    assert thread.fault == ""
    for act in (thread.needs_activation, thread.activate, lambda: thread.command(0.01, 0.0)):
        with pytest.raises(ClosedError):
            act()


# A driver of one's own.


class Own(GripperLink):
    """Driver of a laboratory, whose answers are given."""

    drives = {"stroke_m": (0.0, 0.1), "force_n": (10.0, 240.0)}  # noqa: RUF012  # as drivers state it
    answer = "0.03", "", None
    where = "never shown"

    def __init__(self, request, port=80, broken=False):
        self.request, self.port, self.calls = request, port, []
        if broken:
            raise OSError("no such device")

    def read(self):
        return self.answer() if callable(self.answer) else self.answer

    def command(self, opening_m):
        self.calls.append(opening_m)

    def forget(self):
        self.calls.append("forget")

    def needs_activation(self):
        return 1 / 0

    def activate(self, within_s):
        self.calls.append(within_s)

    def close(self):
        self.calls.append("close")


class Wide(Own):
    drives = {"width_m": (0.0, 1.0)}  # noqa: RUF012


def own_link(file, system, driver=f"{__name__}:Own", tool="robotiq_2f85", options=""):
    entry = OwnGripper(driver=driver, tool=tool, options=options)
    return link_to(file.left.replace(gripper=entry), 60.0, "left", system)


def test_a_driver_of_ones_own(file, system):
    link = own_link(file, system, options="port=81")
    made = link.link
    assert (made.request.arm, made.request.host, made.request.tool, made.request.force_n, made.request.system) == (
        "left",
        file.left.host,
        TOOL,
        60.0,
        system,
    )
    assert (made.port, link.tool, link.read()) == (81, TOOL, GripperReading(0.03, "", None))
    assert link.command(0.02) is False
    link.forget()
    link.activate(2.0)
    with pytest.raises(LinkError, match=r"left gripper: the driver .*:Own: ZeroDivisionError"):
        link.needs_activation()
    link.close()
    assert made.calls == [0.02, "forget", 2.0, "close"]


@pytest.mark.parametrize(
    ("changes", "error", "text"),
    [
        ({"driver": "no_such_module:X"}, SettingsError, "the driver of the left gripper, .* cannot be imported"),
        ({"driver": f"{__name__}:HERE"}, SettingsError, "HERE is no subclass of GripperLink"),
        ({"driver": f"{__name__}:Wide"}, SettingsError, "drives has 'width_m', allowed are stroke_m, speed_m_s, force"),
        ({"tool": "generic_140"}, SettingsError, "stroke_m of 0 to 0.1, and the tool 'generic_140' has 0.14: name"),
        ({"tool": f"{__name__}:WEAK"}, SettingsError, "force_n of 10 to 240, and the tool 'weak' has 5 to 50"),
        ({"options": "colour=red"}, SettingsError, "cannot be made of a request and the options colour=red"),
        ({"options": "broken=true"}, LinkError, "left gripper: the driver .*OSError.*no such device"),
    ],
)
def test_a_driver_that_does_not_fit_is_refused(file, system, changes, error, text):
    with pytest.raises(error, match=text):
        own_link(file, system, **changes)


@pytest.mark.parametrize(
    ("answer", "text"),
    [
        (lambda: 1 / 0, "ZeroDivisionError"),
        (None, "TypeError"),
        (GripperReading("wide", "", None), "ValueError"),
        (GripperReading(float("nan"), "", None), "an opening of nan m; expected are 0 to 0.085 m"),
        (GripperReading(85.0, "", None), "an opening of 85.0 m"),
        (GripperReading(-0.02, "", None), "an opening of -0.02 m"),
        (GripperReading(0.03, None, None), "found the fault None"),
    ],
)
def test_what_a_driver_of_ones_own_gets_wrong_is_a_lost_gripper(file, system, monkeypatch, answer, text):
    monkeypatch.setattr(Own, "answer", staticmethod(answer) if callable(answer) else answer)
    with pytest.raises(LinkError, match=f"left gripper: the driver .*:Own: .*{text}"):
        own_link(file, system).read()


# A gripper at a digital output.


@pytest.mark.parametrize(
    ("output", "open_level"), [(0, True), (7, False), (8, True), (15, True), (16, False), (17, True)]
)
def test_a_digital_output(cell, output, open_level, until, clock, system):
    def level():
        return bool(cell.ask("state", arm="left", names=[OUTPUTS])[OUTPUTS] >> output & 1)

    others = cell.ask("state", arm="left", names=[OUTPUTS])[OUTPUTS] & ~(1 << output)
    before = level()
    gripper = DigitalGripper(output=output, open_level=open_level)
    with DigitalGripperLink(cell.left, gripper, name="left", system=system) as link:
        assert level() == before  # nothing is sent by itself
        assert not link.needs_activation()
        assert f"gripper at output {output}" in link.where
        for opening_m, opens in ((TOOL.stroke_m, True), (0.0, False), (0.06, True)):
            link.command(opening_m)
            until(lambda opens=opens: level() == (opens == open_level))
            until(lambda opens=opens: link.read() == GripperReading(TOOL.stroke_m if opens else 0.0, "", None))
            assert not link.command(opening_m)  # no change
            link.forget()
            assert link.command(opening_m)
            assert not link.command(0.5 * TOOL.stroke_m)  # hysteresis
        kept = level()
    clock.sleep(0.1)
    assert level() == kept  # closing sends nothing
    assert cell.ask("state", arm="left", names=[OUTPUTS])[OUTPUTS] & ~(1 << output) == others


@pytest.mark.parametrize("tool", [TOOL, GENERIC_140], ids=lambda each: each.name)
def test_a_digital_gripper_of_the_cell_file(cell, file, until, system, tool):
    left = file.left.replace(gripper=DigitalGripper(output=3, open_level=True, tool=tool.name))
    with Grippers(file.replace(left=left), system=system) as grippers:
        with pytest.raises(ActionError, match=f"allowed are 0 to {tool.stroke_m} m"):
            grippers.command((tool.stroke_m + 0.001, None), 0.0)
        grippers.command((tool.stroke_m, None), 0.0)
        until(lambda: grippers.opening_m[0] == tool.stroke_m)
        grippers.command((0.0, None), 0.0)
        until(lambda: grippers.opening_m[0] == 0.0)
        cell.ask("link", arm="left", port="rtde", mute=True)
        until(lambda: "left arm, RTDE" in grippers.fault)
    assert link_to(file.left.replace(gripper=NoGripper()), 60.0) is None


def test_outputs_in_use_by_another_client(cell, clock, system):
    names = ("standard_digital_output_mask", "standard_digital_output")
    end_s = clock.now_s() + 5.0
    client = RtdeClient("", cell.left, 30004, end_s, system=system)
    try:
        client.set_up(Kind.SETUP_INPUTS, names, b"", end_s)
        with pytest.raises(LinkError, match="standard digital outputs are in use"):
            DigitalGripperLink(cell.left, DigitalGripper(output=1), system=system)
        DigitalGripperLink(cell.left, DigitalGripper(output=9), system=system).close()  # another group is free
    finally:
        client.socket.close_and_wait(end_s)


def test_registers_are_left_to_others(cell, clock, system):
    """A link leaves all registers free that commands need."""
    from dual_ur10.sim2real.commissioning.doctor import REGISTERS

    with DigitalGripperLink(cell.left, DigitalGripper(output=1), system=system):
        end_s = clock.now_s() + 5.0
        client = RtdeClient("", cell.left, 30004, end_s, system=system)
        try:
            _, kinds = client.set_up(Kind.SETUP_INPUTS, REGISTERS, b"", end_s)
            assert "IN_USE" not in kinds
        finally:
            client.socket.close_and_wait(end_s)


def test_an_output_that_something_else_sets(cell, monkeypatch, until, system):
    monkeypatch.setattr("dual_ur10.sim2real.peripherals.digital_gripper.CHANGE_S", 0.1)
    with DigitalGripperLink(cell.left, DigitalGripper(output=2, open_level=True), system=system) as link:
        link.command(TOOL.stroke_m)
        cell.ask("override", arm="left", **{OUTPUTS: 0})
        try:
            found = until(lambda: link.read().fault)
            assert "output 2 does not open the gripper" in found
        finally:
            cell.ask("override", arm="left", **{OUTPUTS: None})


@pytest.mark.parametrize("fault", ["drop", "mute"])
def test_a_lost_controller(cell, fault, until, system):
    with DigitalGripperLink(cell.right, DigitalGripper(output=2), name="right", system=system) as link:
        link.read()
        if fault == "drop":
            cell.ask("drop", arm="right", port="rtde")
        else:
            cell.ask("link", arm="right", port="rtde", mute=True)

        def lost():
            try:
                link.read()
            except LinkError as error:
                return str(error)
            return ""

        text = until(lost)
        assert "right arm, RTDE" in text
        assert ("stalls" in text) == (fault == "mute")


def test_the_sending_connection_alone_is_lost(cell, until, system):
    with DigitalGripperLink(cell.right, DigitalGripper(output=2), system=system) as link:
        link._sender.socket._open.end_sending()
        with pytest.raises(LinkError):
            until(lambda: link.read() is None)
