"""Environments on two controllers of a virtual cell: spaces, confirmation and refusals."""

import gc
import pickle

import gymnasium as gym
import numpy as np
import pytest

import dual_ur10  # noqa: F401  # registers the environments
from dual_ur10.envs.api.parallel_env import parallel_env
from dual_ur10.errors import (
    ActionError,
    CellBusyError,
    CellFaulted,
    CellFileError,
    ClosedError,
    LinkError,
    ResetNeededError,
    SettingsError,
    StartError,
    UnknownNameError,
)
from dual_ur10.policies.evaluation import rollout as evaluation
from dual_ur10.sim2real.cell_file.cell_file import CellFile
from dual_ur10.sim2real.runtime.approach import Approach, Rates
from dual_ur10.testing import VirtualCell
from tests.cli.command import run
from tests.parity import handed_over
from tests.sim2real.control.motion_checks import HARD
from ur_core.processes.garbage import GarbageCollector

ARMS = ("left", "right")
HANDOVER, SINE = "DualUR10/Handover-v0", "DualUR10/SineTracking-v0"


class Bench:
    """Virtual cell, and at most one environment on it."""

    def __init__(self, task="Handover", **options):
        self.cell, self.env_id = VirtualCell(task=task, plant="nominal", **options), f"DualUR10/{task}-v0"
        self.ask, self.clock = self.cell.ask, self.cell.clock
        self.env = None

    def make(self, **keywords):
        """Return a new environment; the previous one is closed."""
        self.close_env()
        self.env = gym.make(self.env_id, cell=self.cell, disable_env_checker=True, **keywords)
        return self.env

    def set_file(self, **values):
        """Change both arms' entries in the cell file."""
        entries = {arm: {**self.cell.description[arm], **values} for arm in ARMS}
        self.cell.file = CellFile.read({**self.cell.description, **entries}, "the virtual cell")

    @property
    def core(self):
        """Core of the environment."""
        return self.env.unwrapped.core

    @property
    def runner(self):
        """Runner of the environment."""
        return self.core.cell.runner

    def executed(self, arm, since=0):
        """Return the targets that a controller executed, (k, 6)."""
        return np.array([row[1] for row in self.cell.setpoints(arm, since)]).reshape(-1, 6)

    def close_env(self):
        """Close the environment."""
        env, self.env = self.env, None
        if env is not None:
            env.close()

    def close(self):
        """Close everything."""
        self.close_env()
        self.cell.close()


@pytest.fixture
def bench(request):
    made = Bench(**getattr(request, "param", {}))
    yield made
    made.close()


without_grippers = pytest.mark.parametrize("bench", [{"task": "SineTracking"}], indirect=True, ids=["SineTracking"])
"""It begins in a tenth of the time."""


def step(env, action, count):
    for _ in range(count):
        env.step(action)


def still(env):
    return np.zeros(env.action_space.shape, dtype=np.float32)


def test_spaces_and_first_observation_equal_the_simulation(bench):
    simulated = gym.make(HANDOVER, action_latency_ticks=5, disable_env_checker=True)
    env = bench.make()
    assert env.observation_space == simulated.observation_space
    assert env.action_space == simulated.action_space
    expected, _ = simulated.reset(seed=4)
    simulated.close()
    found, info = env.reset(seed=4)
    assert env.observation_space.contains(found)
    # Arms within what servos leave; wrenches are noisy in simulation.
    start = bench.core.task.start(np.arange(1), [np.random.default_rng(0)])
    assert np.abs(info["q_rad"] - start.q_rad[0]).max() < 0.02
    assert (np.abs(found - expected) < 0.02).mean() > 0.85


@without_grippers
@pytest.mark.parametrize("fails", [True, False])
def test_the_program_is_as_before_when_its_cell_is_gone(bench, monkeypatch, fails):
    system, hurried = bench.cell.system, []
    monkeypatch.setattr(system, "garbage", GarbageCollector, raising=False)
    monkeypatch.setattr(system, "hurry", lambda: (hurried.append(True), lambda: hurried.append(False))[1])
    if fails:
        bench.cell.latch.set("somebody stepped in")
        with pytest.raises(CellFaulted):
            bench.make()
    else:
        bench.make()
        assert gc.get_freeze_count() > 0
        bench.close_env()
    assert gc.get_freeze_count() == 0
    assert hurried == [True, False]


def test_make_moves_nothing_and_reset_asks_before_it_does(bench):
    asked = []

    def no(question):
        asked.append(question)
        return False

    bench.make(confirm=no)
    with pytest.raises(StartError, match="not confirmed"):
        bench.env.reset(seed=0)
    assert [bench.cell.packages(arm) for arm in ARMS] == [[], []]
    (question,) = asked
    for words in ("move to where the task begins", "left", "right", "grippers are activated", "open", "emergency stop"):
        assert words in question


