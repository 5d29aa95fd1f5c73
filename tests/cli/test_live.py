"""The command `live` without a browser: what its loops do with handles and buttons, and what it refuses."""

import contextlib
import time
import types
import webbrowser
from unittest.mock import MagicMock

import gymnasium as gym
import numpy as np
import pytest

from dual_ur10.cli import session
from dual_ur10.cli.live import buttons_of
from dual_ur10.cli.train import _meet
from dual_ur10.cli.watch_session import WatchSession
from dual_ur10.envs.core.setup import EnvSetup
from dual_ur10.envs.rendering.live.buttons import EPISODES, TAKES
from dual_ur10.envs.rendering.live.live_page import LivePage
from dual_ur10.envs.rendering.live.memory import Handles
from dual_ur10.errors import CellFaulted, DeviceGarbageError, RenderError, StartError
from dual_ur10.policies import load
from dual_ur10.policies.operators import page as page_module
from dual_ur10.policies.operators.catalog import operator_with
from dual_ur10.policies.operators.session import LiveSession
from dual_ur10.policies.registry import keywords_for
from dual_ur10.policies.training.demonstrations import Demonstration
from tests.cli.command import run
from tests.policies.operators.hands import Hand, twist
from tests.policies.operators.rigs import FOREVER_S, RawPage, serving_nobody
from ur_core.processes.system import LOCAL

pytest.importorskip("viser")


class Driver(RawPage):
    """A session with a page without a process: what a browser would send is written into its memory."""

    def __init__(self, task="Handover", policy=None, **keywords):
        setup = EnvSetup.resolve(task, keywords)
        super().__init__(task, buttons_of(setup, takes=policy is not None), **keywords)
        self.env = gym.make(setup.env_id, **keywords)
        self.core = self.env.unwrapped.core
        actor = None if policy is None else load(policy, setup.env_id, **keywords)
        self.operator = operator_with(self.device, setup)
        self.alarms = []
        self.session = LiveSession(self.env, actor, self.operator, self.page, 0, report=self.alarms.append)
        self.session.begin(0)

    def turn(self, count=1):
        for _ in range(count):
            self.session.turn()

    @property
    def commanded(self):
        return self.core.pipeline.adapter.commanded_q_rad[0].copy()

    def close(self):
        self.session.shown.close()
        self.env.close()
        super().close()


@pytest.fixture
def drive():
    drivers = []

    def started(**keywords):
        drivers.append(Driver(**keywords))
        return drivers[-1]

    yield started
    for each in drivers:
        each.close()


def test_a_handle_leads_its_tool_and_only_that(drive):
    driver = drive()
    driver.turn()
    tools, before = driver.operator.tools_m.copy(), driver.commanded
    wanted = tools.copy()
    wanted[0, :3] += [0.05, 0.02, 0.04]
    driver.drag(wanted, [True, False])
    driver.turn(40)
    np.testing.assert_allclose(driver.operator.tools_m[0, :3], wanted[0, :3], atol=2e-3)
    np.testing.assert_allclose(driver.commanded[1], before[1], atol=1e-9)
    assert driver.words["left arm"] == "led by the operator"
    driver.drag(wanted + 0.1, [False, False])
    driver.turn(10)
    np.testing.assert_allclose(driver.operator.tools_m[0, :3], wanted[0, :3], atol=3e-3)


@pytest.mark.parametrize("task", ["SineTracking", "SyncCarry", "Handover", "Free"])
def test_every_task_is_led_and_shown(drive, task):
    driver = drive(task=task)
    driver.turn()
    wanted = driver.operator.tools_m.copy()
    wanted[:, 2] += 0.02
    driver.drag(wanted, [True, True])
    driver.turn(15)
    np.testing.assert_allclose(driver.operator.tools_m[:, 2], wanted[:, 2], atol=3e-3)
    assert driver.words["episode"].startswith("0, step 16")
    model, data = driver.core.cell_data(0)
    np.testing.assert_allclose(driver.page.memory.rows()[0][-1].qpos[: model.nq], data.qpos, atol=1e-12)


