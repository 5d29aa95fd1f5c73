from collections import deque

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tests.soak import scaled
from ur_core.tools.robotiq_2f85 import ROBOTIQ_2F85 as TOOL
from ur_emulator.ports.robotiq import (
    ACTIVATION_S,
    AT_POSITION,
    LATENCY_S,
    MOVING,
    STOPPED_CLOSING,
    STOPPED_OPENING,
    RobotiqGripper,
)

DT_S = 0.008


class Fingers:
    """Fingers that follow the servo's reference with its lag, between an object and a stop."""

    def __init__(self, gripper: RobotiqGripper, width_m: float = TOOL.stroke_m) -> None:
        self.gripper, self.width_m = gripper, width_m
        self._delayed: deque[float] = deque([width_m] * round(gripper.latency_s / DT_S))
        self.least_m, self.most_m = 0.0, TOOL.stroke_m
        self.reference_m = width_m
        self.now_s = 0.0

    def tick(self) -> None:
        self.now_s += DT_S
        self.reference_m = self.gripper.tick(DT_S, self.width_m)
        self._delayed.append(self.reference_m)
        self.width_m += (self._delayed.popleft() - self.width_m) * min(1.0, DT_S / 0.011)
        self.width_m = min(max(self.width_m, self.least_m), self.most_m)

    def run(self, seconds: float) -> None:
        for _ in range(round(seconds / DT_S)):
            self.tick()

    def run_until(self, name: str, value: int, limit_s: float = 6.0) -> float:
        begin_s = self.now_s
        while get(self.gripper, name) != value:
            self.tick()
            assert self.now_s - begin_s < limit_s, f"{name} is {get(self.gripper, name)}, not {value}"
        return self.now_s - begin_s


def get(gripper: RobotiqGripper, name: str) -> int:
    answer = gripper.answer(f"GET {name}")
    found, value = answer.split()
    assert found == name
    assert answer.endswith("\n")
    return int(value)


def active(width_m: float = TOOL.stroke_m, latency_s: float = 0.0) -> tuple[RobotiqGripper, Fingers]:
    gripper = RobotiqGripper(latency_s=latency_s)
    fingers = Fingers(gripper, width_m)
    assert gripper.answer("SET ACT 1") == "ack"
    fingers.run_until("STA", 3)
    return gripper, fingers


def test_activation_takes_time_and_opens_the_fingers():
    gripper = RobotiqGripper()
    fingers = Fingers(gripper, 0.02)
    assert get(gripper, "STA") == 0
    fingers.run(0.1)
    assert fingers.width_m == pytest.approx(0.02)
    assert gripper.answer("SET ACT 1") == "ack"
    assert get(gripper, "STA") == 1
    assert fingers.run_until("STA", 3) >= ACTIVATION_S - DT_S
    assert fingers.width_m == pytest.approx(TOOL.stroke_m, abs=1e-3)
    assert get(gripper, "FLT") == 0


def test_nothing_moves_before_activation():
    gripper = RobotiqGripper()
    fingers = Fingers(gripper)
    assert gripper.answer("SET POS 255 GTO 1") == "ack"
    fingers.run(2.0)
    assert fingers.width_m == TOOL.stroke_m
    assert get(gripper, "FLT") == 7
    assert get(gripper, "GTO") == 0
    gripper.answer("SET ACT 1")
    assert get(gripper, "FLT") == 0
    gripper.answer("SET POS 255 GTO 1")
    assert get(gripper, "FLT") == 5
    fingers.run(ACTIVATION_S / 2)
    assert fingers.width_m == pytest.approx(TOOL.stroke_m, abs=1e-3)
    fingers.run_until("POS", 255)
    assert get(gripper, "FLT") == 0


@pytest.mark.parametrize("position", [255, 128, 40])
def test_positions_are_linear_in_the_opening(position):
    gripper, fingers = active()
    assert gripper.answer(f"SET POS {position} SPE 255 FOR 100 GTO 1") == "ack"
    assert get(gripper, "PRE") == position
    assert get(gripper, "OBJ") == MOVING
    fingers.run_until("OBJ", AT_POSITION)
    fingers.run(0.2)
    assert fingers.width_m == pytest.approx(TOOL.stroke_m * (1 - position / 255), abs=1e-4)
    assert get(gripper, "POS") == position


@pytest.mark.parametrize(("speed", "expected_m_s"), [(0, 0.02), (255, 0.15), (128, 0.08525)])
def test_speed(speed, expected_m_s):
    gripper, fingers = active()
    gripper.answer(f"SET POS 255 SPE {speed} FOR 255 GTO 1")
    fingers.run(0.1)
    begin_m = fingers.width_m
    fingers.run(0.2)
    assert (begin_m - fingers.width_m) / 0.2 == pytest.approx(expected_m_s, rel=1e-3)