@without_grippers
def test_a_real_cell_asks_at_the_terminal_and_a_pipe_is_none(bench):
    bench.make()
    object.__setattr__(bench.core.cell.file, "kind", "real")
    with pytest.raises(StartError, match="no terminal"):
        bench.env.reset(seed=0)


@pytest.mark.parametrize("bench", [{"tools": ("generic_140", "robotiq_2f85")}], indirect=True)
def test_one_policy_hands_over_on_both_cells_with_a_record(bench, tmp_path):
    """Gate, policy, drivers and emulated grippers have the same figures of two different tools."""
    assert [each.gripper.tool for each in bench.cell.file.arms] == ["generic_140", "robotiq_2f85"]
    found, late, run = handed_over(bench, tmp_path, cell=bench.cell)
    assert found.success, found.ended_by
    assert late == 0
    layout = gym.make(HANDOVER, cell="echo").unwrapped.task.layout
    opened = layout.split(run.episodes[0].observation[0])["gripper_m"]
    np.testing.assert_allclose(opened[:, 0], [0.14, 0.085], atol=2e-3)
    for arm in run.arms:
        np.testing.assert_allclose(np.diff(arm.state["timestamp_s"]), 0.008, atol=1e-9)
        assert len(arm.sent["late_s"]) >= 5 * found.steps


@without_grippers
def test_one_arm_moves_and_the_other_is_held(bench):
    env = bench.make(arm="left")
    before = np.array(bench.ask("state", arm="right", names=["actual_q"])["actual_q"])
    env.reset(seed=0)
    for _ in range(30):
        if env.step(np.full(env.action_space.shape, 0.2, dtype=np.float32))[2]:
            break
    executed = bench.executed("right")
    assert len(executed) > 50
    assert np.abs(executed - before).max() < 1e-3
    assert np.abs(np.diff(bench.executed("left"), axis=0)).max() > 1e-4


def test_the_two_agent_view_runs_on_a_cell(bench):
    env = parallel_env("Handover", cell=bench.cell)
    try:
        env.reset(seed=0)
        for _ in range(5):
            found = env.step({agent: np.zeros(7, dtype=np.float32) for agent in env.agents})
        assert set(found[0]) == {"left", "right"}
    finally:
        env.close()


def trained(bench, **keywords):
    return gym.make_vec(HANDOVER, vectorization_mode="vector_entry_point", cell=bench.cell, **keywords)


def with_entries(bench, **entries):
    bench.set_file(**entries)
    return bench.make()


@pytest.mark.parametrize(
    ("make", "error", "words"),
    [
        (lambda bench: trained(bench, num_envs=2), SettingsError, "one pair of arms"),
        (lambda bench: trained(bench, num_envs=1), SettingsError, "begin by themselves"),
        (
            lambda bench: trained(bench, num_envs=1, autoreset_mode="Disabled", randomization="mild"),
            SettingsError,
            "randomization",
        ),
        (lambda bench: bench.make(action_latency_ticks=3), SettingsError, "5 to 125"),
        (lambda bench: bench.make(confirm="yes"), SettingsError, "function"),
        (lambda bench: bench.make(arm="middle"), UnknownNameError, "middle"),
        (lambda bench: bench.make(record=3), SettingsError, "folder"),
        (lambda bench: bench.make(record_failure="panic"), UnknownNameError, "panic"),
        (lambda bench: gym.make("DualUR10/SyncCarry-v0", cell=bench.cell, grasp="rigid"), SettingsError, "friction"),
        (lambda bench: with_entries(bench, gripper={"kind": "none"}), SettingsError, r"left\.gripper"),
        (
            lambda bench: with_entries(bench, limits={"acceleration_rad_s2": 0.1, "jerk_rad_s3": 1.0}),
            SettingsError,
            "need a brake of",
        ),
        (lambda bench: gym.make(SINE, cell="nowhere.toml"), CellFileError, r"nowhere\.toml"),
    ],
)
def test_what_a_cell_cannot_be_is_refused_by_name(bench, make, error, words):
    with pytest.raises(error, match=words):
        make(bench)


@without_grippers
def test_it_can_be_neither_copied_nor_used_when_closed(bench):
    bench.make()
    cell = bench.core.cell
    with pytest.raises(SettingsError, match="pickled"):
        pickle.dumps(cell)
    bench.close_env()
    with pytest.raises(ClosedError):
        cell.advance(None)
    cell.close()


# What a severe reader found.