def test_a_device_without_a_page_leads_and_the_page_shows_it(drive):
    driver = drive(task="SineTracking")
    hand = Hand(**twist(0, 0, 0.1, 0, 0, 0), buttons=frozenset({"grip"}))
    session = LiveSession(driver.env, None, operator_with(hand, driver.core.setup), driver.page, 0)
    session.begin(0)
    before = driver.commanded
    for _ in range(5):
        session.turn()
    assert np.abs(driver.commanded - before).max() > 1e-3
    driver.press("stop")
    session.turn()
    assert driver.words["stop"].startswith("STOPPED")
    driver.press("pause")
    session.turn()
    driver.press("reset")
    session.turn()
    assert session.shown.episode == 1


def test_motion_led_along_a_limit_is_told(drive):
    driver = drive(task="Free")
    driver.turn()
    down = driver.operator.tools_m.copy()
    down[:, 2] = -0.5
    driver.drag(down, [True, True])
    told = set()
    for _ in range(100):
        driver.turn()
        told.add(driver.words.get("gate"))
    assert told == {None, "leads along what is in the way"}


def interrupted(*_, **__):
    raise KeyboardInterrupt


def test_rollout_is_led_by_a_page_and_shown_in_it(monkeypatch, tmp_path):
    pages, opened, asked = [], [], []
    original = page_module.open_page

    def open_page(setup, buttons, **keywords):
        asked.append(buttons)
        return original(setup, buttons, system=serving_nobody(), **keywords)

    monkeypatch.setattr(page_module, "open_page", open_page)
    monkeypatch.setattr(LivePage, "wait_until_ready", lambda self: setattr(self, "url", "http://the.page/"))
    monkeypatch.setattr(LivePage, "wait_until_open", lambda self: opened.append(self))
    monkeypatch.setattr(LivePage, "close", lambda self: pages.append(self))
    arguments = ("-n", "2", "--set", "duration_s=0.2", "--no-record", "--operator")
    code, text = run("rollout", "SineTracking", *arguments, "page:port=0,cameras=none,arms=left")
    assert (code, "open the page to begin: http://the.page/" in text) == (0, True)
    assert len(opened) == 1
    rows = pages[0].memory.rows()[0]
    assert [(row.scalars["episode"], row.scalars["step"]) for row in rows] == [(e, s) for e in (0, 1) for s in range(6)]
    assert [row.scalars["right_commander"] for row in rows][1:6] == [1] * 5
    assert run("rollout", "SineTracking", *arguments[:-1], "--takeover", "page:port=0,cameras=none")[0] == 0
    assert asked == [(), TAKES]
    monkeypatch.setattr("dual_ur10.policies.training.demonstrations.demonstrate", interrupted)
    record = ("--record", str(tmp_path / "runs"))
    run("collect", "SineTracking", "--operator", "page:port=0,cameras=none", *record)
    assert asked[-1] == EPISODES
    run("collect", "SineTracking", "--takeover", "page:port=0,cameras=none", *record)
    assert asked[-1] == (*TAKES, *EPISODES)
    rows = pages[1].memory.rows()[0]
    assert {row.scalars["right_commander"] for row in rows} == {0}
    assert run("rollout", "SineTracking", *arguments, "page:port=70000")[0] == 2
    assert run("rollout", "SineTracking", *arguments, "page:unattended=yes")[0] == 2
    code, text = run("evaluate", "SineTracking", "-n", "1", "--operator", "page")
    assert (code, "evaluate shows no page" in text) == (2, True)
    for page in pages:
        page.memory.close()


