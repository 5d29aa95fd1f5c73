"""Demonstrations: what a person keeps becomes a dataset, whatever happens afterwards."""

import contextlib
import resource

import gymnasium as gym
import numpy as np
import pytest

from dual_ur10.errors import DatasetError, DeviceAbsentError, DeviceUnpluggedError, RecordingError, TrainingError
from dual_ur10.policies.learned.checkpoint import read_manifest
from dual_ur10.policies.learned.signature import view_of
from dual_ur10.policies.operators.device import Reading
from dual_ur10.policies.training.dataset import collect, read_dataset
from dual_ur10.policies.training.demonstrations import demonstrate, folder_of, kept_of, make_dataset
from dual_ur10.policies.training.train import resume, train
from dual_ur10.sim2real.recording.reader import read_run
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
    """Device of a person who presses buttons at some readings; "unplug" and "interrupt" end it."""

    name, hands = "a person", 2

    def __init__(self, *script):
        self.script = [button for steps, button in script for button in (*[None] * steps, button)]

    def begin(self):
        pass

    def read(self):
        button = self.script.pop(0)
        if button == "unplug":
            raise DeviceUnpluggedError("a person was unplugged")
        if button == "interrupt":
            raise KeyboardInterrupt
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
    _, actions, _, _ = read_dataset(NAME, view_of(f"DualUR10/{TASK}-v0", KEYWORDS))
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


@contextlib.contextmanager
def disk_with_room_for(count):
    """Let no file grow beyond a number of bytes."""
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (count, before[1]))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)


def test_a_full_disk_is_named_and_loses_nothing_that_was_kept(tmp_path):
    """The disk is full at the begin, later in the second episode, and still when the dataset is made."""
    with disk_with_room_for(0), pytest.raises(RecordingError, match=r"cannot write .* any more"):
        demonstrated(tmp_path, Person((0, "record")), 1)
    with disk_with_room_for(200_000), pytest.raises(RecordingError, match=r"cannot write .* any more"):
        demonstrated(tmp_path, Person((0, "record"), (6, "success"), (0, "record"), (1000, "success")), 2)
    with disk_with_room_for(1000), pytest.raises(DatasetError, match="What was kept is in"):
        make_dataset(tmp_path, NAME)
    assert [len(each.rewards) for each in make_dataset(tmp_path, NAME)] == [6]


def test_demonstrations_on_controllers_become_a_dataset(tmp_path):
    with VirtualCell(task=TASK, plant="nominal") as cell:
        person = Person((1, "record"), (3, "discard"), (0, "record"), (5, "success"))
        env, ends = demonstrated(tmp_path, person, 1, cell=cell)
        env.close()
    assert [each.kept for each in ends] == [False, True]
    dataset = make_dataset(tmp_path, NAME)
    assert [len(each.rewards) for each in dataset] == [5]
    assert dataset[0].infos["commander"][1:].all()


TAKEN = (4, "take_both")
"""The policy leads four steps, and the person the fifth."""


@pytest.fixture
def fits(monkeypatch):
    """Actions that networks were fitted to."""
    pytest.importorskip("stable_baselines3")
    from dual_ur10.policies.training.regression import Fit

    seen, real = [], Fit.__call__

    def watched(self, observation, action, *rest):
        seen.append(action)
        return real(self, observation, action, *rest)

    monkeypatch.setattr(Fit, "__call__", watched)
    return seen


@pytest.fixture
def scripted():
    """Name of a dataset of one episode of 50 steps."""
    collect(TASK, "ur10/sine/few-v0", episodes=1, envs=1, env_kwargs={"duration_s": 2.0, "action_latency_ticks": 5})
    return "ur10/sine/few-v0"


def to_correct(**given):
    """Return a training of 11 steps, each of whose rounds has one kept episode."""
    from tests.policies.training.small import small

    changes = {"corrected": 1, **given.pop("changes", {})}
    return small("dagger", envs=1, steps=11, operator="keyboard", changes=changes, **given)


def met(*script):
    """Return a function that meets a person with a script."""
    from dual_ur10.policies.training.corrections import Person as Corrector

    return lambda asked: Corrector(operator_of(Person(*script), TASK, **asked.keywords), wait=lambda time_s: None)


def test_what_a_person_corrects_is_added_to_the_dataset(tmp_path, scripted, fits):
    meet = met((0, "record"), TAKEN, (2, "success"), (0, "record"), TAKEN, (0, "discard"),
               (0, "record"), TAKEN, (1, "hand_back"), (3, "success"))  # fmt: skip
    policy = train(to_correct(dataset=scripted), tmp_path / "out", meet=meet)
    runs = [kept_of(read_run(each)) for each in sorted((tmp_path / "out" / "episodes").iterdir())]
    led = [episode.commander.any(axis=1) for run in runs for episode in run.episodes]
    assert [each.tolist() for each in led] == [[False] * 4 + [True] * 3, [False] * 4 + [True] * 2 + [False] * 4]
    assert [len(each) for each in fits] == [50, 53, 55]
    done = np.concatenate([episode.action for run in runs for episode in run.episodes])
    np.testing.assert_array_equal(fits[-1][50:], done[np.concatenate(led)])
    stated = read_manifest(policy).training
    assert stated["from_operator"] is True
    assert stated["samples"] in (50, 53, 55)  # the best one is the result


def test_a_checkpoint_is_corrected_without_forgetting_what_the_person_left_to_it(tmp_path, scripted, fits):
    from tests.policies.training.small import small

    begin = train(small("bc", dataset=scripted), tmp_path / "begin")
    fits.clear()
    asked = to_correct(init=str(begin))
    with pytest.raises(KeyboardInterrupt):
        train(asked, tmp_path / "out", meet=met((0, "record"), TAKEN, (7, "interrupt")))
    with pytest.raises(TrainingError, match=r"nothing was kept in 12 steps: .* --resume and more --steps"):
        resume(tmp_path / "out", meet=met())
    script = ((0, "record"), (30, "take_both"), (2, "hand_back"), (3, "success"))
    resume(tmp_path / "out", steps=13, meet=met(*script))
    assert [len(each) for each in fits] == [5 + 3 + 4]  # not the 25 steps before the takeover


def test_an_interruption_of_corrections_loses_nothing_that_was_kept(tmp_path, scripted, fits):
    script = ((0, "record"), TAKEN, (1, "success"), (0, "record"), TAKEN, (0, "interrupt"))
    with pytest.raises(KeyboardInterrupt):
        train(to_correct(dataset=scripted, changes={"corrected": 2}), tmp_path / "out", meet=met(*script))
    (tmp_path / "out" / "episodes" / "killed-at-once").mkdir()
    resume(tmp_path / "out", meet=met((0, "record"), TAKEN, (2, "success"), (0, "record"), TAKEN, (2, "success")))
    # 4 + 2 and 4 + 1 steps before the interruption are no less than the 11 that were asked for.
    assert [len(each) for each in fits] == [50, 52]


def test_a_device_that_is_absent_is_named_before_a_folder_is_made(tmp_path, scripted):
    pytest.importorskip("stable_baselines3")
    asked = to_correct(dataset=scripted)
    object.__setattr__(asked, "operator", "spacemouse:path=/dev/no-such-mouse")
    with pytest.raises(DeviceAbsentError, match="/dev/no-such-mouse"):
        train(asked, tmp_path / "out")
    assert not (tmp_path / "out").exists()
