"""The doctor passes an arm in order, and names each fault with its remedy."""

import dataclasses
import functools
import json
import re
import sys

import numpy as np
import pytest
from typer.testing import CliRunner

from dual_ur10.cli import main as cli
from dual_ur10.errors import SettingsError, UnknownNameError
from dual_ur10.sim2real.cell_file.cell_file import CellFile
from dual_ur10.sim2real.commissioning import doctor
from dual_ur10.sim2real.commissioning.doctor import REGISTERS, Route
from dual_ur10.sim2real.commissioning.findings import (
    ExpectedArm,
    Finding,
    SeenArm,
    any_fails,
    calibration_findings,
    flange_error_m,
    processor_finding,
    round_trip_findings,
    safety_findings,
    stream_findings,
    swap_finding,
    tool_findings,
)
from dual_ur10.testing import VirtualCell
from tests.ur_emulator.statuses import status_of
from ur_core.kinematics.robots import MODEL_OF_FAMILY
from ur_core.kinematics.ur10 import DH_A_M, NOMINAL_DH, nominal_dh
from ur_core.links.primary_link import PrimaryFacts
from ur_core.links.rtde_link import RtdeClient
from ur_core.links.rtde_stream import Sample
from ur_core.processes.system import LOCAL
from ur_core.protocol.primary_packet import kinematics_checksums
from ur_core.protocol.rtde import Kind
from ur_emulator.profile import PROFILES

TIMED = {"RTDE rate", "RTDE jitter", "round trip"}

SAFETY = PROFILES["cb3"].safety_checksum
BARE = {
    "dh": NOMINAL_DH, "tcp": (0.0,) * 6, "payload_kg": 0.0, "payload_cog_m": (0.0,) * 3, "safety_checksum": SAFETY,
}  # fmt: skip


def expected(cell, arm="left", **values):
    family = cell.description[arm]["family"]
    bare = BARE | {"dh": nominal_dh(MODEL_OF_FAMILY[family])}
    return ExpectedArm(**{"host": getattr(cell, arm), "family": family, **bare, **values})


def check_cell(cell, left, right, **options):
    return doctor.check_cell(left, right, observe_s=0.05, system=cell.system, **options)


def findings_of(cell, timeout_s=1.5, **values):
    """Findings of the left arm by name."""
    findings = doctor.check_arm(
        "left", expected(cell, **values), timeout_s=timeout_s, observe_s=0.05, system=cell.system
    )
    assert all(each.arm == "left" for each in findings)
    assert len({each.name for each in findings}) == len(findings)
    return {each.name: each for each in findings}


def faults(findings):
    return {name: each for name, each in findings.items() if each.level != "ok"}


ALL = {
    "ports", "calibration", "family", "robot mode", "safety mode", "program", "speed slider", "at rest", "TCP",
    "payload", "registers", "model", "robot type", "safety checksum", *TIMED,
}  # fmt: skip


def test_a_cb3_in_order(cb3):
    findings = findings_of(cb3)
    assert faults(findings) == {}
    assert findings.keys() == ALL
    assert findings["family"].found == "cb3, software 3.15.8.106339"


def test_an_e_series_controller_in_order(e_series):
    findings = findings_of(e_series, serial_number="2021500001", checksums=kinematics_checksums(nominal_dh("ur10e")))
    assert faults(findings) == {}
    assert findings.keys() == ALL | {"remote control", "serial number", "calibration checksums"}


def test_both_arms_in_order(e_series):
    findings = check_cell(e_series, expected(e_series), expected(e_series, "right"))
    assert [each for each in findings if each.level != "ok"] == []
    assert {each.arm for each in findings} == {"cell", "left", "right"}
    assert {each.name for each in findings} >= set(TIMED)


def test_nothing_is_left_behind(cb3):
    before = cb3.ask("state", arm="left")
    for _ in range(3):  # the registers of the last time are free again
        assert findings_of(cb3)["registers"].level == "ok"
    assert not any(cb3.ask("clients", arm="left").values())
    after = cb3.ask("state", arm="left")
    names = ("robot_mode", "safety_mode", "runtime_state", "target_q", "actual_digital_output_bits", "payload")
    assert {name: after[name] for name in names} == {name: before[name] for name in names}


