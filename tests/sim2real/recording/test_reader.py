"""Damaged, illegal and hostile files."""

from __future__ import annotations

import json
import math
import os
import struct
import subprocess
import sys
import zlib
from dataclasses import asdict

import numpy as np
import pytest

from dual_ur10.errors import RecordingError
from dual_ur10.sim2real.recording import mcap_records as mcap
from dual_ur10.sim2real.recording.cdr import CdrField, Schema
from dual_ur10.sim2real.recording.reader import read_run
from dual_ur10.sim2real.recording.run import LATE, RunEvent
from dual_ur10.sim2real.recording.schemas import EPISODE_TOPIC, EVENT_TOPIC, STEP_TOPIC
from dual_ur10.sim2real.recording.writer import RunWriter
from tests.sim2real.recording.runs import SENT_SIZE, begin_row, header, sent_rows, state_rows, step_row, write


@pytest.fixture
def rng():
    return np.random.default_rng(9)


def begun(writer, rng, number=0, at=0.0):
    writer.single(EPISODE_TOPIC, at, begin_row(rng).encode(number, at))


def refused(tmp_path, *parts, **keywords):
    with pytest.raises(RecordingError) as found:
        read_run(tmp_path, **keywords)
    for part in parts:
        assert part in str(found.value)
    assert "run.mcap" in str(found.value)


@pytest.mark.parametrize("field", ["q_rad", "qd_rad_s", "timestamp_s", "target_q_rad"])
@pytest.mark.parametrize("value", [math.nan, math.inf])
def test_states_that_are_not_finite_are_refused_with_their_row(tmp_path, rng, field, value):
    from tests.sim2real.recording.test_writer import columns

    with RunWriter(tmp_path, header()) as writer:
        rows = state_rows(rng, np.arange(10) * 0.008)
        columns(rows)[field][7] = value
        writer.states(1, rows)
    refused(tmp_path, "/right/state, row 7", field)
    # Reports of a controller matter most after a fault.
    assert len(read_run(tmp_path, allow_partial=True).arms[1].state["q_rad"]) == 10


@pytest.mark.parametrize("column", range(SENT_SIZE))
def test_targets_that_are_not_finite_are_refused_with_their_row(tmp_path, rng, column):
    with RunWriter(tmp_path, header()) as writer:
        rows = sent_rows(rng, np.arange(10) * 0.008)
        rows[3, column] = math.nan
        writer.sent(0, rows)
    refused(tmp_path, "/left/target, row 3", allow_partial=True)


def test_times_that_go_back_are_refused_with_their_row(tmp_path, rng):
    with RunWriter(tmp_path, header()) as writer:
        writer.states(0, state_rows(rng, np.array([0.0, 0.008, 0.004])))
    refused(tmp_path, "/left/state, row 2", "goes back from 0.008000 to 0.004000")


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"targets_rad": np.zeros((4, 2, 6))}, "48 numbers of targets, 60 belong to 5 ticks"),
        ({"gripper_m": np.zeros((4, 2))}, "8 gripper widths"),
        ({"action": np.zeros(14)}, "action has 14 numbers"),
        ({"observation": np.zeros(7)}, "observation has 7 numbers"),
        ({"time_s": 0.04}, "time_s goes from 0.040000 to 0.040000"),
        ({"action": np.full(12, np.nan)}, "action is not finite"),
        ({"targets_rad": np.full((5, 2, 6), np.inf)}, "targets_rad is not finite"),
        ({"reward": math.nan}, "reward is not finite"),
        ({"success": 5}, "success is 5"),
    ],
)
def test_illegal_steps_are_refused_with_their_row(tmp_path, rng, changes, message):
    with RunWriter(tmp_path, header()) as writer:
        begun(writer, rng)
        for number in range(2):
            row = step_row(rng, number, **(changes if number else {}))
            writer.single(STEP_TOPIC, 0.04 * number, row.encode(0, number))
    refused(tmp_path, "/step, row 1", message, allow_partial=True)


@pytest.mark.parametrize(
    ("episode", "step", "message"), [(0, 2, "it is step 2"), (0, 0, "it is step 0"), (1, 0, "no episode 1")]
)
def test_steps_that_do_not_follow_are_refused(tmp_path, rng, episode, step, message):
    with RunWriter(tmp_path, header()) as writer:
        begun(writer, rng)
        writer.single(STEP_TOPIC, 0.0, step_row(rng, 0).encode(0, 0))
        writer.single(STEP_TOPIC, 0.1, step_row(rng, 1).encode(episode, step))
    refused(tmp_path, "/step, row 1", message)


