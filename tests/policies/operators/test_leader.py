"""Leader arms: a chain of servos on a pseudo terminal. Real ones were not tried."""

import numpy as np
import pytest

from dual_ur10.errors import (
    DeviceAbsentError,
    DeviceDeniedError,
    DeviceGarbageError,
    DeviceSharedError,
    DeviceSilentError,
    DeviceUnpluggedError,
    SettingsError,
)
from dual_ur10.policies.operators import dynamixel
from dual_ur10.policies.operators.leader import Leader
from tests.policies.operators.rigs import RawLeader

POSTURE = np.array([0.3, -1.2, 1.4, -2.0, 1.0, 0.5])


class Clock:
    now_s = 100.0

    def __call__(self):
        return self.now_s


@pytest.fixture(autouse=True)
def patient(monkeypatch):
    """Emulated servos answer from a thread of a busy machine."""
    monkeypatch.setattr("dual_ur10.policies.operators.leader._WAIT_S", 0.2)


@pytest.fixture
def raw():
    made = RawLeader()
    yield made
    made.close()


def test_packets_have_the_checksum_of_the_protocol():
    # The examples of the protocol's own description: a ping, and its answer.
    assert dynamixel.packet(1, 0x01, b"") == bytes.fromhex("FFFFFD00010300 01 194E")
    assert dynamixel.Scanner().feed(bytes.fromhex("FFFFFD00 01 0700 55 00 0604 26 655D")) == [(1, 0, b"\x06\x04\x26")]