def test_the_page_tells_how_to_begin_and_how_many_are_kept(monkeypatch, tmp_path):
    found, original = [], page_module.open_page

    def demonstrate(env, actor, *, on_end, **_):
        words = env._page.memory
        found.append(words.words)
        env.reset(seed=0)
        found.append(words.words)
        on_end(Demonstration(450, 18.0, True, "success"))
        found.append(words.words)

    monkeypatch.setattr(page_module, "open_page", lambda *a, **k: original(*a, system=serving_nobody(), **k))
    monkeypatch.setattr(LivePage, "wait_until_ready", lambda self: setattr(self, "url", "http://the.page/"))
    monkeypatch.setattr(LivePage, "wait_until_open", lambda self: None)
    monkeypatch.setattr("dual_ur10.policies.training.demonstrations.demonstrate", demonstrate)
    device = ("--operator", "page:port=0,cameras=none", "--record", str(tmp_path / "runs"))
    code, text = run("collect", "SineTracking", *device)
    assert (code, "Record begins an episode, Success keeps it" in text) == (0, True)
    assert "b begins" not in text  # a page has no keys
    begin = "press Record to begin an episode"
    assert [each.get("next") for each in found] == [begin, None, begin]
    assert [each["kept"] for each in found] == ["0 episodes, 0 s"] * 2 + ["1 episodes, 18 s"]


def test_a_training_meets_the_person_at_the_page(monkeypatch, capsys):
    pytest.importorskip("torch")
    original, asked = page_module.open_page, []

    def open_page(setup, buttons, **keywords):
        asked.append(buttons)
        return original(setup, buttons, system=serving_nobody(), **keywords)

    monkeypatch.setattr(page_module, "open_page", open_page)
    monkeypatch.setattr(LivePage, "wait_until_ready", lambda self: setattr(self, "url", "http://the.page/"))
    monkeypatch.setattr(LivePage, "wait_until_open", lambda self: None)
    env_id = "DualUR10/SineTracking-v0"
    person = _meet(types.SimpleNamespace(operator="page:port=0,cameras=none", env_id=env_id, keywords={}))
    with gym.make(env_id) as env:
        for number in (1, 2):  # each round has an environment of its own
            words = person.shown(env)._page.memory
            assert (words.words["next"], asked) == ("press Record to begin an episode", [(*TAKES, *EPISODES)])
            person.on_end(Demonstration(450, 18.0, True, "success"))
            assert words.words["kept"] == f"{number} episodes, {18 * number} s"
    person.operator.close()
    assert "Success keeps it" in capsys.readouterr().out


def test_every_step_is_shown(drive):
    driver = drive()
    driver.turn(5)
    rows, count = driver.page.memory.rows()
    assert count == 6
    assert [row.scalars["step"] for row in rows] == list(range(6))
    assert rows[-1].scalars["left_commander"] == 1
    np.testing.assert_array_equal(rows[-1].commanded_rad, driver.commanded)


def test_the_stop_button_lets_both_arms_rest_until_a_reset(drive):
    driver = drive(policy="scripted")
    driver.turn(20)
    driver.press("stop")
    driver.turn(15)
    assert driver.words["stop"].startswith("STOPPED")
    rest = driver.commanded
    driver.drag(np.tile([0.0, 0.0, 0.5, 1.0, 0.0, 0.0, 0.0], (2, 1)), [True, True])
    driver.press("take_both")
    driver.turn(5)
    np.testing.assert_allclose(driver.commanded, rest, atol=1e-9)
    driver.drag(np.zeros((2, 7)), [False, False])
    driver.press("hand_back", "reset")
    driver.turn(20)
    assert "stop" not in driver.words
    assert np.abs(driver.commanded - rest).max() > 0.01


def test_one_arm_is_taken_and_handed_back(drive):
    driver = drive(task="SineTracking", policy="scripted")
    driver.turn(10)
    driver.press("take_left")
    driver.turn(20)
    rest = driver.commanded
    driver.turn(5)
    assert (driver.words["left arm"], driver.words["right arm"]) == ("led by the operator", "led by the policy")
    np.testing.assert_allclose(driver.commanded[0], rest[0], atol=1e-6)
    assert np.abs(driver.commanded[1] - rest[1]).max() > 1e-3
    wanted = driver.operator.tools_m.copy()
    wanted[0, 2] += 0.02
    driver.drag(wanted, [True, True])
    driver.turn(10)
    np.testing.assert_allclose(driver.operator.tools_m[0, 2], wanted[0, 2], atol=2e-3)
    driver.press("hand_back")
    driver.turn(10)
    assert driver.words["left arm"] == "led by the policy"
    assert sum(row.scalars["left_commander"] for row in driver.page.memory.rows()[0]) == 35
    assert np.abs(driver.commanded[0] - rest[0]).max() > 1e-3


