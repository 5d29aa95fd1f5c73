"""Arms on a serial line: motions, refusals, and every fault of a line, on a virtual clock; and one real pty."""

import itertools
import json
import subprocess
import sys

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from dual_ur10.errors import SettingsError
from dual_ur10.sim2real.serial_arm.firmware import SerialFirmware
from dual_ur10.sim2real.serial_arm.open_loop_arm import SerialLimits, execute
from dual_ur10.sim2real.serial_arm.protocol import MotionState, Request
from dual_ur10.sim2real.trajectory.joint_trajectory import JointTrajectory, ResultCode
from tests.sim2real.serial_rig import STEP_S, Rig, serial_port, trajectory
from tests.soak import scaled

REJECTED = ("rejected", ResultCode.INVALID_GOAL)
ABORTED = ("aborted", ResultCode.PATH_TOLERANCE_VIOLATED)
BOTH = ("left", "right")


@pytest.fixture
def rig(tmp_path):
    return Rig(tmp_path)


def run(rig, motion, **options):
    return execute(motion, "a line", system=rig.system, transport=rig.plug(), **options)


def end(result):
    return result.state, result.code


def largest_step(motion):
    """Bound of a step of the path between two instants of the rig, by its largest speed."""
    return 1.6 * np.abs(np.diff(motion.q_rad, axis=0) / np.diff(motion.time_s)[:, None, None]).max() * STEP_S


@pytest.mark.parametrize("arms", [("left",), ("right",), BOTH])
def test_a_motion_is_followed_to_its_end_on_its_cubics(tmp_path, arms):
    rig, motion, seen = Rig(tmp_path, SerialFirmware(arms)), trajectory(arms), []
    result = run(rig, motion, at_start=True, feedback=lambda time_s, q: seen.append((time_s, q)))
    assert end(result) == ("succeeded", ResultCode.SUCCESSFUL)
    assert result.state_is_commanded
    np.testing.assert_allclose(result.q_rad, motion.q_rad[-1], atol=1e-6)
    assert rig.jump_rad <= largest_step(motion)
    for time_s, q in seen:  # a cubic through points of a cubic is that cubic
        s = time_s / motion.duration_s
        wanted = motion.q_rad[0] + s * s * (3 - 2 * s) * (motion.q_rad[-1] - motion.q_rad[0])
        np.testing.assert_allclose(q, wanted, atol=3e-6)
    assert len(seen) >= motion.duration_s / 0.12


def test_the_next_motion_begins_where_the_last_was_commanded_to_end(rig):
    motion = trajectory()
    assert run(rig, motion, at_start=True).state == "succeeded"
    there = JointTrajectory(("left",), motion.time_s, motion.q_rad[::-1], -motion.qd_rad_s[::-1])
    elsewhere = JointTrajectory(("left",), motion.time_s, motion.q_rad[::-1] + 0.002, -motion.qd_rad_s[::-1])
    refused = run(rig, elsewhere)
    assert end(refused) == REJECTED
    assert "left/shoulder_pan_joint" in refused.text
    assert "last commanded" in refused.text
    assert run(rig, there).state == "succeeded"


def test_a_first_point_after_the_start_is_reached_from_there(rig):
    assert run(rig, trajectory(), at_start=True).state == "succeeded"
    here = trajectory().q_rad[-1:]
    stay = JointTrajectory(("left",), np.array([0.5, 1.0]), np.concatenate([here, here + 0.1]), np.zeros((2, 1, 6)))
    assert run(rig, stay).state == "succeeded"


def test_an_unknown_position_is_refused_and_nothing_moves(rig):
    refused = run(rig, trajectory())
    assert end(refused) == REJECTED
    assert "--at-start" in refused.text
    assert rig.path == []
    assert Request.POINT not in rig.firmware.executed


@pytest.mark.parametrize(
    ("time_s", "words"),
    [
        ((0.0, 5000.0, 9000.0), "the last point is 9000 s ahead"),  # more microseconds than the protocol has bits for
        ((0.0, 1e-309, 1.0), "reaches nan rad/s after point 0"),
    ],
)
def test_what_the_line_cannot_carry_is_refused(rig, time_s, words):
    q = np.array([0.0, 1.0, 0.0]).reshape(3, 1, 1) * np.ones((3, 1, 6))
    refused = run(rig, JointTrajectory(("left",), np.array(time_s), q, np.zeros((3, 1, 6))), at_start=True)
    assert end(refused) == REJECTED
    assert words in refused.text
    assert Request.POINT not in rig.firmware.executed


