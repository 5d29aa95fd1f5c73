"""Doctor: check two controllers, and report for each check what was found, what is expected and what to do.

It moves nothing and writes nothing. It reads, and requests the registers that commands will need, to release them at
once. Every step has a time limit, whatever a controller does.
"""

from __future__ import annotations

import contextlib
import functools
import ipaddress
import sys
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Final, NamedTuple

from dual_ur10.errors import LinkError, SettingsError
from dual_ur10.sim2real.cell_file.cell_file import CellFile
from dual_ur10.sim2real.commissioning.findings import (
    NOT_REPORTED,
    ExpectedArm,
    Finding,
    Level,
    SeenArm,
    any_fails,
    calibration_findings,
    expected_of,
    family_findings,
    judge,
    link_failure,
    model_findings,
    processor_finding,
    round_trip_findings,
    safety_findings,
    state_findings,
    stream_findings,
    swap_finding,
    tool_findings,
)
from ur_core.kinematics.robots import ROBOTS
from ur_core.kinematics.ur10 import ARMS, DHParameters
from ur_core.links import dashboard_link, primary_link, rtde_link
from ur_core.links.arm_status import OPTIONAL_VARIABLES, STATUS_VARIABLES, ArmStatus
from ur_core.links.dashboard_link import DashboardLink
from ur_core.links.link_socket import NO_ANSWER, LinkSocket
from ur_core.links.primary_link import PrimaryFacts, read_primary
from ur_core.links.rtde_link import RtdeClient, RtdeLink
from ur_core.links.rtde_stream import Sample
from ur_core.processes.system import LOCAL, System, in_parallel
from ur_core.protocol.rtde import Kind

PORTS: Final = {
    "dashboard": dashboard_link.PORT,
    "primary": primary_link.PORT,
    "realtime": 30003,  # takes the control script
    "rtde": rtde_link.PORT,
}

REGISTERS: Final = (
    *(f"input_int_register_{number}" for number in range(8)),
    *(f"input_double_register_{number}" for number in range(18)),
)
"""Input registers through which `ur_rtde` commands its control script."""

ROUTES: Final = Path("/proc/net/route")
INTERFACES: Final = Path("/sys/class/net")

_UP: Final = 0x1
_MOST_BYTES: Final = 1 << 20
_IN_USE: Final = "IN_USE"
_CLOSED: Final = "port "  # and its number: name of the finding
_ROUND_TRIPS: Final = 20
_JUDGED_S: Final = 0.2  # of all checks, for a mean of idle processors


@dataclass
class _ArmFacts:
    """Facts about an arm, as far as they were read."""

    name: str
    expected: ExpectedArm
    timeout_s: float
    observe_s: float
    system: System
    serial_number: str | None = None
    model: str | None = None
    facts: PrimaryFacts | None = None

    def deadline_s(self) -> float:
        return self.system.clock.now_s() + self.timeout_s

    def seen(self) -> SeenArm:
        """Return the identity that was read."""
        if self.facts is None:
            return SeenArm(serial_number=self.serial_number)
        return SeenArm(
            serial_number=self.serial_number,
            robot_type=self.facts.robot_type,
            checksums=self.facts.checksums,
            dh=self._dh(self.facts),
        )

    @staticmethod
    def _dh(facts: PrimaryFacts) -> DHParameters | None:
        for robot in ROBOTS.values():
            if robot.robot_type == facts.robot_type:
                with contextlib.suppress(SettingsError):
                    return facts.dh(robot.name)
        return None


