"""Findings of the doctor: pure functions that compare what was read of an arm with what is expected of it."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from typing import Any, Literal, get_args

import numpy as np

from dual_ur10.errors import LinkError, SettingsError, UnknownNameError
from dual_ur10.sim2real.cell_file.tables import ArmEntry
from dual_ur10.sim2real.control.time_scaling import FULL
from ur_core.kinematics import flange_pose
from ur_core.kinematics.robots import MODEL_OF_FAMILY, ROBOTS, RobotModel, robot_model
from ur_core.kinematics.rotations import quat_conjugate, quat_from_rotvec, quat_multiply, quat_to_rotvec
from ur_core.kinematics.ur10 import DHParameters, Family, nominal_dh
from ur_core.links.arm_status import ArmStatus, mode_name, stop_reason
from ur_core.links.link_socket import check_host
from ur_core.links.primary_link import PrimaryFacts
from ur_core.links.rtde_stream import Sample
from ur_core.protocol.modes import RobotMode, RuntimeState, SafetyMode

Level = Literal["ok", "warn", "fail"]
Version = tuple[int, int, int, int]

REST_RAD_S = 0.01
"""Joint speed below which an arm is at rest: the noise of its sensors is smaller."""

# The arms work together within a millimetre, so an error of that size is a wrong calibration. A tenth of it is what
# reading a calibration again, or typing it in with few digits, may change.
WRONG_CALIBRATION_M, OTHER_CALIBRATION_M = 1e-3, 1e-4

_TCP_M, _TCP_RAD = 1e-4, 1e-3
_PAYLOAD_KG, _COG_M = 0.05, 5e-3
_MOST_JITTER_S = 0.1  # a state that old counts as stale, and stops both arms

MOST_ROUND_TRIP_S = 0.004
"""Half a control period of a CB3."""


_CONFIGURATIONS_RAD = (
    (0.0, -np.pi / 2, 0.0, -np.pi / 2, 0.0, 0.0),
    (0.0, -np.pi / 2, np.pi / 2, -np.pi / 2, -np.pi / 2, 0.0),
    (1.0, -1.0, 1.5, -2.0, -1.5, 0.5),
    (-2.0, -2.2, -1.5, -0.8, 1.2, -1.0),
    (2.5, -0.2, 0.3, 0.4, 0.8, 2.0),
)

NOT_REPORTED = "not reported by this software"

_CORES: dict[tuple[Family, bool], float] = {
    ("cb3", False): 0.25,
    ("cb3", True): 0.35,
    ("e-series", False): 0.6,
    ("e-series", True): 0.8,
}
"""Processor cores that two arms take in motion, rounded up, by family and whether they are emulated; without what an
emulated cell takes at rest. Measured by `benchmarks/real_time.py` on x86-64 cores of 2.6 GHz."""

_TOO_BUSY = "this computer, on which the controller is emulated, is too busy: end what else loads it"
_GIVE = "add it to the cell file, so that it is compared"
_TO_PENDANT = "correct it in the installation on the pendant, or in the cell file, whichever is wrong"


@dataclass(frozen=True)
class Finding:
    """Result of one check.

    Attributes:
        arm: "left", "right", "cell" for both, or "machine".
        name: Name of the check.
        level: "ok"; "warn" for the operator to decide; "fail" if no run may start.
        found: Value that was found.
        expected: Value that was expected.
        remedy: Action that puts it right; empty if it is in order.
    """

    arm: str
    name: str
    level: Level
    found: str
    expected: str = ""
    remedy: str = ""

    @property
    def message(self) -> str:
        """Finding in one line."""
        expected = f", expected: {self.expected}" if self.expected else ""
        return f"{self.arm}, {self.name}: {self.found}{expected}" + (f"; {self.remedy}" if self.remedy else "")


def judge(
    arm: str, name: str, good: bool, found: str, expected: str, remedy: str, *, otherwise: Level = "fail"
) -> Finding:
    """Return a finding: "ok" if `good`, else of the level `otherwise` and with the remedy."""
    return Finding(arm, name, "ok", found, expected) if good else Finding(arm, name, otherwise, found, expected, remedy)


def link_failure(arm: str, name: str, error: LinkError) -> Finding:
    """Return the finding of a link that failed. Messages of links end with their remedy."""
    found, _, remedy = str(error).removeprefix(f"{arm} arm, ").rpartition("; ")
    return Finding(arm, name, "fail", found or remedy, "an answer", remedy)


def any_fails(findings: Iterable[Finding]) -> bool:
    """Return True if a finding forbids a run."""
    return any(each.level == "fail" for each in findings)


@dataclass(frozen=True, kw_only=True)
class ExpectedArm:
    """Expected properties of an arm. None: the value found is reported, and compared with nothing.

    Attributes:
        host: IPv4 address of its controller.
        family: "cb3" or "e-series".
        model: Model of the arm, a name in `ur_core.kinematics.robots.ROBOTS`; None: a UR10, or a UR10e of the
            e-Series.
        dh: Calibrated kinematics.
        checksums: (6,) checksums of the calibration.
        safety_checksum: Checksum of the safety settings.
        tcp: (6,) tool centre point from the flange: x, y, z in m, rotation vector in rad.
        payload_kg: Mass at the flange.
        payload_cog_m: (3,) its centre of mass from the flange.
        serial_number: Serial number of the robot, as its dashboard reports it.

    Raises:
        SettingsError: The address or a length is not legal.
        UnknownNameError: There is no such family.
    """

    host: str
    family: Family = "cb3"
    model: str | None = None
    dh: DHParameters | None = None
    checksums: tuple[int, ...] | None = None
    safety_checksum: int | None = None
    tcp: tuple[float, ...] | None = None
    payload_kg: float | None = None
    payload_cog_m: tuple[float, ...] | None = None
    serial_number: str | None = None

    def __post_init__(self) -> None:
        object.__setattr__(self, "host", check_host(self.host))
        if self.family not in get_args(Family):
            raise UnknownNameError("controller family", str(self.family), get_args(Family))
        _ = self.robot
        for name, value, count in (
            ("checksums", self.checksums, 6),
            ("tcp", self.tcp, 6),
            ("payload_cog_m", self.payload_cog_m, 3),
        ):
            if value is not None and len(value) != count:
                raise SettingsError(f"expected {name} is {value!r}: it has {count} numbers")

    @property
    def robot(self) -> RobotModel:
        """Facts of the model."""
        return robot_model(self.model or MODEL_OF_FAMILY[self.family])


def expected_of(arm: ArmEntry) -> ExpectedArm:
    """Return the expectations that a cell file states."""
    return ExpectedArm(
        host=arm.host,
        family=arm.family,
        model=arm.robot,
        dh=arm.mount.dh,
        checksums=arm.calibration.checksum,
        safety_checksum=arm.safety_checksum,
        tcp=arm.tcp,
        payload_kg=arm.payload_kg,
        payload_cog_m=arm.payload_cog_m,
        serial_number=arm.serial_number,
    )


@dataclass(frozen=True, kw_only=True)
class SeenArm:
    """Identity of an arm, as far as its controller reported it.

    Attributes:
        serial_number: Serial number of the robot.
        robot_type: UR's number of the model.
        checksums: (6,) checksums of the calibration.
        dh: Calibrated kinematics.
    """

    serial_number: str | None = None
    robot_type: int | None = None
    checksums: tuple[int, ...] | None = None
    dh: DHParameters | None = None


def swap_finding(expected: tuple[ExpectedArm, ExpectedArm], seen: tuple[SeenArm, SeenArm]) -> Finding | None:
    """Return the finding that each controller is the other arm's; None: nothing says so.

    Args:
        expected: Expected properties of the left and the right arm. What both have in common tells nothing.
        seen: What their controllers reported.
    """
    traits: dict[str, tuple[Sequence[Any], Sequence[Any]]] = {
        "serial number": ([each.serial_number for each in expected], [each.serial_number for each in seen]),
        "calibration checksums": ([each.checksums for each in expected], [each.checksums for each in seen]),
        "calibration": ([each.dh for each in expected], [each.dh for each in seen]),
        "model": ([each.robot.robot_type for each in expected], [each.robot_type for each in seen]),
    }
    names = [name for name, (wanted, found) in traits.items() if _is_crossed(wanted, found)]
    if not names:
        return None
    found = f"each controller has the {' and the '.join(names)} of the other arm"
    remedy = "the addresses are swapped: exchange left.host and right.host in the cell file"
    return Finding("cell", "swapped addresses", "fail", found, "those of its own arm", remedy)


def _is_crossed(wanted: Sequence[Any], found: Sequence[Any]) -> bool:
    """Return True if what was found is as wanted of the other arm, wherever both are known, and not of its own."""
    if _are_same(*wanted):
        return False
    crossed = [_are_same(*each) for each in zip(found, reversed(wanted), strict=True) if None not in each]
    return bool(crossed) and all(crossed) and not any(map(_are_same, found, wanted))


def _are_same(one: Any, other: Any) -> bool:
    if isinstance(one, DHParameters) and isinstance(other, DHParameters):
        return flange_error_m(one, other) <= OTHER_CALIBRATION_M
    return bool(one is not None and one == other)


def family_findings(arm: str, expected: ExpectedArm, version: Version) -> Iterator[Finding]:
    """Check that the software is that of the family."""
    family = "cb3" if version[0] <= 3 else "e-series"
    found = f"{family}, software {'.'.join(map(str, version))}"
    remedy = "correct the address or the family in the cell file"
    yield judge(arm, "family", family == expected.family, found, expected.family, remedy)


def model_findings(arm: str, expected: ExpectedArm, model: str | None, robot_type: int | None) -> Iterator[Finding]:
    """Check that it is the expected model.

    Args:
        arm: Name of the arm.
        expected: Expected properties.
        model: Model that the dashboard reports, or None.
        robot_type: Robot type that the primary interface reports, or None.
    """
    remedy = "correct the address, or the model in the cell file"
    robot = expected.robot
    # Some versions of the e-Series report the name without its "e".
    titles = tuple(dict.fromkeys((robot.title.removesuffix("e"), robot.title)))
    if model is not None:
        yield judge(arm, "model", model in titles, model, " or ".join(titles), remedy)
    if robot_type is not None:
        names = " or ".join(each.title for each in ROBOTS.values() if each.robot_type == robot_type) or "unknown"
        wanted, good = f"{robot.robot_type} ({robot.title})", robot_type == robot.robot_type
        yield judge(arm, "robot type", good, f"{robot_type} ({names})", wanted, remedy)


def state_findings(arm: str, status: ArmStatus) -> Iterator[Finding]:
    """Check that a program could move the arm, and that none does yet."""
    running, normal = status.robot_mode == RobotMode.RUNNING, status.safety_mode == SafetyMode.NORMAL
    remedy = "find the cause, and clear it at the pendant or at the button or gate"
    yield judge(arm, "safety mode", normal, mode_name(SafetyMode, status.safety_mode), "1 (NORMAL)", remedy)
    remedy = "power the arm on and release its brakes at the pendant"
    yield judge(arm, "robot mode", running, mode_name(RobotMode, status.robot_mode), "7 (RUNNING)", remedy)
    reason = stop_reason(status, playing=False)
    if reason is not None and running and normal:
        remedy = "find the cause, and clear it at the pendant"
        yield Finding(arm, "status bits", "fail", reason, "none of a stop", remedy)
    stopped, found = status.runtime_state == RuntimeState.STOPPED, mode_name(RuntimeState, status.runtime_state)
    remedy = "stop the program at the pendant, and end other programs that use this arm"
    yield judge(arm, "program", stopped, found, "1 (STOPPED)", remedy)
    remedy = "move the slider on the pendant to 100 %; speed_factor in the cell file makes both arms slower together"
    yield judge(arm, "speed slider", status.slider >= FULL, f"{100 * status.slider:.0f} %", "100 %", remedy)
    fastest = max(map(abs, status.qd_rad_s))
    found, wanted = f"{fastest:.4f} rad/s", f"less than {REST_RAD_S:g} rad/s"
    yield judge(arm, "at rest", fastest < REST_RAD_S, found, wanted, "wait until it stops; check what moves it")


def tool_findings(arm: str, expected: ExpectedArm, status: ArmStatus) -> Iterator[Finding]:
    """Check that the controller is set to the same tool and payload."""
    found = status.tcp_offset
    text = NOT_REPORTED if found is None else _row(found, "m, rad")
    if expected.tcp is None or found is None:
        yield Finding(arm, "TCP", "warn", text, "", _GIVE if found is not None else "check it at the pendant")
    else:
        off_m = float(np.linalg.norm(np.subtract(found[:3], expected.tcp[:3])))
        off_rad = _angle(found[3:], expected.tcp[3:])
        good = off_m <= _TCP_M and off_rad <= _TCP_RAD
        yield judge(arm, "TCP", good, text, _row(expected.tcp, "m, rad"), _TO_PENDANT)
    mass, cog = status.payload_kg, status.payload_cog_m
    text = NOT_REPORTED if mass is None or cog is None else f"{mass:.3f} kg at {_row(cog, 'm')}"
    if expected.payload_kg is None or mass is None or cog is None:
        yield Finding(arm, "payload", "warn", text, "", _GIVE if mass is not None else "check it at the pendant")
        return
    wanted = expected.payload_cog_m
    # Without mass, there is no centre of it.
    near = wanted is None or mass <= _PAYLOAD_KG or float(np.linalg.norm(np.subtract(cog, wanted))) <= _COG_M
    good = abs(mass - expected.payload_kg) <= _PAYLOAD_KG and near
    at = "" if wanted is None else f" at {_row(wanted, 'm')}"
    yield judge(arm, "payload", good, text, f"{expected.payload_kg:.3f} kg{at}", _TO_PENDANT)


def calibration_findings(arm: str, expected: ExpectedArm, facts: PrimaryFacts) -> Iterator[Finding]:
    """Check that the arm has the kinematics with which targets are computed."""
    remedy, robot = "read the calibration of this arm into the cell file, or correct the address", expected.robot
    try:
        dh = facts.dh(robot.name)
    except SettingsError as error:
        yield Finding(arm, "calibration", "fail", str(error), f"a {robot.title}'s kinematics", remedy)
        return
    error_m = flange_error_m(dh, nominal_dh(robot.name) if expected.dh is None else expected.dh)
    text = f"flange {1e3 * error_m:.3f} mm off"
    if expected.dh is None:
        yield Finding(arm, "calibration", "warn", f"{text} the nominal {robot.title}'s", "", _GIVE)
    else:
        of = (
            f"the nominal {robot.title}'s, which the cell file uses"
            if expected.dh.is_nominal
            else "that of the cell file"
        )
        good, most = error_m <= OTHER_CALIBRATION_M, f"at most {1e3 * OTHER_CALIBRATION_M:g} mm"
        level: Level = "fail" if error_m > WRONG_CALIBRATION_M else "warn"
        yield judge(arm, "calibration", good, f"{text} {of}", most, remedy, otherwise=level)
    if expected.checksums is not None:
        same = facts.checksums == tuple(expected.checksums)
        found, wanted = (" ".join(f"{each:08x}" for each in row) for row in (facts.checksums, expected.checksums))
        yield judge(arm, "calibration checksums", same, found, wanted, remedy)


def safety_findings(arm: str, expected: ExpectedArm, facts: PrimaryFacts) -> Iterator[Finding]:
    """Check that the safety settings are those of the risk assessment."""
    found, wanted = facts.safety_checksum, expected.safety_checksum
    text = NOT_REPORTED if found is None else f"0x{found:08x}"
    compare = "compare the checksum that the pendant shows with the one in your risk assessment"
    changed = "they were changed: check them at the pendant, assess the risk again, then correct the cell file"
    if wanted is None:
        remedy = compare if found is None else f"{compare}, then write safety_checksum = {text} in the cell file"
        yield Finding(arm, "safety checksum", "warn", text, "", remedy)
        return
    level: Level = "warn" if found is None else "fail"
    remedy = compare if found is None else changed
    yield judge(arm, "safety checksum", found == wanted, text, f"0x{wanted:08x}", remedy, otherwise=level)


def flange_error_m(found: DHParameters, expected: DHParameters) -> float:
    """Return the largest distance of the flange between two calibrations, over some configurations, m."""
    one, other = (flange_pose(_CONFIGURATIONS_RAD, dh)[0] for dh in (found, expected))
    return float(np.linalg.norm(one - other, axis=-1).max())


def stream_findings(
    arm: str, samples: Sequence[Sample], rate_hz: float, *, loopback: bool = False
) -> Iterator[Finding]:
    """Check that the controller's state comes at its rate and evenly.

    Args:
        arm: Name of the arm.
        samples: Consecutive samples.
        rate_hz: Expected rate.
        loopback: True if the controller is emulated on this computer.
    """
    remedy = "use a wired network of its own, and check what else loads the controller and this computer"
    remedy = _TOO_BUSY if loopback else remedy
    if len(samples) < 2 or samples[-1].timestamp_s <= samples[0].timestamp_s:
        found = f"{len(samples)} samples, whose time does not advance"
        yield Finding(arm, "RTDE rate", "fail", found, f"{rate_hz:g} Hz", remedy)
        return
    times = np.array([each.timestamp_s for each in samples])
    delays = np.array([each.arrival_s for each in samples]) - times
    found_hz = (len(samples) - 1) / (times[-1] - times[0])
    good, found = found_hz >= 0.99 * rate_hz, f"{found_hz:.1f} Hz"
    level: Level = "fail" if found_hz < 0.9 * rate_hz else "warn"
    yield judge(arm, "RTDE rate", good, found, f"{rate_hz:g} Hz", remedy, otherwise=level)
    jitter_s, most_s = float(delays.max() - delays.min()), 1.0 / rate_hz
    found, most = f"{1e3 * jitter_s:.1f} ms", f"at most {1e3 * most_s:g} ms"
    level = "fail" if jitter_s > _MOST_JITTER_S else "warn"
    yield judge(arm, "RTDE jitter", jitter_s <= most_s, found, most, remedy, otherwise=level)


def processor_finding(free: float, family: Family, *, emulated: bool) -> Finding:
    """Check that this computer can run the processes that two moving arms need, besides what runs now.

    Args:
        free: Number of idle processor cores, a mean over the other checks.
        family: Family of the controllers.
        emulated: They are emulated on this computer, and run already.
    """
    needed = _CORES[family, emulated]
    remedy = "end other programs on this computer: actions will be late, and arms stop where it stalls for long"
    found, expected = f"{free:.1f} cores idle", f"at least {needed:g} for two arms in motion"
    return judge("cell", "processor", free >= needed, found, expected, remedy, otherwise="warn")


def round_trip_findings(arm: str, round_trips_s: Sequence[float], *, loopback: bool = False) -> Iterator[Finding]:
    """Check that answers come soon enough for a target to arrive in its control period.

    Args:
        arm: Name of the arm.
        round_trips_s: Measured times, at least one.
        loopback: True if the controller is emulated on this computer.
    """
    median, worst = float(np.median(round_trips_s)), max(round_trips_s)
    found = f"{1e3 * median:.2f} ms, at worst {1e3 * worst:.2f} ms of {len(round_trips_s)}"
    most = f"at most {1e3 * MOST_ROUND_TRIP_S:g} ms"
    remedy = _TOO_BUSY if loopback else "use a wired network of its own, without routers"
    level: Level = "fail" if median > MOST_ROUND_TRIP_S else "warn"
    yield judge(arm, "round trip", worst <= MOST_ROUND_TRIP_S, found, most, remedy, otherwise=level)


def _angle(first: Sequence[float], second: Sequence[float]) -> float:
    """Angle between two orientations, given as rotation vectors, rad."""
    rotation = quat_multiply(quat_conjugate(quat_from_rotvec(first)), quat_from_rotvec(second))
    return float(np.linalg.norm(quat_to_rotvec(rotation)))


def _row(values: Sequence[float], unit: str) -> str:
    return f"[{', '.join(f'{each + 0.0:.4g}' for each in values)}] {unit}"
