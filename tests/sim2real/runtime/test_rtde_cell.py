"""Environments on two emulated controllers: spaces, confirmation and refusals."""

import gc
import os
import pickle
import signal
import threading
import time
import weakref

import gymnasium as gym
import numpy as np
import pytest

import dual_ur10
from dual_ur10 import policies
from dual_ur10.envs.api.parallel_env import parallel_env
from dual_ur10.errors import (
    ActionError,
    CellBusyError,
    CellFaulted,
    ClosedError,
    ResetNeededError,
    SettingsError,
    StartError,
    UnknownNameError,
)
from dual_ur10.policies.evaluation.rollout import rollout
from dual_ur10.sim2real.processes.system import LOCAL
from dual_ur10.sim2real.recording.reader import read_run
from dual_ur10.sim2real.runtime.approach import Approach
from tests.live.faults.lab import Lab, Swing, assert_gone, descendants
from tests.live.faults.wire import derivative

pytestmark = pytest.mark.streams

HANDOVER, SINE = "DualUR10/Handover-v0", "DualUR10/SineTracking-v0"


@pytest.fixture(scope="module")
def the_lab(tmp_path_factory):
    made = Lab(tmp_path_factory.mktemp("cell"), task="Handover")
    yield made
    made.close()


@pytest.fixture
def lab(the_lab):
    text = the_lab.path.read_text()
    yield the_lab
    the_lab.path.write_text(text)
    the_lab.mend()


def test_spaces_and_first_observation_equal_the_simulation(lab):
    simulated = gym.make(HANDOVER, action_latency_ticks=5, disable_env_checker=True)
    env = lab.make()
    assert env.observation_space == simulated.observation_space
    assert env.action_space == simulated.action_space
    expected, _ = simulated.reset(seed=4)
    simulated.close()
    found, info = env.reset(seed=4)
    assert env.observation_space.contains(found)
    # Arms within what servos leave; wrenches are noisy in simulation.
    core = env.unwrapped.core
    assert np.abs(info["q_rad"] - core.task.start(np.arange(1), [np.random.default_rng(0)]).q_rad[0]).max() < 0.02
    quiet = np.abs(found - expected) < 0.02
    assert quiet.mean() > 0.85


def test_make_moves_nothing_and_reset_asks_before_it_does(lab):
    asked = []

    def no(question):
        asked.append(question)
        return False

    lab.make(confirm=no)
    assert len(lab.executed("left")) == len(lab.executed("right")) == 0
    with pytest.raises(StartError, match="not confirmed"):
        lab.env.reset(seed=0)
    assert len(lab.executed("left")) == len(lab.executed("right")) == 0
    (question,) = asked
    for words in ("move to where the task begins", "left", "right", "grippers are activated", "open", "emergency stop"):
        assert words in question


def test_a_real_cell_asks_at_the_terminal_and_a_pipe_is_none(lab, monkeypatch):
    lab.make()
    cell = lab.env.unwrapped.core.cell
    monkeypatch.setattr(type(cell.file), "kind", "real", raising=False)
    object.__setattr__(cell.file, "kind", "real")
    with pytest.raises(StartError, match="no terminal"):
        lab.env.reset(seed=0)
    object.__setattr__(cell.file, "kind", "emulated")


def test_one_policy_hands_over_on_both_cells_with_a_record(lab, tmp_path):
    keywords = {"action_latency_ticks": 8}
    simulated = gym.make(HANDOVER, disable_env_checker=True, **keywords)
    policy = policies.load("scripted", HANDOVER, **keywords)
    assert rollout(simulated, policy, seed=1).success
    simulated.close()
    env = lab.make(record=str(tmp_path), **keywords)
    found = rollout(env, policy, seed=1)
    late = env.unwrapped.core.late_actions
    lab.close_env()
    assert found.success or late, found.ended_by
    run = read_run(next(tmp_path.iterdir()))
    assert run.complete
    assert run.header.source == "emulated"
    assert len(run.episodes[0].action) == found.steps
    for arm in run.arms:
        assert np.unique(np.diff(arm.state["timestamp_s"]).round(4)).tolist() == [0.008]
        assert len(arm.sent["late_s"]) > 4.8 * found.steps  # late targets are skipped
    # The block is where the camera of the cell sees it.
    np.testing.assert_array_equal(run.episodes[0].q_rad.shape, (found.steps + 1, 2, 6))


