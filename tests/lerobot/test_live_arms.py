"""Arms and tasks as LeRobot's robots and environments have them, without LeRobot."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import threading
from types import SimpleNamespace

import numpy as np
import pytest

from dual_ur10 import ids
from dual_ur10.errors import (
    ActionError,
    ClosedError,
    LeaderConfigurationError,
    LinkError,
    SettingsError,
    StartError,
    UnknownNameError,
)
from dual_ur10.lerobot import live_arms
from dual_ur10.lerobot.dataset_reader import read_dataset
from dual_ur10.lerobot.features import ACTION, ENVIRONMENT_STATE, STATE
from dual_ur10.lerobot.gym_view import LeRobotView
from dual_ur10.lerobot.live_arms import LiveArms, LiveOperator
from dual_ur10.lerobot.live_process import Exchange
from dual_ur10.policies.operators.device import Reading
from dual_ur10.sim2real.cell.cell_kinds import CELL_KINDS
from tests.lerobot.conftest import STEPS


class Lift:
    """Two hands that lift both tools."""

    name, hands = "lift", 2

    def begin(self):
        pass

    def read(self):
        twist = np.zeros((2, 6))
        twist[:, 2] = 0.05
        return Reading(twist=twist, clutch=np.ones(2, dtype=bool))

    def close(self):
        pass


class Leader:
    """Two leader arms, whose grippers are closed."""

    name, hands, q_rad = "leader", 2, None

    def begin(self):
        pass

    def read(self):
        return Reading(joints_rad=self.q_rad, clutch=np.ones(2, dtype=bool), gripper=np.zeros(2))

    def close(self):
        pass


def until(reached, tries=1000):
    """Wait for steps of the arms, of which each takes 40 ms."""
    waiting = threading.Event()
    for _ in range(tries):
        if reached():
            return True
        waiting.wait(0.01)
    return False


APPROACHES = """
import time
from pathlib import Path

from dual_ur10.envs.sim.mujoco_cell import MujocoCell
from dual_ur10.errors import StartError
from dual_ur10.sim2real.cell.cell_kinds import register_cell

LOG = Path(__file__).with_name("log")


def note(word):
    with LOG.open("a") as file:
        file.write(word + "\\n")


class Approaching(MujocoCell):
    def reset(self, start, rows=None, **others):
        if not self.confirm("They move."):
            raise StartError("the motion was not confirmed")
        try:  # Ctrl-C may come as soon as the word is written
            note("moves")
            for _ in range(self.tenths):
                time.sleep(0.1)
        except KeyboardInterrupt:
            note("stops")
            raise
        note("arrives")
        return super().reset(start, rows, **others)

    def close(self):
        note("closes")
        super().close()


def make(request, tenths=0):
    cell = Approaching(request.config, request.ticks, latency_ticks=request.latency_ticks)
    cell.confirm, cell.tenths = request.confirm, tenths
    return cell


def make_slow(request):
    return make(request, 3000)