@pytest.mark.parametrize("force", [0, 100, 255])
def test_grip_stops_at_the_object_and_presses_with_the_force(force):
    gripper, fingers = active()
    fingers.least_m = 0.05
    gripper.answer(f"SET POS 255 SPE 100 FOR {force} GTO 1")
    fingers.run(0.1)
    assert get(gripper, "OBJ") == MOVING
    fingers.run_until("OBJ", STOPPED_CLOSING)
    fingers.run(0.1)
    asked_n = TOOL.force_n[0] + (TOOL.force_n[1] - TOOL.force_n[0]) * force / 255
    assert TOOL.servo_kp * (fingers.width_m - fingers.reference_m) == pytest.approx(asked_n, rel=1e-6)
    assert get(gripper, "POS") == round(255 * (1 - 0.05 / TOOL.stroke_m))
    assert gripper.answer("SET POS 255 GTO 1") == "ack"  # a repetition changes nothing
    assert get(gripper, "OBJ") == STOPPED_CLOSING


def test_fingers_that_press_for_a_while_count_as_blocked():
    gripper, fingers = active()
    fingers.least_m = TOOL.stroke_m - 0.002
    gripper.answer("SET POS 255 SPE 0 FOR 255 GTO 1")
    force_s = TOOL.force_n[1] / TOOL.servo_kp / 0.02  # until the reference is so far ahead
    took_s = fingers.run_until("OBJ", STOPPED_CLOSING)
    assert force_s + 0.1 < took_s < force_s + 0.5
    assert gripper.force_n == TOOL.force_n[1]


def test_before_they_count_as_stopped_the_force_is_bounded():
    gripper, fingers = active()
    fingers.least_m = 0.05
    gripper.answer("SET POS 255 SPE 255 FOR 0 GTO 1")
    pressed_n = 0.0
    while get(gripper, "OBJ") == MOVING:
        fingers.tick()
        pressed_n = max(pressed_n, TOOL.servo_kp * (fingers.width_m - fingers.reference_m))
    assert TOOL.force_n[0] < pressed_n <= TOOL.force_n[0] + TOOL.servo_kp * 0.02 * 0.15 * 1.001
    assert get(gripper, "OBJ") == STOPPED_CLOSING


def test_fingers_that_push_something_along_are_not_stopped():
    gripper, fingers = active()
    fingers.least_m = 0.05
    gripper.answer("SET POS 255 SPE 255 FOR 0 GTO 1")
    fingers.run(0.25)
    for _ in range(500):  # 5 mm/s
        fingers.least_m -= 0.005 * DT_S
        fingers.tick()
        assert get(gripper, "OBJ") == MOVING
    fingers.run_until("OBJ", STOPPED_CLOSING)


@pytest.mark.parametrize("force", [0, 255])
def test_late_fingers_do_not_count_as_blocked(force):
    gripper, fingers = active(latency_s=LATENCY_S)
    gripper.answer(f"SET POS 255 SPE 255 FOR {force} GTO 1")
    fingers.run(0.25)
    begin_m = fingers.width_m
    fingers.run(0.2)
    assert (begin_m - fingers.width_m) / 0.2 == pytest.approx(0.15, rel=1e-3)
    fingers.run_until("OBJ", AT_POSITION)
    gripper.answer("SET POS 0 SPE 0")
    while get(gripper, "OBJ") == MOVING:
        fingers.tick()
        assert fingers.now_s < 20.0
    assert get(gripper, "OBJ") == AT_POSITION
    fingers.least_m = 0.05
    gripper.answer("SET POS 255")
    fingers.run_until("OBJ", STOPPED_CLOSING)
    fingers.run(0.3)
    pressed_n = TOOL.servo_kp * (fingers.width_m - fingers.reference_m)
    assert pressed_n == pytest.approx(TOOL.force_n[0] if force == 0 else TOOL.force_n[1], rel=1e-6)


def test_initial_values_of_the_gripper():
    gripper = RobotiqGripper()
    names = ("ACT", "GTO", "ATR", "ARD", "POS", "PRE", "SPE", "FOR", "STA", "OBJ", "FLT", "SID")
    assert [get(gripper, name) for name in names] == [0, 0, 0, 0, 0, 0, 255, 255, 0, 0, 0, 9]


def test_contact_while_opening():
    gripper, fingers = active()
    gripper.answer("SET POS 255 GTO 1")
    fingers.run_until("OBJ", AT_POSITION)
    fingers.most_m = 0.04
    gripper.answer("SET POS 0")
    fingers.run_until("OBJ", STOPPED_OPENING)


def test_closing_resumes_when_the_object_is_lost():
    gripper, fingers = active()
    fingers.least_m = 0.05
    gripper.answer("SET POS 255 GTO 1")
    fingers.run_until("OBJ", STOPPED_CLOSING)
    fingers.least_m = 0.0
    fingers.run(2 * DT_S)
    assert get(gripper, "OBJ") == MOVING
    fingers.run_until("OBJ", AT_POSITION)
    assert get(gripper, "POS") == pytest.approx(255, abs=3)