@without_grippers
def test_after_a_step_that_failed_an_episode_is_begun_again(bench, monkeypatch):
    env = bench.make()
    env.reset(seed=0)
    env.step(still(env))

    def interrupted(cell, command):
        raise KeyboardInterrupt

    monkeypatch.setattr(bench.core, "_advance", interrupted)
    with pytest.raises(KeyboardInterrupt):
        env.step(still(env))
    monkeypatch.undo()
    with pytest.raises(ResetNeededError, match="a step that failed"):
        env.step(still(env))
    env.reset(seed=0, options={"move_to_start": True})
    env.step(still(env))


@pytest.mark.parametrize(("still_s", "error"), [(0.8, StartError), (3.0, CellFaulted)])
def test_a_program_that_stalls_in_an_approach_sends_nothing_more(bench, monkeypatch, still_s, error):
    """It may stall for the half second that it has written ahead."""
    bench.make().reset(seed=0)
    cell, memory = bench.core.cell, bench.runner.arms[0]
    first = memory.sent_count
    here = cell.runner.last().reshape(2, 6)
    there = here + np.array([0, 0, 0, 0, 0, 1.0])
    way = Approach([here.reshape(12), there.reshape(12)], Rates(HARD.robots)).targets(0.008)
    assert len(way) > 600
    waited = []

    def stalled(index):
        if not waited:
            waited.append(index)
            bench.clock.sleep(still_s)

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
    assert (np.diff(sent.period) == 1).all()
    assert np.abs(np.diff(sent.target_rad, n=2, axis=0)).max() < 1e-3


@without_grippers
@pytest.mark.parametrize("stalls", [1, 3])
def test_an_approach_continues_after_stalls_of_the_program(bench, monkeypatch, stalls):
    asked = []
    env = bench.make(confirm=lambda question: asked.append(question) or True)
    env.reset(seed=0)
    action = still(env).reshape(2, -1)
    action[:, 5] = 0.5
    step(env, action.reshape(-1), 20)
    asked.clear()
    runner, left = bench.runner, [stalls]
    wait_for = runner.wait_for

    def stall(index):
        wait_for(index)
        if left[0] and asked and runner.cell.live:  # on the path, with more to come
            left[0] -= 1
            bench.clock.sleep(0.8)  # longer than targets were written ahead

    monkeypatch.setattr(runner, "wait_for", stall)
    if stalls < 3:
        env.reset(seed=0)
    else:
        with pytest.raises(StartError, match=r"too busy to move arms in real time \(this program stalled\)"):
            env.reset(seed=0)
    assert (len(asked), left) == (min(stalls + 1, 3), [0])  # somebody agrees to each motion
    assert bench.cell.fault == ""
    for arm in ARMS:
        assert np.abs(np.diff(bench.executed(arm), n=2, axis=0)).max() < 1e-3


def test_a_stop_while_a_person_is_asked_leaves_grippers_alone(bench, monkeypatch):
    def stop(question):
        bench.ask("stop", arm="left", mode=3)
        bench.clock.sleep(1.0)
        assert bench.runner.cell.fault
        return True

    env = bench.make(confirm=stop)
    told = []
    monkeypatch.setattr(bench.core.cell._grippers, "activate", lambda *_, **__: told.append("activate"))
    with pytest.raises(CellFaulted, match="left: safety mode 3"):
        env.reset(seed=0)
    assert not told


@without_grippers
def test_nothing_goes_to_a_start_past_the_gate(bench):
    env = bench.make()
    env.reset(seed=0)
    cell = bench.core.cell
    for spoiled in ("jump", "nan", "table"):
        here = cell.runner.last().reshape(2, 6)
        there = here.copy()
        there[0, 1] += 1.5 if spoiled == "table" else 0.5
        way = Approach([here.reshape(12), there.reshape(12)], Rates(HARD.robots)).targets(0.008)
        if spoiled == "jump":
            way[:] = here
            way[200:] += 0.01
        elif spoiled == "nan":
            way[200, 1, 3] = np.nan
        first = bench.ask("setpoints", arm="left")["count"]
        with pytest.raises((StartError, ActionError), match="finite" if spoiled == "nan" else "safety gate refuses"):
            cell._path.follow(cell.runner, here, way)
        cell.runner.wait_for(cell.runner.end)
        sent = bench.executed("left", first)
        assert np.isfinite(sent).all()
        assert np.abs(np.diff(sent, axis=0)).max() < 4e-3  # a period of the approach; the jump is larger
        assert cell._clearance.spare_m(cell.runner.last().reshape(1, 12)).min() >= 0.0
    env.reset(seed=0, options={"move_to_start": True})  # and continues from there


