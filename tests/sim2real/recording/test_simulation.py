"""Records of simulated runs."""

from __future__ import annotations

import json
import signal
import sys
from types import SimpleNamespace

import gymnasium as gym
import numpy as np
import pytest

import dual_ur10  # noqa: F401 - registers the ids
from dual_ur10.errors import RecordingError, SettingsError
from dual_ur10.policies.evaluation.minari_export import to_minari
from dual_ur10.policies.evaluation.rollout import rollout
from dual_ur10.sim2real.cell.cell import CellStep
from dual_ur10.sim2real.recording.header import describe
from dual_ur10.sim2real.recording.hook import RecordHook
from dual_ur10.sim2real.recording.reader import read_run
from dual_ur10.sim2real.recording.run import LATE
from dual_ur10.sim2real.recording.run_folder import LOG_FILE, new_folder
from dual_ur10.sim2real.recording.simulation import SimulationRecord
from tests.sim2real.recording.runs import TICKS
from tests.soak import SOAK
from ur_core.kinematics import flange_pose
from ur_core.kinematics.ur10 import NOMINAL_DH

INTERRUPTS = 1400 if SOAK else 50  # at so many calls within the recording of three steps

TASKS = ("SineTracking", "Handover")


class Still:
    """Policy that keeps both arms at rest."""

    def reset(self):
        pass

    def __call__(self, observation):
        return np.zeros(12)


class Led(Still):
    """Person who commands the left arm."""

    commander = np.array([True, False])


def actions(env, count, seed=5):
    rng = np.random.default_rng(seed)
    low, high = env.action_space.low, env.action_space.high
    return [rng.uniform(0.3 * low, 0.3 * high).astype(np.float32) for _ in range(count)]


def recorded(folder, task, *, episodes=2, steps=8, **keywords):
    """Record a run. Returns the file's folder and what the environment gave: (observation, info) by episode."""
    env = gym.make(f"DualUR10/{task}-v0", **keywords)
    core = env.unwrapped.core
    latency = keywords.get("action_latency_ticks", 0)
    header = describe(
        f"DualUR10/{task}-v0", keywords, core.config, period_ticks=core.pipeline.gate.ticks, latency_ticks=latency
    )
    where = new_folder(folder, header)
    record = SimulationRecord(where, header)
    core.attach(RecordHook(record, core.cell))
    given = []
    for episode in range(episodes):
        observation, info = env.reset(seed=4 if not episode else None)
        rows = [(observation, info, None)]
        for action in actions(env, steps, episode):
            observation, reward, *_, info = env.step(action)
            rows.append((observation, info, reward))
        given.append(rows)
    env.close()
    record.close()
    return where, given


@pytest.mark.parametrize("task", TASKS)
def test_a_simulated_run_is_recorded_bit_for_bit(tmp_path, task):
    where, given = recorded(tmp_path, task, action_latency_ticks=3)
    run = read_run(where)
    assert run.complete
    assert (run.header.source, run.header.family, run.header.latency_ticks) == ("mujoco", "cb3", 3)
    assert [episode.seed for episode in run.episodes] == [4, None]
    for episode, rows in zip(run.episodes, given, strict=True):
        assert np.array_equal(episode.observation, [row[0] for row in rows])
        assert np.array_equal(episode.q_rad, [row[1]["q_rad"] for row in rows])
        assert np.array_equal(episode.flange_m, [row[1]["flange_m"] for row in rows])
        assert np.array_equal(episode.reward, [row[2] for row in rows[1:]])
        assert (episode.gripper_m is None) == (task == "SineTracking")
        assert episode.initial_state


@pytest.mark.parametrize("task", TASKS)
def test_joints_are_recorded_at_every_control_period(tmp_path, task):
    run = read_run(recorded(tmp_path, task)[0])
    ticks, steps = run.header.period_ticks, 8
    for side, arm in enumerate(run.arms):
        time_s, q_rad = arm.state["arrival_s"], arm.state["q_rad"]
        assert np.allclose(time_s, 0.008 * np.arange(1, 2 * steps * ticks + 1), atol=1e-12, rtol=0)
        for number, episode in enumerate(run.episodes):
            first = number * steps * ticks
            assert episode.begin_s == pytest.approx(0.008 * first)
            ends = q_rad[first + ticks - 1 : first + steps * ticks : ticks]
            assert np.array_equal(ends, episode.q_rad[1:, side])
            sent = arm.sent["target_rad"][first : first + steps * ticks].reshape(steps, ticks, 6)
            assert np.array_equal(sent, episode.targets_rad[:, :, side])
        # Speeds are those of the positions, and the law's wish is close to them.
        count = steps * ticks  # of an episode; a tick apart they would differ by up to 0.05 rad/s
        speed = (q_rad[2:count] - q_rad[: count - 2]) / 0.016
        assert np.allclose(speed, arm.state["qd_rad_s"][1 : count - 1], atol=0.012)
        assert np.abs(arm.state["target_q_rad"] - q_rad).max() < 1e-3
        assert np.allclose(arm.state["tcp_pose"][:, :3], flange_pose(q_rad, NOMINAL_DH)[0])
        assert np.allclose(arm.sent["sent_s"], time_s - 0.008, atol=1e-12, rtol=0)
        assert np.array_equal(arm.sent["period"], np.arange(2 * steps * ticks))


