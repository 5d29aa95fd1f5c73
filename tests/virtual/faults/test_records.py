"""Records that cannot be written or must not be replayed: rows 59 and 60 of docs/reference/faults.md."""

import dataclasses
import os
import shutil
import types

import gymnasium as gym
import numpy as np
import pytest

from dual_ur10.errors import RecordingError
from dual_ur10.sim2real.analysis.replay import replay
from dual_ur10.sim2real.recording import writer
from dual_ur10.sim2real.recording.reader import read_run
from tests.virtual.faults.lab import ARMS, Swing

WRITTEN_TICKS = 150  # until the recorder writes, and the program hears of it


@pytest.fixture
def full(lab, monkeypatch):
    """Let the disk have no room for records from now on."""

    def write(number, data):
        raise OSError(28, "No space left on device")

    def fill():
        lab.note()
        monkeypatch.setattr(writer, "os", types.SimpleNamespace(**{**vars(os), "write": write}))

    return fill


def test_59_a_full_disk_stops_both_on_request(lab, full, tmp_path):
    lab.begin(record=str(tmp_path), record_failure="stop")
    full()
    error = lab.step_until_faulted()
    words = "the run is not recorded any more", "No space left on device"
    lab.assert_stopped(error, *words, seen_ticks=WRITTEN_TICKS, ramped=ARMS)
    folder = max(tmp_path.iterdir())
    assert not read_run(folder, allow_partial=True).complete


def test_59_arms_continue_on_a_full_disk_otherwise(lab, full, tmp_path, caplog):
    lab.begin(record=str(tmp_path))
    full()
    lab.step(25)
    assert lab.latch.read() is None
    assert any("No space left on device" in each.message for each in caplog.records)


@pytest.fixture(scope="module")
def recorded(tmp_path_factory):
    folder = tmp_path_factory.mktemp("runs")
    env = gym.make("DualUR10/SineTracking-v0", action_latency_ticks=5, record=str(folder), disable_env_checker=True)
    env.reset(seed=0)
    policy = Swing()
    for _ in range(25):
        env.step(policy())
    env.close()
    (run,) = folder.iterdir()
    return run


def test_60_the_arms_replay_a_recording(lab, recorded):
    lab.mark()
    found = replay(read_run(recorded), lab.where)
    assert found.steps == found.recorded == 25
    assert len(lab.executed("left")) > 100
    assert lab.latch.read() is None
    lab.assert_at_rest()


@pytest.mark.parametrize(
    ("change", "word", "uploads"),
    [
        ({"tick_s": 0.002, "family": "e-series"}, "e-series", 0),
        ({"period_ticks": 3}, "ticks per action: 3", 1),  # reported by the environment, with connected arms
        ({"speed_factor": 2.0}, "speed_factor", 0),
    ],
)
def test_60_a_recording_of_another_robot_or_rate_is_refused(lab, recorded, change, word, uploads):
    run = read_run(recorded)
    lab.mark()
    with pytest.raises(RecordingError, match=word):
        replay(dataclasses.replace(run, header=dataclasses.replace(run.header, **change)), lab.where)
    lab.assert_nothing_has_moved((uploads, uploads))


def test_60_nonfinite_numbers_are_refused_with_their_row(lab, recorded):
    run = read_run(recorded)
    (episode,) = run.episodes
    action = np.array(episode.action)
    action[7, 3] = np.nan
    lab.mark()
    with pytest.raises(RecordingError, match="action 7 of episode 0"):
        replay(dataclasses.replace(run, episodes=[dataclasses.replace(episode, action=action)]), lab.where)
    lab.assert_nothing_has_moved()


@pytest.mark.parametrize("share", [0.0, 0.3, 0.9])
def test_60_a_truncated_recording_is_refused_by_default(recorded, tmp_path, share):
    folder = tmp_path / recorded.name
    shutil.copytree(recorded, folder)
    data = (folder / "run.mcap").read_bytes()
    (folder / "run.mcap").write_bytes(data[: int(share * len(data))])
    with pytest.raises(RecordingError):
        read_run(folder)
    if share > 0.5:
        assert not read_run(folder, allow_partial=True).complete