def test_a_device_that_lost_its_power_has_to_be_declared_again(tmp_path, rig):
    assert run(rig, trajectory(), at_start=True).state == "succeeded"
    rig.firmware = SerialFirmware(boot=2)
    back = JointTrajectory(("left",), np.array([0.0, 2.0]), trajectory().q_rad[[-1, 0]], np.zeros((2, 1, 6)))
    assert end(run(rig, back)) == REJECTED
    assert run(rig, back, at_start=True).state == "succeeded"


def test_commands_of_another_program_are_noticed(tmp_path, rig):
    assert run(rig, trajectory(), at_start=True).state == "succeeded"
    note = next(tmp_path.glob("serial-arm-*.json"))
    values = json.loads(note.read_text())
    values["q_rad"][0][3] += 0.01
    note.write_text(json.dumps(values))
    assert end(run(rig, trajectory())) == REJECTED


DAMAGED = ["", "{", "[]", '{"q_rad": [[1]], "settled": true, "boot": 1}', '{"q_rad": [], "settled": 1, "boot": 1}']


@pytest.mark.parametrize("text", DAMAGED)
def test_a_damaged_note_is_kept_and_refused(tmp_path, rig, text):
    assert run(rig, trajectory(), at_start=True).state == "succeeded"
    note = next(tmp_path.glob("serial-arm-*.json"))
    note.write_text(text)
    refused = run(rig, trajectory(), at_start=True)
    assert end(refused) == REJECTED
    assert "move the file away" in refused.text
    assert note.read_text() == text


def test_no_motion_begins_if_its_note_cannot_be_written(tmp_path, rig):
    (tmp_path / "serial-arm-00000001.json").mkdir()
    assert end(run(rig, trajectory(), at_start=True)) == REJECTED
    assert rig.path == []


def test_cancelling_stops_on_the_path_and_the_end_is_known(rig):
    motion, times = trajectory(), []
    result = run(
        rig,
        motion,
        at_start=True,
        feedback=lambda time_s, q: times.append(time_s),
        canceled=lambda: times[-1] > 0.8,
    )
    assert end(result) == ("preempted", ResultCode.SUCCESSFUL)
    assert rig.firmware.state == MotionState.STOPPED
    assert rig.jump_rad <= largest_step(motion)
    q = result.q_rad[0]
    s = (q[0] - motion.q_rad[0, 0, 0]) / (motion.q_rad[-1, 0, 0] - motion.q_rad[0, 0, 0])
    np.testing.assert_allclose(q, motion.q_rad[0, 0] + s * (motion.q_rad[-1, 0] - motion.q_rad[0, 0]), atol=5e-6)
    rest = JointTrajectory(
        ("left",), np.array([0.0, 1.0]), np.stack([result.q_rad, motion.q_rad[-1]]), np.zeros((2, 1, 6))
    )
    assert run(rig, rest).state == "succeeded"


def test_an_error_in_the_feedback_stops_the_arms(rig):
    def fail(time_s, q):
        if time_s > 0.5:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        run(rig, trajectory(), at_start=True, feedback=fail)
    rig.system.clock.sleep(0.5)
    assert rig.firmware.state == MotionState.STOPPED
    here = JointTrajectory(
        ("left",), np.array([0.0, 1.0]), np.stack([rig.firmware.q_rad, trajectory().q_rad[0]]), np.zeros((2, 1, 6))
    )
    assert run(rig, here).state == "succeeded"  # the firmware knows what the program did not see


# Faults of the line.


def test_an_unplugged_line_lets_the_firmware_stop_by_itself(rig):
    motion = trajectory()
    rig.at[0.9] = rig.unplug
    result = run(rig, motion, at_start=True)
    assert end(result) == ABORTED
    assert result.reason == "lost"
    assert "look where they stand" in result.text
    rig.system.clock.sleep(2.0)
    assert rig.firmware.state == MotionState.STOPPED
    assert rig.jump_rad <= largest_step(motion)
    moved = [time_s for (time_s, q), (_, after) in itertools.pairwise(rig.path) if (q != after).any()]
    assert moved[-1] - rig.path[0][0] <= 0.9 + 0.5 + 0.25 + 2 * STEP_S


def test_a_dead_device_is_named_and_nothing_moves(rig):
    rig.there.cut = True
    result = run(rig, trajectory(), at_start=True)
    assert end(result) == REJECTED
    assert "no valid answer to HELLO" in result.text