def test_values_without_expectation_are_reported_with_a_warning(cb3):
    findings = faults(findings_of(cb3, dh=None, tcp=None, payload_kg=None, safety_checksum=None))
    assert findings.keys() == {"calibration", "TCP", "payload", "safety checksum"}
    assert {each.level for each in findings.values()} == {"warn"}
    assert "0.000 mm off the nominal" in findings["calibration"].found
    assert f"safety_checksum = 0x{SAFETY:08x} in the cell file" in findings["safety checksum"].remedy


# One fault.


@pytest.mark.parametrize(
    ("values", "name", "found", "remedy"),
    [
        ({"robot_mode": 3}, "robot mode", "3 (POWER_OFF)", "power the arm on"),
        ({"robot_mode": 5}, "robot mode", "5 (IDLE)", "brakes"),
        ({"safety_mode": 3}, "safety mode", "3 (PROTECTIVE_STOP)", "cause"),
        ({"safety_mode": 2}, "safety mode", "2 (REDUCED)", "clear it"),
        ({"safety_mode": 21}, "safety mode", "21 (unknown)", "cause"),
        ({"safety_status_bits": 0x401}, "status bits", "stopped due to safety", "cause"),
        ({"robot_status_bits": 5}, "status bits", "freedrive", "cause"),
        ({"runtime_state": 2}, "program", "2 (PLAYING)", "stop the program"),
        ({"runtime_state": 4}, "program", "4 (PAUSED)", "stop the program"),
        ({"target_speed_fraction": 0.5}, "speed slider", "50 %", "100 %"),
        ({"actual_qd": [0, 0, 0, -0.1, 0, 0]}, "at rest", "0.1000 rad/s", "wait"),
        ({"payload": 1.0}, "payload", "1.000 kg", "installation"),
        ({"tcp_offset": [0, 0, 0.01, 0, 0, 0]}, "TCP", "0.01", "installation"),
        ({"tcp_offset": [0, 0, 0, 0, 0.1, 0]}, "TCP", "0.1", "installation"),
    ],
)
def test_a_wrong_state(cb3, values, name, found, remedy):
    cb3.ask("override", arm="left", **values)
    findings = faults(findings_of(cb3))
    assert findings.keys() == {name}
    assert findings[name].level == "fail"
    assert found in findings[name].found
    assert remedy in findings[name].remedy
    assert findings[name].expected
    assert findings[name].message.startswith(f"left, {name}: ")


def test_the_slider_itself(cb3):
    cb3.ask("slider", arm="left", fraction=0.1)
    assert faults(findings_of(cb3))["speed slider"].found == "10 %"


def test_local_control(e_series):
    e_series.ask("remote", arm="left", on=False)
    findings = faults(findings_of(e_series))
    assert findings.keys() == {"remote control"}
    assert findings["remote control"].remedy == "switch left to Remote Control on its pendant"


@pytest.mark.parametrize(
    ("reported", "names", "found"),
    [
        ({"model": "UR5", "robot_type": 1}, {"model", "robot type"}, ("UR5", "1 (UR5 or UR5e or UR7e)")),
        ({"model": "UR10e"}, {"model"}, ("UR10e",)),
        ({"robot_type": 12}, {"robot type"}, ("12 (unknown)",)),
        ({"version": [5, 12, 0, 1]}, {"family", "remote control", "RTDE rate"}, ("e-series, software 5.12.0.1",)),
    ],
)
def test_another_robot(cb3, reported, names, found):
    cb3.ask("remote", arm="left", on=False)
    cb3.ask("pretend", arm="left", **reported)
    findings = faults(findings_of(cb3))
    assert findings.keys() == names
    assert {each.level for each in findings.values()} == {"fail"}
    assert {*found} <= {each.found for each in findings.values()}