def test_one_arm_moves_and_the_other_is_held(lab):
    env = lab.make(arm="left")
    lab.policy.reset()
    before = np.array(lab.ask("right", "actual_q")[0])
    env.reset(seed=0)
    for _ in range(30):
        if env.step(np.full(env.action_space.shape, 0.2, dtype=np.float32))[2]:
            break
    executed = lab.executed("right")
    assert len(executed) > 50
    assert np.abs(executed - before).max() < 1e-3
    assert np.abs(np.diff(lab.executed("left"), axis=0)).max() > 1e-4


def test_the_two_agent_view_runs_on_a_cell(lab):
    env = parallel_env("Handover", cell=str(lab.path))
    try:
        env.reset(seed=0)
        for _ in range(5):
            found = env.step({agent: np.zeros(7, dtype=np.float32) for agent in env.agents})
        assert set(found[0]) == {"left", "right"}
    finally:
        env.close()


@pytest.mark.parametrize(
    ("keywords", "words"),
    [
        ({"num_envs": 2}, "one pair of arms"),
        ({"num_envs": 1}, "begin by themselves"),
        ({"num_envs": 1, "autoreset_mode": "Disabled", "randomization": "mild"}, "randomization"),
    ],
)
def test_training_is_refused(lab, keywords, words):
    with pytest.raises(SettingsError, match=words):
        gym.make_vec(HANDOVER, vectorization_mode="vector_entry_point", cell=str(lab.path), **keywords)


@pytest.mark.parametrize(
    ("keywords", "error", "words"),
    [
        ({"action_latency_ticks": 2}, SettingsError, "3 to 125"),
        ({"confirm": "yes"}, SettingsError, "function"),
        ({"arm": "middle"}, UnknownNameError, "middle"),
        ({"record": 3}, SettingsError, "folder"),
        ({"record_failure": "panic"}, UnknownNameError, "panic"),
    ],
)
def test_keywords_that_cannot_be_are_refused_by_name(lab, keywords, error, words):
    with pytest.raises(error, match=words):
        lab.make(**keywords)


def test_a_welded_grasp_exists_in_simulation_only(lab):
    with pytest.raises(SettingsError, match="friction"):
        gym.make("DualUR10/SyncCarry-v0", cell=str(lab.path), grasp="rigid")


def test_a_task_with_objects_needs_grippers(lab):
    text = lab.path.read_text().replace('kind = "robotiq"', 'kind = "none"')
    lab.path.write_text(text)
    with pytest.raises(SettingsError, match=r"left\.gripper"):
        lab.make()


def test_it_can_be_neither_copied_nor_used_when_closed(lab):
    env = lab.make()
    cell = env.unwrapped.core.cell
    with pytest.raises(SettingsError, match="pickled"):
        pickle.dumps(cell)
    lab.close_env()
    with pytest.raises(ClosedError):
        cell.advance(None)
    cell.close()


def test_no_such_file_is_an_error_that_names_it():
    with pytest.raises(dual_ur10.errors.CellFileError, match=r"nowhere\.toml"):
        gym.make(SINE, cell="nowhere.toml")


# What a severe reader found.


def test_after_a_step_that_failed_an_episode_is_begun_again(lab, monkeypatch):
    env = lab.make()
    env.reset(seed=0)
    action = np.zeros(env.action_space.shape, dtype=np.float32)
    env.step(action)
    core = env.unwrapped.core

    def interrupted(cell, command):
        raise KeyboardInterrupt

    monkeypatch.setattr(core, "_advance", interrupted)
    with pytest.raises(KeyboardInterrupt):
        env.step(action)
    monkeypatch.undo()
    with pytest.raises(ResetNeededError, match="a step that failed"):
        env.step(action)
    env.reset(seed=0, options={"move_to_start": True})
    env.step(action)