@pytest.mark.parametrize("cut", range(1, 40, 3))
def test_answers_are_found_in_any_pieces_and_between_garbage(cut):
    count = b"\xff\xff\xfd\x01"  # is stuffed
    answers = b"".join(dynamixel.packet(each, dynamixel.STATUS, b"\0" + count) for each in (1, 2))
    data = b"\xff\xff\x00" + answers[: len(answers) // 2] + b"" + answers[len(answers) // 2 :] + b"\xff\xff"
    scanner = dynamixel.Scanner()
    found = [each for k in range(0, len(data), cut) for each in scanner.feed(data[k : k + cut])]
    assert found == [(1, 0, count), (2, 0, count)]
    assert scanner.garbled == 3


def test_positions_become_joints_and_the_trigger_an_opening(raw):
    raw.place(POSTURE, opening=0.25)
    leader = Leader(raw.path, gripper_deg=(200, 100), clock=Clock())
    reading = leader.read()
    np.testing.assert_allclose(reading.joints_rad[0], POSTURE, atol=1e-3)
    assert reading.gripper[0] == pytest.approx(0.25, abs=0.01)
    assert reading.clutch.tolist() == [True, False]
    assert reading.age_s == 0.0
    raw.place(POSTURE + 0.1, opening=1.0)
    np.testing.assert_allclose(leader.read().joints_rad[0], POSTURE + 0.1, atol=1e-3)
    leader.close()
    leader.close()


def test_offsets_are_those_of_each_leader(raw):
    other = RawLeader(6)
    six = RawLeader(6)
    half, quarter = (np.pi / 2,) * 6, (np.pi / 4,) * 6
    leader = Leader(left=six.path, right=other.path, signs=(1,) * 6, offsets_rad=half, right_offsets_rad=quarter)
    reading = leader.read()
    np.testing.assert_allclose(reading.joints_rad[:, 0], [np.pi / 2, 3 * np.pi / 4])
    assert reading.clutch.all()
    leader.close()
    other.close()
    six.close()


def test_positions_of_several_turns_and_below_zero_are_read(raw):
    raw.counts[:2] = [-5000, 70000]
    leader = Leader(raw.path, gripper_deg=(200, 100), signs=(1,) * 6)
    np.testing.assert_allclose(leader.read().joints_rad[0, :2], np.array([-5000, 70000]) * 2 * np.pi / 4096)
    leader.close()


@pytest.mark.parametrize(
    ("fault", "error", "message"),
    [
        ("silent", DeviceSilentError, "no answer of the servos 1, 2, 3, 4, 5, 6, 7"),
        ("half", DeviceSilentError, "no answer of the servos 3, 4"),
        ("crc", DeviceGarbageError, "no valid packets"),
    ],
)
def test_a_chain_that_fails_ages_and_is_then_given_up(raw, fault, error, message):
    clock = Clock()
    leader = Leader(raw.path, gripper_deg=(200, 100), clock=clock)
    before = leader.read()
    raw.fault = fault
    clock.now_s += 0.1
    leader.read()
    clock.now_s += 0.1
    frozen = leader.read()
    np.testing.assert_array_equal(frozen.joints_rad, before.joints_rad)
    assert frozen.age_s == pytest.approx(0.2)
    raw.fault = None
    clock.now_s += 0.1
    assert leader.read().age_s < 0.15
    raw.fault = fault
    for _ in range(2):
        clock.now_s += 0.4
        leader.read()
    clock.now_s += 0.4
    with pytest.raises(error, match=message):
        leader.read()
    leader.close()


def test_a_pause_without_readings_is_no_silence(raw, monkeypatch):
    """As between two episodes. At 57,600 baud no answer comes within the first reading after it."""
    clock = Clock()
    leader = Leader(raw.path, gripper_deg=(200, 100), clock=clock)
    raw.fault = "silent"
    clock.now_s += 5.0
    assert leader.read().age_s == 1.0  # nothing moves by it
    raw.fault = None
    monkeypatch.setattr("dual_ur10.policies.operators.leader._WAIT_S", 0.2)
    clock.now_s += 0.06
    assert leader.read().age_s < 0.05
    raw.fault = "silent"
    clock.now_s += 5.0
    leader.read()
    for _ in range(2):
        clock.now_s += 0.4
        leader.read()
    clock.now_s += 0.4
    with pytest.raises(DeviceSilentError):
        leader.read()
    leader.close()


def test_an_echo_of_the_request_is_left_out(raw):
    raw.fault = "echo"
    leader = Leader(raw.path, gripper_deg=(200, 100))
    assert leader.read().joints_rad[0, 0] == pytest.approx(np.pi)
    leader.close()


def test_servos_that_report_an_error_are_named(raw):
    raw.fault = "error"
    with pytest.raises(DeviceGarbageError, match="servo 1 answers with error 2"):
        Leader(raw.path, gripper_deg=(200, 100))


def test_servos_that_never_answer_are_named(raw, monkeypatch):
    monkeypatch.setattr("dual_ur10.policies.operators.leader._FIRST_S", 0.05)
    raw.fault = "half"
    with pytest.raises(DeviceSilentError, match=r"leader at .*no answer of the servos 3, 4, 5, 6, 7"):
        Leader(raw.path, gripper_deg=(200, 100))


def test_unplugging_is_named(raw):
    leader = Leader(raw.path, gripper_deg=(200, 100))
    raw.unplug()
    with pytest.raises(DeviceUnpluggedError, match="was unplugged"):
        leader.read()


def test_absent_denied_and_shared_ports_are_named(raw, tmp_path, monkeypatch):
    with pytest.raises(DeviceAbsentError, match=r"there is no .*Found here"):
        Leader(str(tmp_path / "none"))
    with pytest.raises(DeviceSharedError, match="both hands"):
        Leader(left=raw.path, right=raw.path)
    leader = Leader(raw.path, gripper_deg=(200, 100))
    with pytest.raises(DeviceSharedError, match="another program reads"):
        Leader(raw.path)
    leader.close()
    import serial

    def denied(*_, **__):
        raise serial.SerialException(13, "could not open port: Permission denied")

    monkeypatch.setattr(serial, "Serial", denied)
    with pytest.raises(DeviceDeniedError, match=r'SUBSYSTEM=="tty"'):
        Leader(raw.path)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"signs": (1, 2, 3, 4, 5, 6)}, "signs"),
        ({"signs": (1, -1)}, "6 finite numbers"),
        ({"offsets_rad": (np.nan,) * 6}, "6 finite numbers"),
        ({"gripper_deg": (10, 10)}, "differ"),
        ({"baud": 0}, "baud"),
        ({"left": "/dev/ttyUSB1"}, "two as left"),
    ],
)
def test_wrong_arguments_are_named(arguments, message):
    with pytest.raises(SettingsError, match=message):
        Leader(**{"path": "/dev/ttyUSB0", **arguments})