def check_file(cell: CellFile, system: System = LOCAL, *, timeout_s: float = 1.5) -> list[Finding]:
    """Check both arms of a cell file. If the emulator of an emulated cell does not run, that is the first failure.

    It is the only one if nothing answers: closed ports follow from it.

    Args:
        cell: The cell file.
        system: Clock and network.
        timeout_s: Time limit of each connection with all its requests.
    """
    idle_s, begin_s = system.idle_s(), system.clock.now_s()
    findings = check_cell(*(expected_of(arm) for arm in cell.arms), timeout_s=timeout_s, system=system)
    now_s, took_s = system.idle_s(), system.clock.now_s() - begin_s
    if idle_s is not None and now_s is not None and took_s > _JUDGED_S:
        free = (now_s - idle_s) / took_s
        findings.append(processor_finding(free, cell.arms[0].family, emulated=cell.kind == "emulated"))
    if cell.kind != "emulated" or not any_fails(findings):
        return findings
    of_arms = [each for each in findings if each.arm in ARMS]
    is_silent = all(each.name.startswith(_CLOSED) and NO_ANSWER not in each.found for each in of_arms)
    pid = None if cell.emulator is None else cell.emulator.pid
    if pid is not None and not system.is_running(pid):
        remedy = "start it again: `python -m dual_ur10 emulate --cell FILE` writes that file anew"
        stopped = Finding("cell", "emulator", "fail", f"process {pid} has ended", "running", remedy)
    elif is_silent:
        hosts = " and ".join(arm.host for arm in cell.arms)
        remedy = f"start it in another terminal: `{_emulate(cell)}`"
        stopped = Finding("cell", "emulator", "fail", f"nothing runs at {hosts}", "running", remedy)
    else:
        return findings
    return [stopped] if is_silent else [stopped, *findings]


def _emulate(cell: CellFile) -> str:
    """Return the command that emulates a cell whose file it did not write."""
    robots = ",".join(dict.fromkeys(arm.robot for arm in cell.arms))
    task = "" if cell.task is None else f" --task {cell.task}"
    left, right = cell.arms
    return f"python -m dual_ur10 emulate --left {left.host} --right {right.host} --robot {robots}{task}"


def check_cell(
    left: ExpectedArm,
    right: ExpectedArm,
    *,
    timeout_s: float = 1.5,
    observe_s: float = 0.3,
    system: System = LOCAL,
) -> list[Finding]:
    """Check both arms as `check_arm` does, that they are two, and not swapped. It takes no longer than one arm.

    Raises:
        SettingsError: A time is not legal.
    """
    if ipaddress.IPv4Address(left.host) == ipaddress.IPv4Address(right.host):
        both = f"both arms have {left.host}"
        remedy = "give each arm the address of its own controller"
        same = Finding("cell", "two controllers", "fail", both, "two addresses", remedy)
        # A second check of the same controller at the same time would disturb the first.
        return [same, *check_arm(ARMS[0], left, timeout_s=timeout_s, observe_s=observe_s, system=system)]
    arms = [_ArmFacts(name, each, timeout_s, observe_s, system) for name, each in zip(ARMS, (left, right), strict=True)]
    findings = in_parallel(system, [functools.partial(_examine, arm) for arm in arms])
    swapped = swap_finding((left, right), (arms[0].seen(), arms[1].seen()))
    return [*([] if swapped is None else [swapped]), *_distinct(*arms), *findings[0], *findings[1]]


def check_arm(
    name: str, expected: ExpectedArm, *, timeout_s: float = 1.5, observe_s: float = 0.3, system: System = LOCAL
) -> list[Finding]:
    """Check one arm.

    Args:
        name: "left" or "right".
        expected: Expected properties.
        timeout_s: Time limit of each connection with all its requests. All checks take at most five times that.
        observe_s: Time for which the state is observed.
        system: Clock and network.

    Raises:
        SettingsError: A time is not legal.
    """
    return _examine(_ArmFacts(name, expected, timeout_s, observe_s, system))


def _distinct(left: _ArmFacts, right: _ArmFacts) -> Iterator[Finding]:
    hosts = f"{left.expected.host} and {right.expected.host}"
    if left.serial_number is None or right.serial_number is None:
        found = f"{hosts}; serial numbers could not be compared"
        yield Finding("cell", "two controllers", "ok", found, "two addresses and serial numbers")
        return
    found = f"{hosts}, serial numbers {left.serial_number} and {right.serial_number}"
    remedy = "both addresses lead to one controller: give each arm the address of its own"
    two = left.serial_number != right.serial_number
    yield judge("cell", "two controllers", two, found, "two addresses and serial numbers", remedy)


