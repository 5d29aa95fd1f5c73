"""Files of trajectories: what is written is read, messages of ROS are read, and anything else is named."""

import json
import resource
import signal

import numpy as np
import pytest
import yaml
from hypothesis import given
from hypothesis import strategies as st

from dual_ur10.errors import DualUR10Error, TrajectoryError, UnknownNameError
from dual_ur10.sim2real.trajectory import files
from dual_ur10.sim2real.trajectory.files import parse_trajectory, read_trajectory, write_trajectory
from dual_ur10.sim2real.trajectory.joint_trajectory import JointTrajectory, ResultCode
from ur_core.kinematics.ur10 import JOINTS

MESSAGE = """\
header:
  stamp:
    sec: 0
    nanosec: 0
  frame_id: world
joint_names:
- right_elbow_joint
- right_shoulder_lift_joint
- right_shoulder_pan_joint
- right_wrist_1_joint
- right_wrist_2_joint
- right_wrist_3_joint
points:
- positions: [3.0, 2.0, 1.0, 4.0, 5.0, 6.0]
  velocities: [0.0, 0, 0, 0, 0, 0]
  accelerations: []
  effort: []
  time_from_start:
    sec: 0
    nanosec: 500000000
- positions: [3.1, 2.0, 1.0, 4.0, 5.0, 6.0]
  velocities: [0, 0, 0, 0, 0, 0]
  time_from_start: {sec: 2}
---
"""


def made(seed, order, arms):
    rng = np.random.default_rng(seed)
    count = int(rng.integers(1, 20))
    time = np.cumsum(rng.integers(1, 10**9, count)) / 1e9
    return JointTrajectory(arms, time, *rng.normal(size=(1 + order, count, len(arms), 6)))


def assert_equal(first, second):
    assert first.arms == second.arms
    np.testing.assert_allclose(first.time_s, second.time_s, rtol=0, atol=1e-9)
    for name in ("q_rad", "qd_rad_s", "qdd_rad_s2"):
        one, other = getattr(first, name), getattr(second, name)
        assert (one is None) == (other is None)
        assert one is None or np.array_equal(one, other)


@given(st.integers(0, 2**31), st.integers(0, 2), st.sampled_from([("left",), ("right",), ("left", "right")]))
def test_what_is_written_is_read(seed, order, arms):
    trajectory = made(seed, order, arms)
    text = files._json_of(trajectory)
    assert_equal(parse_trajectory(text.encode(), "json"), trajectory)
    assert_equal(parse_trajectory(files._csv_of(trajectory).encode(), "csv"), trajectory)
    assert_equal(parse_trajectory(yaml.safe_dump(json.loads(text)).encode(), "yaml"), trajectory)


@pytest.mark.parametrize("suffix", [".json", ".csv"])
def test_files_are_written_once(tmp_path, suffix):
    path = tmp_path / f"points{suffix}"
    trajectory = made(0, 2, ("left", "right"))
    assert write_trajectory(path, trajectory) == path
    assert_equal(read_trajectory(path), trajectory)
    before = path.read_bytes()
    with pytest.raises(TrajectoryError, match="exists"):
        write_trajectory(path, made(1, 0, ("left",)))
    assert path.read_bytes() == before


@pytest.mark.parametrize("suffix", [".json", ".csv"])
def test_a_full_disk_leaves_no_part_of_a_file(tmp_path, suffix):
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    handler = signal.signal(signal.SIGXFSZ, signal.SIG_IGN)  # a write beyond the limit fails with EFBIG
    try:
        resource.setrlimit(resource.RLIMIT_FSIZE, (100, before[1]))
        with pytest.raises(TrajectoryError, match="cannot write"):
            write_trajectory(tmp_path / f"points{suffix}", made(0, 2, ("left", "right")))
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)
        signal.signal(signal.SIGXFSZ, handler)
    assert not list(tmp_path.iterdir())


