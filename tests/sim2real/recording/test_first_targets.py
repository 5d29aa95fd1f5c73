"""Which of the targets that were sent belong to which step."""

from __future__ import annotations

from types import SimpleNamespace

import gymnasium as gym
import numpy as np
import pytest

import dual_ur10  # noqa: F401 - registers the ids
from dual_ur10.errors import RecordingError
from dual_ur10.sim2real.config.cell import CellStep
from dual_ur10.sim2real.recording.hook import RecordHook
from dual_ur10.sim2real.recording.reader import read_run
from dual_ur10.sim2real.recording.run import LATE
from dual_ur10.sim2real.recording.schemas import EPISODE_TOPIC, STEP_TOPIC
from dual_ur10.sim2real.recording.writer import RunWriter
from tests.sim2real.recording.runs import TICKS, begin_row, header, step_row


def written(folder, targets, seed=9, **head):
    """A run of one episode, whose steps begin with these targets."""
    rng = np.random.default_rng(seed)
    with RunWriter(folder, header(**head)) as writer:
        writer.single(EPISODE_TOPIC, 0.0, begin_row(rng).encode(0, 0.0))
        for step, target in enumerate(targets):
            writer.single(STEP_TOPIC, 0.1 * step, step_row(rng, step, first_target=target).encode(0, step))
    return folder


def test_steps_tell_with_which_target_they_begin(tmp_path):
    targets = [40, 45, LATE, 130, 135]
    (episode,) = read_run(written(tmp_path, targets)).episodes
    assert episode.first_target.tolist() == targets
    assert episode.first_target.dtype == np.int64


@pytest.mark.parametrize("targets", [[40, 44], [40, LATE, 44], [-2], [-3], [2**60]])
def test_targets_that_no_run_has_are_refused_with_their_row(tmp_path, targets):
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


@pytest.mark.parametrize("latency", [0, 3])
def test_in_simulation_they_are_counted(tmp_path, latency):
    env = gym.make("DualUR10/SineTracking-v0", record=str(tmp_path), action_latency_ticks=latency)
    for _ in range(2):
        env.reset(seed=0)
        for _ in range(6):
            env.step(np.full(12, 0.1, dtype=np.float32))
    env.close()
    run = read_run(next(tmp_path.iterdir()))
    for number, episode in enumerate(run.episodes):
        assert episode.first_target.tolist() == [number * 30 + step * TICKS + latency for step in range(6)]
        for arm in range(2):
            sent = run.arms[arm].sent
            at = np.searchsorted(sent["index"], episode.first_target[:-1])
            assert (sent["target_rad"][at] == episode.targets_rad[:-1, 0, arm]).all()


def test_an_action_that_missed_its_deadline_is_an_event_and_has_no_target():
    told, events = [], []
    recorder = SimpleNamespace(
        begin_episode=lambda row: None,
        event=lambda kind, text, *_: events.append((kind, text)),
        step=lambda row, trace: told.append(row.first_target),
    )
    hook = RecordHook(recorder, cell=object())
    state = SimpleNamespace(q_rad=np.zeros((1, 2, 6)), flange_m=np.zeros((1, 2, 3)), time_s=np.zeros(1))
    command = SimpleNamespace(targets_rad=np.zeros((1, 5, 2, 6)), gripper_m=None)
    step = SimpleNamespace(
        terminated=[False], truncated=[False], verdicts={}, reward=[0.0], observation=np.zeros((1, 3)), info={}
    )
    for begin in (100, 900):
        hook.resetting([np.random.default_rng(0)], 1)
        hook.reset(np.zeros((1, 3)), state, {})
        events.clear()
        told.clear()
        for number in range(4):
            period = CellStep(state, late=number == 2, first_target=begin + 5 * number)
            hook.step(np.zeros(12), command, step, period)
        assert told == [begin, begin + 5, LATE, begin + 15]
        ((kind, text),) = events
        assert kind == "late"
        assert f"the action of step 2 missed the deadline of target {begin + 10}:" in text
