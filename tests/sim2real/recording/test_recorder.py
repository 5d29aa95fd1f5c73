"""The recorder's process."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import threading
import time
from pathlib import Path

import numpy as np
import pytest

from dual_ur10.errors import RecordingError
from dual_ur10.sim2real.recording.black_box import KEPT_S, BlackBox
from dual_ur10.sim2real.recording.reader import read_run
from dual_ur10.sim2real.recording.recorder import RecorderProcess
from dual_ur10.sim2real.recording.recorder_process import Recorder
from dual_ur10.sim2real.recording.run import RunEvent
from dual_ur10.sim2real.recording.run_folder import LOG_FILE
from dual_ur10.sim2real.recording.schemas import EPISODE_TOPIC, STEP_TOPIC
from dual_ur10.sim2real.runtime.arm_memory import RING, ArmMemory, Phase
from tests.sim2real.recording.runs import OBSERVATION, begin_row, feed, header, sent_rows, state_rows, status, step_row

ROOT = Path(__file__).parents[3]


@pytest.fixture
def rng():
    return np.random.default_rng(10)


@pytest.fixture
def memories():
    pair = ArmMemory(), ArmMemory()
    yield pair
    for memory in pair:
        memory.close()


@pytest.fixture
def recorder(memories, tmp_path):
    process = RecorderProcess((memories[0].name, memories[1].name), tmp_path, header(), tmp_path)
    try:
        process.wait_until_ready()
        yield process
    finally:
        process.kill()


def waited(condition, within_s=20.0):
    end = time.monotonic() + within_s
    while not condition() and time.monotonic() < end:
        time.sleep(0.01)
    assert condition()


def test_states_targets_steps_and_events_are_recorded(recorder, memories, tmp_path, rng):
    recorder.begin_episode(begin_row(rng, initial_state=None))
    steps, number = [], 0
    for index in range(6):
        number = feed(memories, number, 20)
        steps.append(step_row(rng, index))
        recorder.step(steps[-1])
        time.sleep(0.03)
    recorder.event("note", "größer", "left")
    recorder.close()
    recorder.close()
    assert recorder.failure == ""
    assert recorder.boxes == []
    run = read_run(tmp_path)
    assert run.complete
    for arm in run.arms:
        assert np.array_equal(arm.state["q_rad"], np.tile(np.arange(number)[:, None], (1, 6)))
        assert np.array_equal(arm.sent["target_rad"][:, 0], np.arange(number))
        assert 0 < arm.state["arrival_s"][0] < arm.state["arrival_s"][-1] < 20
        assert 0 < arm.sent["sent_s"][0] < 20
        assert np.isnan(arm.state["payload_kg"]).all()
    (episode,) = run.episodes
    assert np.array_equal(episode.action, [row.action for row in steps])
    assert 0 < episode.begin_s < run.arms[0].state["arrival_s"][0]
    assert [(event.kind, event.text, event.arm) for event in run.events] == [("note", "größer", "left")]
    assert "left note: größer" in (tmp_path / LOG_FILE).read_text()


def test_earlier_rows_of_the_memories_are_not_recorded(memories, tmp_path):
    feed(memories, 0, 50)
    recorder = RecorderProcess((memories[0].name, memories[1].name), tmp_path, header(), tmp_path)
    recorder.wait_until_ready()
    feed(memories, 50, 10)
    recorder.close()
    assert read_run(tmp_path).arms[1].state["q_rad"][:, 0].tolist() == list(range(50, 60))


def test_a_stop_leaves_a_black_box_with_the_stop_in_it(recorder, memories, tmp_path, rng):
    recorder.begin_episode(begin_row(rng))
    recorder.step(step_row(rng, 0))
    feed(memories, 0, 20)
    memories[0].enter(Phase.STOPPING, "left: protective stop")
    time.sleep(0.3)
    feed(memories, 20, 5)
    memories[0].enter(Phase.STOPPED, "left: protective stop")
    waited(lambda: recorder.event("tick", "") or recorder.boxes)
    recorder.close()
    assert recorder.boxes == [tmp_path / "blackbox-1.mcap"]
    run = read_run(recorder.boxes[0])
    assert run.header.extra["black_box"]
    assert run.arms[0].state["q_rad"][:, 0].tolist() == list(range(25))
    assert len(run.episodes[0].reward) == 1
    found_events = [(event.kind, event.arm, event.text) for event in run.events if event.kind != "tick"]
    assert found_events == [
        ("phase", "left", "stopping: left: protective stop"),
        ("phase", "left", "stopped: left: protective stop"),
        ("stop", "", "left: protective stop"),
    ]


def test_a_requested_stop_leaves_no_black_box(recorder, memories):
    memories[0].enter(Phase.STOPPED, "left: a stop was requested")
    waited(lambda: recorder.event("tick", "") or recorder.now_s > 0.3)
    recorder.close()
    assert recorder.boxes == []


def test_black_boxes_are_written_without_a_run_too(memories, tmp_path):
    recorder = RecorderProcess((memories[0].name, memories[1].name), None, header(), tmp_path)
    recorder.wait_until_ready()
    feed(memories, 0, 10)
    recorder.black_box("a test")
    recorder.close()
    assert [path.name for path in tmp_path.iterdir()] == ["blackbox-1.mcap"]
    run = read_run(recorder.boxes[0])
    assert len(run.arms[0].state["q_rad"]) == 10
    assert [event.text for event in run.events] == ["a test", "a test"]


def test_a_black_box_keeps_the_last_seconds_and_their_episode(tmp_path, rng):
    box = BlackBox(tmp_path, header())
    rows = []
    box.single(EPISODE_TOPIC, 0.0, begin_row(rng).encode(4, 0.0))
    for number in range(100):
        now = 0.2 * (number + 1)
        rows.append(step_row(rng, number))
        box.states(0, state_rows(rng, np.linspace(now - 0.19, now, 20)))
        box.sent(1, sent_rows(rng, np.linspace(now - 0.19, now, 20)))
        box.single(STEP_TOPIC, now, rows[-1].encode(4, number))
        box.forget(now)
    run = read_run(box.write(20.0, "why"))
    (episode,) = run.episodes
    assert (episode.number, len(episode.reward)) == (4, 51)
    first = 100 - 51
    assert np.array_equal(episode.action, [row.action for row in rows[first:]])
    assert np.array_equal(episode.q_rad[0], rows[first - 1].q_rad)
    assert np.array_equal(episode.observation[0], rows[first - 1].observation)
    assert episode.observation.shape == (52, OBSERVATION)
    assert episode.initial_state is None
    times = run.arms[0].state["arrival_s"]
    assert 20 - KEPT_S - 0.21 < times[0] <= 20 - KEPT_S
    assert times[-1] == 20
    assert box.write(20.0, "again").name == "blackbox-2.mcap"


def test_lost_rows_are_an_event(memories, tmp_path):
    recorder = Recorder(memories, tmp_path, header(), tmp_path, time.monotonic(), 0)
    feed(memories, 0, RING + 99)
    recorder.poll()
    recorder.close()
    run = read_run(tmp_path)
    assert [(event.arm, event.text.split(":")[0]) for event in run.events] == [
        (arm, f"100 {what}") for arm in ("left", "right") for what in ("states", "targets")
    ]
    assert run.arms[0].state["q_rad"][:, 0].tolist() == list(range(100, RING + 99))


class _Overtaken(ArmMemory):
    """Memory whose arm goes on writing while it is read for the first time."""

    over = False

    def states(self, since=0):
        rows, count = super().states(since)
        if len(rows) and not self.over:
            self.over = True
            for number in range(count, count + 50):
                self.note_state(status(number, time.monotonic()))
        return rows, count


def test_rows_overwritten_while_they_are_read_are_dropped(memories, tmp_path):
    pair = _Overtaken(memories[0].name), memories[1]
    recorder = Recorder(pair, tmp_path, header(), tmp_path, time.monotonic(), 0)
    feed(memories, 0, RING - 10)
    recorder.poll()
    recorder.close()
    pair[0].close()
    run = read_run(tmp_path, allow_partial=True)
    # Fifty came meanwhile: of the oldest, 41 may be theirs.
    assert run.arms[0].state["q_rad"][:, 0].tolist() == list(range(41, RING + 40))
    assert [event.text.split(":")[0] for event in run.events] == ["41 states"]


def test_what_prevents_recording_is_reported_at_the_start(memories, tmp_path):
    names = memories[0].name, memories[1].name
    (tmp_path / "run.mcap").touch()
    cases = (
        ((names, tmp_path), {}, "File exists"),
        ((names, tmp_path / "none"), {}, "No such file"),
        ((names, tmp_path), {"least_free_bytes": 2**60}, "MiB are needed"),
        (((names[0], "psm_none"), None), {}, "psm_none"),
    )
    for (pair, folder), keywords, message in cases:
        recorder = RecorderProcess(pair, folder, header(), tmp_path, **keywords)
        with pytest.raises(RecordingError, match=message):
            recorder.wait_until_ready()
        assert not recorder.process.is_alive
        recorder.event("note", "of no use")
        recorder.close()


def test_a_recorder_that_hangs_does_not_block_the_program(recorder, memories, tmp_path, rng):
    recorder.begin_episode(begin_row(rng))
    os.kill(recorder.process.pid, signal.SIGSTOP)
    woken = threading.Timer(30.0, os.kill, (recorder.process.pid, signal.SIGCONT))  # lest it wait for ever
    woken.start()
    for number in range(300):
        recorder.step(step_row(rng, number))
    assert woken.is_alive()
    woken.cancel()
    os.kill(recorder.process.pid, signal.SIGCONT)
    recorder.close()
    assert recorder.failure == ""
    assert len(read_run(tmp_path).episodes[0].reward) == 300


def test_a_recorder_that_dies_is_reported_and_blocks_nothing(recorder, memories, tmp_path, rng):
    recorder.begin_episode(begin_row(rng))
    feed(memories, 0, 10)
    waited(lambda: recorder.event("tick", "") or (tmp_path / "run.mcap").stat().st_size > 20_000)
    recorder.process.kill()
    for number in range(3):
        recorder.step(step_row(rng, number))
    assert "recorder has ended" in recorder.failure
    recorder.close()
    run = read_run(tmp_path, allow_partial=True)
    assert len(run.arms[0].state["q_rad"]) == 10
    assert not run.complete


def test_ctrl_c_is_left_to_the_program(recorder, memories, tmp_path):
    for _ in range(3):
        os.kill(recorder.process.pid, signal.SIGINT)
    feed(memories, 0, 5)
    recorder.close()
    assert recorder.failure == ""
    assert len(read_run(tmp_path).arms[0].state["q_rad"]) == 5


def test_a_full_disk_ends_the_record_and_nothing_else(recorder, memories, tmp_path):
    import resource

    resource.prlimit(recorder.process.pid, resource.RLIMIT_FSIZE, (50_000, 50_000))
    number = 0

    def fed():
        nonlocal number
        number = feed(memories, number, 20)
        recorder.event("tick", "")
        return recorder.failure

    waited(fed)
    assert "File too large" in recorder.failure
    assert recorder.process.is_alive
    recorder.close()
    run = read_run(tmp_path, allow_partial=True)
    time_s = run.arms[0].state["timestamp_s"]
    assert np.array_equal(time_s, np.arange(len(time_s)) * 0.002)


MAIN = """
import sys, time
from pathlib import Path
import numpy as np
from dual_ur10.sim2real.recording.recorder import RecorderProcess
from dual_ur10.sim2real.runtime.arm_memory import ArmMemory
from tests.sim2real.recording.runs import begin_row, header, step_row
if __name__ == "__main__":
    folder, rng = Path(sys.argv[1]), np.random.default_rng(0)
    recorder = RecorderProcess((sys.argv[2], sys.argv[3]), folder, header(), folder)
    recorder.wait_until_ready()
    recorder.begin_episode(begin_row(rng))
    for number in range(5):
        recorder.step(step_row(rng, number))
    print(recorder.process.pid, flush=True)
    {end}