@pytest.mark.parametrize(("still_s", "error"), [(0.8, StartError), (3.0, CellFaulted)])
def test_a_program_that_stalls_in_an_approach_sends_nothing_more(lab, monkeypatch, still_s, error):
    """It may stall for the half second that it has written ahead."""
    lab.make().reset(seed=0)
    core = lab.env.unwrapped.core
    cell, memory, tick_s = core.cell, lab.runner.arms[0], core.config.servoj.tick_s
    first = memory.sent_count
    here = cell.runner.last().reshape(2, 6)
    there = here + np.array([0, 0, 0, 0, 0, 1.0])
    way = Approach([here.reshape(12), there.reshape(12)]).targets(0.008)
    assert len(way) > 600
    waited = []

    def stalled(index):
        if not waited:
            waited.append(index)
            time.sleep(still_s)

    real = cell.runner.wait_for
    monkeypatch.setattr(cell.runner, "wait_for", stalled)
    with pytest.raises(StartError, match="stalled"):
        cell._path.follow(cell.runner, here, way)
    monkeypatch.undo()
    if error is CellFaulted:
        with pytest.raises(CellFaulted, match="the policy gave no action"):
            real(cell.runner.end)
    else:
        real(cell.runner.end)
    sent, _ = memory.sent(first)
    assert len(sent.period) > 50
    assert np.abs(derivative(sent.period, sent.target_rad, 2, tick_s)).max() < 1e-3 / tick_s**2


def test_a_stop_while_a_person_is_asked_leaves_grippers_alone(lab, monkeypatch):
    def stop(question):
        lab.do("stop", arm="left", mode=3)
        end = time.monotonic() + 10.0
        while not lab.runner.cell.fault and time.monotonic() < end:
            time.sleep(0.01)
        return True

    env = lab.make(confirm=stop)
    told = []
    monkeypatch.setattr(env.unwrapped.core.cell._grippers, "activate", lambda *_, **__: told.append("activate"))
    with pytest.raises(CellFaulted, match="left: safety mode 3"):
        env.reset(seed=0)
    assert not told


@pytest.mark.parametrize("spoiled", ["jump", "table", "nan"])
def test_nothing_goes_to_a_start_past_the_gate(lab, spoiled):
    lab.make().reset(seed=0)
    cell = lab.env.unwrapped.core.cell
    here = cell.runner.last().reshape(2, 6)
    there = here.copy()
    there[0, 1] += 1.5  # through the table
    way = Approach([here.reshape(12), there.reshape(12)]).targets(0.008)
    if spoiled == "jump":
        way[:] = here
        way[200:] += 0.01
    elif spoiled == "nan":
        way[200, 1, 3] = np.nan
    first = lab.cell.ask("setpoints", arm="left")["count"]
    with pytest.raises((StartError, ActionError), match="finite" if spoiled == "nan" else "safety gate refuses"):
        cell._path.follow(cell.runner, here, way)
    cell.runner.wait_for(cell.runner.end)
    sent = np.array([each[1] for each in lab.cell.setpoints("left", first)])
    assert np.isfinite(sent).all()
    # Two periods of the approach, as a busy machine skips one. The jump is larger.
    assert np.abs(np.diff(sent, axis=0)).max() < 8e-3
    assert cell._clearance.shortfall_m(cell.runner.last().reshape(12)).max() <= 0.0
    lab.reset(seed=0)  # and continues from there


def test_dead_processes_are_a_fault(lab):
    env = lab.make()
    env.reset(seed=0)
    lab.assert_watched()
    lab.policy = Swing(env.action_space.shape[0])
    for _ in range(20):
        env.step(lab.policy())
    lab.note()
    for pid in lab.pids:
        os.kill(pid, signal.SIGKILL)
    lab.assert_stopped(lab.step_until_faulted(), "no longer responds")


def test_the_collector_ignores_objects_from_before_the_episode(lab, monkeypatch):
    env = lab.make()
    made = gc.get_freeze_count()
    assert made > 10_000
    kept = [[] for _ in range(10_000)]

    def collect(*_):
        raise AssertionError("a collection stops the threads that hear grippers and cameras")

    with monkeypatch.context() as patch:
        patch.setattr(gc, "collect", collect)
        env.reset(seed=0)
    frozen = gc.get_freeze_count()
    assert frozen >= made + len(kept)
    episode = Swing(1)
    episode.itself, left = episode, weakref.ref(episode)
    for _ in range(2):
        env.reset(seed=0, options={"move_to_start": True})
        episode = None
    assert left() is None
    assert gc.get_freeze_count() <= frozen
    lab.close_env()
    assert gc.get_freeze_count() == 0