def test_bytes_that_come_later_than_the_watchdog_stop_the_arms(rig):
    def slow():
        rig.there.delay_s = 0.7

    rig.at[0.5] = slow
    result = run(rig, trajectory(), at_start=True)
    assert result.state == "aborted"
    rig.system.clock.sleep(1.0)
    assert rig.firmware.state == MotionState.STOPPED


def test_late_bytes_within_the_limit_cost_only_time(rig):
    rig.there.delay_s = rig.back.delay_s = 0.02
    assert run(rig, trajectory(), at_start=True).state == "succeeded"


def test_answers_that_come_after_their_retry_are_not_mixed_up(rig):
    rig.back.delay_s = 0.09  # each answer comes during a later try
    assert run(rig, trajectory(), at_start=True).state == "succeeded"
    assert rig.firmware.executed.count(Request.START) == 1
    assert rig.firmware.executed.count(Request.POINT) == len(trajectory())


@pytest.mark.parametrize("device", ["nonsense", "an old version", "one arm"])
def test_other_devices_are_refused(tmp_path, device):
    rig = Rig(tmp_path)
    if device == "nonsense":
        rig.firmware.receive = lambda data, now_s: b"ok\r\n" * bool(data)
    elif device == "an old version":
        rig.firmware.info = rig.firmware.info._replace(version=0)
    arms = BOTH if device == "one arm" else ("left",)
    result = run(rig, trajectory(arms), at_start=True)
    assert result.state == "rejected"
    assert result.code == (ResultCode.INVALID_JOINTS if device == "one arm" else ResultCode.INVALID_GOAL)
    assert rig.path == []


def test_a_full_buffer_is_refused_before_and_by_the_firmware(tmp_path):
    rig = Rig(tmp_path, SerialFirmware(capacity=4))
    early = run(rig, trajectory(points=5), at_start=True)
    assert "holds 4" in early.text
    rig.firmware.info = rig.firmware.info._replace(capacity=5)
    rig.firmware._points[0] = _Full()
    late = run(rig, trajectory(points=5), at_start=True)
    assert end(early) == end(late) == REJECTED
    assert "its buffer is full" in late.text
    assert rig.path == []


class _Full(list):
    def __len__(self):
        return 99


def test_a_restart_of_the_device_ends_the_motion(rig):
    def restart():
        rig.firmware = SerialFirmware(boot=2)

    rig.at[0.6] = restart
    result = run(rig, trajectory(), at_start=True)
    assert end(result) == ABORTED
    assert "restarted" in result.text
    assert end(run(rig, trajectory())) == REJECTED


