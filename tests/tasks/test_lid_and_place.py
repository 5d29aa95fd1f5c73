"""LidAndPlace: one arm holds a lid open, the other puts a block inside."""

import gymnasium as gym
import pytest

from benchmarks.cheats import LID, tried
from dual_ur10.errors import SettingsError
from dual_ur10.policies import evaluate

ID = "DualUR10/LidAndPlace-v0"


@pytest.mark.parametrize("randomization", ["none", "mild"])
def test_the_script_succeeds(randomization):
    keywords = {"randomization": randomization, "on_refusal": "terminate"}
    (episode,) = evaluate(ID, "scripted", episodes=1, env_kwargs=keywords).episodes
    assert episode.success
    assert max(episode.peak["force_n/left"], episode.peak["force_n/right"]) < 40


def test_ways_round_the_stages_do_not_succeed():
    ends = {
        "block dropped into the case": (False, 2, "block_fell"),
        "lid let go of over the block": (False, 3, "lid_slammed"),
    }
    assert tried(ID, {name: LID[name] for name in ends}) == ends


@pytest.mark.parametrize(
    ("keywords", "message"),
    [
        ({"slam_rad_s": 0.0}, "slam_rad_s"),
        ({"object_range_m": 0.2}, "object_range_m"),
        ({"robot": "ur3e"}, "ur3e, cannot reach"),
    ],
)
def test_settings_that_cannot_work_are_refused(keywords, message):
    with pytest.raises(SettingsError, match=message):
        gym.make(ID, **keywords)