def test_an_old_controller_has_no_serial_number_and_no_model(cb3):
    cb3.ask("pretend", arm="left", version=[3, 10, 0, 1])
    findings = findings_of(cb3, serial_number="1")
    cell = check_cell(cb3, expected(cb3), expected(cb3, "right"))[0]
    assert faults(findings).keys() == {"serial number"}
    assert (findings["serial number"].level, findings["serial number"].found) == (
        "warn",
        "not reported by this software",
    )
    assert "model" not in findings
    assert findings["robot type"].level == "ok"
    assert (cell.level, "could not be compared" in cell.found) == ("ok", True)


def test_an_old_controller_does_not_report_its_tool():
    status = status_of()._replace(payload_kg=None, payload_cog_m=None, tcp_offset=None)
    findings = list(tool_findings("left", ExpectedArm(host="127.0.0.1", **BARE), status))
    assert [each.name for each in findings] == ["TCP", "payload"]
    assert {each.level for each in findings} == {"warn"}
    assert {each.found for each in findings} == {"not reported by this software"}


def test_another_arm_of_the_same_kind(e_series):
    findings = faults(findings_of(e_series, serial_number="2021500002", checksums=(1, 2, 3, 4, 5, 6)))
    assert findings.keys() == {"serial number", "calibration checksums"}
    assert "swapped" in findings["serial number"].remedy


@pytest.mark.parametrize(("error_m", "level"), [(0.00002, "ok"), (0.0002, "warn"), (0.003, "fail")])
def test_another_calibration(cb3, error_m, level):
    cb3.ask("calibration", arm="left", error_m=error_m)
    finding = findings_of(cb3)["calibration"]
    assert finding.level == level
    assert "nominal UR10's, which the cell file uses" in finding.found  # it gives no other
    off_m = float(re.search(r"([\d.]+) mm", finding.found)[1]) / 1e3
    assert error_m <= off_m <= 2 * error_m + 1e-6


def test_registers_in_use(cb3):
    deadline_s = cb3.clock.now_s() + 20.0
    client = RtdeClient("", cb3.left, 30004, deadline_s, system=cb3.system)
    number, _ = client.set_up(Kind.SETUP_INPUTS, REGISTERS[3:5], b"", deadline_s)
    assert number == 1
    findings = faults(findings_of(cb3))
    client.socket.close_and_wait(deadline_s)
    assert findings.keys() == {"registers"}
    assert findings["registers"].found == "in use: input_int_register_3 and 1 more"
    assert "EtherNet/IP" in findings["registers"].remedy
    assert faults(findings_of(cb3)) == {}


# The network.


def test_a_closed_port_is_named_and_the_rest_is_checked(cb3):
    cb3.ask("refuse", arm="left", port="realtime")
    cb3.ask("refuse", arm="left", port="dashboard")
    findings = findings_of(cb3)
    assert faults(findings).keys() == {"port 30003", "port 29999"}
    assert f"{cb3.left}:30003: no connection" in findings["port 30003"].found
    assert "cable" in findings["port 30003"].remedy
    assert findings.keys() >= {"robot mode", "calibration", "registers", "robot type"}


@pytest.mark.parametrize("fault", [{"half_open": True}, {"mute": True}])
def test_a_silent_controller_runs_into_the_time_limit(cb3, fault):
    cb3.ask("link", arm="left", port="all", **fault)
    findings = check_cell(cb3, expected(cb3), expected(cb3, "right"))
    assert {(each.arm, each.name) for each in findings if each.level == "fail"} == {
        ("left", "dashboard"), ("left", "primary interface"), ("left", "RTDE"),
    }  # fmt: skip
    assert all("no answer in time" in each.found for each in findings if each.name == "RTDE")


def test_a_controller_whose_time_does_not_advance(cb3):
    cb3.ask("override", arm="left", timestamp=1e6)
    rate = findings_of(cb3)["RTDE rate"]
    assert rate.level == "fail"
    assert "does not advance" in rate.found


def test_a_slow_network_is_found(cb3):
    cb3.ask("link", arm="left", port="rtde", delay_s=0.02)
    finding = findings_of(cb3, timeout_s=5.0)["round trip"]
    assert finding.level == "fail"
    assert "4 ms" in finding.expected