def test_the_gripper_of_an_arm_that_was_taken_closes_at_the_press_of_its_button(drive):
    driver = drive(policy="scripted")
    driver.press("take_left")
    driver.turn(5)
    assert driver.core.pipeline.commanded_widths_m[0, 0] > 0.05
    driver.drag(driver.operator.tools_m, [True, False], [0.0, np.nan])
    driver.turn()
    driver.drag(driver.operator.tools_m, [False, False])
    driver.turn(20)
    assert driver.core.pipeline.commanded_widths_m[0, 0] < 0.01


def test_time_can_be_paused_and_advanced_by_one_step(drive):
    driver = drive(policy="scripted")
    driver.press("pause")
    driver.turn(3)
    assert driver.page.memory.count == 1
    driver.press("step")
    driver.turn(3)
    assert driver.page.memory.count == 2
    driver.press("next_seed")
    driver.turn()
    assert driver.session.shown.episode == 1


def watching(drive):
    """Return the driver of a session as `view` makes it: no operator, and policies to switch between."""
    driver = drive(task="SineTracking")

    def make(name):
        return *session.make("SineTracking", name, {}, 0), None

    driver.session.shown.close()
    driver.session = LiveSession(*make("scripted"), driver.page, 7, ("scripted", "no/folder", "learned"), make)
    driver.session.begin(7)
    return driver


def test_seeds_count_up_and_a_reset_repeats_one(drive):
    driver = watching(drive)
    begun = [driver.page.memory.rows()[0][-1].qpos]
    for name, seed in (("reset", 7), ("next_seed", 8), ("reset", 8)):
        driver.turn(2)
        driver.press(name)
        driver.turn()
        assert driver.words["episode"].endswith(f", step 0, seed {seed}")
        begun.append(driver.page.memory.rows()[0][-1].qpos)
    np.testing.assert_array_equal(begun[::2], begun[1::2])


def test_the_speed_is_that_of_its_button(drive, monkeypatch):
    driver = watching(drive)
    driver.press("speed_4")
    assert slept_in(driver, 2, monkeypatch) == pytest.approx([0.01, 0.02])
    assert driver.words["episode"].endswith(", 4× speed")


def slept_in(driver, count, monkeypatch):
    """Times for which the loop sleeps after each of its turns, while the clock stands."""
    slept, turns, turn = [], iter(range(count)), driver.session.turn

    def turned():
        next(turns)
        return turn()

    stopped = types.SimpleNamespace(monotonic=lambda: 0.0, sleep=slept.append)
    with monkeypatch.context() as patch:
        patch.setattr("dual_ur10.policies.operators.session.time", stopped)
        patch.setattr(LivePage, "lost", "")
        patch.setattr(driver.session, "turn", turned)
        with pytest.raises(StopIteration):
            driver.session.run(None)
    return slept


def test_another_policy_acts_from_the_beginning_in_an_environment_that_fits_it(drive):
    driver = watching(drive)
    driver.turn(2)
    assert driver.words["progress"].startswith("error L ")
    assert driver.words["reward"].startswith("return ")
    assert driver.words["reward"].count(", ") == len(driver.core.weights) - 1
    driver.press("policy_2")
    driver.turn()
    assert (driver.words["policy"], driver.words["episode"]) == ("learned", "1, step 0, seed 7")
    fitting = keywords_for("learned", driver.env.spec.id, {})
    assert driver.session.shown.unwrapped.core.setup.options == EnvSetup.resolve("SineTracking", fitting).options
    driver.press("policy_15")  # a page can name no other policy than the program
    driver.turn(2)
    assert driver.words["episode"].startswith("1, step 2")