register_cell("near", "approaching:make", controllers=True)
register_cell("far", "approaching:make_slow", controllers=True)
"""


@pytest.fixture
def log(tmp_path, monkeypatch):
    """Words that two cells of an installed package wrote: "near" reaches its start at once, "far" in five minutes."""
    (tmp_path / "approaching.py").write_text(APPROACHES)
    (tmp_path / "approaching-1.dist-info").mkdir()
    (tmp_path / "approaching-1.dist-info" / "METADATA").write_text(
        "Metadata-Version: 2.1\nName: approaching\nVersion: 1\n"
    )
    (tmp_path / "approaching-1.dist-info" / "entry_points.txt").write_text("[dual_ur10.tasks]\ncells = approaching\n")
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.setattr(ids, "_loaded", set())
    kinds = dict(CELL_KINDS)
    path = tmp_path / "log"
    path.touch()
    yield lambda: path.read_text().split()
    sys.modules.pop("approaching", None)
    CELL_KINDS.clear()
    CELL_KINDS.update(kinds)


class Interrupted:
    """Values in whose writing Ctrl-C comes."""

    def items(self):
        raise KeyboardInterrupt


def test_commands_after_an_interrupted_one_count():
    shapes = {"target": (2,), "observation": (1,), "images": (0,)}
    here = Exchange(shapes)
    there = Exchange(shapes, here.name)
    before = np.zeros(2, dtype=np.float32)
    with pytest.raises(KeyboardInterrupt):
        here._write(0, Interrupted())
    assert there.commanded(before) is before
    for value in (1.0, 2.0):
        here.command(np.full(2, value, dtype=np.float32))
        assert there.commanded(before).tolist() == [value, value]
    there.close()
    here.close()


def test_arms_hold_and_approach_what_is_commanded():
    arms = LiveArms()
    with pytest.raises(ClosedError, match="not started"):
        arms.observation()
    arms.start()
    try:
        start, observation, images = arms.observation()
        assert (len(start), len(observation), images) == (14, 94, {})
        goal = start.copy()
        goal[[0, 12]] += 0.03  # a joint of each arm
        arms.command(goal)
        assert until(lambda: np.array_equal(np.delete(arms.observation()[0], [6, 13]), np.delete(goal, [6, 13])))
        for bad in (goal[:13], np.full(14, np.nan)):
            with pytest.raises(ActionError, match="expected are 14 finite numbers"):
                arms.command(bad)
        assert np.array_equal(np.delete(arms.observation()[0], [6, 13]), np.delete(goal, [6, 13]))
        person = LiveOperator(arms, f"{__name__}:Lift")
        found = person()
        assert list(found) == list(arms.names)
        assert found["left_gripper.pos"] == 1.0
        assert 0.0 < np.abs(np.array(list(found.values())) - arms.observation()[0])[:6].max() < 0.01
        person.close()
    finally:
        arms.stop()
    arms.stop()
    with pytest.raises(ClosedError):
        arms.command(goal)


def test_leaders_join_anew_after_a_pause_and_a_start(monkeypatch):
    def joints():
        return np.delete(arms.observation()[0], [6, 13]).reshape(2, 6)

    def lead(seconds=0.03):
        """Return the step of the joints that a leader commands so long after the call before, and the grippers'."""
        nonlocal now_s
        now_s += seconds
        found = np.array(list(person().values()))
        return np.abs(np.delete(found, [6, 13]).reshape(2, 6) - joints()).max(), found[[6, 13]].tolist()

    now_s = 0.0
    monkeypatch.setattr(live_arms, "time", SimpleNamespace(monotonic=lambda: now_s))
    slow = 0.2 * 0.04 * 1.001  # of one period
    arms = LiveArms()
    arms.start()
    try:
        Leader.q_rad = joints()
        person = LiveOperator(arms, f"{__name__}:Leader")
        assert lead() == (0.0, [0.0, 0.0])
        Leader.q_rad = joints() + 0.4
        assert lead()[0] > 3 * slow  # the leader is followed
        assert 0.0 < lead(2.0)[0] < slow
        Leader.q_rad = joints()
        lead()
        arms.stop()
        arms.start()
        Leader.q_rad = joints() + 0.4
        assert 0.0 < lead()[0] < slow
        Leader.q_rad = joints() + 1.0
        arms.stop()
        arms.start()
        with pytest.raises(LeaderConfigurationError, match="Put the leader into the configuration of its arm"):
            lead()
        person.close()
    finally:
        arms.stop()


def test_what_ends_the_motion_is_raised_by_the_next_call():
    """Here the end of a task's time, and that of the process."""
    arms = LiveArms("SineTracking", duration_s=0.4)
    arms.start()
    assert until(lambda: not arms.started)
    with pytest.raises(ClosedError, match="the motion of both arms has ended: its time is over"):
        arms.observation()
    arms.stop()
    arms = LiveArms()
    arms.start()
    arms._process.kill()
    with pytest.raises(LinkError, match="the process that moves the arms has ended: start them again"):
        arms.observation()
    arms.stop()
    with pytest.raises(UnknownNameError):
        LiveArms("Nothing")


def no_terminal(question):
    raise StartError("there is no terminal")


def interrupted(question):
    raise KeyboardInterrupt


@pytest.mark.parametrize(
    ("answer", "error"),
    [(lambda question: False, StartError), (no_terminal, StartError), (interrupted, KeyboardInterrupt)],
)
def test_a_start_that_was_refused_is_none(answer, error, log, monkeypatch, capfd):
    monkeypatch.setattr(live_arms, "ask_at_terminal", answer)
    arms = LiveArms(cell="near")
    for _ in range(2):  # the second one asks again
        with pytest.raises(error):
            arms.start()
        assert not arms.started
        with pytest.raises((ClosedError, StartError)):
            arms.observation()
    assert log() == ["closes", "closes"]
    assert "KeyboardInterrupt" not in capfd.readouterr().err
    monkeypatch.setattr(live_arms, "ask_at_terminal", lambda question: True)
    arms.start()
    assert arms.started
    arms.stop()
    assert not arms.started
    assert log()[2:] == ["moves", "arrives", "closes"]


def test_a_process_that_ends_before_the_answer_is_a_named_error(log, monkeypatch):
    arms = LiveArms(cell="near")

    def answer(question):
        arms._process.kill()
        arms._process.wait(30.0)
        return True

    monkeypatch.setattr(live_arms, "ask_at_terminal", answer)
    with pytest.raises(LinkError, match="the process that moves the arms has ended: start them again"):
        arms.start()
    assert log() == []


def test_ctrl_c_stops_the_path_to_the_start(log, monkeypatch):
    handler = signal.signal(signal.SIGINT, signal.default_int_handler)
    monkeypatch.setattr(live_arms, "ask_at_terminal", lambda question: True)
    arms = LiveArms(cell="far")

    def interrupt():
        until(lambda: "moves" in log(), 10_000)
        signal.pthread_kill(threading.main_thread().ident, signal.SIGINT)

    thread = threading.Thread(target=interrupt)
    thread.start()
    try:
        with pytest.raises(KeyboardInterrupt):
            arms.start()
    finally:
        thread.join()
        signal.signal(signal.SIGINT, handler)
    assert log() == ["moves", "stops", "closes"]
    assert not arms.started