def test_one_host_for_both_arms(cb3):
    findings = check_cell(cb3, expected(cb3), expected(cb3))
    first = findings[0]
    assert (first.arm, first.name, first.level) == ("cell", "two controllers", "fail")
    assert cb3.left in first.found
    assert {each.arm for each in findings[1:]} == {"left"}


def test_two_addresses_of_one_controller(cb3):
    cb3.ask("pretend", arm="right", serial_number="2010300001")
    first = check_cell(cb3, expected(cb3), expected(cb3, "right"))[0]
    assert (first.arm, first.level) == ("cell", "fail")
    assert "2010300001 and 2010300001" in first.found


@pytest.mark.parametrize(
    ("route", "level", "text"),
    [
        (Route("eth1", None, False, False), "ok", "by eth1"),
        (Route("eth0", None, True, False), "warn", "other networks"),
        (Route("eth1", "10.0.0.1", False, False), "warn", "router 10.0.0.1"),
        (Route("wlan0", None, False, True), "fail", "Wi-Fi"),
        (None, "warn", "could not be determined"),
    ],
)
def test_findings_of_routes(monkeypatch, route, level, text):
    monkeypatch.setattr(doctor, "route_to", lambda host: route)
    arm = doctor._ArmFacts("left", ExpectedArm(host="192.168.1.11"), 1.0, 1.0, LOCAL)
    (finding,) = doctor._network(arm)
    assert finding.level == level
    assert text in finding.found
    assert list(doctor._network(dataclasses.replace(arm, expected=ExpectedArm(host="127.0.0.5")))) == []


# Pure functions.


def samples(times, late=()):
    delays = dict(late)
    return [Sample({"timestamp": at}, 100.0 + at + delays.get(index, 0.0)) for index, at in enumerate(times)]


@pytest.mark.parametrize(
    ("times", "late", "rate", "jitter"),
    [
        (np.arange(40) * 0.008, {}, "ok", "ok"),
        (np.arange(40) * 0.008, {7: 0.007}, "ok", "ok"),
        (np.arange(40) * 0.008, {7: 0.009}, "ok", "warn"),
        (np.arange(40) * 0.008, {7: 0.11}, "ok", "fail"),
        (np.delete(np.arange(40) * 0.008, [9]), {}, "warn", "ok"),
        (np.arange(20) * 0.016, {}, "fail", "ok"),
    ],
)
def test_findings_of_streams(times, late, rate, jitter):
    found = {each.name: each.level for each in stream_findings("left", samples(times, late.items()), 125.0)}
    assert found == {"RTDE rate": rate, "RTDE jitter": jitter}


@pytest.mark.parametrize("times", [[], [1.0], [1.0, 1.0, 1.0]])
def test_a_stalled_stream_fails(times):
    (finding,) = stream_findings("left", samples(times), 125.0)
    assert (finding.name, finding.level) == ("RTDE rate", "fail")


@pytest.mark.parametrize(("times", "level"), [([0.001] * 9, "ok"), ([0.001] * 9 + [0.02], "warn"), ([0.005], "fail")])
def test_findings_of_round_trips(times, level):
    (finding,) = round_trip_findings("left", times)
    assert finding.level == level


def test_a_late_emulated_controller_is_the_fault_of_this_machine():
    late = samples(np.arange(50) / 125, {10: 0.02}.items())
    for loopback in (False, True):
        findings = [
            *stream_findings("left", late, 125.0, loopback=loopback),
            *round_trip_findings("left", [0.02], loopback=loopback),
        ]
        remedies = [each.remedy for each in findings if each.level != "ok"]
        assert ["too busy" in each for each in remedies] == [loopback] * 2
        assert ["network" in each for each in remedies] == [not loopback] * 2


def test_a_rotation_by_pi_has_two_vectors():
    status = status_of(tcp_offset=(0.0, 0.0, 0.1, np.pi, 0.0, 0.0))
    (tcp, _) = tool_findings("left", ExpectedArm(host="127.0.0.1", tcp=(0.0, 0.0, 0.1, -np.pi, 0.0, 0.0)), status)
    assert tcp.level == "ok"