def _examine(arm: _ArmFacts) -> list[Finding]:
    findings = list(_network(arm))
    ports, closed = _ports(arm)
    findings += ports
    steps: tuple[tuple[str, str, Callable[[_ArmFacts], Iterator[Finding]]], ...] = (
        ("dashboard", "dashboard", _dashboard),
        ("primary", "primary interface", _primary),
        ("rtde", "RTDE", _rtde),
    )
    for port, title, step in steps:
        if port in closed:
            continue
        try:
            for finding in step(arm):  # one by one: those before an error count
                findings.append(finding)
        except LinkError as error:
            findings.append(link_failure(arm.name, title, error))
    if arm.model is not None or arm.facts is not None:
        findings += model_findings(arm.name, arm.expected, arm.model, arm.facts and arm.facts.robot_type)
    return findings


def _network(arm: _ArmFacts) -> Iterator[Finding]:
    host = arm.expected.host
    if is_loopback(host):
        return
    route = route_to(host)
    expected = "a wired interface of its own"
    remedy = "connect the controllers to a wired network interface that nothing else uses"
    if route is None:
        yield Finding(arm.name, "route", "warn", f"the route to {host} could not be determined", expected, remedy)
        return
    path = f"by {route.interface}" + (f" and the router {route.gateway}" if route.gateway else "")
    if route.wireless:
        yield Finding(arm.name, "route", "fail", f"{path}, which is Wi-Fi", expected, remedy)
    elif route.default:
        yield Finding(arm.name, "route", "warn", f"{path}, which also leads to other networks", expected, remedy)
    else:
        yield judge(arm.name, "route", route.gateway is None, path, expected, remedy, otherwise="warn")


def _ports(arm: _ArmFacts) -> tuple[list[Finding], set[str]]:
    """Return findings and closed ports. The ports share one time limit: a host that is silent is silent on all."""
    findings, closed = [], set()
    deadline_s = arm.deadline_s()
    for name, port in PORTS.items():
        try:
            LinkSocket(arm.name, f"port {name}", arm.expected.host, port, deadline_s, system=arm.system).close()
        except LinkError as error:
            closed.add(name)
            findings.append(link_failure(arm.name, f"{_CLOSED}{port}", error))
    if not closed:
        numbers = ", ".join(map(str, PORTS.values()))
        findings.append(Finding(arm.name, "ports", "ok", f"{numbers} are open", "open"))
    return findings, closed


def _dashboard(arm: _ArmFacts) -> Iterator[Finding]:
    with DashboardLink(arm.expected.host, arm.timeout_s, name=arm.name, system=arm.system) as link:
        remote = link.remote_control()
        if remote is not None:
            remedy = f"switch {arm.name} to Remote Control on its pendant"
            yield judge(arm.name, "remote control", remote, "remote" if remote else "local", "remote", remedy)
        arm.model = link.model()
        arm.serial_number = link.serial_number()
    wanted, found = arm.expected.serial_number, arm.serial_number
    if wanted is not None:
        remedy = "the arms may be swapped: correct the address or the serial number in the cell file"
        level: Level = "warn" if found is None else "fail"
        yield judge(arm.name, "serial number", found == wanted, found or NOT_REPORTED, wanted, remedy, otherwise=level)


def _primary(arm: _ArmFacts) -> Iterator[Finding]:
    arm.facts = read_primary(arm.expected.host, arm.timeout_s, name=arm.name, system=arm.system)
    yield from calibration_findings(arm.name, arm.expected, arm.facts)
    yield from safety_findings(arm.name, arm.expected, arm.facts)


def _rtde(arm: _ArmFacts) -> Iterator[Finding]:
    host = arm.expected.host
    with RtdeLink(
        host,
        STATUS_VARIABLES,
        timeout_s=arm.timeout_s,
        optional=OPTIONAL_VARIABLES,
        name=arm.name,
        system=arm.system,
    ) as link:
        samples = _observe(link, arm)
    yield from family_findings(arm.name, arm.expected, link.version)
    if samples:
        status = ArmStatus.from_sample(samples[-1])
        yield from state_findings(arm.name, status)
        yield from tool_findings(arm.name, arm.expected, status)
    yield from stream_findings(arm.name, samples, link.frequency_hz, loopback=is_loopback(host))
    yield from _registers(arm)


