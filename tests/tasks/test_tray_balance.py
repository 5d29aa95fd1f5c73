"""TrayBalance: both arms carry a tray, and roll the ball on it to its middle."""

import gymnasium as gym
import pytest

from benchmarks.cheats import TRAY, tried
from dual_ur10.errors import SettingsError
from dual_ur10.policies import evaluate

ID = "DualUR10/TrayBalance-v0"


@pytest.mark.parametrize("randomization", ["none", "mild"])
def test_the_script_succeeds(randomization):
    keywords = {"randomization": randomization, "on_refusal": "terminate"}
    (episode,) = evaluate(ID, "scripted", episodes=1, env_kwargs=keywords).episodes
    assert episode.success
    assert max(episode.peak["force_n/left"], episode.peak["force_n/right"]) < 80


def test_ways_round_the_stages_do_not_succeed():
    ends = {"left fingers about the object": (False, 4, "time")}
    assert tried(ID, {name: TRAY[name] for name in ends}) == ends


@pytest.mark.parametrize(
    ("keywords", "message"),
    [
        ({"ball_range_m": 1.0}, "ball_range_m"),
        ({"ball_range_m": 0.125}, "does not fit the tray.* Use ball_range_m=0.12 or less"),
        ({"success_ball_m": 0.0}, "success_ball_m"),
        ({"robot": "ur3e"}, "ur3e, cannot reach"),
    ],
)
def test_settings_that_cannot_work_are_refused(keywords, message):
    with pytest.raises(SettingsError, match=message):
        gym.make(ID, **keywords)


def test_a_level_tray_leaves_the_ball_where_it_was(monkeypatch):
    monkeypatch.setattr("dual_ur10.tasks.tray_balance.POSITION_GAIN", 0.0)
    monkeypatch.setattr("dual_ur10.tasks.tray_balance.SPEED_GAIN", 0.0)
    (episode,) = evaluate(ID, "scripted", episodes=1, env_kwargs={"duration_s": 16.0}).episodes
    assert (episode.success, episode.best_stage) == (False, 2)