def test_a_policy_that_cannot_be_used_is_named_and_the_other_one_goes_on(drive):
    driver = watching(drive)
    driver.press("policy_1")
    driver.turn(2)
    assert driver.words["policy"].startswith("REFUSED no/folder: ")
    assert driver.words["episode"].startswith("0, step 2")


class Succeeding(gym.Wrapper):
    def step(self, action):
        observation, reward, *_, info = self.env.step(action)
        return observation, reward, True, False, {**info, "is_success": True}


def test_successes_are_counted(drive):
    driver = watching(drive)
    assert driver.words["success"] == "not yet; 0 of 0 episodes"
    driver.session.shown.env = Succeeding(driver.session.shown.env)
    driver.turn(2)
    assert driver.words["success"] == "not yet; 2 of 2 episodes"
    assert driver.words["episode"] == "2, step 0, seed 9"


def test_a_gripper_opens_and_closes_while_its_handle_is_held(drive):
    driver = drive()
    driver.turn(2)
    driver.drag(driver.operator.tools_m, [True, False], [0.0, np.nan])
    driver.turn(20)
    left, right = driver.core.pipeline.commanded_widths_m[0]
    assert left < 0.01 < right
    driver.press("stop")
    driver.turn(10)
    np.testing.assert_allclose(driver.core.pipeline.commanded_widths_m[0], [left, right], atol=1e-6)


def test_a_button_latches_a_stop_of_a_virtual_cell(drive, monkeypatch):
    from dual_ur10.testing import VirtualCell

    with VirtualCell() as cell:
        found = []
        with monkeypatch.context() as patch:
            patch.setattr(page_module, "LivePage", lambda about, **_: found.append(about.buttons) or MagicMock())
            for keywords in ({}, {"cell": cell}):
                page_module.page_device(EnvSetup.resolve("SineTracking", keywords))
        assert found == [(), ("stop",)]  # nothing in a simulation would act on it
        driver = drive(task="SineTracking", policy="scripted", cell=cell)
        assert slept_in(driver, 3, monkeypatch) == pytest.approx([0.04, 0.08, 0.12])
        assert operator_with(driver.device, driver.core.setup, paced=True)._clock is time.monotonic  # as in simulation
        driver.turn(7)
        assert driver.words["gate"] == "releases all"
        driver.press("stop")
        driver.turn(3)
        assert "live page" in driver.core.cell.runner.cell.fault
        assert driver.words["program"].startswith("LATCHED")
        (alarm,) = driver.alarms  # perhaps nobody sees the page
        assert "both arms were stopped" in alarm
        driver.press("reset")
        driver.turn(3)
        assert driver.session.shown.episode == 1  # a person clears it, not the page
        with pytest.raises(CellFaulted, match="stopped: the button"):
            driver.session.run(0.0)
        monkeypatch.setattr(driver.session, "turn", interrupted)
        with pytest.raises(CellFaulted, match="stopped: the button"):
            driver.session.run(5.0)


def test_a_page_that_is_gone_stops_both_arms_of_a_virtual_cell(drive, monkeypatch):
    from dual_ur10.testing import VirtualCell

    with VirtualCell() as cell:
        driver = drive(task="SineTracking", policy="scripted", cell=cell)
        monkeypatch.setattr(LivePage, "lost", "its process has ended")
        with pytest.raises(RenderError, match="both arms were stopped: the live page is gone"):
            driver.session.run(5.0)
        assert "the live page is gone" in driver.core.cell.runner.cell.fault
        with pytest.raises(RenderError, match="start the program again"):
            WatchSession((), driver.page, {}).run(5.0)


def test_a_device_that_fails_stops_both_arms_of_a_virtual_cell(drive):
    from dual_ur10.testing import VirtualCell

    with VirtualCell() as cell:
        driver = drive(task="SineTracking", cell=cell)
        driver.turn()
        driver.drag(np.full((2, 7), np.nan), [True, False])
        with pytest.raises(DeviceGarbageError):
            driver.turn()
        assert "DeviceGarbageError" in driver.core.cell.runner.cell.fault