def test_slow_fingers_do_not_count_as_blocked():
    gripper, fingers = active()
    gripper.answer("SET POS 255 SPE 0 FOR 0 GTO 1")
    while get(gripper, "OBJ") == MOVING:
        fingers.tick()
        assert fingers.now_s < 20.0
    assert get(gripper, "OBJ") == AT_POSITION


def test_stop_and_go_on():
    gripper, fingers = active()
    gripper.answer("SET POS 255 SPE 0 GTO 1")
    fingers.run(1.0)
    gripper.answer("SET GTO 0")
    fingers.run(0.1)
    stopped_m = fingers.width_m
    assert 0.01 < stopped_m < TOOL.stroke_m - 0.01
    fingers.run(1.0)
    assert fingers.width_m == pytest.approx(stopped_m, abs=1e-4)
    gripper.answer("SET GTO 1")
    fingers.run_until("OBJ", AT_POSITION)


def test_reset_loses_the_activation():
    gripper, fingers = active()
    gripper.answer("SET POS 100 GTO 1")
    fingers.run_until("OBJ", AT_POSITION)
    width_m = fingers.width_m
    assert gripper.answer("SET ACT 0") == "ack"
    assert [get(gripper, name) for name in ("ACT", "STA", "GTO", "PRE", "FLT")] == [0, 0, 0, 0, 0]
    fingers.run(0.5)
    assert fingers.width_m == pytest.approx(width_m, abs=1e-3)


@pytest.mark.parametrize(("direction", "position"), [(1, 0), (0, 255)])
def test_automatic_release(direction, position):
    gripper, fingers = active()
    gripper.answer("SET POS 128 GTO 1")
    fingers.run_until("OBJ", AT_POSITION)
    assert gripper.answer(f"SET ARD {direction} ATR 1") == "ack"
    assert get(gripper, "FLT") == 11
    fingers.run_until("FLT", 15)
    gripper.answer(f"SET POS {255 - position}")
    fingers.run(1.0)
    assert get(gripper, "POS") == pytest.approx(position, abs=3)  # only a reset ends it
    gripper.answer("SET ACT 0")
    gripper.answer("SET ATR 0 ACT 1")
    fingers.run_until("STA", 3)
    assert get(gripper, "FLT") == 0


def test_without_power_nothing_is_known_and_activation_is_lost():
    gripper, fingers = active()
    gripper.powered = False
    fingers.run(0.1)
    assert gripper.answer("GET POS") == "POS ?\n"
    assert gripper.answer("SET POS 3") == "?\n"
    gripper.powered = True
    assert get(gripper, "STA") == 0


@pytest.mark.parametrize(
    "line",
    [
        *("SET", "SET POS", "SET POS 256", "SET POS -1", "SET POS 1.5", "SET POS ٣", "SET POS 1 SPE"),
        *("SET ACT 2", "SET XYZ 1", "SET STA 3", "SET ACT 1 POS 300", "set ACT 1"),
        *("", "GET", "GET POS PRE", "FOO"),
    ],
)
def test_unknown_commands_change_nothing(line):
    gripper = RobotiqGripper()
    assert gripper.answer(line) == "?\n"
    assert [get(gripper, name) for name in ("ACT", "POS", "STA", "PRE", "SPE")] == [0, 0, 0, 0, 255]


def test_unknown_register():
    assert RobotiqGripper().answer("GET XYZ") == "XYZ ?\n"


def test_ack_is_three_bytes():
    assert RobotiqGripper().answer("SET SPE 10") == "ack"
    assert RobotiqGripper().answer("GET SPE\r") == "SPE 255\n"


words = st.sampled_from(["SET", "GET", "ACT", "GTO", "POS", "SPE", "FOR", "ATR", "ARD", "STA", "0", "1", "255", "-3"])
lines = st.one_of(st.text(max_size=30), st.lists(words, max_size=9).map(" ".join))


@given(st.lists(st.tuples(lines, st.floats(-0.01, 0.1), st.integers(0, 20)), max_size=20))
@settings(max_examples=scaled(2000, 40))
def test_no_line_raises_and_the_reference_stays_in_the_stroke(steps):
    gripper = RobotiqGripper()
    last_m = None
    for line, width_m, ticks in steps:
        assert gripper.answer(line) in ("ack", "?\n") or line.split()[0] == "GET"
        for _ in range(ticks):
            reference_m = gripper.tick(DT_S, width_m)
            assert 0.0 <= reference_m <= TOOL.stroke_m
            last_m = width_m
    if last_m is not None:
        assert 0 <= get(gripper, "POS") <= 255
    assert get(gripper, "OBJ") in range(4)