@without_grippers
def test_the_end_of_the_emulator_is_the_root_cause_of_all_that_follows(bench):
    env = bench.make()
    env.reset(seed=0)
    step(env, still(env), 3)
    bench.cell.end("emulated cell")
    with pytest.raises(CellFaulted, match="both controllers are gone"):
        step(env, still(env), 50)
    pid = bench.cell.file.emulator.pid
    where = f"left at {bench.cell.left} and right at {bench.cell.right}"
    assert bench.cell.fault == (
        f"both controllers are gone: {where}: the emulator (process {pid}) has ended; start it again"
    )


@without_grippers
def test_dead_processes_are_a_fault(bench):
    env = bench.make()
    env.reset(seed=0)
    action = np.full(env.action_space.shape, 0.1, dtype=np.float32)
    step(env, action, 20)
    for process in (*ARMS, "supervisor"):
        bench.cell.end(process)
    with pytest.raises(CellFaulted, match="has ended"):
        step(env, action, 50)
    for arm in ARMS:
        assert bench.ask("state", arm=arm, names=["runtime_state"])["runtime_state"] == 1
        assert np.abs(bench.ask("state", arm=arm, names=["target_qd"])["target_qd"]).max() == 0.0
    assert "has ended" in bench.cell.fault


@without_grippers
def test_a_program_that_ends_with_its_supervisor_is_noted(bench):
    bench.make().reset(seed=0)
    lock = next(bench.cell.system.state_folder().glob(f"lock-{bench.cell.left}"))
    note = lock.read_text()
    assert " moving " in note
    bench.close_env()
    assert "moving" not in lock.read_text()
    lock.write_text(note)
    for _ in range(2):
        with pytest.raises(CellFaulted, match="ended without stopping"):
            bench.make()
    bench.cell.clear()
    bench.make()


def test_a_slider_at_zero_moves_no_gripper_and_raises_nothing(bench):
    env = bench.make()
    env.reset(seed=0)
    begin_s = bench.cell.now_s
    bench.ask("slider", arm="left", fraction=0.0)

    def raise_it():
        bench.clock.sleep(2.0)
        bench.ask("slider", arm="left", fraction=1.0)

    raised = bench.cell.system.thread(raise_it, "slider")
    for _ in range(20):
        env.step(still(env))
    raised.join()
    assert bench.cell.now_s - begin_s > 2.0
    assert not bench.cell.fault


@without_grippers
def test_a_fault_of_the_equipment_says_that_the_stop_is_latched_and_how_to_go_on(bench, monkeypatch):
    env = bench.make()
    env.reset(seed=0)

    def lost(statuses):
        raise LinkError("left arm, Robotiq gripper at 127.0.0.2:63352: no answer in time; check it")

    monkeypatch.setattr(bench.core.cell, "_state", lost)
    for _ in range(2):  # the fault persists
        with pytest.raises(CellFaulted, match=r"both arms were stopped: left arm, Robotiq .* Check both.*\.clear\(\)"):
            env.step(still(env))
    assert "no answer in time" in bench.cell.fault


def test_a_policy_that_fails_in_a_rollout_has_the_exit_code_of_a_latched_stop(monkeypatch, capsys):
    class Failing:
        def reset(self):
            pass

        def __call__(self, observation):
            raise ZeroDivisionError("of this policy")

    monkeypatch.setattr(evaluation, "as_policy", lambda policy: Failing())
    code, text = run("rollout", "SineTracking", "--cell", "virtual", "-n", "1", "--no-record")
    assert code == 2
    lines = (text + capsys.readouterr().err).splitlines()
    assert any("ZeroDivisionError: of this policy" in line for line in lines)
    assert lines[-1].startswith("both arms were stopped: the policy failed: ZeroDivisionError")


@without_grippers
def test_an_interrupted_close_can_be_done_again(bench, monkeypatch):
    env = bench.make()
    env.reset(seed=0)
    cell, runner = bench.core.cell, bench.runner
    processes = [*(each.process for each in runner.processes), runner.supervisor.process]

    def interrupted(within_s):
        raise KeyboardInterrupt

    monkeypatch.setattr(runner, "_wait_for_end", interrupted)
    with pytest.raises(KeyboardInterrupt):
        cell.close()
    monkeypatch.undo()
    cell.close()
    assert [each.is_alive for each in processes] == [False] * 3
    bench.make()  # the lock is free


@without_grippers
def test_a_make_that_fails_late_leaves_nothing_behind(bench):
    with pytest.raises(UnknownNameError) as kept:
        bench.make(observation="pixels", cameras=("nowhere",))
    bench.make()  # while the error still holds what was made
    assert kept.value is not None


@without_grippers
def test_a_second_cell_of_one_program_is_refused(bench):
    bench.make()
    with pytest.raises(CellBusyError, match=r"env\.close\(\)"):
        gym.make(bench.env_id, cell=bench.cell, disable_env_checker=True)
