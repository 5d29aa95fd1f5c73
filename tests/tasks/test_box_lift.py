"""BoxLift: both arms press a box, lift it and place it."""

import gymnasium as gym
import pytest

from benchmarks.cheats import BOX, tried
from dual_ur10.errors import SettingsError
from dual_ur10.policies import evaluate

ID = "DualUR10/BoxLift-v0"


@pytest.mark.parametrize("randomization", ["none", "mild"])
def test_the_script_succeeds(randomization):
    keywords = {"randomization": randomization, "on_refusal": "terminate"}
    (episode,) = evaluate(ID, "scripted", episodes=1, env_kwargs=keywords).episodes
    assert episode.success
    assert max(episode.peak["force_n/left"], episode.peak["force_n/right"]) < 60


def test_ways_round_the_stages_do_not_succeed():
    ends = {"dropped on its goal": (False, 3, "box_fell")}
    assert tried(ID, {name: BOX[name] for name in ends}) == ends


@pytest.mark.parametrize(
    ("keywords", "message"),
    [
        ({"width_m": 0.4}, "width_m is 0.4: it must be a number, 0.1 to 0.26"),
        ({"object_turn_rad": 1.0}, "object_turn_rad"),
        ({"success_error_m": 0.0}, "success_error_m"),
        ({"robot": "ur3e"}, "ur3e, cannot reach"),
    ],
)
def test_settings_that_cannot_work_are_refused(keywords, message):
    with pytest.raises(SettingsError, match=message):
        gym.make(ID, **keywords)
