"""ACT: complete trainings that take seconds."""

from __future__ import annotations

import json
import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pytest

pytest.importorskip("stable_baselines3")

from dual_ur10 import policies
from dual_ur10.errors import CheckpointError, SettingsError, TrainingError, UnknownNameError
from dual_ur10.policies.chunks.executor import ChunkExecutor
from dual_ur10.policies.learned import checkpoint
from dual_ur10.policies.learned.act_network import ActNetwork, ActShape
from dual_ur10.policies.learned.act_torch import ActImageNetwork
from dual_ur10.policies.learned.resnet import RESNET18
from dual_ur10.policies.learned.signature import view_of
from dual_ur10.policies.training import act, state
from dual_ur10.policies.training.act import ActImitator
from dual_ur10.policies.training.act_fit import ActFit, Chunks
from dual_ur10.policies.training.folder import TrainingFolder, read_backbone
from dual_ur10.policies.training.gather import Samples
from dual_ur10.policies.training.settings import ActSettings, defaults, first_seed_of
from dual_ur10.policies.training.train import resume, train
from tests.policies.training.small import small
from ur_core.kinematics.forward import flange_pose

SINE = "DualUR10/SineTracking-v0"


def sha_of(path: Path) -> str:
    return checkpoint.read_manifest(path).weights_sha256


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return train(small("act", rounds=1), tmp_path_factory.mktemp("whole") / "out", threads=2)


def test_the_result_is_a_policy_of_chunks_that_states_its_origin(whole: Path) -> None:
    manifest = checkpoint.read_manifest(whole)
    assert manifest.training["algorithm"] == "act"
    assert manifest.training["settings"]["chunk_size"] == 4
    assert manifest.training["samples"] == 100
    assert manifest.training["fitted"] in (8, 16, 20)
    assert manifest.evaluation is not None
    assert manifest.evaluation["episodes"] == 2
    assert isinstance(policies.load(whole), ChunkExecutor)
    checks = state.load(whole.parent / "state")[1]["checks"]
    assert len(checks) == 3  # after 8, 16 and 20 gradient steps


def test_a_network_does_not_see_the_unseen_fields(whole: Path) -> None:
    manifest = checkpoint.read_manifest(whole)
    view = view_of(SINE, manifest.signature.kwargs)
    unseen = view.indices(manifest.training["settings"]["unseen"], joint=True)
    assert np.flatnonzero(np.array(manifest.normalisers[1].var) > 1e12).tolist() == sorted(unseen)
    assert max(manifest.normalisers[0].var) < 1e3  # commanded joints are seen