PROGRAM = """
import os
import os
import signal
import subprocess
import sys
import threading
from types import SimpleNamespace
import time

from dual_ur10.lerobot import live_arms

live_arms.ask_at_terminal = lambda question: True
arms = live_arms.LiveArms(cell=sys.argv[1])
threading.Thread(target=arms.start, daemon=True).start()
while sys.argv[2] not in open(sys.argv[3]).read() or not (arms.started or sys.argv[2] == "moves"):
    time.sleep(0.01)
if not os.fork():
    os.read(0, 1)
    os._exit(0)
if sys.argv[4] == "stop":
    arms.stop()
os.kill(os.getpid(), signal.SIGKILL)
"""


@pytest.mark.parametrize("end", ["kill", "stop"])
@pytest.mark.parametrize(
    ("cell", "word", "left"), [("far", "moves", ["stops", "closes"]), ("near", "arrives", ["closes"])]
)
def test_arms_stop_though_a_forked_worker_lives_on(cell, word, left, end, log, tmp_path):
    paths = os.pathsep.join(each or os.getcwd() for each in sys.path)
    program = subprocess.Popen(
        [sys.executable, "-c", PROGRAM, cell, word, str(tmp_path / "log"), end],
        stdin=subprocess.PIPE, env={**os.environ, "PYTHONPATH": paths}, stderr=subprocess.DEVNULL,
    )  # fmt: skip
    with program:
        assert program.wait() == -signal.SIGKILL
        assert until(lambda: "closes" in log())
        assert log()[-len(left) - 1 :] == [word, *left]
        program.stdin.close()  # ends the worker


def test_targets_of_a_dataset_lead_to_the_same_targets(made):
    """A policy that has learned `action` is evaluated where it gives the recorded motion."""
    dataset = read_dataset(made[1])
    env = LeRobotView("Handover", randomization="mild", on_refusal="brake", episode_length=STEPS[0])
    columns = dataset.episode(0)
    observation, _ = env.reset(seed=7, options={"lerobot_new_rollout": True})
    assert np.allclose(observation["agent_pos"], columns[STATE][0], atol=1e-6)
    assert np.array_equal(observation["environment_state"], columns[ENVIRONMENT_STATE][0])
    for step, action in enumerate(columns[ACTION][:-1]):
        observation, _, _, truncated, info = env.step(action)
        assert np.allclose(observation["agent_pos"], columns[STATE][step + 1], atol=1e-5), step
        assert np.allclose(observation["environment_state"], columns[ENVIRONMENT_STATE][step + 1], atol=1e-3), step
        assert not truncated
    *_, truncated, info = env.step(columns[ACTION][-1])
    assert (truncated, info["is_success"]) == (True, False)
    assert (env.task_description, env._max_episode_steps) == ("Handover", STEPS[0])
    env.close()


def test_the_view_is_an_environment_of_gymnasium():
    env = LeRobotView("SineTracking", cameras=("front",), width=48, height=32)
    observation, _ = env.reset(seed=0)
    assert env.observation_space.contains(observation)
    assert observation["pixels"]["front"].dtype == np.uint8
    assert env.observation_space.contains(env.step(observation["agent_pos"])[0])
    assert env._max_episode_steps == 750
    assert env.observation_space["pixels"]["front"].shape == (32, 48, 3)
    env.close()
    with pytest.raises(SettingsError, match="do not end: give them a length"):
        LeRobotView("Free")


@pytest.mark.parametrize(
    ("keyword", "words"),
    [
        ("max_episode_steps", "give episode_length instead"),
        ("disable_env_checker", "leave it out"),
        ("action_mode", "leave it out, actions are joint positions"),
        ("observation", "leave it out, and give cameras for images"),
    ],
)
def test_keywords_that_the_view_sets_are_refused_by_name(keyword, words):
    with pytest.raises(SettingsError, match=f"{keyword} is set by LeRobotView itself: {words}"):
        LeRobotView("Handover", **{keyword: 3})


def test_the_other_process_imports_the_module_of_a_task(tmp_path, monkeypatch):
    (tmp_path / "loose.py").write_text(
        "from dual_ur10.envs.tasks.free.task import Free\nfrom dual_ur10.registration import register\n\n\n"
        '@register("MyLab/Loose-v0")\nclass Loose(Free):\n    pass\n'
    )
    monkeypatch.syspath_prepend(tmp_path)
    try:
        arms = LiveArms("loose:MyLab/Loose-v0")
        arms.start()
        assert arms.started
        arms.stop()
    finally:
        ids.TASKS.pop("MyLab/Loose-v0", None)
        sys.modules.pop("loose", None)


@pytest.mark.parametrize("keyword", ["action_mode", "observation", "height", "width"])
def test_keywords_that_live_arms_set_are_refused_by_name(keyword):
    with pytest.raises(SettingsError, match=f"{keyword} is set by LiveArms itself"):
        LiveArms(**{keyword: 3})