def test_a_program_that_ends_with_its_supervisor_is_noted(lab):
    lab.make().reset(seed=0)
    lock = next(path for path in LOCAL.state_folder().glob(f"lock-{lab.cell.left}"))
    note = lock.read_text()
    assert " moving " in note
    lab.close_env()
    assert "moving" not in lock.read_text()
    lock.write_text(note)
    with pytest.raises(CellFaulted, match="ended without stopping"):
        lab.make()
    with pytest.raises(CellFaulted, match="ended without stopping"):
        lab.make()
    lab.latch.clear()
    lab.make()


def test_limits_whose_brake_is_too_long_are_refused_at_make(lab):
    text = lab.path.read_text() + "\n"
    for arm in ("left", "right"):
        text += f"[{arm}.limits]\nacceleration_rad_s2 = 0.1\njerk_rad_s3 = 1.0\n"
    lab.path.write_text(text)
    with pytest.raises(SettingsError, match="need a brake of"):
        lab.make()


def test_a_slider_at_zero_moves_no_gripper_and_raises_nothing(lab):
    env = lab.make()
    env.reset(seed=0)
    action = np.zeros(env.action_space.shape, dtype=np.float32)
    lab.cell.ask("slider", arm="left", fraction=0.0)
    raised = threading.Timer(2.0, lambda: lab.cell.ask("slider", arm="left", fraction=1.0))
    raised.start()
    for _ in range(20):
        env.step(action)
    raised.join()


def test_an_interrupted_close_can_be_done_again(lab, monkeypatch):
    env = lab.make()
    env.reset(seed=0)
    cell, pids = env.unwrapped.core.cell, lab.pids
    runner = cell.runner

    def interrupted(within_s):
        raise KeyboardInterrupt

    monkeypatch.setattr(runner, "_wait_for_end", interrupted)
    with pytest.raises(KeyboardInterrupt):
        cell.close()
    monkeypatch.undo()
    cell.close()
    for pid in pids:
        with pytest.raises(ProcessLookupError):
            os.kill(pid, 0)
    lab.make()  # the lock is free


@pytest.mark.parametrize("after_s", [0.1, 0.5, 0.9])
def test_a_make_interrupted_twice_leaves_nothing_behind(lab, after_s):
    def interrupt():
        for pause_s in (after_s, 0.1):
            time.sleep(pause_s)
            os.kill(os.getpid(), signal.SIGINT)

    before = set(descendants(os.getpid()))
    heard = []
    thread = threading.Thread(target=interrupt)
    for work in (lambda: (thread.start(), lab.make(), time.sleep(30.0)), thread.join):
        try:
            work()
        except KeyboardInterrupt as error:
            heard.append(error)
    thread.join()
    assert heard
    heard.clear()  # with them goes what they hold
    assert_gone(set(descendants(os.getpid())) - before)
    lab.make()  # the lock is free


def test_ctrl_c_reports_that_both_arms_are_at_rest(lab):
    process = lab.program("rollout", "SineTracking", "-n", "1", "--no-record")
    lab.wait_until_moving(process)
    process.send_signal(signal.SIGINT)
    assert process.wait(30.0) == 130
    assert process.stdout.read().splitlines()[-1] == "interrupted: both arms have stopped"
    lab.assert_at_rest()


def test_a_make_that_fails_late_leaves_nothing_behind(lab):
    with pytest.raises(UnknownNameError) as kept:
        lab.make(observation="pixels", cameras=("nowhere",))
    lab.make()  # while the error still holds what was made
    assert kept.value is not None


def test_a_second_cell_of_one_program_is_refused(lab):
    lab.make()
    with pytest.raises(CellBusyError, match=r"env\.close\(\)"):
        gym.make(HANDOVER, cell=str(lab.path), disable_env_checker=True)
