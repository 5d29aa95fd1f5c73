"""Writing and reading records."""

from __future__ import annotations

import math
import signal
import struct
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest
from mcap.reader import make_reader
from mcap_ros2.decoder import DecoderFactory

from dual_ur10.errors import ClosedError, RecordingError
from dual_ur10.sim2real.recording import mcap_records as mcap
from dual_ur10.sim2real.recording.reader import read_run
from dual_ur10.sim2real.recording.run import RunEvent
from dual_ur10.sim2real.recording.run_folder import check_name, new_folder
from dual_ur10.sim2real.recording.schemas import EPISODE_TOPIC, STATE_COLUMNS, STEP_TOPIC
from dual_ur10.sim2real.recording.writer import RunWriter
from tests.sim2real.recording.runs import TICKS, begin_row, header, step_row, write
from tests.soak import scaled
from ur_core.kinematics.ur10 import ARMS, JOINTS

ROOT = Path(__file__).parents[3]


@pytest.fixture
def rng():
    return np.random.default_rng(8)


def written(folder, rng, **changes):
    with RunWriter(folder, header(**changes)) as writer:
        given = write(writer, rng)
        writer.event(RunEvent(0.1, "note", "größer", "right"))
    return writer.path, given


def columns(rows):
    """A row of states as a dict by name."""
    found, at = {}, 0
    for name, size in STATE_COLUMNS:
        found[name] = rows[:, at] if size == 1 else rows[:, at : at + size]
        at += size
    return found


def test_everything_comes_back_bit_for_bit(tmp_path, rng):
    path, given = written(tmp_path, rng)
    run = read_run(path)
    assert run.complete
    assert run.header == header()
    assert run.events == [RunEvent(0.1, "note", "größer", "right")]
    for arm in range(2):
        states, sent = (np.vstack(given[name][arm]) for name in ("states", "sent"))
        log = run.arms[arm]
        assert log.state.keys() == dict(STATE_COLUMNS).keys()
        for name, values in columns(states).items():
            assert np.array_equal(log.state[name], values, equal_nan=True), name
        assert np.array_equal(np.column_stack(list(log.sent.values())), sent)
        assert list(log.sent) == ["period", "index", "sent_s", "late_s", "target_rad"]
    for number, episode in enumerate(run.episodes):
        begin_s, begin = given["begins"][number]
        rows = [row for at, row in given["steps"] if at == number]
        assert (episode.number, episode.begin_s, episode.seed) == (number, begin_s, 2**70 + 1)
        assert episode.initial_state == bytes(range(256))
        assert (episode.success, episode.ended_by) == (True, "so")
        for name in ("action", "targets_rad", "gripper_m", "gated", "reward", "terminated", "truncated", "time_s"):
            assert np.array_equal(getattr(episode, name), np.array([getattr(row, name) for row in rows])), name
        for name in ("observation", "q_rad", "flange_m"):
            values = [getattr(begin, name), *(getattr(row, name) for row in rows)]
            assert np.array_equal(getattr(episode, name), np.array(values)), name
        assert episode.targets_rad.shape == (6, TICKS, 2, 6)


def test_what_is_not_there_is_none(tmp_path, rng):
    with RunWriter(tmp_path, header()) as writer:
        begin = begin_row(rng, seed=None, observation=None, initial_state=None)
        writer.single(EPISODE_TOPIC, 0.0, begin.encode(0, 0.0))
        step = step_row(rng, 0, gripper_m=None, observation=None)
        writer.single(STEP_TOPIC, 0.04, step.encode(0, 0))
        writer.single(EPISODE_TOPIC, 0.1, begin.encode(1, 0.1))
    first, second = read_run(tmp_path / "run.mcap").episodes
    assert (first.seed, first.observation, first.gripper_m, first.initial_state) == (None,) * 4
    assert (first.success, first.ended_by) == (None, "")
    assert second.q_rad.shape == (1, 2, 6)
    assert [len(each) for each in (second.action, second.targets_rad, second.reward, second.time_s)] == [0] * 4


