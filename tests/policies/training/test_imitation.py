"""Behaviour cloning and DAgger: complete trainings that take seconds."""

from __future__ import annotations

import csv
import dataclasses
import errno
import json
import os
import shutil
from contextlib import closing

import gymnasium as gym
import numpy as np
import pytest

pytest.importorskip("stable_baselines3")

from dual_ur10 import ArmMount, CellConfig, Perturbation, policies
from dual_ur10.errors import CheckpointError, SettingsError, TrainingError, UnknownNameError
from dual_ur10.policies.learned import checkpoint
from dual_ur10.policies.training import folder as folders
from dual_ur10.policies.training import imitation as imitate
from dual_ur10.policies.training import state
from dual_ur10.policies.training.train import resume, train
from tests.policies.training.small import STEPS, small

SINE = "DualUR10/SineTracking-v0"


def sha_of(path):
    return checkpoint.read_manifest(path).weights_sha256


@pytest.fixture(scope="module")
def whole(tmp_path_factory):
    """A DAgger training of three rounds."""
    out = tmp_path_factory.mktemp("whole") / "out"
    return train(small(rounds=3), out, threads=2)


@pytest.fixture(scope="module")
def short(tmp_path_factory):
    """Folder of a DAgger training of one round."""
    return train(small(rounds=1), tmp_path_factory.mktemp("short") / "out").parent


def test_the_folder_holds_every_documented_file(whole):
    folder = whole.parent
    names = {each.name.split(".out")[0] for each in folder.iterdir()}
    samples = {f"samples-000{k}.safetensors" for k in range(3)}
    kept = {name for name in names if name.startswith("steps-")}
    assert kept
    assert names == {"training.json", "lock", "state", "policy", "curve.png", "progress.csv", "events", *samples, *kept}
    assert (folder / "curve.png").read_bytes()[:8] == b"\x89PNG\r\n\x1a\n"
    table = list(csv.DictReader((folder / "progress.csv").read_text().splitlines()))
    assert [int(each["time/steps"]) for each in table] == [100, 100, 200, 200, 300, 300]  # a fit and a look each
    assert table[1]["check/success_rate"]
    assert json.loads((folder / "training.json").read_text())["algorithm"] == "dagger"


@pytest.mark.parametrize(("steps", "episodes"), [(20, 1), (3 * STEPS, 3), (3 * STEPS + 1, 4)])
def test_a_last_round_has_only_the_episodes_that_the_steps_allow(tmp_path, steps, episodes):
    asked = small("bc", envs=2, steps=steps)
    policy = train(asked, tmp_path / "out", threads=2)
    training = checkpoint.read_manifest(policy).training
    assert training["steps"] == training["samples"] == episodes * STEPS


@pytest.mark.parametrize(("left", "further"), [(1, 0), (2, 2)])
def test_a_rest_of_few_episodes_is_no_round_of_dagger(tmp_path, left, further):
    """A round of less than a quarter of the cells is not worth a fit."""
    policy = train(small("dagger", envs=8, steps=(8 + left) * STEPS), tmp_path / "out", threads=2)
    assert state.load(policy.parent / "state")[1]["steps"] == (8 + further) * STEPS


def test_the_result_states_its_origin(whole):
    manifest = checkpoint.read_manifest(whole)
    assert manifest.signature.env_id == SINE
    assert manifest.signature.rate.latency_ticks == 5
    assert manifest.training["algorithm"] == "dagger"
    assert manifest.training["steps"] in (2 * STEPS, 2 * 2 * STEPS, 3 * 2 * STEPS)
    assert manifest.training["settings"]["hidden"] == [16]
    assert manifest.evaluation["episodes"] == 2
    assert manifest.evaluation["seed"] == 10_000_000
    text = (whole / "manifest.json").read_text()
    assert str(whole.parent.parent) not in text  # paths are private


def test_the_best_check_is_the_result(tmp_path, monkeypatch):
    """Among four fits, the third equals the second, and the fourth is worse."""
    rates, seen = [0.0, 1.0, 1.0, 0.5], []
    real = folders.check_of

    def check_of(*arguments):
        seen.append(dataclasses.replace(real(*arguments), success_rate=rates[len(seen)], mean_return=float(len(seen))))
        return seen[-1]

    monkeypatch.setattr(folders, "check_of", check_of)
    policy = train(small(rounds=4), tmp_path / "out")
    assert [each.steps for each in seen] == [100, 200, 300, 400]
    kept = sorted(each.name for each in policy.parent.glob("steps-*"))
    assert kept == ["steps-000000100", "steps-000000200", "steps-000000300"]  # each the best so far
    assert sha_of(policy) == sha_of(policy.parent / kept[-1])
    assert checkpoint.read_manifest(policy).training["steps"] == 300


