"""Status of an arm, decoded from RTDE samples, and the reasons for which it must not move."""

from __future__ import annotations

import itertools
import math
from operator import itemgetter
from typing import Annotated, Any, Final, NamedTuple, Self, get_type_hints

from ur_core.links.rtde_stream import Sample
from ur_core.protocol.modes import RobotBits, RobotMode, RuntimeState, SafetyBits, SafetyMode

Row = tuple[float, ...]


class ArmStatus(NamedTuple):
    """Status of one arm, as its controller reports it. Annotations hold the RTDE variable, and the size of a row.

    Attributes:
        arrival_s: Time of reading, on the clock of the reader.
        timestamp_s: Controller's own time.
        robot_mode: `RobotMode`, or any other number.
        safety_mode: `SafetyMode`, or any other number.
        robot_bits: `RobotBits`.
        safety_bits: `SafetyBits`.
        runtime_state: `RuntimeState`, or any other number.
        slider: Speed slider, 0 to 1.
        speed_scaling: Resulting speed scaling, with reduced mode and the controller's own limits.
        q_rad: (6,) measured joint angles.
        qd_rad_s: (6,) measured joint speeds.
        target_q_rad: (6,) joint angles that the controller aims at.
        tcp_pose: (6,) measured TCP pose: x, y, z in m, rotation vector in rad, in `base`.
        tcp_speed: (6,) measured TCP speed, m/s and rad/s.
        tcp_force: (6,) force and torque at the TCP, N and N·m; a CB3 estimates them from the currents.
        current_a: (6,) joint currents.
        temperature_c: (6,) joint temperatures.
        joint_voltage_v: (6,) joint voltages.
        main_voltage_v: Voltage of the power supply.
        robot_voltage_v: Voltage at the arm.
        robot_current_a: Current of the arm.
        digital_inputs: Bits 0 to 7 standard, 8 to 15 configurable, 16 and 17 of the tool.
        digital_outputs: The same bits of the outputs.
        analog_input0, analog_input1: V, or A.
        payload_kg: Payload that is set on the controller; None if unknown.
        payload_cog_m: (3,) its centre of mass; None if unknown.
        tcp_offset: (6,) tool centre point from the flange; None if unknown.
    """

    arrival_s: float
    timestamp_s: Annotated[float, "timestamp"]
    robot_mode: Annotated[int, "robot_mode"]
    safety_mode: Annotated[int, "safety_mode"]
    robot_bits: Annotated[int, "robot_status_bits"]
    safety_bits: Annotated[int, "safety_status_bits"]
    runtime_state: Annotated[int, "runtime_state"]
    slider: Annotated[float, "target_speed_fraction"]
    speed_scaling: Annotated[float, "speed_scaling"]
    q_rad: Annotated[Row, "actual_q", 6]
    qd_rad_s: Annotated[Row, "actual_qd", 6]
    target_q_rad: Annotated[Row, "target_q", 6]
    tcp_pose: Annotated[Row, "actual_TCP_pose", 6]
    tcp_speed: Annotated[Row, "actual_TCP_speed", 6]
    tcp_force: Annotated[Row, "actual_TCP_force", 6]
    current_a: Annotated[Row, "actual_current", 6]
    temperature_c: Annotated[Row, "joint_temperatures", 6]
    joint_voltage_v: Annotated[Row, "actual_joint_voltage", 6]
    main_voltage_v: Annotated[float, "actual_main_voltage"]
    robot_voltage_v: Annotated[float, "actual_robot_voltage"]
    robot_current_a: Annotated[float, "actual_robot_current"]
    digital_inputs: Annotated[int, "actual_digital_input_bits"]
    digital_outputs: Annotated[int, "actual_digital_output_bits"]
    analog_input0: Annotated[float, "standard_analog_input0"]
    analog_input1: Annotated[float, "standard_analog_input1"]
    payload_kg: Annotated[float | None, "payload"] = None
    payload_cog_m: Annotated[Row | None, "payload_cog", 3] = None
    tcp_offset: Annotated[Row | None, "tcp_offset", 6] = None

    @classmethod
    def from_sample(cls, sample: Sample) -> Self:
        """Return the status in a sample of `STATUS_VARIABLES` and any of `OPTIONAL_VARIABLES`.

        Raises:
            KeyError: A variable is missing.
        """
        values: Any = sample.values
        return cls(sample.arrival_s, *_REQUIRED(values), *map(values.get, OPTIONAL_VARIABLES))

    def row(self) -> list[float]:
        """Return all numbers in the order of `ROW`; NaN for unknown values."""
        fields: tuple[Any, ...] = self
        row: list[float] = []
        for part in _NUMBERS_AND_ROWS:
            if isinstance(part, slice):
                row.extend(map(float, fields[part]))
            else:
                row += fields[part]
        for value, size in zip(fields[_OPTIONAL], _OPTIONAL_SIZES, strict=True):
            row += (math.nan,) * size if value is None else (value,) if size == 1 else value
        return row

    @classmethod
    def from_row(cls, row: Any) -> Self:
        """Return the status of such a row."""
        found: list[Any] = list(_OF_ROW(tuple(map(float, row))))
        for place in _WHOLE:
            found[place] = int(found[place])
        for place, size in enumerate(_OPTIONAL_SIZES, start=len(found) - len(_OPTIONAL_SIZES)):
            if math.isnan(found[place] if size == 1 else found[place][0]):
                found[place] = None
        return cls(*found)