@pytest.mark.parametrize(("number", "at"), [(2, 1.0), (0, 1.0), (1, -1.0)])
def test_episodes_that_do_not_follow_are_refused(tmp_path, rng, number, at):
    with RunWriter(tmp_path, header()) as writer:
        begun(writer, rng)
        begun(writer, rng, number, at)
    refused(tmp_path, "/episode, row 1", "does not follow")


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"seed": "-1"}, "seed"),
        ({"seed": "9" * 101}, "seed"),
        ({"seed": "٣"}, "seed"),
        ({"number": -1}, "episode -1"),
        ({"first_step": 3}, "begins with step 3"),
        ({"begin_s": math.nan}, "not finite"),
        ({"q_rad": np.full(12, np.nan)}, "not finite"),
    ],
)
def test_an_illegal_episode_is_refused(tmp_path, rng, changes, message):
    from dual_ur10.sim2real.recording.schemas import BEGIN

    with RunWriter(tmp_path, header()) as writer:
        values = BEGIN.decode(begin_row(rng).encode(0, 0.0))
        writer.single(EPISODE_TOPIC, 0.0, BEGIN.encode(values | changes))
    refused(tmp_path, "/episode, row 0", message)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"source": "a dream"}, "source is 'a dream'"),
        ({"family": "ur20"}, "family is 'ur20'"),
        ({"tick_s": 0.0}, "tick_s is 0.0"),
        ({"tick_s": 10**400}, "tick_s is 1000"),
        ({"tick_s": True}, "tick_s is True"),
        ({"tick_s": "0.008"}, "tick_s is '0.008'"),
        ({"period_ticks": 0}, "period_ticks is 0"),
        ({"period_ticks": 10**9}, "period_ticks is 1000000000"),
        ({"speed_factor": 1.5}, "speed_factor is 1.5"),
        ({"mounts": [{}]}, "mounts is [{}]"),
        ({"mounts": [{"position_m": [0.0], "x": 2}] * 2}, "mounts.1.x is 2"),
        ({"mounts": [{"dh": {"a_m": [math.pi, "1"]}}] * 2}, "mounts.0.dh.a_m.1 is '1'"),
        ({"servoj": [1, 2]}, "servoj.1 is 2"),
        ({"servoj": [{}, {}]}, "servoj.1.lookahead_s: it is missing"),
        ({"servoj": [{"lookahead_s": 0.03, "gain": "x"}] * 2}, "servoj.0.gain is 'x'"),
        ({"servoj": [{"lookahead_s": 0.03, "gain": 10**400}] * 2}, "servoj.0.gain is 1000"),
        ({"versions": {"x": 1}}, "versions.x is 1"),
        ({"kwargs": []}, "kwargs is []"),
    ],
)
def test_an_illegal_header_is_refused(tmp_path, changes, message):
    RunWriter(tmp_path, header(**changes)).close()
    refused(tmp_path, message)


def preamble(line, **changes):
    values = {"format": "1", "header": line, "crc32": str(zlib.crc32(line.encode()))} | changes
    return mcap.MAGIC + mcap.header("x") + mcap.metadata("dual_ur10", values)


@pytest.mark.parametrize(
    ("line", "changes", "message"),
    [
        ("{", {}, "Invalid JSON"),
        ("[" * 100_000, {}, "recursion limit"),
        ("[]", {}, "it should be an object"),
        ('{"a": NaN}', {}, "env_id: it is missing"),
        ("1" * 5000, {}, "out of range"),
        ("{}", {"crc32": "0"}, "checksum"),
        ("{}", {"format": "2"}, "format is '2'"),
        (json.dumps(asdict(header()) | {"more": 1}), {}, "more is 1"),
        (json.dumps(asdict(header())).replace('"extra": {}', '"extra": {"x": [1e999]}'), {}, "inf is not finite"),
        (json.dumps(asdict(header())).replace("0.008", "NaN"), {}, "tick_s is nan"),
        (json.dumps(asdict(header())).replace("300.0", "Infinity"), {}, "servoj.1.gain is inf"),
        (
            json.dumps(asdict(header())).replace("[0.0, 0.5, 0.0]", "[0.0, NaN, 0.0]"),
            {},
            "mounts.0.position_m.1 is nan",
        ),
        (json.dumps(asdict(header()) | {"versions": {f"{k}": 0 for k in range(10**5)}}), {}, "characters: allowed are"),
        (json.dumps(asdict(header())), {}, "cut off"),
    ],
)
def test_a_damaged_header_is_refused(tmp_path, line, changes, message):
    (tmp_path / "run.mcap").write_bytes(preamble(line, **changes))
    refused(tmp_path, message, allow_partial=True)


def test_a_header_that_could_not_be_read_is_not_written(tmp_path):
    with pytest.raises(RecordingError, match="characters: allowed are 1048576"):
        RunWriter(tmp_path, header(extra={"text": "x" * 2**20}))


def head(code, length):
    return struct.pack("<BQ", code, length)