@pytest.mark.parametrize(
    ("mass", "cog", "level"),
    [
        (1.0, (0.0, 0.0, 0.05), "ok"),
        (1.04, (0.0, 0.003, 0.053), "ok"),
        (1.06, (0.0, 0.0, 0.05), "fail"),
        (0.94, (0.0, 0.0, 0.05), "fail"),
        (1.0, (0.0, 0.0, 0.056), "fail"),
    ],
)
def test_findings_of_payloads(mass, cog, level):
    status = status_of(payload=mass, payload_cog=cog)
    wanted = ExpectedArm(host="127.0.0.1", payload_kg=1.0, payload_cog_m=(0.0, 0.0, 0.05))
    assert [each.level for each in tool_findings("left", wanted, status)][1] == level


def test_other_safety_settings_fail(cb3):
    cb3.ask("pretend", arm="left", safety_checksum=0xBEEF)
    finding = findings_of(cb3)["safety checksum"]
    assert (finding.level, finding.found, finding.expected) == ("fail", "0x0000beef", f"0x{SAFETY:08x}")
    assert "assess the risk" in finding.remedy


@pytest.mark.parametrize("wanted", [None, SAFETY])
def test_a_missing_safety_checksum_is_a_warning(wanted):
    facts = PrimaryFacts((3, 15, 8, 1), 2, (0,) * 6, *[(0.0,) * 6] * 4)
    (finding,) = safety_findings("left", ExpectedArm(host="127.0.0.1", safety_checksum=wanted), facts)
    assert (finding.level, finding.found) == ("warn", "not reported by this software")
    assert "pendant" in finding.remedy


def test_flange_errors_are_distances():
    longer = dataclasses.replace(NOMINAL_DH, a_m=(DH_A_M[0], DH_A_M[1] + 0.002, *DH_A_M[2:]))
    assert flange_error_m(NOMINAL_DH, NOMINAL_DH) == 0.0
    assert flange_error_m(longer, NOMINAL_DH) == pytest.approx(0.002, rel=1e-9)


def test_parameters_of_another_robot_fail():
    rows = {"theta_rad": (0.0,) * 6, "a_m": (0.0, -0.425, -0.392, 0.0, 0.0, 0.0), "alpha_rad": NOMINAL_DH.alpha_rad}
    facts = PrimaryFacts((3, 15, 8, 1), 2, (0,) * 6, d_m=NOMINAL_DH.d_m, **rows)
    (finding,) = calibration_findings("left", ExpectedArm(host="127.0.0.1"), facts)
    assert finding.level == "fail"
    assert "another robot" in finding.found


@pytest.mark.parametrize(
    ("values", "kind"),
    [
        ({"host": "robot"}, SettingsError),
        ({"family": "cb2"}, UnknownNameError),
        ({"tcp": (0.0,) * 5}, SettingsError),
        ({"payload_cog_m": (0.0,) * 4}, SettingsError),
        ({"checksums": ()}, SettingsError),
    ],
)
def test_expectations_that_are_not_legal(values, kind):
    with pytest.raises(kind):
        ExpectedArm(**{"host": "127.0.0.1", **values})


def test_only_failures_forbid_a_run():
    ok, warn, fail = (Finding("left", "x", level, "y") for level in ("ok", "warn", "fail"))
    assert not any_fails([ok, warn])
    assert any_fails([ok, fail, warn])


def test_an_emulator_that_has_ended_is_named_first(cb3, tmp_path):
    values = {**cb3.description, "emulator": {**cb3.description["emulator"], "pid": 2**31 - 1}}
    cell = CellFile.read(values, "cell.toml")
    assert doctor.check_file(cell, cb3.system)[0].name != "emulator"  # while its controllers answer
    gone = CellFile.read({**values, "left": {**values["left"], "host": "127.0.0.9"}}, "cell.toml")
    first = doctor.check_file(gone, cb3.system)[0]
    assert first.message.startswith("cell, emulator: process 2147483647 has ended, expected: running; start it again")
    both = {arm: {**values[arm], "host": host} for arm, host in (("left", "127.0.0.9"), ("right", "127.0.0.10"))}
    assert doctor.check_file(CellFile.read({**values, **both}, "cell.toml"), cb3.system) == [first]  # no port beside it