def test_other_readers_decode_every_message(tmp_path, rng):
    path, given = written(tmp_path, rng)
    found = {}
    with path.open("rb") as file:
        reader = make_reader(file, validate_crcs=True, decoder_factories=[DecoderFactory()])
        for schema, channel, message, decoded in reader.iter_decoded_messages(log_time_order=False):
            found.setdefault(channel.topic, []).append((schema.name, message.log_time, decoded))
    began_ns = 1769860800_250000000
    for side, arm in enumerate(ARMS):
        states, sent = (np.vstack(given[name][side]) for name in ("states", "sent"))
        joints, own = found[f"/{arm}/joint_states"], found[f"/{arm}/state"]
        for row, (name, log_ns, message) in enumerate(joints):
            assert name == "sensor_msgs/msg/JointState"
            assert message.name == [f"{arm}/{joint}" for joint in JOINTS]
            values = {name: value[row] for name, value in columns(states).items()}
            assert message.position == values["q_rad"].tolist()
            assert message.velocity == values["qd_rad_s"].tolist()
            assert list(message.effort) == []
            stamp = message.header.stamp.sec * 10**9 + message.header.stamp.nanosec
            assert stamp == log_ns
            assert abs(stamp - began_ns - values["arrival_s"] * 1e9) < 2
            for key, value in values.items():
                assert np.array_equal(getattr(own[row][2], key), value, equal_nan=True), key
        assert [message.target_rad for _, _, message in found[f"/{arm}/target"]] == sent[:, 4:].tolist()
    steps = [message for _, _, message in found[STEP_TOPIC]]
    for message, (episode, row) in zip(steps, given["steps"], strict=True):
        assert (message.episode, message.gated, message.ended_by) == (episode, row.gated, row.ended_by)
        assert message.success == (-1 if row.success is None else 1)
        for name in ("action", "targets_rad", "gripper_m", "observation", "q_rad"):
            assert list(getattr(message, name)) == np.ravel(getattr(row, name)).tolist(), name
    (begin, *_), (event,) = found[EPISODE_TOPIC], found["/event"]
    assert (begin[2].seed, bytes(begin[2].initial_state)) == (str(2**70 + 1), bytes(range(256)))
    assert (event[2].kind, event[2].text, event[2].arm) == ("note", "größer", "right")


def test_the_index_lets_a_viewer_seek(tmp_path, rng):
    path, given = written(tmp_path, rng)
    with path.open("rb") as file:
        reader = make_reader(file, validate_crcs=True, decoder_factories=[DecoderFactory()])
        summary = reader.get_summary()
        assert len(summary.chunk_indexes) == 13  # twelve steps, and the event
        assert summary.statistics.message_count == 2 * 3 * 60 + 12 + 2 + 1
        assert {channel.topic for channel in summary.channels.values()} >= {"/left/joint_states", STEP_TOPIC}
        (metadata,) = reader.iter_metadata()
        assert metadata.name == "dual_ur10"
        begin = summary.statistics.message_start_time
        part = list(reader.iter_messages(["/left/target"], starting_at=begin + 10**8, ending_before=begin + 2 * 10**8))
    times = np.vstack(given["sent"][0])[:, 2]
    assert len(part) == ((times >= 0.1 - 1e-12) & (times < 0.2 - 1e-12)).sum()


def test_every_entry_of_the_index_leads_to_its_message(tmp_path, rng):
    path, _ = written(tmp_path, rng)
    data = path.read_bytes()
    with path.open("rb") as file:
        indexes = make_reader(file).get_summary().chunk_indexes
    count = 0
    for index in indexes:
        assert data[index.chunk_start_offset] == mcap.CHUNK
        messages = index.chunk_start_offset + 9 + 40
        end = index.chunk_start_offset + index.chunk_length
        assert min(index.message_index_offsets.values()) == end
        for channel, at in index.message_index_offsets.items():
            code, _, number, length = struct.unpack_from("<BQHI", data, at)
            assert (code, number) == (mcap.MESSAGE_INDEX, channel)
            for entry in struct.iter_unpack("<QQ", data[at + 15 : at + 15 + length]):
                found = struct.unpack_from("<BQHIQ", data, messages + entry[1])
                assert (found[0], found[2], found[4]) == (mcap.MESSAGE, channel, entry[0])
                count += 1
    assert count == 2 * 3 * 60 + 12 + 2 + 1