def test_an_interrupted_training_gives_the_same_result(
    whole: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    real, calls = ActFit.__call__, []

    def interrupted(self: ActFit, *arguments: Any) -> float:
        calls.append(self.done)
        if len(calls) > 2:
            raise KeyboardInterrupt
        return real(self, *arguments)

    monkeypatch.setattr(ActFit, "__call__", interrupted)
    with pytest.raises(KeyboardInterrupt):
        train(small("act", rounds=1), tmp_path / "out")
    monkeypatch.setattr(ActFit, "__call__", lambda self, *given: calls.append(-self.done) or real(self, *given))
    assert sha_of(resume(tmp_path / "out")) == sha_of(whole)
    assert calls == [0, 8, 16, -16]
    assert resume(tmp_path / "out").name == "policy-2"  # nothing is left to do


def test_a_longer_training_fits_to_all_samples_anew(whole: Path, tmp_path: Path) -> None:
    folder = shutil.copytree(whole.parent, tmp_path / "out")
    resume(folder, steps=200)
    values = state.load(folder / "state")[1]
    assert [each["steps"] for each in values["checks"]] == [100] * 3 + [200] * 3
    assert values["fitted"] == 20


def test_a_state_of_another_network_is_refused(whole: Path, tmp_path: Path) -> None:
    folder = shutil.copytree(whole.parent, tmp_path / "out")
    tensors, values = state.load(folder / "state")
    tensors["weight.action_head.bias"] = np.zeros(3, dtype=np.float32)
    state.save(folder / "state", tensors, {**values, "fitted": 16})
    with pytest.raises(TrainingError, match="the state is not of this training"):
        resume(folder)


@pytest.mark.parametrize("chunk_mode", ["joint_delta", "joint_position"])
def test_chunks_are_of_one_episode_and_what_is_commanded(tmp_path: Path, chunk_mode: str) -> None:
    folder = TrainingFolder.create(tmp_path / "out", small("act", changes={"chunk_mode": chunk_mode}))
    learner = ActImitator(None, folder)
    folder.close()
    shape, rng = learner._shape, np.random.default_rng(0)
    episode = np.array([2, 0, 2, 0, 2])  # as a batch of cells gives them
    observation = rng.normal(size=(5, shape.environment_state)).astype(np.float32)
    action = rng.uniform(-1, 1, (5, shape.action)).astype(np.float32)
    learner._samples = [Samples(observation, action, episode)] * 2
    chunks = learner._chunks()
    order = [1, 3, 0, 2, 4]
    assert chunks.left.tolist() == [2, 1, 3, 2, 1] * 2
    assert chunks.observation.tobytes() == observation[order * 2].tobytes()
    step = np.tile(learner._view.signature.actions.joint_step_rad, 2)
    expected = action if chunk_mode == "joint_delta" else observation[:, list(shape.state)] + step * action
    np.testing.assert_allclose(chunks.action, expected[order * 2], atol=1e-5)


def test_steps_of_tools_are_learned_as_those_of_joints(tmp_path: Path) -> None:
    asked = defaults("Handover", "act", envs=2)
    assert (asked.demonstrated["action_mode"], "action_mode" in asked.keywords) == ("tcp_delta", False)
    folder = TrainingFolder.create(tmp_path / "out", asked)
    learner = ActImitator(None, folder)
    folder.close()
    env = policies.make("zero", "Handover", action_mode="tcp_delta")[0]
    observation = env.reset(seed=0)[0][None].astype(np.float32)
    env.close()
    action = np.array([[0.5, 0.0, 0.0, 0.0, 0.0, 0.0, -1.0, 0.0, 0.0, -0.4, 0.0, 0.0, 0.0, 0.5]], dtype=np.float32)
    labels = learner._labels(Samples(observation, action, np.zeros(1, dtype=np.int64))).reshape(2, 7)
    assert labels[:, 6].tolist() == [0.0, 0.75]
    before = observation[0, list(learner._shape.state)].reshape(2, 7)[:, :6].astype(float)
    after = before + learner._view.setup.make_adapter().joint_step_rad.reshape(2, 6) * labels[:, :6]
    for arm, length_m in enumerate((0.5 * 0.25 * 0.04, 0.4 * 0.25 * 0.04)):
        dh = learner._view.setup.config.left.dh
        moved = flange_pose(after[arm], dh)[0] - flange_pose(before[arm], dh)[0]
        assert np.linalg.norm(moved) == pytest.approx(length_m, rel=1e-3)


def test_a_transformer_learns_chunks_and_ignores_what_is_behind_an_end() -> None:
    """Positions follow a line whose slope is observed; beyond an episode's end they are of no use."""
    rng, size = np.random.default_rng(0), 4
    slope = np.repeat(rng.uniform(-1, 1, 100), 10).astype(np.float32)
    time = np.tile(np.arange(10, dtype=np.float32), 100)
    observation = np.stack([slope, time, rng.normal(size=1000)], axis=1).astype(np.float32)
    action = (slope * (time + 1))[:, None]
    left = (10 - time).astype(np.int64)
    shape = ActShape((0,), 3, size, 16, 2, 32, 1, "joint_delta")
    settings = ActSettings(learning_rate=1e-2, batch_size=64, fit_steps=800, averaging=0.9)
    fit = ActFit(settings, shape, Chunks(observation, action, left), [2], seed=0)
    fit(settings.fit_steps)
    network, (state_norm, seen_norm, action_norm) = ActNetwork(shape, fit.tensors()), fit.normalisers
    for given, at in ((0.5, 3.0), (-0.8, 6.0)):
        seen = np.array([given, at, 50.0])
        scaled = [
            ((values - np.array(each.mean)) / np.sqrt(each.var)).astype(np.float32)
            for values, each in ((seen[:1], state_norm), (seen, seen_norm))
        ]
        found = network(*scaled)[:, 0] * np.sqrt(action_norm.var) + action_norm.mean
        np.testing.assert_allclose(found, given * (at + 1 + np.arange(size)), atol=0.25)


@pytest.mark.parametrize(
    ("given", "message"),
    [
        ({"agents": "shared"}, "agents is 'shared': act makes one network"),
        ({"init": "x"}, "act begins with no checkpoint"),
        ({"operator": "keyboard"}, "from which act learns"),
        ({"keywords": {"observation": "pixels"}}, "training needs observation='state' or 'goals' or 'both'"),
        ({"keywords": {"observation": "both"}, "dataset": "x"}, "a dataset has no images"),
        ({"changes": {"chunk_size": 0}}, "chunk_size"),
    ],
)
def test_impossible_settings_are_refused(given: dict[str, Any], message: str) -> None:
    with pytest.raises(SettingsError, match=message):
        defaults("SineTracking", "act", **given)


@pytest.mark.parametrize(
    ("keywords", "changes", "message"),
    [
        ({"action_mode": "tcp_delta"}, {}, "action_mode is 'tcp_delta': act learns joint positions"),
        ({"observation": "goals"}, {}, "act needs observations with commanded_q_rad"),
        ({}, {"n_heads": 3}, "n_heads is 3"),
        ({}, {"backbone": "x"}, "backbone is for images, and there are none"),
        ({"observation": "both", "cameras": "left/wrist"}, {}, "unknown camera 'left/wrist'"),
        ({"observation": "both"}, {"backbone": "none.safetensors"}, "none.safetensors cannot be read"),
    ],
)
def test_impossible_trainings_are_refused_before_they_begin(
    tmp_path: Path, keywords: dict[str, Any], changes: dict[str, Any], message: str
) -> None:
    asked = small("act", keywords=keywords, changes={**changes, "unseen": ()})
    with pytest.raises((SettingsError, TrainingError, UnknownNameError), match=message):
        train(asked, tmp_path / "out")
    assert not (tmp_path / "out").exists()


PICTURES: dict[str, Any] = {"observation": "both", "cameras": ("front",), "width": 40, "height": 32, "duration_s": 0.4}


@pytest.fixture(scope="module")
def pictured(tmp_path_factory: pytest.TempPathFactory) -> Path:
    asked = small("act", rounds=1, keywords=PICTURES, changes={"fit_steps": 2, "demonstrations": 2, "batch_size": 4})
    return train(asked, tmp_path_factory.mktemp("pictured") / "out", threads=1)


def test_a_policy_of_images_is_trained_and_acts(pictured: Path) -> None:
    manifest = checkpoint.read_manifest(pictured)
    shape: Any = manifest.network
    assert (shape.cameras, shape.height, shape.width, shape.environment_state) == (("front",), 32, 40, 0)
    assert [len(each.mean) for each in manifest.normalisers] == [12, 12]
    assert (manifest.evaluation or {})["episodes"] == 2
    env, policy = policies.make(str(pictured), SINE, duration_s=0.4)
    policies.rollout(env, policy, seed=0)
    env.close()
    assert policy.splices > 1
    with pytest.raises(CheckpointError, match=r"made for kwargs\.cameras"):
        policies.load(pictured, SINE, **{**PICTURES, "cameras": ("side",)})


def test_samples_have_the_images_that_were_seen(pictured: Path) -> None:
    samples = state.load_tensors(pictured.parent / "samples-0000.safetensors")
    assert samples["images"].shape == (20, 1, 32, 40, 3)
    keywords = checkpoint.read_manifest(pictured).signature.kwargs
    env = policies.make("zero", SINE, **keywords)[0]
    for row in (0, 1):
        seen = env.reset(seed=first_seed_of(0) + row)[0]
        assert np.array_equal(samples["images"][row, 0], seen["pixels"]["front"])
        assert np.array_equal(samples["observation"][row], seen["state"].astype(np.float32))
    env.close()
    assert not np.array_equal(samples["images"][0], samples["images"][1])
    folder, kept = TrainingFolder.resume(pictured.parent)
    assert kept is not None
    chunks = ActImitator(None, folder, kept[1])._chunks()
    folder.close()
    order = np.argsort(samples["episode"], kind="stable")
    assert np.array_equal(chunks.images, samples["images"][order])


def _sides(rng: np.random.Generator) -> tuple[ActShape, Chunks]:
    """Return samples whose action says on which side of its image it is bright."""
    right = rng.integers(0, 2, 32)
    images = rng.integers(0, 60, (32, 1, 32, 32, 3)).astype(np.uint8)
    for image, side in zip(images, right.tolist(), strict=True):
        image[0, 8:24, 16 * side : 16 * side + 16] += 150
    numbers, action = rng.normal(size=(32, 2)).astype(np.float32), (2.0 * right - 1.0)[:, None].astype(np.float32)
    shape = ActShape((0,), 0, 1, 16, 2, 16, 1, "joint_delta", ("front",), 32, 32)
    return shape, Chunks(numbers, action, np.ones(32, dtype=np.int64), images)


def test_a_fit_learns_from_images_and_goes_on_from_its_state() -> None:
    shape, chunks = _sides(np.random.default_rng(0))
    settings = ActSettings(batch_size=8, fit_steps=1000, averaging=0.0, learning_rate=0.02)
    fit, later = ActFit(settings, shape, chunks, [], 0), ActFit(settings, shape, chunks, [], 1)
    begun = fit.tensors()
    assert begun["backbone.layer4.1.bn2.running_var"].min() > 0.01  # of the images, not 1
    fit(10)
    later.restore(fit.state(), fit.done)
    later._seed = 0
    fit(1)
    later(1)
    found, expected = later.tensors(), fit.tensors()
    assert {name for name, each in found.items() if each.tobytes() != expected[name].tobytes()} == set()
    same = {name for name in RESNET18 if found[f"backbone.{name}"].tobytes() == begun[f"backbone.{name}"].tobytes()}
    assert same == {name for name, size in RESNET18.items() if len(size) == 1}  # normalisations are frozen
    network = ActImageNetwork(shape, found)
    assert chunks.images is not None
    for number in range(8):
        chunk = network(np.zeros(1, dtype=np.float32), chunks.images[number])
        assert np.sign(chunk[0, 0]) == chunks.action[number, 0]


def test_a_fit_begins_with_the_backbone_of_a_file(tmp_path: Path) -> None:
    rng, path = np.random.default_rng(0), tmp_path / "resnet.safetensors"
    given = {name: rng.uniform(0.1, 1.0, size).astype(np.float32) for name, size in RESNET18.items()}
    state.save_tensors(path, {**given, "fc.bias": np.zeros(1000, dtype=np.float32)})
    shape, chunks = _sides(rng)
    begun = ActFit(ActSettings(), shape, chunks, [], 0, read_backbone(str(path))).tensors()
    assert {name for name, each in given.items() if begun[f"backbone.{name}"].tobytes() != each.tobytes()} == set()


def test_a_longer_training_begins_with_the_backbone_again(
    pictured: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    folder, path = shutil.copytree(pictured.parent, tmp_path / "out"), tmp_path / "resnet.safetensors"
    state.save_tensors(path, {name: np.ones(size, dtype=np.float32) for name, size in RESNET18.items()})
    asked = json.loads((folder / "training.json").read_text())
    asked["settings"] |= {"backbone": str(path), "demonstrations": 0}
    (folder / "training.json").write_text(json.dumps(asked))
    given: list[Any] = []

    def begun(*arguments: Any) -> ActFit:
        given.append(arguments[-1])
        raise KeyboardInterrupt

    monkeypatch.setattr(act, "ActFit", begun)
    with pytest.raises(KeyboardInterrupt):
        resume(folder, steps=40)
    assert [{*each} for each in given] == [{*RESNET18}]


def test_a_file_of_another_backbone_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "resnet.safetensors"
    state.save_tensors(path, {"conv1.weight": np.zeros((64, 3, 7, 7), dtype=np.float32)})
    asked = small("act", keywords=PICTURES, changes={"backbone": str(path)})
    with pytest.raises(TrainingError, match=r"is no ResNet18: bn1.weight is missing, expected \(64,\)"):
        train(asked, tmp_path / "out")


def test_defaults_for_images_are_those_of_a_gpu() -> None:
    asked = defaults("Handover", "act", keywords={"observation": "both", "width": 96}, changes={"fit_steps": 7})
    settings: Any = asked.settings
    assert (settings.dim_model, settings.fit_steps, settings.demonstrated) == (512, 7, "tcp_delta")
    assert (asked.keywords["width"], asked.keywords["height"]) == (96, 224)