def test_a_machine_that_can_not_hold_two_arms_is_named_before_they_move(cb3, monkeypatch):
    def checked():
        return doctor.check_file(CellFile.read(cb3.description, "cell.toml"), cb3.system)[-1]

    assert checked().name != "processor"  # a virtual cell takes its time
    for cores, level in ((0.3, "warn"), (0.4, "ok")):
        monkeypatch.setattr(cb3.system, "idle_s", lambda cores=cores: 7.0 + cores * cb3.clock.now_s(), raising=False)
        found = checked()
        assert (found.arm, found.name, found.found) == ("cell", "processor", f"{cores:.1f} cores idle")
        assert found.level == level
    emulated, real = (processor_finding(0.7, "e-series", emulated=each) for each in (True, False))
    assert emulated.message.endswith("expected: at least 0.8 for two arms in motion; " + emulated.remedy)
    assert (emulated.level, real.level) == ("warn", "ok")
    idle_s = LOCAL.idle_s()
    assert idle_s is None or idle_s >= 0.0


UNSEEN = SeenArm()


def swapped(first, second, left=UNSEEN, right=UNSEEN):
    """Finding of a swap, from what both controllers report."""
    return swap_finding((first, second), (left, right))


OTHER_DH = dataclasses.replace(NOMINAL_DH, a_m=tuple(each + 0.003 for each in DH_A_M))
ONE, TWO = ExpectedArm(host="10.0.0.1"), ExpectedArm(host="10.0.0.2")


@pytest.mark.parametrize(
    ("name", "left", "right"),
    [
        ("serial_number", "1", "2"),
        ("checksums", (1,) * 6, (2,) * 6),
        ("dh", NOMINAL_DH, OTHER_DH),
        ("model", "ur10", "ur5"),
    ],
)
def test_swapped_addresses_are_named_by_all_that_tells_arms_apart(name, left, right):
    one, two = dataclasses.replace(ONE, **{name: left}), dataclasses.replace(TWO, **{name: right})
    if name == "model":
        seen, other = SeenArm(robot_type=one.robot.robot_type), SeenArm(robot_type=two.robot.robot_type)
    else:
        seen, other = SeenArm(**{name: left}), SeenArm(**{name: right})
    assert swapped(one, two, left=seen, right=other) is None
    finding = swapped(one, two, left=other, right=seen)
    assert (finding.arm, finding.name, finding.level) == ("cell", "swapped addresses", "fail")
    assert "exchange left.host and right.host" in finding.remedy
    assert swapped(one, two, left=other) is not None  # as far as it can be told
    assert swapped(one, dataclasses.replace(two, **{name: left}), left=other, right=seen) is None  # equal arms
    assert swapped(one, two, left=other, right=other) is None  # one controller twice is another fault
    if name != "model":  # which every file has
        assert swapped(one, TWO, right=seen) is not None  # one of both is described


def test_swapped_addresses_of_an_emulated_file_are_refused(cb3):
    left, right = cb3.description["left"], cb3.description["right"]
    assert left["serial_number"] != right["serial_number"]
    values = {**cb3.description, "left": {**left, "host": cb3.right}, "right": {**right, "host": cb3.left}}
    findings = doctor.check_file(CellFile.read(values, "cell.toml"), cb3.system)
    assert findings[0].name == "swapped addresses"
    assert [each.name for each in findings if each.level == "fail"] == ["swapped addresses", *["serial number"] * 2]


def test_the_safety_mode_comes_before_the_power_that_it_took(cb3):
    cb3.ask("override", arm="left", safety_mode=7, robot_mode=3)
    failed = [name for name, each in findings_of(cb3).items() if each.level == "fail"]
    assert failed[:2] == ["safety mode", "robot mode"]


# The command line.


@pytest.fixture
def virtual_doctor(cb3, monkeypatch):
    monkeypatch.setattr(doctor, "check_cell", functools.partial(doctor.check_cell, system=cb3.system))


def run(*arguments, width=200):
    result = CliRunner().invoke(cli.app, ["doctor", *arguments], env={"COLUMNS": str(width)})
    return result.exit_code, re.sub(r"\x1b\[[0-9;]*m", "", result.output)