class _Arm:
    def __init__(self, name, status):
        self.name, self.status = name, status
        self.dead, self.program, self.program_fault = "", "PLAYING x.urp", ""


def _status(q):
    from ur_core.links.arm_status import ROW_SIZE, ArmStatus

    status = ArmStatus.from_row(np.zeros(ROW_SIZE))
    return status._replace(q_rad=(q,) * 6, target_q_rad=(q + 0.1,) * 6, robot_mode=7, safety_mode=1, slider=1.0)


def test_a_watcher_shows_what_both_controllers_measure(drive):
    page = drive().page
    since = page.memory.count
    left, right = _Arm("left", _status(0.5)), _Arm("right", None)
    session = WatchSession((left, right), page, {"arms": "watched only"})
    session.show(0.0, 0)
    assert page.memory.count == since
    assert page.memory.words["right arm"] == "nothing heard yet"
    right.status = _status(-0.5)
    left.dead = "its time stalls"
    session.show(0.04, 1)
    (row,), _ = page.memory.rows(since)
    assert (row.q_rad[0, 0], row.q_rad[1, 0], row.commanded_rad[0, 5]) == (0.5, -0.5, 0.6)
    assert page.memory.words["left arm"] == "LOST: its time stalls"


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["--operator", "telepathy"], "unknown operator 'telepathy'"),
        (["--operator", "page:port=0"], "takes --port and --cameras"),
        (["--command"], "name their cell file with --cell"),
        (["--cell", "CELL", "--policy", "scripted"], "add --command"),
        (["--cell", "CELL", "--power-on"], "add --command"),
        (["--cell", "CELL", "--unattended"], "add --command"),
        (["--unattended"], "add --command"),
        (["--cameras", "fornt"], "front"),
    ],
)
def test_what_does_not_go_together_is_named(tmp_path, arguments, words):
    arguments = [str(tmp_path / "cell.toml") if each == "CELL" else each for each in arguments]
    code, text = run("live", "SineTracking", *arguments)
    assert code == 2
    assert words in text


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["-p", "zero", "-p", "psychic"], "unknown policy 'psychic'"),
        ([each for number in range(13) for each in ("-p", f"own:Policy{number}")], "at most 16 policies"),
    ],
)
def test_what_view_cannot_show_is_named(arguments, words):
    code, text = run("view", "SineTracking", "--no-browser", "--port", "0", "--seconds", "0.1", *arguments)
    assert (code, words in text) == (2, True)


def test_view_refuses_a_cell_of_controllers(monkeypatch):
    """Its page has no button that stops both arms."""
    setup = types.SimpleNamespace(config=types.SimpleNamespace(controllers=True))
    monkeypatch.setattr("dual_ur10.cli.view.setup_for", lambda *_: setup)
    code, text = run("view", "SineTracking", "--set", "cell=lab.toml")
    assert (code, "`live --cell` shows" in text) == (2, True)


def test_view_opens_a_page_without_a_stop_and_a_browser_that_has_a_window(monkeypatch):
    made, asked = [], []
    original = page_module.open_page

    def open_page(*arguments, **keywords):
        made.append(keywords)
        return original(*arguments, system=serving_nobody(), **keywords)

    monkeypatch.setattr(page_module, "open_page", open_page)
    monkeypatch.setattr(LivePage, "wait_until_ready", lambda self: setattr(self, "url", "http://the.page/"))
    monkeypatch.setattr(LiveSession, "run", interrupted)
    monkeypatch.setattr(webbrowser, "get", lambda: types.SimpleNamespace(open=asked.append))
    for display, more in ((":0", ()), (":0", ("--no-browser",)), ("", ())):
        monkeypatch.setenv("DISPLAY", display)
        monkeypatch.delenv("WAYLAND_DISPLAY", raising=False)
        code, text = run("view", "SineTracking", "-p", "zero", "--cameras", "none", *more)
        assert (code, "closed" in text, asked) == (0, True, ["http://the.page/"])
    assert made[0]["policies"][:2] == ("zero", "scripted")
    assert not made[0]["handles"]


