"""The command `replay --page`: the states of a record, and the images of its cameras at their times."""

import types

import gymnasium as gym
import numpy as np
import pytest

from dual_ur10.cli.playback_session import PlaybackSession
from dual_ur10.sim2real.cameras.pattern_camera import pattern_time_s
from dual_ur10.sim2real.cameras.video_record import video_name
from dual_ur10.sim2real.recording.reader import read_run
from dual_ur10.testing import VirtualCell
from tests.cli.command import run
from ur_core.objects import load_object

pytest.importorskip("av")
STEPS = 8
SHOWN = ("--page", "--no-browser", "--port", "0", "--seconds", "0.5")


class Clock:
    """A clock that nobody waits for."""

    def __init__(self):
        self.time_s = 100.0

    def now_s(self):
        return self.time_s

    def sleep(self, duration_s):
        self.time_s += duration_s


class ShownPage:
    """A page that keeps what it is shown."""

    lost = ""

    def __init__(self, clock):
        self.clock, self.rows, self.texts = clock, [], []

    def attach(self, view):
        path, *names = view
        self.view = load_object(path, "the view", registered=True)(*names)

    def say(self, words):
        self.texts.append(words)

    def show_measured(self, q_rad, commanded_rad, scalars):
        images = self.view.images(self.clock.now_s())
        self.rows.append((self.clock.now_s(), q_rad, commanded_rad, scalars, images))


@pytest.fixture(scope="module")
def recorded(tmp_path_factory):
    runs = tmp_path_factory.mktemp("runs")
    with VirtualCell(file={"camera": [{"name": "left/wrist", "kind": "pattern", "rate_hz": 30.0}]}) as cell:
        env = gym.make("dual_ur10:DualUR10/SineTracking-v0", cell=cell, record=runs, confirm=lambda _: True)
        for seed in range(2):
            env.reset(seed=seed)
            for _ in range(STEPS):
                env.step(0.3 * env.action_space.high)
        begin_s = env.unwrapped.core._hook.recorder.begin_s
        env.close()
    (folder,) = runs.iterdir()
    return folder, begin_s


def test_each_step_is_shown_at_its_time_with_the_newest_image(recorded):
    folder, begin_s = recorded
    found = read_run(folder)
    broken = folder / video_name("overhead")
    broken.write_bytes(b"cut off")
    clock, reports = Clock(), []
    page = ShownPage(clock)
    with PlaybackSession(
        found, found.episodes[1], folder, reports.append, system=types.SimpleNamespace(clock=clock)
    ) as shown:
        times_s = shown._times_s
        shown.run(page, 2 * (times_s[-1] - times_s[0]) + 2.0)
        page.view.close()
    broken.unlink()
    assert shown.cameras == ("left/wrist",)
    assert len(reports) == 1
    assert "camera_overhead.mp4 is no video" in reports[0]
    assert len(page.rows) == 2 * (STEPS + 1)  # again and again
    for number, (at_s, q_rad, commanded_rad, scalars, images) in enumerate(page.rows):
        step = number % (STEPS + 1)
        np.testing.assert_array_equal(q_rad, found.episodes[1].q_rad[step])
        if step:
            np.testing.assert_array_equal(commanded_rad, found.episodes[1].targets_rad[step - 1, -1])
        assert (scalars["episode"], scalars["step"]) == (1, step)
        assert at_s == pytest.approx(page.rows[number - step][0] + times_s[step] - times_s[0])
        age_s = times_s[step] - (pattern_time_s(images["left/wrist"]) - begin_s)
        assert -1e-5 <= age_s <= 1 / 30 + 1e-5


def test_the_command_shows_a_record_and_moves_nothing(recorded):
    pytest.importorskip("viser")
    folder, _ = recorded
    arguments = ("replay", str(folder), *SHOWN)
    code, text = run(*arguments)
    assert code == 0, text
    assert "the page is at http://127.0.0.1:" in text
    code, text = run(*arguments, "--cell", "virtual")
    assert code == 2
    assert "--page moves nothing" in text


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        ((*SHOWN, "--record", "elsewhere"), "--page records nothing"),
        ((*SHOWN, "--no-record"), "--page records nothing"),
        (("--seconds", "1"), "are for the page"),
        (("--port", "0"), "are for the page"),
        (("--no-browser",), "are for the page"),
    ],
)
def test_options_of_the_other_replay_are_refused(recorded, arguments, words):
    pytest.importorskip("viser")
    code, text = run("replay", str(recorded[0]), *arguments)
    assert code == 2
    assert words in text