@pytest.mark.usefixtures("virtual_doctor")
def test_the_command_prints_and_fails_if_something_does(cb3):
    cb3.ask("override", arm="left", safety_mode=3)
    code, text = run("--left", cb3.left, "--right", cb3.right)
    assert code == 1
    for word in ("safety mode", "PROTECTIVE", "speed slider", "two controllers", "fail", "warn", "ok"):
        assert word in text
    assert "Traceback" not in text


@pytest.mark.usefixtures("virtual_doctor")
def test_problems_come_first(cb3):
    cb3.ask("override", arm="left", safety_mode=3)
    _, text = run("--left", cb3.left, "--right", cb3.right)
    levels = [line.split("│")[3].strip() for line in text.splitlines() if line.startswith("│")]
    assert {*levels} == {"fail", "warn", "ok"}
    assert levels == sorted(levels, key=("fail", "warn", "ok").index)


@pytest.mark.usefixtures("virtual_doctor")
def test_warnings_do_not_fail_the_command(cb3):
    code, text = run("--left", cb3.left, "--right", cb3.right)
    assert code == 0, text
    assert "8 warnings, 0 failed" in text


@pytest.mark.usefixtures("virtual_doctor")
def test_nothing_is_wrapped_in_a_pipe(cb3):
    code, text = run("--left", cb3.left, "--right", cb3.right, width=80)
    assert code == 0
    rows = [line for line in text.splitlines() if line.startswith("│")]
    assert all(line.split("│")[1].strip() for line in rows)  # a continued row has no arm
    assert any(f"0x{SAFETY:08x}" in line for line in rows)


@pytest.mark.usefixtures("virtual_doctor")
def test_rows_in_json(cb3):
    cb3.ask("override", arm="left", safety_mode=3)
    code, text = run("--left", cb3.left, "--right", cb3.right, "--json", width=80)
    assert code == 1
    rows = json.loads(text)
    assert all(list(row) == ["arm", "check", "status", "found", "expected", "remedy"] for row in rows)
    mode = next(row for row in rows if row["arm"] == "left" and row["check"] == "safety mode")
    assert mode["status"] == "fail"
    assert "PROTECTIVE" in mode["found"]
    assert {row["status"] for row in rows} == {"ok", "warn", "fail"}


def test_without_a_cell_the_machine_alone_is_checked(monkeypatch):
    code, text = run()
    assert (code, text.splitlines()[-1]) == (0, "1 ok, 0 warnings, 0 failed")
    monkeypatch.setitem(sys.modules, "mujoco", None)  # as an upgrade in place from 3 to 4 leaves it
    code, text = run()
    assert code == 1
    assert "pip install --force-reinstall --no-deps mujoco mujoco-core mujoco-studio" in text


@pytest.mark.parametrize(
    ("arguments", "word"),
    [
        (("--left", "robot", "--right", "127.0.0.2"), "IPv4"),
        (("--left", "127.0.0.1", "--right", "127.0.0.2", "--family", "cb2"), "e-series"),
    ],
)
def test_arguments_that_are_not_legal_are_one_line_and_exit_code_2(arguments, word):
    code, text = run(*arguments)
    assert code == 2
    assert word in text
    assert len(text.strip().splitlines()) == 1


def test_an_emulated_cell_with_nothing_running_is_one_line_with_the_command_that_starts_it():
    arms = {"left": {"host": "127.0.0.2", "model": "ur5e"}, "right": {"host": "127.0.0.3", "model": "ur10e"}}
    for each in arms.values():
        each["family"] = "e-series"
    cell = CellFile.read({"kind": "emulated", **arms, "task": "DualUR10/Handover-v0"}, "e.toml")
    with VirtualCell() as other:
        other.end("emulated cell")
        (only,) = doctor.check_file(cell, other.system)
    assert only.message == (
        "cell, emulator: nothing runs at 127.0.0.2 and 127.0.0.3, expected: running; start it in another terminal: "
        "`python -m dual_ur10 emulate --left 127.0.0.2 --right 127.0.0.3 --robot ur5e,ur10e "
        "--task DualUR10/Handover-v0`"
    )