def test_arms_do_not_move_to_the_start_without_the_yes_that_rollout_asks_for(drive, monkeypatch):
    from dual_ur10.testing import VirtualCell

    asked = []

    def prompt_for(file, confirm=None):
        assert confirm is None  # the page never answers for the operator
        return lambda question: asked.append(question)

    monkeypatch.setattr("dual_ur10.sim2real.runtime.start_of_episode.prompt_for", prompt_for)
    with VirtualCell() as cell:
        with pytest.raises(StartError, match="not confirmed"):
            drive(task="SineTracking", policy="scripted", cell=cell)
        with commanding(monkeypatch, cell) as (pages, turned):
            code, text = run(*COMMAND)
        assert (code, "not confirmed" in text, turned) == (2, True, ["waited"])
        assert not pages[0].memory.count  # nothing was shown, since nothing began
    assert len(asked) == 2


COMMAND = ("live", "SineTracking", "--cell", "lab.toml", "--command", "--port", "0", "--cameras", "none")


@contextlib.contextmanager
def commanding(monkeypatch, cell):
    """Let `live --command` command a virtual cell from a page without a process, for the time of a drag.

    Yields the pages, and the ways of both commanded tools (m) with what a second command said meanwhile.
    """
    pages, turned, opened = [], [], page_module.open_page

    def open_page(*arguments, **keywords):
        pages.append(opened(*arguments, system=serving_nobody(), **keywords))
        return pages[-1]

    def lead(session, seconds):
        session.begin(0)
        session.turn()
        page, begun = pages[0], session.operator.tools_m.copy()
        page.memory.beat(LOCAL.clock.now_s() + FOREVER_S)
        wanted = begun + np.array([[0, 0, 0.02, 0, 0, 0, 0], [0] * 7])
        page.memory.put_handles(Handles(wanted, np.array([True, False]), np.full(2, np.nan), 0.0))
        for _ in range(20):
            session.turn()
        turned.append((session.operator.tools_m - begun)[:, 2])
        if len(pages) == 1:
            turned.append(run(*COMMAND))

    with monkeypatch.context() as patch:
        patch.setattr(page_module, "open_page", open_page)
        patch.setattr(LivePage, "wait_until_ready", lambda self: "http://the.page/")
        patch.setattr(LivePage, "wait_until_open", lambda self: turned.append("waited"))
        patch.setattr(LiveSession, "run", lead)
        patch.setattr("dual_ur10.cli.live.keywords_on", lambda *_: {"cell": cell})
        yield pages, turned


def test_live_commands_a_cell_of_controllers_for_one_operator_at_a_time(monkeypatch):
    from dual_ur10.testing import VirtualCell

    with VirtualCell() as cell:
        with commanding(monkeypatch, cell) as (_, turned):
            code, text = run(*COMMAND, "--unattended")
        fault = cell.fault
    assert (code, "the page is at http://the.page/" in text) == (0, True)
    np.testing.assert_allclose(turned[0], [0.02, 0.0], atol=2e-3)
    code, text = turned[1]
    assert (code, len(turned)) == (2, 2)  # it did not wait for a page
    assert "moved by this program already" in text
    assert not fault  # the refusal stops nobody


@pytest.mark.parametrize(
    ("text", "names"),
    [("front, left/wrist", ("front", "left/wrist")), ("left/wrist/side", ("left/wrist", "side")), ("none", ())],
)
def test_names_of_cameras_may_have_the_separator_in_them(text, names):
    setup = EnvSetup.resolve("DualUR10/Handover-v0", {})
    page = page_module.open_page(setup, port=0, cameras=text, system=serving_nobody())
    assert page._about.cameras == names
    page.close()