_HINTS: Final = get_type_hints(ArmStatus, include_extras=True)
_METADATA: Final[dict[str, tuple[Any, ...]]] = {
    name: getattr(hint, "__metadata__", ()) for name, hint in _HINTS.items()
}
_WHOLE: Final = [place for place, hint in enumerate(_HINTS.values()) if getattr(hint, "__origin__", None) is int]
_FIELDS: Final = [data[0] for name, data in _METADATA.items() if data and name not in ArmStatus._field_defaults]

STATUS_VARIABLES: Final = tuple(_FIELDS)
"""RTDE variables that a status needs. Every software version has them."""

OPTIONAL_VARIABLES: Final = tuple(_METADATA[name][0] for name in ArmStatus._field_defaults)
"""RTDE variables since software 3.11, 3.12 and 5.5.1: UR's RTDE guide."""

ROW: Final = tuple((name, data[1] if len(data) > 1 else 1) for name, data in _METADATA.items())
"""Names and sizes of the values of a status."""

ROW_SIZE: Final = sum(size for _, size in ROW)
"""Length of a row."""

_REQUIRED: Final = itemgetter(*STATUS_VARIABLES)
_OPTIONAL: Final = slice(1 + len(STATUS_VARIABLES), None)
_OPTIONAL_SIZES: Final = [size for _, size in ROW[_OPTIONAL]]


def _numbers_and_rows() -> list[slice | int]:
    """Return the places of required fields in order: runs of single numbers as slices, and those of rows."""
    places: list[slice | int] = []
    for place, (_, size) in enumerate(ROW[: _OPTIONAL.start]):
        last = places[-1] if places else None
        if size > 1:
            places.append(place)
        elif isinstance(last, slice):
            places[-1] = slice(last.start, place + 1)
        else:
            places.append(slice(place, place + 1))
    return places


def _places_in_row() -> list[slice | int]:
    """Return the places of all fields in a row."""
    ends = itertools.accumulate(size for _, size in ROW)
    return [end - 1 if size == 1 else slice(end - size, end) for (_, size), end in zip(ROW, ends, strict=True)]


_NUMBERS_AND_ROWS: Final = _numbers_and_rows()
_OF_ROW: Final = itemgetter(*_places_in_row())