HOSTILE = {
    "empty": b"",
    "another": b"PK\x03\x04" + bytes(100),
    "magic only": mcap.MAGIC,
    "huge record": mcap.MAGIC + head(mcap.METADATA, 2**63),
    "huge chunk": mcap.MAGIC + head(mcap.CHUNK, 2**62) + bytes(100),
    "huge data of a chunk": mcap.MAGIC + mcap.record(mcap.CHUNK, bytes(32) + struct.pack("<Q", 2**63) + b"x"),
    "huge string": mcap.MAGIC + mcap.record(mcap.METADATA, struct.pack("<I", 2**32 - 1)),
    "unknown": mcap.MAGIC + head(0x77, 0),
    "attachment": mcap.MAGIC + mcap.record(0x09, bytes(50)),
    "no text": mcap.MAGIC + mcap.record(mcap.METADATA, struct.pack("<I", 2) + b"\xff\xfe"),
    "compressed": mcap.MAGIC + mcap.record(mcap.CHUNK, bytes(28) + mcap.text("zstd") + bytes(8)),
    "chunk of a chunk": mcap.MAGIC + mcap.chunk(0, 0, mcap.chunk(0, 0, b"")),
    "schema of another kind": mcap.MAGIC
    + mcap.record(mcap.SCHEMA, b"\1\0" + mcap.text("x") + mcap.text("pickle") + mcap.text("")),
    "channel without schema": mcap.MAGIC + mcap.channel(1, "/x"),
    "many schemas": mcap.MAGIC + b"".join(mcap.schema(number, "x", "") for number in range(100)),
    "many zeros": mcap.MAGIC + bytes(100_000),
    "footer at once": mcap.MAGIC + mcap.data_end(zlib.crc32(mcap.MAGIC)) + mcap.ending(0, []),
}


@pytest.mark.parametrize("name", HOSTILE)
def test_hostile_files_are_refused(tmp_path, name):
    (tmp_path / "run.mcap").write_bytes(HOSTILE[name])
    for allow_partial in (False, True):
        refused(tmp_path, allow_partial=allow_partial)


def test_sparse_files_are_not_taken_into_memory(tmp_path):
    path = tmp_path / "run.mcap"
    path.write_bytes(mcap.MAGIC + head(mcap.CHUNK, 2**40) + bytes(100))
    os.truncate(path, 2**41)
    refused(tmp_path, f"{2**41} bytes: allowed are")
    refused(tmp_path, f"{2**40} bytes: allowed are", most_bytes=2**42)