def test_the_same_seed_gives_the_same_bits_on_any_number_of_threads(whole, tmp_path):
    assert sha_of(train(small(rounds=3), tmp_path / "again", threads=1)) == sha_of(whole)
    assert sha_of(train(small(rounds=3, seed=1), tmp_path / "other")) != sha_of(whole)


@pytest.mark.parametrize("at", [0, 2])
def test_an_interrupted_training_gives_the_same_result(whole, tmp_path, monkeypatch, at):
    real, calls = imitate.gather, []

    def interrupted(*arguments, **keywords):
        calls.append(1)
        if len(calls) > at:
            raise KeyboardInterrupt
        return real(*arguments, **keywords)

    monkeypatch.setattr(imitate, "gather", interrupted)
    with pytest.raises(KeyboardInterrupt):
        train(small(rounds=3), tmp_path / "out")
    monkeypatch.undo()
    assert not (tmp_path / "out" / "policy").exists()
    assert sha_of(resume(tmp_path / "out")) == sha_of(whole)


@pytest.mark.parametrize("name", ["rounds", "longest", "steps"])
@pytest.mark.parametrize("value", ["x", None, []])
def test_an_impossible_state_is_refused(whole, tmp_path, name, value):
    copied = shutil.copytree(whole.parent, tmp_path / "out")
    path = copied / "state" / "values.json"
    path.write_text(json.dumps({**json.loads(path.read_text()), name: value}))
    with pytest.raises(TrainingError, match=rf"the state in .*\.{name} is "):
        resume(copied)


def test_a_training_in_a_cell_of_ones_own_continues_there(tmp_path):
    cell = CellConfig(left=ArmMount((-0.75, 0.6, 0.0), yaw_rad=0.1), perturbation=Perturbation(mass_scale=1.05))
    asked = small(keywords={"cell": cell})
    folders.TrainingFolder.create(tmp_path / "out", asked).close()
    with closing(folders.TrainingFolder.resume(tmp_path / "out")[0]) as folder:
        assert folder.training.keywords == asked.keywords
    path = tmp_path / "out" / "training.json"
    values = json.loads(path.read_text())
    values["keywords"]["cell"]["left"] = {"yaw_rad": 0.1}
    path.write_text(json.dumps(values))
    with pytest.raises(TrainingError, match="its cell is not legal"):
        resume(tmp_path / "out")


def test_a_training_can_be_extended(short, tmp_path):
    more = resume(shutil.copytree(short, tmp_path / "out"), steps=2 * 2 * STEPS)
    assert more.name == "policy-2"
    assert (tmp_path / "out" / "policy").is_dir()
    assert len(list((tmp_path / "out").glob("samples-*"))) == 2
    assert sha_of(more) == sha_of(train(small(rounds=2), tmp_path / "at_once"))


@pytest.mark.parametrize("agents", ["joint", "shared", "independent"])
def test_every_kind_of_agents_trains(tmp_path, agents):
    asked = small("bc", agents, rounds=1)
    path = train(asked, tmp_path / "out")
    policy = policies.load(path, SINE, **asked.keywords)
    assert policy.manifest.agents == agents
    assert policy.manifest.network.layers[0] == (94 if agents == "joint" else 47)
    env = gym.make(SINE, **asked.keywords)
    observation, _ = env.reset(seed=0)
    action = policy(observation)
    assert action.shape == (12,)
    assert np.abs(action).max() > 0.0
    env.step(action)
    env.close()
    if agents == "independent":
        left, right = policy.layers
        assert left[0][0].tobytes() != right[0][0].tobytes()


@pytest.mark.parametrize(
    ("agents", "fields", "blind"),
    [
        ("joint", ("flange_base_m", "rotation"), [18, 19, 20, 31, 32, 33, 65, 66, 67, 78, 79, 80]),
        ("shared", ("other_flange_base_quat", "rotation"), [31, 32, 33, 43, 44, 45, 46]),
    ],
)
def test_a_network_does_not_see_the_unseen_fields(tmp_path, agents, fields, blind):
    asked = small("bc", agents, rounds=1, changes={"unseen": fields})
    (normaliser,) = checkpoint.read_manifest(train(asked, tmp_path / "out")).normalisers
    assert np.flatnonzero(np.array(normaliser.var) > 1e12).tolist() == blind


