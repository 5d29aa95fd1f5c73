"""Demonstrations: what a person keeps becomes a dataset, whatever happens afterwards."""

import contextlib

import gymnasium as gym
import numpy as np
import pytest

from dual_ur10.errors import DatasetError, DeviceUnpluggedError
from dual_ur10.policies.learned.signature import view_of
from dual_ur10.policies.operators.device import Reading
from dual_ur10.policies.training.dataset import read_dataset
from dual_ur10.policies.training.demonstrations import demonstrate, folder_of, make_dataset
from dual_ur10.testing import VirtualCell
from tests.policies.operators.hands import operator_of

minari = pytest.importorskip("minari")
pytest.importorskip("h5py")

TASK, NAME = "SineTracking", "ur10/sine/person-v0"
KEYWORDS = {"duration_s": 4.0, "action_mode": "tcp_delta"}


@pytest.fixture(autouse=True)
def _own_folder(tmp_path_factory, monkeypatch):
    monkeypatch.setenv("MINARI_DATASETS_PATH", str(tmp_path_factory.mktemp("datasets")))


class Person:
    """Device of a person who presses buttons at some readings; "unplug" ends it."""

    name, hands = "a person", 2

    def __init__(self, *script):
        self.script = [button for steps, button in script for button in (*[None] * steps, button)]

    def read(self):
        button = self.script.pop(0)
        if button == "unplug":
            raise DeviceUnpluggedError("a person was unplugged")
        twist = np.full((2, 6), 0.05)
        return Reading(twist=twist, clutch=np.array([True, True]), buttons=frozenset([button] if button else []))

    def close(self):
        pass


def demonstrated(folder, person, episodes, **keywords):
    """Return the environment of demonstrations, and their ends."""
    ends = []
    keywords = {**KEYWORDS, **keywords}
    env = gym.make(f"DualUR10/{TASK}-v0", record=str(folder), record_about={"policy": "a person"}, **keywords)
    operator = operator_of(person, TASK, **keywords)
    with contextlib.suppress(DeviceUnpluggedError):
        demonstrate(env, operator, episodes=episodes, seed=3, on_end=ends.append, wait=lambda time_s: None)
    return env, ends


def test_episodes_begin_are_kept_and_are_thrown_away_by_buttons(tmp_path):
    folder = folder_of(tmp_path, NAME)
    person = Person((2, "record"), (4, "discard"), (1, "record"), (5, "success"), (0, "record"), (3, "reset"),
                    (6, "success"))  # fmt: skip
    env, ends = demonstrated(folder, person, 2)
    env.close()
    assert [(each.steps, each.kept, each.ended_by) for each in ends] == [
        (4, False, "discard"), (5, True, "success"), (3, False, "reset"), (6, True, "success")
    ]  # fmt: skip
    assert ends[1].time_s == pytest.approx(0.2)
    dataset = make_dataset(folder, NAME, author="a person")
    assert [len(each.rewards) for each in dataset] == [5, 6]
    assert all(each.infos["intervention"][1:].all() for each in dataset)
    stated = list(dataset.storage.get_episode_metadata(range(2)))
    assert [(each["success"], each["seed"]) for each in stated] == [("true", 4), ("true", 6)]
    _, actions = read_dataset(NAME, view_of(f"DualUR10/{TASK}-v0", KEYWORDS))
    assert actions.shape == (11, 12)
    assert actions[:, :3].any()
    with pytest.raises(DatasetError, match=r"What was kept is in .*ur10-sine-person-v0"):
        make_dataset(folder, NAME)


def test_an_episode_that_ends_by_itself_is_kept_if_the_task_succeeds(tmp_path):
    env, ends = demonstrated(tmp_path, Person((0, "record"), (99, "unplug")), 1, duration_s=0.2)
    env.close()
    assert [(each.kept, each.ended_by) for each in ends] == [(False, "time")]
    assert make_dataset(tmp_path, NAME) is None


def test_what_was_kept_survives_a_crash_and_is_in_the_dataset_of_the_next_try(tmp_path):
    crashed, _ = demonstrated(tmp_path, Person((0, "record"), (5, "success"), (0, "record"), (2, "unplug")), 9)
    again, _ = demonstrated(tmp_path, Person((0, "record"), (7, "success")), 1)
    again.close()
    dataset = make_dataset(tmp_path, NAME)  # the first record is still open, as a kill leaves it
    assert sorted(len(each.rewards) for each in dataset) == [5, 7]
    crashed.close()


def test_demonstrations_on_controllers_become_a_dataset(tmp_path):
    with VirtualCell(task=TASK, plant="nominal") as cell:
        person = Person((1, "record"), (3, "discard"), (0, "record"), (5, "success"))
        env, ends = demonstrated(tmp_path, person, 1, cell=cell)
        env.close()
    assert [each.kept for each in ends] == [False, True]
    dataset = make_dataset(tmp_path, NAME)
    assert [len(each.rewards) for each in dataset] == [5]
    assert dataset[0].infos["commander"][1:].all()