def _observe(link: RtdeLink, arm: _ArmFacts) -> list[Sample]:
    """Return the samples of `observe_s` from the first on, for which it waits `timeout_s`."""
    samples: list[Sample] = []
    clock = arm.system.clock
    begin = clock.now_s()
    while True:
        now = clock.now_s()
        if now - begin >= (arm.observe_s if samples else arm.timeout_s):
            return samples
        if clock.wait((link.fileno(),), now + 0.05)[0]:
            came = link.poll()
            if came and not samples:  # these may have waited: the time counts from here
                begin = clock.now_s()
            samples += came


def _registers(arm: _ArmFacts) -> Iterator[Finding]:
    """Request the registers and release them at once; measure round trips on the same connection."""
    deadline_s = arm.deadline_s()
    client = RtdeClient(arm.name, arm.expected.host, PORTS["rtde"], deadline_s, system=arm.system)
    try:
        round_trips_s = client.round_trips_s(_ROUND_TRIPS, deadline_s)
        number, types = client.set_up(Kind.SETUP_INPUTS, REGISTERS, b"", deadline_s)
    finally:
        client.socket.close_and_wait(arm.deadline_s())
    yield from round_trip_findings(arm.name, round_trips_s, loopback=is_loopback(arm.expected.host))
    taken = [name for name, kind in zip(REGISTERS, types, strict=True) if kind == _IN_USE]
    missing = [name for name, kind in zip(REGISTERS, types, strict=True) if kind not in ("INT32", "DOUBLE", _IN_USE)]
    if missing:
        found, remedy = f"{missing[0]} does not exist", "update the controller's software"
        yield Finding(arm.name, "registers", "fail", found, "free", remedy)
        return
    found = f"in use: {taken[0]} and {len(taken) - 1} more" if taken else f"{len(REGISTERS)} free"
    remedy = "end other programs that command this arm, and switch off EtherNet/IP, PROFINET and Modbus on the pendant"
    yield judge(arm.name, "registers", not taken and number > 0, found, "free", remedy)


class Route(NamedTuple):
    """Route to a host.

    Attributes:
        interface: Name of the interface; "lo" for this computer itself.
        gateway: Address of the router, or None.
        default: True if the same interface has the default route.
        wireless: True for Wi-Fi.
    """

    interface: str
    gateway: str | None
    default: bool
    wireless: bool


def is_loopback(host: str) -> bool:
    """Return True for a loopback address."""
    return ipaddress.IPv4Address(host).is_loopback


def route_to(host: str, routes: Path = ROUTES, interfaces: Path = INTERFACES) -> Route | None:
    """Return the route to a host, or None if it cannot be determined: there is none, or this is not Linux.

    Args:
        host: IPv4 address.
        routes: Table of routes of the kernel.
        interfaces: Folder in which the kernel lists network interfaces.
    """
    if is_loopback(host):
        return Route("lo", None, False, False)
    if not sys.platform.startswith("linux"):
        return None
    try:
        with routes.open(encoding="ascii") as file:
            table = [row for row in map(_row, file.read(_MOST_BYTES).splitlines()[1:]) if row is not None]
    except (OSError, UnicodeDecodeError):
        return None
    address = int(ipaddress.IPv4Address(host))
    fitting = [row for row in table if address & row.mask == row.destination]
    if not fitting:
        return None
    # The most specific route wins; among equals, the one with the least metric.
    best = max(fitting, key=lambda row: (row.mask, -row.metric))
    return Route(
        best.interface,
        str(ipaddress.IPv4Address(best.gateway)) if best.gateway else None,
        any(row.mask == 0 and row.interface == best.interface for row in table),
        any((interfaces / best.interface / each).exists() for each in ("wireless", "phy80211")),
    )


class _Row(NamedTuple):
    interface: str
    destination: int
    gateway: int
    metric: int
    mask: int


def _row(line: str) -> _Row | None:
    """Return a line of the table, or None if it is not a route in use."""
    words = line.split()
    try:
        interface, destination, gateway, flags = words[0], words[1], words[2], int(words[3], 16)
        metric, mask = int(words[6]), words[7]
        if not flags & _UP or "/" in interface:
            return None
        return _Row(interface, _address(destination), _address(gateway), metric, _address(mask))
    except (IndexError, ValueError, OverflowError):
        return None


def _address(text: str) -> int:
    """Return an address from the kernel's text: bytes in network order, read as a number of this machine."""
    return int.from_bytes(int(text, 16).to_bytes(4, sys.byteorder), "big")