def test_targets_are_recorded_as_they_go_out_after_the_latency(tmp_path):
    run = read_run(recorded(tmp_path, "SineTracking", episodes=1, action_latency_ticks=3)[0])
    wanted = run.episodes[0].targets_rad.reshape(-1, 2, 6)
    for side, arm in enumerate(run.arms):
        sent = arm.sent["target_rad"]
        assert np.array_equal(sent[3:], wanted[:-3, side])
        assert np.array_equal(sent[:3], np.repeat(run.episodes[0].q_rad[:1, side], 3, axis=0))


def test_recording_changes_no_number(tmp_path):
    _, given = recorded(tmp_path, "Handover", episodes=1)
    env = gym.make("DualUR10/Handover-v0")
    assert np.array_equal(env.reset(seed=4)[0], given[0][0][0])
    for action, row in zip(actions(env, 8, 0), given[0][1:], strict=True):
        assert np.array_equal(env.step(action)[0], row[0])
    env.close()


def test_a_record_holds_all_that_repeats_its_episodes(tmp_path):
    where, given = recorded(tmp_path, "SyncCarry", randomization="mild")
    run = read_run(where)
    generators = [json.loads(event.text) for event in run.events if event.kind == "generator"]
    sampled = [json.loads(event.text) for event in run.events if event.kind == "drawn"]
    assert len(generators) == len(sampled) == 2
    assert sampled[0] != sampled[1]
    env = gym.make(run.header.env_id, **run.header.kwargs)
    env.reset(seed=1)
    for number in (1, 0):
        env.unwrapped.np_random.bit_generator.state = generators[number]
        observation, _ = env.reset()
        assert np.array_equal(observation, given[number][0][0])
        assert env.unwrapped.core.cell.integration_state() == run.episodes[number].initial_state
        for action, row in zip(run.episodes[number].action, given[number][1:], strict=True):
            assert np.array_equal(env.step(action.astype(np.float32))[0], row[0])
    env.close()


def test_a_refusal_of_the_gate_is_recorded(tmp_path):
    env = gym.make("DualUR10/SineTracking-v0", action_mode="joint_position", on_refusal="terminate")
    core = env.unwrapped.core
    header = describe("DualUR10/SineTracking-v0", {}, core.config, period_ticks=5, latency_ticks=0)
    where = new_folder(tmp_path, header)
    record = SimulationRecord(where, header)
    core.attach(RecordHook(record, core.cell))
    env.reset(seed=0)
    terminated = False
    for _ in range(200):
        _, _, terminated, _, info = env.step(env.action_space.high)
        if terminated:
            break
    env.close()
    record.close()
    episode = read_run(where).episodes[0]
    assert terminated == episode.terminated[-1] == episode.gated[-1]
    assert episode.ended_by == str(info.get("safety", ""))
    assert episode.success is False if terminated else episode.success is None


def test_an_interrupt_at_any_instant_leaves_a_whole_record(tmp_path):
    """Wherever Ctrl-C comes: between two calls of the system, in the middle of encoding, before the checksum."""
    calls, wanted, interrupted = [0], [0], 0

    def profile(frame, event, argument):
        if event in ("call", "c_call") and "dual_ur10/sim2real/recording" in frame.f_code.co_filename:
            calls[0] += 1
            if calls[0] == wanted[0]:
                signal.raise_signal(signal.SIGINT)

    for number in range(1, INTERRUPTS + 1):
        calls[0], wanted[0] = 0, (number * 37) % 1400
        folder, env, heard = tmp_path / str(number), None, False
        env = gym.make("DualUR10/SineTracking-v0", record=str(folder), disable_env_checker=True)
        sys.setprofile(profile)
        try:
            env.reset(seed=1)
            for action in actions(env, 3):
                env.step(action)
        except KeyboardInterrupt:
            heard = True
        finally:
            sys.setprofile(None)
        if heard:
            interrupted += 1
            env.reset(seed=2)  # as in a notebook
            env.step(actions(env, 1)[0])
        env.close()
        (found,) = folder.iterdir()
        run = read_run(found)
        assert run.complete
        assert len(run.episodes[-1].reward) == (1 if heard else 3)
    assert interrupted == INTERRUPTS