def test_a_message_of_ros_is_read_whatever_the_order_of_its_joints():
    found = parse_trajectory(MESSAGE.encode(), "yaml")
    assert found.arms == ("right",)
    np.testing.assert_array_equal(found.q_rad[:, 0], [[1, 2, 3, 4, 5, 6], [1, 2, 3.1, 4, 5, 6]])
    np.testing.assert_array_equal(found.time_s, [0.5, 2.0])
    assert found.qd_rad_s is not None
    assert found.qdd_rad_s2 is None


@pytest.mark.parametrize(
    ("old", "new", "code", "text"),
    [
        ("right_elbow_joint", "right_elbow_jiont", -2, "did you mean right/elbow_joint?"),
        ("right_elbow_joint", "elbow_joint", -2, "did you mean left/elbow_joint"),
        ("- right_elbow_joint\n", "- left_elbow_joint\n", -2, "joint left/shoulder_pan_joint is missing"),
        ("- right_elbow_joint\n", "- right_wrist_1_joint\n", -2, "right/wrist_1_joint is there twice"),
        ("- right_elbow_joint\n", "", -1, "points[0].positions has 6 numbers, and there are 5 joints"),
        ("    sec: 0\n    nanosec: 0\n  f", "    sec: 7\n  f", -3, "header.stamp is not 0"),
        ("sec: 2", "sec: 0", -1, "point 1 is at 0 s, the one before at 0.5 s: times must increase"),
        ("sec: 2", "sec: -2", -1, "times must increase"),
        ("[3.1,", "[.nan,", -1, "q_rad of right/elbow_joint at point 1 is nan"),
        ("[3.1,", "['3.1',", -1, "points[1].positions[0] is '3.1'"),
        ("effort: []", "effort: [1, 1]", -1, "efforts cannot be commanded"),
        ("velocities: [0, 0, 0, 0, 0, 0]\n", "velocities: []\n", -1, "points[1].velocities has 0 numbers"),
        ("time_from_start: {sec", "time_from_stert: {sec", -1, "time_from_start"),
        ("  frame_id: world", "  frame: world", -1, "header.frame is unknown: remove it, or did you mean frame_id?"),
        ("---", "---\n{}", -1, "there are 2 documents"),
        ("header:", "header: [", -1, "this is no YAML"),
        ("header:", "&a [*a]\n---\n", -1, "has the anchor 'a': write the values out"),
        ("header:", "*a", -1, "has the anchor 'a'"),
        ("frame_id: world", "frame_id: !!bool foo", -1, "has the tag"),
        ("frame_id: world", "frame_id: !!int ''", -1, "has the tag"),
        ("frame_id: world", "frame_id: !!timestamp x", -1, "has the tag"),
        ("frame_id: world", "frame_id: !!python/object:os.system {}", -1, "this is no YAML"),
    ],
)
def test_a_wrong_message_is_named(old, new, code, text):
    assert old in MESSAGE
    with pytest.raises(TrajectoryError) as found:
        parse_trajectory(MESSAGE.replace(old, new, 1).encode(), "yaml", "my file")
    assert found.value.code == ResultCode(code)
    assert text in str(found.value)
    assert str(found.value).startswith("my file: ")


@pytest.mark.parametrize("kind", ["json", "yaml"])
def test_a_number_of_too_many_digits_is_none(kind):
    with pytest.raises(TrajectoryError, match=r"this is no \w+: a value has too many digits to be a number here$"):
        parse_trajectory(b'{"points": ' + b"7" * 5000 + b"}", kind)


@pytest.mark.parametrize("content", [b"[]", b"3", b"null", b"{}", b"[" * 100_000, b"\xff", b'{"points": NaN}', b""])
@pytest.mark.parametrize("kind", ["json", "yaml", "csv"])
def test_other_content_is_refused(content, kind):
    with pytest.raises(TrajectoryError):
        parse_trajectory(content, kind)


HEADER = "time_s," + ",".join(f"left/{each}" for each in JOINTS)