"""


@pytest.mark.parametrize("end", ["time.sleep(60)", "sys.exit()"])
def test_a_recorder_outlives_its_program_until_the_arms_stop(memories, tmp_path, end):
    code = tmp_path / "program.py"
    code.write_text(MAIN.replace("{end}", end))
    process = subprocess.Popen(
        [sys.executable, str(code), str(tmp_path), memories[0].name, memories[1].name],
        stdout=subprocess.PIPE,
        text=True,
        env=os.environ | {"PYTHONPATH": str(ROOT)},
    )
    child = int(process.stdout.readline())
    killed = end.startswith("time")
    if killed:
        feed(memories, 0, 10)
        process.send_signal(signal.SIGKILL)
        process.wait()
        feed(memories, 10, 10)
        for memory in memories:
            memory.enter(Phase.FAULTED, "the program is gone")
    process.wait(timeout=20)
    process.stdout.close()
    waited(lambda: not Path(f"/proc/{child}").exists() or _is_zombie(child))
    run = read_run(tmp_path)
    assert run.complete
    assert len(run.episodes[0].reward) == 5
    if killed:
        assert run.arms[0].state["q_rad"][:, 0].tolist() == list(range(20))
        kinds = [event.kind for event in run.events]
        assert kinds.count("orphaned") == 1
        assert (tmp_path / "blackbox-1.mcap").exists()
        assert len(read_run(tmp_path / "blackbox-1.mcap").arms[0].state["q_rad"]) == 20
    for memory in memories:
        assert memory.phase == (Phase.FAULTED if killed else Phase.STARTING)


def _is_zombie(pid):
    try:
        return Path(f"/proc/{pid}/stat").read_text().split(") ")[1].startswith("Z")
    except FileNotFoundError:
        return True


def test_events_of_a_clock_that_began_before(memories, tmp_path):
    begin_s = time.monotonic() - 100.0
    names = memories[0].name, memories[1].name
    recorder = RecorderProcess(names, tmp_path, header(), tmp_path, begin_s=begin_s)
    recorder.wait_until_ready()
    recorder.event("early", "", time_s=1.25)
    feed(memories, 0, 1)
    recorder.close()
    run = read_run(tmp_path)
    assert run.events == [RunEvent(1.25, "early", "")]
    assert 100.0 < run.arms[0].state["arrival_s"][0] < 130.0
