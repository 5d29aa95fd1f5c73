"""What a controller's state says about whether an arm is ready: pure functions from what was read to findings."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np

from dual_ur10.errors import SettingsError
from dual_ur10.kinematics import flange_pose
from dual_ur10.kinematics.rotations import quat_conjugate, quat_from_rotvec, quat_multiply, quat_to_rotvec
from dual_ur10.kinematics.ur10 import NOMINAL_DH, DHParameters
from dual_ur10.sim2real.commissioning.doctor_findings import ExpectedArm, Finding, judged
from dual_ur10.sim2real.control.time_scaling import FULL
from dual_ur10.sim2real.links.arm_status import ArmStatus, name_of, stop_reason
from dual_ur10.sim2real.links.primary_link import PrimaryFacts
from dual_ur10.sim2real.links.rtde_stream import Sample
from dual_ur10.sim2real.protocol.modes import RobotMode, RuntimeState, SafetyMode

Version = tuple[int, int, int, int]

# At the start, nothing moves; the sensors' noise is below this.
REST_RAD_S = 0.01

# A wrong calibration is one that shows: the arms are to work together within a millimetre. A tenth is what a
# calibration that was read again, or typed in with few digits, may be off.
WRONG_CALIBRATION_M, OTHER_CALIBRATION_M = 1e-3, 1e-4

_TCP_M, _TCP_RAD = 1e-4, 1e-3
_PAYLOAD_KG, _COG_M = 0.05, 5e-3
_MOST_JITTER_S = 0.1  # then the state counts as stale, and both arms are stopped

MOST_ROUND_TRIP_S = 0.004
"""Half a control period of a CB3."""

_UR10 = 2  # robot type of the primary interface: UR's client library
_TYPES = {1: "UR5", 2: "UR10", 3: "UR3", 4: "UR16", 5: "UR18", 6: "UR8L", 7: "UR20", 8: "UR30", 9: "UR15"}
_MODELS = {"cb3": ("UR10",), "e-series": ("UR10", "UR10e")}

_POSTURES_RAD = (
    (0.0, -np.pi / 2, 0.0, -np.pi / 2, 0.0, 0.0),
    (0.0, -np.pi / 2, np.pi / 2, -np.pi / 2, -np.pi / 2, 0.0),
    (1.0, -1.0, 1.5, -2.0, -1.5, 0.5),
    (-2.0, -2.2, -1.5, -0.8, 1.2, -1.0),
    (2.5, -0.2, 0.3, 0.4, 0.8, 2.0),
)

_GIVE = "say it in the cell file, so that it is compared"
_TO_PENDANT = "correct it in the installation on the pendant, or in the cell file, whichever is wrong"


def family_findings(arm: str, expected: ExpectedArm, version: Version) -> Iterator[Finding]:
    """Whether the software is that of the family."""
    found = "cb3" if version[0] <= 3 else "e-series"
    yield judged(
        arm,
        "family",
        found == expected.family,
        f"{found}, software {'.'.join(map(str, version))}",
        expected.family,
        "correct the address or the family in the cell file",
    )


def model_findings(arm: str, expected: ExpectedArm, model: str | None, robot_type: int | None) -> Iterator[Finding]:
    """Whether it is a UR10.

    Args:
        arm: Its name.
        expected: What it should be.
        model: As the dashboard says it; None where it does not.
        robot_type: As the primary interface says it; None where it was not read.
    """
    remedy = "this program moves UR10s only: correct the address"
    models = _MODELS[expected.family]
    if model is not None:
        yield judged(arm, "model", model in models, model, " or ".join(models), remedy)
    if robot_type is not None:
        name = _TYPES.get(robot_type, "unknown")
        yield judged(arm, "robot type", robot_type == _UR10, f"{robot_type} ({name})", f"{_UR10} (UR10)", remedy)


def state_findings(arm: str, status: ArmStatus) -> Iterator[Finding]:
    """Whether the arm is ready to be moved by a program, and is not moved yet."""
    yield judged(
        arm,
        "robot mode",
        status.robot_mode == RobotMode.RUNNING,
        name_of(RobotMode, status.robot_mode),
        "7 (RUNNING)",
        "power the arm on and release its brakes at the pendant",
    )
    yield judged(
        arm,
        "safety mode",
        status.safety_mode == SafetyMode.NORMAL,
        name_of(SafetyMode, status.safety_mode),
        "1 (NORMAL)",
        "find the cause, and clear it at the pendant or at the button or gate",
    )
    reason = stop_reason(status, playing=False)
    known = status.robot_mode != RobotMode.RUNNING or status.safety_mode != SafetyMode.NORMAL
    if reason is not None and not known:
        yield Finding(
            arm, "status bits", "fail", reason, "none of a stop", "find the cause, and clear it at the pendant"
        )
    yield judged(
        arm,
        "program",
        status.runtime_state == RuntimeState.STOPPED,
        name_of(RuntimeState, status.runtime_state),
        "1 (STOPPED)",
        "stop the program at the pendant, and end other programs that use this arm",
    )
    yield judged(
        arm,
        "speed slider",
        status.slider >= FULL,
        f"{100 * status.slider:.0f} %",
        "100 %",
        "move the slider on the pendant to 100 %; speed_factor in the cell file makes both arms slower together",
    )
    fastest = max(map(abs, status.qd_rad_s))
    yield judged(
        arm,
        "at rest",
        fastest < REST_RAD_S,
        f"{fastest:.4f} rad/s",
        f"less than {REST_RAD_S:g} rad/s",
        "wait until it stands; see what moves it",
    )


def tool_findings(arm: str, expected: ExpectedArm, status: ArmStatus) -> Iterator[Finding]:
    """Whether the controller believes in the same tool and payload."""
    found = status.tcp_offset
    text = "not told by this software" if found is None else _row(found, "m, rad")
    if expected.tcp is None or found is None:
        yield Finding(arm, "TCP", "warn", text, "", _GIVE if found is not None else "look at the pendant")
    else:
        off_m = float(np.linalg.norm(np.subtract(found[:3], expected.tcp[:3])))
        off_rad = _angle(found[3:], expected.tcp[3:])
        yield judged(
            arm, "TCP", off_m <= _TCP_M and off_rad <= _TCP_RAD, text, _row(expected.tcp, "m, rad"), _TO_PENDANT
        )
    mass, cog = status.payload_kg, status.payload_cog_m
    text = "not told by this software" if mass is None or cog is None else f"{mass:.3f} kg at {_row(cog, 'm')}"
    if expected.payload_kg is None or mass is None or cog is None:
        yield Finding(arm, "payload", "warn", text, "", _GIVE if mass is not None else "look at the pendant")
        return
    wanted = expected.payload_cog_m
    # Without mass, there is no centre of it.
    near = wanted is None or mass <= _PAYLOAD_KG or float(np.linalg.norm(np.subtract(cog, wanted))) <= _COG_M
    good = abs(mass - expected.payload_kg) <= _PAYLOAD_KG and near
    at = "" if wanted is None else f" at {_row(wanted, 'm')}"
    yield judged(arm, "payload", good, text, f"{expected.payload_kg:.3f} kg{at}", _TO_PENDANT)


def calibration_findings(arm: str, expected: ExpectedArm, facts: PrimaryFacts) -> Iterator[Finding]:
    """Whether the arm's kinematics are those that targets are computed with."""
    remedy = "read the calibration of this arm into the cell file, or correct the address"
    try:
        dh = facts.dh()
    except SettingsError as error:
        yield Finding(arm, "calibration", "fail", str(error), "a UR10's kinematics", remedy)
        return
    error_m = flange_error_m(dh, NOMINAL_DH if expected.dh is None else expected.dh)
    text = f"flange {1e3 * error_m:.3f} mm off"
    if expected.dh is None:
        yield Finding(arm, "calibration", "warn", f"{text} the nominal UR10's", "", _GIVE)
    else:
        of = "the nominal UR10's, which the cell file goes by" if expected.dh.is_nominal else "that of the cell file"
        yield judged(
            arm,
            "calibration",
            error_m <= OTHER_CALIBRATION_M,
            f"{text} {of}",
            f"at most {1e3 * OTHER_CALIBRATION_M:g} mm",
            remedy,
            otherwise="fail" if error_m > WRONG_CALIBRATION_M else "warn",
        )
    if expected.checksums is not None:
        yield judged(
            arm,
            "calibration checksums",
            facts.checksums == tuple(expected.checksums),
            " ".join(f"{each:08x}" for each in facts.checksums),
            " ".join(f"{each:08x}" for each in expected.checksums),
            remedy,
        )