@pytest.mark.parametrize("cut", [0.3, 0.7, 0.97])
def test_a_file_that_was_cut_off_is_read_as_far_as_it_goes(tmp_path, rng, cut):
    path, given = written(tmp_path, rng)
    data = path.read_bytes()
    path.write_bytes(data[: int(len(data) * cut)])
    with pytest.raises(RecordingError, match="cut off at byte"):
        read_run(path)
    run = read_run(path, allow_partial=True)
    assert not run.complete
    count = len(run.arms[0].state["arrival_s"])
    assert 0 < count <= 60
    whole = np.vstack(given["states"][0])
    assert np.array_equal(run.arms[0].state["q_rad"], columns(whole)["q_rad"][:count])


def test_every_message_before_a_cut_is_read(tmp_path, rng):
    path, _ = written(tmp_path, rng)
    data = path.read_bytes()
    at = data.index(b"\x06", len(data) // 2)
    short = tmp_path / "short.mcap"
    steps = max(1, len(data) // scaled(1200, 40))
    before = -1
    for end in range(at, len(data), steps):
        short.write_bytes(data[:end])
        run = read_run(short, allow_partial=True)
        count = sum(len(arm.state["arrival_s"]) + len(arm.sent["sent_s"]) for arm in run.arms)
        assert count >= before
        before = count
    assert before == 2 * 2 * 60


def test_zeros_that_a_power_cut_leaves_are_no_rows(tmp_path, rng):
    path, _ = written(tmp_path, rng)
    data = path.read_bytes()
    end = data.index(b"\x0f\x04\0\0\0\0\0\0\0")  # the end of the data
    path.write_bytes(data[:end] + bytes(5000))
    with pytest.raises(RecordingError, match="only zeros"):
        read_run(path)
    assert len(read_run(path, allow_partial=True).arms[0].state["arrival_s"]) == 60


WRITE = """
import sys, numpy as np
from pathlib import Path
from dual_ur10.sim2real.recording.writer import RunWriter
from tests.sim2real.recording.runs import header, state_rows, sent_rows
writer = RunWriter(Path(sys.argv[1]), header())
rng, number = np.random.default_rng(0), 0
while True:
    times = np.arange(number, number + 25) * 0.002
    for arm in range(2):
        states = state_rows(rng, times)
        states[:, 1] = times
        writer.states(arm, states)
        writer.sent(arm, sent_rows(rng, times))
    writer.flush()
    number += 25
    print(number, flush=True)
"""


@pytest.mark.parametrize("trial", range(max(3, scaled(30))))
def test_what_was_flushed_survives_a_kill_at_any_instant(tmp_path, trial):
    process = subprocess.Popen(
        [sys.executable, "-c", WRITE, str(tmp_path)], cwd=ROOT, stdout=subprocess.PIPE, text=True
    )
    process.stdout.readline()
    time.sleep(np.random.default_rng(trial).uniform(0.0, 0.3))
    process.send_signal(signal.SIGKILL)
    flushed = int(process.stdout.read().split()[-1])
    process.wait()
    process.stdout.close()
    run = read_run(tmp_path / "run.mcap", allow_partial=True)
    for arm in run.arms:
        time_s = arm.state["timestamp_s"]
        assert len(time_s) >= flushed
        assert len(arm.sent["sent_s"]) >= flushed
        assert np.array_equal(time_s, np.arange(len(time_s)) * 0.002)


FILL = """
import resource, sys, numpy as np
from pathlib import Path
from dual_ur10.errors import RecordingError
from dual_ur10.sim2real.recording.writer import RunWriter
from tests.sim2real.recording.runs import header, write
resource.setrlimit(resource.RLIMIT_FSIZE, (100_000, 100_000))
writer = RunWriter(Path(sys.argv[1]), header())
try:
    write(writer, np.random.default_rng(1), steps=100)
except RecordingError as error:
    print(error)
for again in (writer.flush, writer.close):
    try:
        again()
    except RecordingError as error:
        print("again", error)
"""


def test_a_full_disk_is_named_and_the_file_can_be_read_up_to_there(tmp_path):
    done = subprocess.run([sys.executable, "-c", FILL, str(tmp_path)], cwd=ROOT, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    assert "run.mcap any more after " in done.stdout
    assert "File too large" in done.stdout
    run = read_run(tmp_path / "run.mcap", allow_partial=True)
    assert not run.complete
    count = len(run.arms[0].state["arrival_s"])
    assert count == len(run.arms[1].sent["sent_s"]) == 5 * len(run.episodes[0].reward)
    assert 20 < count < 100
    assert (tmp_path / "run.mcap").stat().st_size < 100_000


def test_too_little_room_is_refused_at_the_start(tmp_path):
    with pytest.raises(RecordingError, match=r"MiB are free, .* MiB are needed"):
        RunWriter(tmp_path, header(), least_free_bytes=2**60)
    assert list(tmp_path.iterdir()) == []


def test_nothing_is_overwritten_and_no_link_is_followed(tmp_path, rng):
    path, _ = written(tmp_path, rng)
    before = path.read_bytes()
    with pytest.raises(RecordingError, match="File exists"):
        RunWriter(tmp_path, header())
    assert path.read_bytes() == before
    other = tmp_path / "other"
    other.mkdir()
    (other / "run.mcap").symlink_to(other / "elsewhere")
    with pytest.raises(RecordingError):
        RunWriter(other, header())
    with pytest.raises(RecordingError, match="cannot record in"):
        RunWriter(tmp_path / "none", header())
    assert not (other / "elsewhere").exists()


def test_a_new_folder_never_is_one_that_exists(tmp_path):
    folders = [new_folder(tmp_path / "runs", header()) for _ in range(3)]
    assert [folder.name for folder in folders] == [
        "20260131T120000-SineTracking-v0-emulated",
        "20260131T120000-SineTracking-v0-emulated-2",
        "20260131T120000-SineTracking-v0-emulated-3",
    ]
    with pytest.raises(RecordingError, match="cannot make a folder"):
        new_folder(Path("/proc/none"), header())


@pytest.mark.parametrize("name", ["", "../x", "a/b", ".hidden", "a b", "ü", "a\n", "x" * 200, "a\0"])
def test_names_that_lead_elsewhere_are_refused(tmp_path, name):
    with pytest.raises(RecordingError, match="cannot be used"):
        check_name(name)
    with pytest.raises(RecordingError, match="cannot be used"):
        RunWriter(tmp_path, header(), name=name)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"kwargs": {"policy": object()}}, "JSON"),
        ({"extra": {"x": math.nan}}, "JSON"),
        ({"started_utc": "yesterday"}, "started_utc"),
    ],
)
def test_a_header_that_json_cannot_hold_is_refused(tmp_path, changes, message):
    with pytest.raises(RecordingError, match=message):
        RunWriter(tmp_path, header(**changes))


def test_a_closed_record_takes_nothing_more(tmp_path, rng):
    writer = RunWriter(tmp_path, header())
    writer.close()
    writer.close()
    with pytest.raises(ClosedError):
        writer.flush()
    run = read_run(tmp_path)
    assert run.complete
    assert run.episodes == run.events == []
    assert run.arms[0].state["q_rad"].shape == (0, 6)


def test_no_state_is_written_without_joints(tmp_path):
    with pytest.raises(RecordingError, match="q_rad"):
        RunWriter(tmp_path, header(), columns=(("arrival_s", 1), ("qd_rad_s", 6)))