def test_events_are_in_the_record_and_in_the_log(tmp_path):
    header = describe("DualUR10/SineTracking-v0", {}, _config(), period_ticks=5, latency_ticks=0, policy="still")
    where = new_folder(tmp_path, header)
    record = SimulationRecord(where, header)
    record.event("note", "one\ntwo", "left", 1.5)
    record.close()
    assert [(event.kind, event.text, event.arm) for event in read_run(where).events] == [("note", "one\ntwo", "left")]
    first, second = (where / LOG_FILE).read_text().splitlines()
    assert first.endswith("+0.000 s begin: DualUR10/SineTracking-v0 on mujoco, cb3, still")
    assert second.endswith("+1.500 s left note: one two")


def _config():
    from dual_ur10.sim2real.cell.cell_config import CellConfig

    return CellConfig()


def test_several_cells_cannot_be_recorded(tmp_path):
    from dual_ur10.envs.core.core import Core

    core = Core("SineTracking", {}, n=2)
    header = describe("DualUR10/SineTracking-v0", {}, core.config, period_ticks=5, latency_ticks=0)
    record = SimulationRecord(new_folder(tmp_path, header), header)
    with pytest.raises(SettingsError, match="only one alone"):
        core.attach(RecordHook(record, core.cell))
    record.close()
    core.close()


def test_an_episode_of_a_policy_after_that_of_a_person_is_not_the_persons(tmp_path):
    with gym.make("DualUR10/SineTracking-v0", duration_s=0.12, record=str(tmp_path)) as env:
        for policy in (Led(), Still()):
            rollout(env, policy, seed=0)
    run = read_run(next(tmp_path.iterdir()))
    assert [each.commander.any(axis=0).tolist() for each in run.episodes] == [[True, False], [False, False]]


@pytest.mark.parametrize("view", ["state", "goals"])
def test_episodes_become_a_minari_dataset_with_a_key_per_agent(tmp_path, monkeypatch, view):
    minari = pytest.importorskip("minari")
    pytest.importorskip("h5py")
    monkeypatch.setenv("MINARI_DATASETS_PATH", str(tmp_path / "datasets"))
    runs = [read_run(recorded(tmp_path, "SineTracking", observation=view)[0]) for _ in range(2)]
    runs[0].episodes[0].commander[2:5, 1] = True
    to_minari(runs, "ur10/sine/random-v0", author="nobody")
    dataset = minari.load_dataset("ur10/sine/random-v0")
    assert dataset.total_episodes == 4
    assert dataset[0].infos["commander"].tolist() == [[0, 0]] * 3 + [[0, 1]] * 3 + [[0, 0]] * 3
    assert dataset[0].infos["intervention"].tolist() == [False] * 3 + [True] * 3 + [False] * 3
    assert not dataset[1].infos["commander"].any()
    assert set(dataset.observation_space.spaces) == set(dataset.action_space.spaces) == {"left", "right"}
    from dual_ur10.envs.api.parallel_env import parallel_env

    both = parallel_env("SineTracking", observation=view)
    observation, _ = both.reset(seed=4)
    episode = dataset[0]
    for arm in ("left", "right"):
        assert np.array_equal(episode.observations[arm][0], observation[arm])
        assert dataset.action_space[arm] == both.action_space(arm)
        assert dataset.observation_space[arm] == both.observation_space(arm)
    for number in range(8):
        action = {arm: episode.actions[arm][number] for arm in ("left", "right")}
        observation, rewards, *_ = both.step(action)
        for arm in ("left", "right"):
            assert np.array_equal(episode.observations[arm][number + 1], observation[arm])
        assert episode.rewards[number] == pytest.approx(rewards["left"])
    both.close()
    assert dataset.spec.env_spec.id == "DualUR10/SineTracking-v0"
    env = dataset.recover_environment()
    assert env.observation_space == dataset.observation_space
    env.close()
    with pytest.raises(RecordingError, match="ur10/sine/random-v0"):
        to_minari(runs, "ur10/sine/random-v0")


@pytest.mark.parametrize("latency", [0, 3])
def test_a_simulation_counts_its_targets(tmp_path, latency):
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
    firsts, events = [], []
    recorder = SimpleNamespace(
        begin_episode=lambda row: None,
        event=lambda kind, text, *_: events.append((kind, text)),
        step=lambda row, trace: firsts.append(row.first_target),
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
        firsts.clear()
        for number in range(4):
            period = CellStep(state, late=number == 2, first_target=begin + 5 * number)
            hook.step(np.zeros(12), command, step, period, "", np.zeros(2, dtype=bool))
        assert firsts == [begin, begin + 5, LATE, begin + 15]
        ((kind, text),) = events
        assert kind == "late"
        assert f"the action of step 2 missed the deadline of target {begin + 10}:" in text