def safety_findings(arm: str, expected: ExpectedArm, facts: PrimaryFacts) -> Iterator[Finding]:
    """Whether the safety settings are those with which the risk was assessed."""
    found, wanted = facts.safety_checksum, expected.safety_checksum
    text = "not told by this software" if found is None else f"0x{found:08x}"
    look = "compare the checksum that the pendant shows with the one in your risk assessment"
    changed = "they were changed: look at them on the pendant, assess the risk anew, then correct the cell file"
    if wanted is None:
        remedy = look if found is None else f"{look}, then write safety_checksum = {text} in the cell file"
        yield Finding(arm, "safety checksum", "warn", text, "", remedy)
        return
    yield judged(
        arm,
        "safety checksum",
        found == wanted,
        text,
        f"0x{wanted:08x}",
        look if found is None else changed,
        otherwise="warn" if found is None else "fail",
    )


def flange_error_m(found: DHParameters, expected: DHParameters) -> float:
    """Largest distance of the flange, over some postures, between two calibrations of an arm, m."""
    one, other = (flange_pose(_POSTURES_RAD, dh)[0] for dh in (found, expected))
    return float(np.linalg.norm(one - other, axis=-1).max())


def stream_findings(arm: str, samples: Sequence[Sample], rate_hz: float) -> Iterator[Finding]:
    """Whether the controller's state comes as often and as evenly as it should.

    Args:
        arm: Its name.
        samples: In a row.
        rate_hz: How often they should come.
    """
    remedy = "use a wired network of its own, and see what else burdens the controller and this computer"
    if len(samples) < 2 or samples[-1].timestamp_s <= samples[0].timestamp_s:
        yield Finding(
            arm, "RTDE rate", "fail", f"{len(samples)} samples, whose time does not go on", f"{rate_hz:g} Hz", remedy
        )
        return
    times = np.array([each.timestamp_s for each in samples])
    delays = np.array([each.arrival_s for each in samples]) - times
    found_hz = (len(samples) - 1) / (times[-1] - times[0])
    yield judged(
        arm,
        "RTDE rate",
        found_hz >= 0.99 * rate_hz,
        f"{found_hz:.1f} Hz",
        f"{rate_hz:g} Hz",
        remedy,
        otherwise="fail" if found_hz < 0.9 * rate_hz else "warn",
    )
    jitter_s = float(delays.max() - delays.min())
    most_s = 1.0 / rate_hz
    yield judged(
        arm,
        "RTDE jitter",
        jitter_s <= most_s,
        f"{1e3 * jitter_s:.1f} ms",
        f"at most {1e3 * most_s:g} ms",
        remedy,
        otherwise="fail" if jitter_s > _MOST_JITTER_S else "warn",
    )


def round_trip_findings(arm: str, round_trips_s: Sequence[float]) -> Iterator[Finding]:
    """Whether answers come soon enough for a target to arrive in its control period.

    Args:
        arm: Its name.
        round_trips_s: Measured, at least one.
    """
    median, worst = float(np.median(round_trips_s)), max(round_trips_s)
    yield judged(
        arm,
        "round trip",
        worst <= MOST_ROUND_TRIP_S,
        f"{1e3 * median:.2f} ms, at worst {1e3 * worst:.2f} ms of {len(round_trips_s)}",
        f"at most {1e3 * MOST_ROUND_TRIP_S:g} ms",
        "use a wired network of its own, without routers",
        otherwise="fail" if median > MOST_ROUND_TRIP_S else "warn",
    )


def _angle(first: Sequence[float], second: Sequence[float]) -> float:
    """Angle between two orientations, given as rotation vectors, rad."""
    turn = quat_multiply(quat_conjugate(quat_from_rotvec(first)), quat_from_rotvec(second))
    return float(np.linalg.norm(quat_to_rotvec(turn)))


def _row(values: Sequence[float], unit: str) -> str:
    return f"[{', '.join(f'{each + 0.0:.4g}' for each in values)}] {unit}"