_STOPPING_BITS: Final = {
    SafetyBits.PROTECTIVE_STOPPED: "protective stop",
    SafetyBits.RECOVERY: "recovery mode",
    SafetyBits.SAFEGUARD_STOPPED: "safeguard stop",
    SafetyBits.SYSTEM_EMERGENCY_STOPPED: "system emergency stop",
    SafetyBits.ROBOT_EMERGENCY_STOPPED: "robot emergency stop",
    SafetyBits.EMERGENCY_STOPPED: "emergency stop",
    SafetyBits.VIOLATION: "safety violation",
    SafetyBits.FAULT: "safety fault",
    SafetyBits.STOPPED_DUE_TO_SAFETY: "stopped due to safety",
}

_KNOWN_BITS: Final = int(SafetyBits.NORMAL | SafetyBits.REDUCED | sum(_STOPPING_BITS))

_NOT_PLAYING: Final = "its program was stopped or paused from outside, or failed; the controller's log says which"

# Plain numbers: operations on flags take several times as long, and every sample is checked.
_NORMAL, _REDUCED = int(SafetyBits.NORMAL), int(SafetyBits.REDUCED)
_FINE: Final = (_NORMAL,)
_FINE_REDUCED: Final = (_NORMAL, _REDUCED, _NORMAL | _REDUCED)
_POWER_ON, _TEACH_BUTTON = int(RobotBits.POWER_ON), int(RobotBits.TEACH_BUTTON)


def stop_reason(status: ArmStatus, *, allow_reduced: bool = False, playing: bool = True) -> str | None:
    """Return the reason why an arm must not move, or None if it may.

    It may move in safety mode 1, and in 2 where reduced mode is allowed. Every other number is a stop, even one that no
    document lists. The same holds for robot modes other than 7, and for bits.

    Args:
        status: Status of the arm.
        allow_reduced: True if it may move in reduced mode.
        playing: True if a program must be running, as while this program moves the arm.
    """
    mode = status.safety_mode
    if mode != SafetyMode.NORMAL and not (mode == SafetyMode.REDUCED and allow_reduced):
        return f"safety mode {mode_name(SafetyMode, mode)}"
    bits = status.safety_bits
    if bits not in (_FINE_REDUCED if allow_reduced else _FINE):
        return f"safety status bits 0x{bits:x}: {_describe(bits)}"
    if status.robot_mode != RobotMode.RUNNING:
        return f"robot mode {mode_name(RobotMode, status.robot_mode)}"
    if not status.robot_bits & _POWER_ON:
        return f"robot status bits 0x{status.robot_bits:x}: no power"
    # The bit of the power button is not checked: its effect shows in the modes.
    if status.robot_bits & _TEACH_BUTTON:
        return f"robot status bits 0x{status.robot_bits:x}: freedrive button pressed"
    if playing and status.runtime_state != RuntimeState.PLAYING:
        return f"program state {mode_name(RuntimeState, status.runtime_state)}: {_NOT_PLAYING}"
    if not all(map(math.isfinite, (*status.q_rad, *status.qd_rad_s, status.slider, status.speed_scaling))):
        return "joint angles, joint speeds, slider or speed scaling that are not finite numbers"
    return None


def program_ended(status: ArmStatus) -> bool:
    """Return True if nothing but the end of its program keeps an arm from moving."""
    return (
        status.runtime_state != RuntimeState.PLAYING and stop_reason(status, allow_reduced=True, playing=False) is None
    )


def _describe(bits: int) -> str:
    found = [text for bit, text in _STOPPING_BITS.items() if bits & bit]
    if bits & ~_KNOWN_BITS:
        found.append(f"unknown bits 0x{bits & ~_KNOWN_BITS:x}")
    if bits & _REDUCED:
        found.append("reduced mode")
    if not bits & (_NORMAL | _REDUCED):
        found.append("neither normal nor reduced mode")
    return ", ".join(found)


def mode_name(kind: type[SafetyMode] | type[RobotMode] | type[RuntimeState], number: int) -> str:
    """Return a number with UR's name for it, such as "7 (RUNNING)" or "21 (unknown)"."""
    known = {int(each): each.name for each in kind}
    return f"{number} ({known.get(number, 'unknown')})"