@pytest.mark.parametrize(
    ("content", "text"),
    [
        ("t,a\n1,2\n", "the first column is 't'"),
        (f"{HEADER}\n", "there are 0 rows"),
        (f"{HEADER}\n1,2,3\n", "point 0 has 3 values, and the header 7"),
        (f"{HEADER}\n0,1,2,3,4,5,x\n", "a value is no number"),
        (f"{HEADER}\n0,1,2,3,4,5,inf\n", "left/wrist_3_joint at point 0 is inf"),
        (f"{HEADER},left/elbow_joint.speed\n0,1,2,3,4,5,6,7\n", "has no column with the suffix '.speed'"),
        (f"{HEADER},left/elbow_joint\n0,1,2,3,4,5,6,7\n", "there twice"),
        ("time_s\n0\n", "no column of a joint"),
        (HEADER.replace("elbow", "elbwo") + "\n0,1,2,3,4,5,6\n", "did you mean left/elbow_joint?"),
    ],
)
def test_a_wrong_table_is_named(content, text):
    with pytest.raises(TrajectoryError) as found:
        parse_trajectory(content.encode(), "csv")
    assert text in str(found.value)


def test_a_trajectory_that_no_goal_may_last_is_refused():
    text = f"{HEADER}\n0,1,2,3,4,5,6\n1e9,1,2,3,4,5,6\n"
    with pytest.raises(TrajectoryError, match=r"is 1e\+09 s ahead, .* cut the trajectory into goals") as found:
        parse_trajectory(text.encode(), "csv")
    assert found.value.code == ResultCode.INVALID_GOAL
    message = MESSAGE.replace("{sec: 2}", "{sec: 3601}").encode()
    with pytest.raises(TrajectoryError, match="is 3601 s ahead"):
        parse_trajectory(message, "yaml")
    assert parse_trajectory(message, "yaml", number_points=True).duration_s == 3601.0  # times do not count there


ROWS = f"{HEADER}\n0,1.25,2.25,3.25,4.25,5.25,6.25\n1,1.5,2.5,3.5,4.5,5.5,6.5\n"


@pytest.mark.parametrize("line_end", ["\n", "\r\n"])
@given(cut=st.integers(len(HEADER) + 1 + len("0,1.25,2.25,3.25,4.25,5.25,6.25\n"), len(ROWS) - 1))
def test_a_row_that_was_cut_off_is_refused_or_left_out(line_end, cut):
    text = ROWS[:cut].replace("\n", line_end)
    found = parse_trajectory(text.encode(), "csv", allow_partial=True)
    assert found.q_rad.tolist() == [[[1.25, 2.25, 3.25, 4.25, 5.25, 6.25]]]
    if not text.endswith(line_end):
        with pytest.raises(TrajectoryError, match=r"it may be cut off.*--allow-partial"):
            parse_trajectory(text.encode(), "csv")


def test_whole_rows_are_all_read(tmp_path):
    (tmp_path / "a.csv").write_text(ROWS)
    for allow_partial in (False, True):
        assert len(read_trajectory(tmp_path / "a.csv", allow_partial=allow_partial)) == 2


def test_files_that_cannot_be_read_or_written_are_named(tmp_path, monkeypatch):
    with pytest.raises(TrajectoryError, match="there is no file"):
        read_trajectory(tmp_path / "a.json")
    with pytest.raises(TrajectoryError, match="suffix"):
        read_trajectory(tmp_path / "a.txt")
    with pytest.raises(TrajectoryError, match="suffix must be"):
        write_trajectory(tmp_path / "a.yaml", made(0, 0, ("left",)))
    with pytest.raises(DualUR10Error, match="does not exist"):
        write_trajectory(tmp_path / "b" / "a.json", made(0, 0, ("left",)))
    with pytest.raises(UnknownNameError):
        parse_trajectory(b"", "xml")
    monkeypatch.setattr(files, "MOST_YAML_BYTES", 10)
    with pytest.raises(TrajectoryError, match="convert it to JSON"):
        parse_trajectory(MESSAGE.encode(), "yaml")
