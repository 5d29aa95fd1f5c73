"""PegInsertion: both arms pick up their objects and insert one into the other."""

import gymnasium as gym
import pytest

from benchmarks.cheats import PEG, tried
from dual_ur10.errors import SettingsError
from dual_ur10.policies import evaluate

ID = "DualUR10/PegInsertion-v0"


@pytest.mark.parametrize("randomization", ["none", "mild"])
def test_the_script_succeeds(randomization):
    keywords = {"clearance_m": 0.0005, "randomization": randomization, "on_refusal": "terminate"}
    (episode,) = evaluate(ID, "scripted", episodes=1, env_kwargs=keywords).episodes
    assert episode.success
    assert max(episode.peak["force_n/left"], episode.peak["force_n/right"]) < 40


def test_ways_round_the_stages_do_not_succeed():
    ends = {"tip beside the plate": (False, 3, "time")}
    assert tried(ID, {name: PEG[name] for name in ends}) == ends


@pytest.mark.parametrize(
    ("keywords", "message"),
    [
        ({"clearance_m": 2e-4}, r"clearance_m is 0.0002: .* less than 0.0003 m wider. Use 0.0005"),
        ({"clearance_m": 0.02}, "clearance_m is 0.02: it must be a number, .* to 0.01"),
        ({"chamfer_m": 0.0}, "chamfer_m"),
        ({"object_range_m": 0.2}, "object_range_m"),
        ({"robot": "ur3e"}, "the left arm, ur3e, cannot reach .* longer arms, such as ur10e"),
    ],
)
def test_settings_that_cannot_work_are_refused(keywords, message):
    with pytest.raises(SettingsError, match=message):
        gym.make(ID, **keywords)


def test_loads_and_coupling_follow_the_stages():
    with gym.make(ID) as env:
        env.reset(seed=0)
        task = env.unwrapped.core.task
        for passed, load_kg, coupled in ((0, (0.0, 0.0), False), (1, (0.4, 0.25), False), (3, (0.4, 0.25), True)):
            task.passed[:] = passed
            assert tuple(task.load_kg()[0]) == load_kg
            assert task.coupled().tolist() == [coupled]