@pytest.mark.parametrize("where", ["profile", "preamble", "data", "summary"])
def test_one_wrong_bit_is_noticed(tmp_path, rng, where):
    with RunWriter(tmp_path, header()) as writer:
        end = len(writer.encoder.preamble)
        write(writer, rng)
        data_end = writer.size
    data = bytearray(writer.path.read_bytes())
    at = {"profile": 22, "preamble": end - 5, "data": (end + data_end) // 2, "summary": data_end + 60}[where]
    for bit in range(8):
        data[at] ^= 1 << bit
        writer.path.write_bytes(data)
        refused(tmp_path)
        data[at] ^= 1 << bit
    writer.path.write_bytes(data)
    assert read_run(tmp_path).complete


def test_one_wrong_bit_is_noticed_where_the_file_was_cut_off_later(tmp_path, rng):
    with RunWriter(tmp_path, header()) as writer:
        end = len(writer.encoder.preamble)
        write(writer, rng)
        data_end = writer.size
    data = bytearray(writer.path.read_bytes())[: data_end - 100]
    data[end + 2000] ^= 1
    writer.path.write_bytes(data)
    refused(tmp_path, "checksum is wrong", allow_partial=True)


def test_what_is_no_regular_file_is_refused(tmp_path, rng):
    other = tmp_path / "other"
    other.mkdir()
    with RunWriter(other, header()) as writer:
        write(writer, rng)
    (tmp_path / "run.mcap").symlink_to(other / "run.mcap")
    refused(tmp_path, "links are not followed")
    (tmp_path / "run.mcap").unlink()
    refused(tmp_path, "it is a folder of runs", str(other))
    os.mkfifo(tmp_path / "run.mcap")
    refused(tmp_path, "no regular file")
    (tmp_path / "run.mcap").unlink()
    (tmp_path / "run.mcap").mkdir()
    refused(tmp_path, "no regular file")
    with pytest.raises(RecordingError):
        read_run("/dev/zero")
    with pytest.raises(RecordingError):
        read_run("a\0b")


@pytest.mark.parametrize(
    ("values", "message"),
    [
        ({"time_s": math.nan, "arm": ""}, "not legal"),
        ({"time_s": 0.0, "arm": "middle"}, "not legal"),
    ],
)
def test_illegal_events_are_refused(tmp_path, values, message):
    from dual_ur10.sim2real.recording.schemas import EVENT

    with RunWriter(tmp_path, header()) as writer:
        writer.event(RunEvent(0.0, "note", "x"))
        writer.single(EVENT_TOPIC, 0.0, EVENT.encode({"kind": "", "text": ""} | values))
    refused(tmp_path, "/event, row 1", message)


@pytest.mark.parametrize("code", ["<IQHIQQ", "sequence", "channel", "short"])
def test_messages_that_are_missing_or_foreign_are_refused(tmp_path, rng, code):
    writer = RunWriter(tmp_path, header())
    (message,) = writer.encoder.sent(0, sent_rows(rng, np.array([0.0])))
    record = bytearray(message.records)
    if code == "sequence":
        record[11] = 1
    elif code == "channel":
        record[9] = 77
    elif code == "short":
        record = bytearray(struct.pack("<BQ", 5, 22) + bytes(record[9:31]))
    else:
        record[0] = 6
    writer.add([message._replace(records=bytes(record))])
    writer.close()
    refused(tmp_path)


FLAT = Schema(
    "x_msgs/msg/X",
    (CdrField("a", "float64[]"), CdrField("b", "string"), CdrField("c", "float64[3]"), CdrField("d", "uint8[]")),
)


@pytest.mark.parametrize("size", [0, 1, 3])
def test_messages_come_back_at_every_alignment(size):
    values = {"a": np.arange(size) + 0.5, "b": "ü" * size, "c": np.arange(3.0), "d": bytes(size)}
    found = FLAT.decode(FLAT.encode(values))
    assert (found["b"], found["d"]) == (values["b"], values["d"])
    assert np.array_equal(found["a"], values["a"])
    assert np.array_equal(found["c"], values["c"])
    data = FLAT.encode(values)
    for end in range(len(data)):
        with pytest.raises(RecordingError):
            FLAT.decode(data[:end])
    with pytest.raises(RecordingError, match="malformed"):
        FLAT.decode(data + b"\0")


def written(folder, targets, seed=9, **head):
    """Write a run of one episode whose steps begin with these targets."""
    rng = np.random.default_rng(seed)
    with RunWriter(folder, header(**head)) as writer:
        writer.single(EPISODE_TOPIC, 0.0, begin_row(rng).encode(0, 0.0))
        for step, target in enumerate(targets):
            writer.single(STEP_TOPIC, 0.1 * step, step_row(rng, step, first_target=target).encode(0, step))
    return folder


def test_steps_hold_the_number_of_their_first_target(tmp_path):
    targets = [40, 45, LATE, 130, 135]
    (episode,) = read_run(written(tmp_path, targets)).episodes
    assert episode.first_target.tolist() == targets
    assert episode.first_target.dtype == np.int64


@pytest.mark.parametrize("targets", [[40, 44], [40, LATE, 44], [-2], [-3], [2**60]])
def test_illegal_first_targets_are_refused_with_their_row(tmp_path, targets):
    with pytest.raises(RecordingError, match=f"/step, row {len(targets) - 1}: first_target is"):
        read_run(written(tmp_path, targets))


def test_the_seed_of_a_run_is_that_of_its_first_reset(tmp_path):
    assert read_run(written(tmp_path, [5], seed=1)).header.seed == 3  # as its header says
    (tmp_path / "run.mcap").unlink()
    rng = np.random.default_rng(0)
    with RunWriter(tmp_path, header(seed=None)) as writer:
        writer.single(EPISODE_TOPIC, 0.0, begin_row(rng, seed=71).encode(0, 0.0))
        writer.single(EPISODE_TOPIC, 1.0, begin_row(rng, seed=72).encode(1, 1.0))
    assert read_run(tmp_path).header.seed == 71


@pytest.mark.parametrize("package", ["mcap", "mcap_ros2"])
def test_without_the_libraries_only_writing_works(tmp_path, package):
    code = (
        "import sys, pathlib, numpy as np\n"
        f"sys.modules[{package!r}] = None\n"
        "from dual_ur10.errors import MissingExtraError\n"
        "from dual_ur10.sim2real.recording.writer import RunWriter\n"
        "from tests.sim2real.recording.runs import header, write\n"
        f"with RunWriter(pathlib.Path({str(tmp_path)!r}), header()) as writer:\n"
        "    write(writer, np.random.default_rng(0))\n"
        "try:\n"
        "    from dual_ur10.sim2real.recording.reader import read_run\n"
        f"    read_run({str(tmp_path)!r})\n"
        "except MissingExtraError as error:\n"
        "    print(error)\n"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=60)
    assert done.stderr == ""
    assert 'pip install "dual-ur10[records]"' in done.stdout
    assert read_run(tmp_path).complete