@settings(max_examples=scaled(400), suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(
    seed=st.integers(0, 2**32 - 1),
    loss=st.sampled_from([0.0, 0.001, 0.01]),
    garble=st.sampled_from([0.0, 0.001, 0.01]),
    delay_s=st.sampled_from([0.0, 0.01, 0.05]),
)
def test_any_bad_line_ends_in_a_result_without_a_jump(tmp_path_factory, seed, loss, garble, delay_s):
    rig, motion = Rig(tmp_path_factory.mktemp("state"), SerialFirmware(BOTH), seed=seed), trajectory(BOTH, duration_s=1)
    for line in (rig.there, rig.back):
        line.loss, line.garble, line.delay_s = loss, garble, delay_s
    result = run(rig, motion, at_start=True)
    rig.system.clock.sleep(2.0)
    assert rig.jump_rad <= largest_step(motion)
    assert rig.firmware.executed.count(Request.START) <= 1
    if result.state == "succeeded":
        np.testing.assert_allclose(rig.firmware.q_rad, motion.q_rad[-1], atol=1e-6)
    elif result.state == "rejected":
        assert rig.path == []
    else:
        assert rig.firmware.state != MotionState.MOVING
    assert loss or garble or result.state == "succeeded"


# Bad input.


def bad(**changes):
    values = {"time_s": [0.0, 1.0], "q_rad": np.zeros((2, 1, 6)), "qd_rad_s": np.zeros((2, 1, 6)), **changes}
    return JointTrajectory(("left",), **values)


@pytest.mark.parametrize(
    ("motion", "words"),
    [
        (bad(time_s=[0.0], q_rad=np.zeros((1, 1, 6)), qd_rad_s=np.zeros((1, 1, 6))), "2 points"),
        (bad(qd_rad_s=np.stack([np.zeros((1, 6)), np.eye(6)[2:3] * 0.1])), "elbow_joint has 0.1 rad/s at the last"),
        (bad(qd_rad_s=np.stack([np.eye(6)[:1] * 0.1, np.zeros((1, 6))])), "at the first"),
        (bad(q_rad=np.stack([np.zeros((1, 6)), np.full((1, 6), 2.7)]), time_s=[0.0, 9.0]), "reaches 2.7 rad"),
        (bad(q_rad=np.stack([np.zeros((1, 6)), np.full((1, 6), 1.2)])), "reaches 1.8 rad/s after point 0"),
    ],
)
def test_bad_trajectories_are_refused_with_joint_and_remedy(rig, motion, words):
    refused = run(rig, motion, at_start=True)
    assert end(refused) == REJECTED
    assert words in refused.text
    assert rig.firmware.executed == []


@given(st.integers(0, 2**32 - 1))
def test_bounds_of_cubics_hold_everywhere(seed):
    from dual_ur10.sim2real.serial_arm.firmware import _hermite
    from dual_ur10.sim2real.serial_arm.open_loop_arm import _extremes
    from dual_ur10.sim2real.serial_arm.protocol import Point

    rng = np.random.default_rng(seed)
    motion = bad(
        q_rad=rng.normal(size=(2, 1, 6)), qd_rad_s=rng.normal(size=(2, 1, 6)), time_s=[0.0, rng.uniform(0.1, 3)]
    )
    points = [
        Point(0, k, t, tuple(motion.q_rad[k, 0]), tuple(motion.qd_rad_s[k, 0])) for k, t in enumerate(motion.time_s)
    ]
    times = np.linspace(0.0, motion.duration_s, 400)
    path = np.array([_hermite(points, each) for each in times])
    q, qd = (each[0, 0] for each in _extremes(motion))
    assert (np.abs(path).max(axis=0) <= q + 1e-9).all()
    speed = np.abs(np.diff(path, axis=0)).max(axis=0) / times[1]
    assert (speed <= qd + 1e-9).all()
    assert (speed >= qd - 0.05 * (1 + qd)).all()


@pytest.mark.parametrize("value", [0.0, -1.0, 11.0, float("nan")])
def test_limits_are_checked(value):
    with pytest.raises(SettingsError, match="speed_rad_s"):
        SerialLimits(speed_rad_s=value)


def test_a_port_that_does_not_exist_is_named(tmp_path):
    result = execute(trajectory(), str(tmp_path / "ttyUSB9"), at_start=True)
    assert end(result) == REJECTED
    assert "ttyUSB9 cannot be opened" in result.text


def test_the_missing_extra_is_named():
    code = """import sys
sys.modules["serial"] = None
from dual_ur10.sim2real.serial_arm.serial_line import SerialTransport
SerialTransport("/dev/null", 57600)"""
    found = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert 'pip install "dual-ur10[serial]"' in found.stderr


def test_a_real_port_with_pyserial():
    with serial_port(SerialFirmware()) as port:
        result = execute(trajectory(duration_s=0.3, size_rad=0.05), port, at_start=True)
    assert end(result) == ("succeeded", ResultCode.SUCCESSFUL), result.text


def test_a_dense_trajectory_is_reduced_to_the_buffer_of_the_firmware(rig):
    time_s = np.linspace(0.0, 10.0, 1251)
    s = np.clip(np.minimum(time_s, 10.0 - time_s) / 2.0, 0.0, 1.0)
    wave = (0.08 * s**2 * (3 - 2 * s) * np.sin(np.pi * time_s))[:, None, None] * np.ones((1, 1, 6))
    dense = JointTrajectory(("left",), time_s, wave, np.gradient(wave, time_s, axis=0))
    result = run(rig, dense, at_start=True)
    assert result.state == "succeeded", result.text
    assert rig.firmware.executed.count(Request.POINT) <= 36
    begin_s = rig.path[0][0]
    for at_s, q in rig.path[::20]:
        near = [np.interp(at_s - begin_s + late, time_s, wave[:, 0, 0]) for late in (-0.003, 0.0, 0.003)]
        assert min(near) - 1.1e-3 <= q[0, 0] <= max(near) + 1.1e-3
    narrow = run(rig, dense, at_start=True, bound_rad=1e-6)
    assert end(narrow) == REJECTED
    assert "deviate" in narrow.text