def test_unknown_unseen_fields_are_refused_before_training(tmp_path):
    with pytest.raises(UnknownNameError, match="unknown observation field 'gripper_m'"):
        train(small("bc", rounds=1, changes={"unseen": ("gripper_m",)}), tmp_path / "out")
    assert not list((tmp_path / "out").glob("samples*"))


@pytest.mark.parametrize(
    ("agents", "observed", "actions"),
    [("joint", [*range(12, 18), *range(59, 65)], list(range(12))), ("shared", list(range(12, 18)), list(range(6)))],
)
def test_the_commanded_joints_are_scattered(tmp_path, monkeypatch, agents, observed, actions):
    seen = []
    real = imitate.Scatter.__call__

    def watched(self, action, rng):
        seen.append((list(self.observed), list(self.actions), tuple(self.step_rad)))
        return real(self, action, rng)

    monkeypatch.setattr(imitate.Scatter, "__call__", watched)
    asked = small("bc", agents, rounds=1, changes={"scatter_rad": 0.02})
    policy = train(asked, tmp_path / "out")
    step_rad = checkpoint.read_manifest(policy).signature.actions.joint_step_rad
    assert seen[0] == (observed, actions, step_rad * (len(actions) // 6))
    assert len(seen) == 31  # the whitening, then 30 gradient steps


def test_samples_of_another_kind_of_action_are_not_scattered(tmp_path):
    asked = small("bc", keywords={"action_mode": "joint_position"}, rounds=1, changes={"scatter_rad": 0.02})
    with pytest.raises(SettingsError, match=r"action_mode 'joint_position': only .* use action_mode='joint_delta'"):
        train(asked, tmp_path / "out")
    assert not list((tmp_path / "out").glob("samples*"))


def test_imitation_learns(tmp_path):
    changes = {"hidden": (64, 64), "fit_steps": 200, "batch_size": 256}
    keywords = {"randomize": False, "randomization": "none"}
    asked = small(envs=8, rounds=1, steps=3 * 8 * STEPS, changes=changes, keywords=keywords)
    learned = checkpoint.read_manifest(train(asked, tmp_path / "out")).evaluation["mean_return"]
    raw = checkpoint.read_manifest(train(small(rounds=1, keywords=keywords), tmp_path / "raw")).evaluation[
        "mean_return"
    ]
    assert learned > 0.95 * STEPS > 2 * raw  # of at most one per step


def test_imitation_can_begin_with_a_checkpoint(whole, tmp_path):
    asked = small("bc", rounds=1, init=str(whole), changes={"fit_steps": 1, "learning_rate": 1e-9})
    after, before = checkpoint.load(train(asked, tmp_path / "out")), checkpoint.load(whole)
    for (a, b), (c, d) in zip(before.layers[0], after.layers[0], strict=True):
        np.testing.assert_allclose(a, c, rtol=1e-4, atol=1e-5)
        np.testing.assert_allclose(b, d, rtol=1e-4, atol=1e-5)
    assert checkpoint.read_manifest(tmp_path / "out" / "policy").training["from_checkpoint"] is True
    with pytest.raises(TrainingError, match="both must be the same"):
        train(small("bc", rounds=1, init=str(whole), changes={"hidden": (8,)}), tmp_path / "wrong")


@pytest.mark.parametrize("nth", [0, 3])
def test_a_full_disk_loses_no_saved_state(whole, tmp_path, monkeypatch, nth):
    real, count = os.fsync, []

    def full(descriptor):
        if (tmp_path / "out" / "training.json").exists():
            count.append(1)
        if len(count) > nth:
            raise OSError(errno.ENOSPC, "No space left on device")
        return real(descriptor)

    monkeypatch.setattr(os, "fsync", full)
    with pytest.raises((TrainingError, CheckpointError), match="No space left"):
        train(small(rounds=3), tmp_path / "out")
    monkeypatch.undo()
    if (tmp_path / "out" / "state").exists():
        assert sha_of(resume(tmp_path / "out")) == sha_of(whole)
    else:
        assert nth < 3


def test_a_full_disk_for_the_logs_is_a_training_error(tmp_path, monkeypatch):
    from stable_baselines3.common.logger import CSVOutputFormat

    def full(*_, **__):
        raise OSError(errno.ENOSPC, "No space left on device")

    with monkeypatch.context() as patch:
        patch.setattr(CSVOutputFormat, "write", full)
        with pytest.raises(TrainingError, match=r"No space left.*--resume"):
            train(small(rounds=1), tmp_path / "out")
    assert resume(tmp_path / "out").name == "policy"


def test_a_folder_that_is_not_empty_is_left_alone(whole, tmp_path):
    before = sorted(each.name for each in whole.parent.iterdir())
    with pytest.raises(TrainingError, match="not empty"):
        train(small(), whole.parent)
    assert sorted(each.name for each in whole.parent.iterdir()) == before
    (tmp_path / "file").write_text("x")
    with pytest.raises(TrainingError, match="cannot make"):
        train(small(), tmp_path / "file")


@pytest.mark.parametrize(
    ("name", "content", "match"),
    [
        ("training.json", None, "is no folder of a training"),
        ("training.json", b"[]", "it must be an object"),
        ("training.json", b"{" * 100_000, "cannot be read"),
        ("samples-0000.safetensors", b"no", "cannot be read"),
        ("samples-0000.safetensors", None, "cannot be read"),
        (
            "state/values.json",
            b'{"rounds": 1, "steps": 100}',
            r"the state in .*seconds is missing: write it down; .*checks is missing",
        ),
    ],
)
def test_a_damaged_training_is_refused(short, tmp_path, name, content, match):
    path = shutil.copytree(short, tmp_path / "out") / name
    path.unlink() if content is None else path.write_bytes(content)
    with pytest.raises(TrainingError, match=match):
        resume(tmp_path / "out", steps=1000)


def test_one_process_at_a_time_trains_in_a_folder(tmp_path):
    out = tmp_path / "out"
    for begin in (lambda: folders.TrainingFolder.create(out, small()), lambda: folders.TrainingFolder.resume(out)[0]):
        with closing(begin()), pytest.raises(TrainingError, match=r"another process trains in .*out: wait"):
            resume(out)


def test_a_file_system_without_locks_warns_and_goes_on(tmp_path, monkeypatch, caplog):
    def no_locks(*_):
        raise OSError(errno.ENOLCK, "No locks available")

    monkeypatch.setattr("fcntl.flock", no_locks)
    folders.TrainingFolder.create(tmp_path / "out", small()).close()
    assert "cannot be locked: No locks available" in caplog.text


def test_wrong_settings_are_reported_with_their_paths(whole, tmp_path):
    path = shutil.copytree(whole.parent, tmp_path / "out") / "training.json"
    asked = json.loads(path.read_text())
    path.write_text(json.dumps({**asked, "envs": "2", "settings": {**asked["settings"], "hidden": [16, "a"]}}))
    with pytest.raises(TrainingError, match=r"json\.envs is '2'.*; .*json\.settings\.hidden\[1\] is 'a': it must be"):
        resume(path.parent)


def test_samples_of_another_environment_are_refused(whole, tmp_path):
    train(small(rounds=1, changes={"unseen": ()}), tmp_path / "out")
    asked = tmp_path / "out" / "training.json"
    text = asked.read_text().replace("SineTracking", "Handover").replace('"duration_s": 2.0,', "")
    asked.write_text(text.replace('"random_path": true,', ""))
    with pytest.raises(TrainingError, match="another environment"):
        resume(tmp_path / "out", steps=1000)


def test_time_left_counts_gathering_and_every_coming_fit():
    now = [0.0]
    left = imitate.TimeLeft(lambda: now[0])
    left.gathered(100, 10.0)
    assert left(300, 100.0, refits=True) is None
    left.fit_begins()
    now[0] = 30.0
    left.fit_ends()
    # Three rounds of 10 s, with two fits between them and one after the last.
    assert left(300, 100.0, refits=True) == pytest.approx(3 * 10.0 + 3 * 30.0)
    left.gathered(200, 30.0)  # slower
    assert left(50, 100.0, refits=True) == pytest.approx(50 * 0.15 + 30.0)
    assert left(0, 100.0, refits=True) == pytest.approx(30.0)  # the last fit
    assert left(300, 100.0, refits=False) == pytest.approx(300 * 0.15 + 30.0)


def test_time_left_falls_during_a_fit():
    now = [0.0]
    left = imitate.TimeLeft(lambda: now[0])
    left.gathered(100, 10.0)
    left.fit_begins()
    now[0] = 30.0
    left.fit_ends()
    left.fit_begins()
    now[0] = 42.0
    assert left(200, 100.0, refits=True) == pytest.approx(20.0 + 2 * 30.0 + 18.0)
    assert left(0, 100.0, refits=True) == pytest.approx(18.0)
    now[0] = 100.0
    assert left(0, 100.0, refits=True) == 0.0
