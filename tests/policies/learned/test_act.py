"""Chunk policies of a transformer: their network, checkpoints and execution."""

from __future__ import annotations

import dataclasses
import json
import os
import pickle
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from safetensors.numpy import load_file

from dual_ur10 import policies
from dual_ur10.errors import ActionError, CheckpointError, MissingExtraError
from dual_ur10.policies.chunks.chunk_policy import ChunkPolicy
from dual_ur10.policies.chunks.executor import ChunkExecutor
from dual_ur10.policies.learned import checkpoint
from dual_ur10.policies.learned.act_network import ActNetwork, ActShape
from dual_ur10.policies.learned.act_policy import ActPolicy
from tests.policies.learned.acts import act_parts
from tests.policies.learned.checkpoints import HANDOVER, SINE, edit

LEROBOT_FILES = {
    "config.json",
    "policy_preprocessor.json",
    "policy_postprocessor.json",
    "policy_preprocessor_step_3_normalizer_processor.safetensors",
    "policy_postprocessor_step_0_unnormalizer_processor.safetensors",
}


@pytest.fixture
def saved(tmp_path: Path) -> Path:
    checkpoint.save(tmp_path / "act", *act_parts(HANDOVER, action_latency_ticks=5))
    return tmp_path / "act"


def test_outputs_equal_those_of_torch() -> None:
    torch = pytest.importorskip("torch")
    from dual_ur10.policies.learned.act_torch import chunks_of

    (tensors,), manifest = act_parts(HANDOVER)
    shape: Any = manifest.network
    rng = np.random.default_rng(1)
    state, seen = (rng.normal(size=(5, size)).astype(np.float32) for size in (shape.action, shape.environment_state))
    weights = {name: torch.from_numpy(each) for name, each in tensors.items()}
    expected = chunks_of(shape, weights, torch.from_numpy(state), torch.from_numpy(seen)).numpy()
    network = ActNetwork(shape, tensors)
    found = np.stack([network(*each) for each in zip(state, seen, strict=True)])
    assert found.dtype == np.float32
    assert found.shape == (5, 6, 14)
    np.testing.assert_allclose(found, expected, atol=2e-5)
    assert not np.allclose(found[0], found[1])
    assert not np.allclose(found[0, 0], found[0, 1])


@pytest.mark.parametrize("env_id", [SINE, HANDOVER])
def test_a_saved_act_loads_bit_for_bit(tmp_path: Path, env_id: str) -> None:
    (tensors,), made = act_parts(env_id)
    written = checkpoint.save(tmp_path / "act", [tensors], made)
    assert {*os.listdir(tmp_path / "act")} == {"manifest.json", "model.safetensors", *LEROBOT_FILES}
    manifest, (found,) = checkpoint.read(tmp_path / "act")
    assert manifest == written
    assert isinstance(found, dict)
    assert {name: each.tobytes() for name, each in found.items()} == {k: v.tobytes() for k, v in tensors.items()}
    policy = checkpoint.load(tmp_path / "act")
    assert isinstance(policy, ActPolicy)
    assert isinstance(policy, ChunkPolicy)
    seen = np.random.default_rng(0).normal(size=made.signature.observation.shape)
    chunk = policy.chunk(seen, 0.0)
    assert chunk.shape == (6, made.signature.action.shape[0])
    # A child process is given a copy.
    assert pickle.loads(pickle.dumps(policy)).chunk(seen, 1.0).tobytes() == chunk.tobytes()


def test_grippers_are_fractions_for_lerobot_and_openings_here(saved: Path) -> None:
    policy: Any = checkpoint.load(saved)
    seen = np.random.default_rng(0).normal(size=policy.manifest.signature.observation.shape)
    before = load_file(saved / "policy_preprocessor_step_3_normalizer_processor.safetensors")
    config = json.loads((saved / "config.json").read_text())
    assert config["output_features"] == {"action": {"type": "ACTION", "shape": [14]}}
    state = seen[list(policy.manifest.network.state)]
    state[6::7] /= 0.085  # stroke of the gripper
    name = "observation.environment_state"
    scaled = [
        ((state - before["observation.state.mean"]) / before["observation.state.std"]).astype(np.float32),
        ((seen - before[f"{name}.mean"]) / before[f"{name}.std"]).astype(np.float32),
    ]
    found = policy._network(*scaled) * before["action.std"] + before["action.mean"]
    found[:, 6::7] = 2 * found[:, 6::7] - 1
    np.testing.assert_allclose(policy.chunk(seen, 0.0), found, atol=1e-4)


def test_it_is_loaded_with_its_executor_and_moves_both_arms(tmp_path: Path) -> None:
    path = tmp_path / "sine"
    checkpoint.save(path, *act_parts(SINE, duration_s=0.6, action_latency_ticks=5))
    env, policy = policies.make(str(path), SINE, duration_s=0.6)
    assert isinstance(policy, ChunkExecutor)
    assert policy.latency_s == pytest.approx(0.04)
    policies.rollout(env, policy, seed=0)
    env.close()
    assert policy.splices > 1
    given = policies.load(path)
    assert isinstance(given, ChunkExecutor)
    kinds = (str(path), given, given.source)
    found = [policies.evaluate(SINE, each, episodes=2, env_kwargs={"duration_s": 0.6}).mean_return for each in kinds]
    assert found[0] == found[1] == found[2] != 0.0


def test_a_wrong_observation_is_refused(saved: Path) -> None:
    policy: Any = checkpoint.load(saved)
    size = policy.manifest.signature.observation.shape[0]
    for wrong in (np.zeros(3), np.zeros((2, size)), np.zeros(size, dtype=complex)):
        with pytest.raises(ActionError, match=r"observation"):
            policy.chunk(wrong, 0.0)


def test_another_environment_is_refused(saved: Path) -> None:
    with pytest.raises(CheckpointError, match="latency_ticks 5, the environment has 0"):
        policies.load(saved, HANDOVER, action_latency_ticks=0)
    with pytest.raises(CheckpointError, match="is of DualUR10/Handover-v0"):
        policies.load(saved, SINE)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"n_heads": 5}, "n_heads is 5: it must divide dim_model"),
        ({"chunk_size": 0}, "chunk_size is 0"),
        ({"chunk_size": 10**6}, "chunk_size is 1000000"),
        ({"dim_model": 4095, "dim_feedforward": 4096}, "allowed are 4000000"),
        ({"n_encoder_layers": 10**9}, "n_encoder_layers is 1000000000"),
        ({"state": [10**6] * 14}, "state is"),
        ({"state": [0] * 13}, "the network is of observations and actions of"),
        ({"environment_state": 4000}, "the network is of observations and actions of"),
        ({"dim_model": "12"}, "dim_model is '12'"),
        ({"more": 1}, "more is unknown"),
        ({"action_mode": "tcp_delta"}, "action_mode is .tcp_delta"),
        ({"n_encoder_layers": 1}, "holds .* expected are"),
        ({"dim_feedforward": 21}, "expected is F32 of"),
    ],
)
def test_an_impossible_shape_is_refused(saved: Path, change: dict[str, Any], message: str) -> None:
    edit(saved, lambda value: value["network"].update(change))
    with pytest.raises(CheckpointError, match=message):
        checkpoint.load(saved)


def test_a_manifest_that_is_of_no_act_is_refused() -> None:
    _, made = act_parts(HANDOVER)
    with pytest.raises(CheckpointError, match="agents is 'shared': an ACT is one network"):
        dataclasses.replace(made, agents="shared")
    with pytest.raises(CheckpointError, match=r"the normalisers have .* means"):
        dataclasses.replace(made, normalisers=made.normalisers[:2])
    with pytest.raises(CheckpointError, match=r"actions\.mode is 'tcp_delta'"):
        act_parts(HANDOVER, action_mode="tcp_delta")


def test_changed_weights_are_refused(saved: Path) -> None:
    path = saved / "model.safetensors"
    content = bytearray(path.read_bytes())
    content[-1] ^= 1
    path.write_bytes(content)
    with pytest.raises(CheckpointError, match="is not the file that was saved"):
        checkpoint.load(saved)


def test_shapes_of_this_size_fit() -> None:
    """LeRobot's smallest useful sizes are far below the bound."""
    assert ActShape(tuple(range(14)), 130, 25, 128, 8, 512, 2, "joint_delta").parameters < 800_000


PICTURES: dict[str, Any] = {"observation": "both", "cameras": ("front", "left/wrist"), "height": 48, "width": 72}


@pytest.fixture(scope="module")
def pictured(tmp_path_factory: pytest.TempPathFactory) -> Path:
    pytest.importorskip("torch")
    path = tmp_path_factory.mktemp("pictured") / "act"
    checkpoint.save(path, *act_parts(HANDOVER, **PICTURES))
    return path


def _observation(policy: ActPolicy) -> dict[str, Any]:
    """Return an observation whose images have a top and a bottom, a left and a right."""
    state = np.zeros(policy.manifest.signature.observation.shape)
    shape: Any = policy.manifest.network
    state[list(shape.state)] = np.linspace(-1.0, 1.0, 14)
    state[[shape.state[6], shape.state[13]]] *= 0.085  # LeRobot's are fractions of the stroke
    front, wrist = np.zeros((2, 48, 72, 3), dtype=np.uint8)
    front[:] = 5 * np.arange(48)[:, None, None]
    wrist[:, 36:, 0] = 200
    return {"state": state, "pixels": {"left/wrist": wrist, "front": front}}


def test_chunks_from_images_are_those_of_lerobot(pictured: Path) -> None:
    """The numbers are those of LeRobot 0.6.1, whose `ACTPolicy.from_pretrained` loaded this checkpoint, `strict`."""
    policy: Any = checkpoint.load(pictured)
    seen = _observation(policy)
    found = policy.chunk(seen, 0.0)
    found[:, 6::7] = (found[:, 6::7] + 1.0) / 2.0
    # fmt: off
    first = [0.193493, -0.878866, 2.292157, 2.923198, 0.305742, 0.684625, 0.181048,
             -0.7841, -0.38886, 1.955258, 1.116055, -3.213248, 0.017425, 1.712922]
    # fmt: on
    assert found.shape == (6, 14)
    np.testing.assert_allclose(found[0], first, atol=5e-6)
    for change in (np.flipud, np.fliplr, np.zeros_like):
        other = policy.chunk({**seen, "pixels": {name: change(each) for name, each in seen["pixels"].items()}}, 0.0)
        assert np.abs(other[0, :6] - found[0, :6]).max() > 5e-5
    assert pickle.loads(pickle.dumps(policy)).chunk(seen, 1.0).tobytes() == policy.chunk(seen, 0.0).tobytes()


def test_lerobot_is_told_of_the_images(pictured: Path) -> None:
    config = json.loads((pictured / "config.json").read_text())
    assert config["input_features"] == {
        "observation.state": {"type": "STATE", "shape": [14]},
        "observation.images.front": {"type": "VISUAL", "shape": [3, 48, 72]},
        "observation.images.left_wrist": {"type": "VISUAL", "shape": [3, 48, 72]},
    }
    before = load_file(pictured / "policy_preprocessor_step_3_normalizer_processor.safetensors")
    assert before["observation.images.left_wrist.std"].shape == (3, 1, 1)
    assert {name for name in load_file(pictured / "model.safetensors") if "layer4.1.bn2" in name} == {
        f"model.backbone.layer4.1.bn2.{each}" for each in ("weight", "bias", "running_mean", "running_var")
    }


@pytest.mark.parametrize(
    ("keywords", "message"),
    [
        ({"cameras": ("front", "right/wrist")}, "cameras .*'left/wrist'.*, the environment has .*'right/wrist'"),
        ({"cameras": ("left/wrist", "front")}, "made for kwargs.cameras"),
        ({"height": 64}, "made for kwargs.height 48, the environment has 64"),
        ({"pixels_rate_hz": 5.0}, "made for kwargs.pixels_rate_hz None, the environment has 5.0"),
        ({"observation": "state"}, "made for view 'both', the environment has 'state': .*observation='both'"),
    ],
)
def test_other_images_are_refused(pictured: Path, keywords: dict[str, Any], message: str) -> None:
    with pytest.raises(CheckpointError, match=message):
        checkpoint.load(pictured, HANDOVER, **{**PICTURES, **keywords})


def test_an_observation_without_its_images_is_refused(pictured: Path) -> None:
    policy: Any = checkpoint.load(pictured)
    seen = _observation(policy)
    for wrong in (seen["state"], {"state": seen["state"], "pixels": {"front": seen["pixels"]["front"]}}):
        with pytest.raises(ActionError, match="images of front, left/wrist: make the environment with"):
            policy.chunk(wrong, 0.0)
    small = {name: each[:40] for name, each in seen["pixels"].items()}
    with pytest.raises(ActionError, match=r"the image of front is uint8 of shape \(40, 72, 3\)"):
        policy.chunk({**seen, "pixels": small}, 0.0)


def test_an_environment_for_it_has_its_cameras(pictured: Path) -> None:
    env, policy = policies.make(str(pictured), HANDOVER)
    assert env.observation_space["pixels"]["left/wrist"].shape == (48, 72, 3)
    env.close()
    assert isinstance(policy, ChunkExecutor)


def test_images_alone_need_pytorch(pictured: Path, saved: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "torch", None)
    monkeypatch.delitem(sys.modules, "dual_ur10.policies.learned.act_torch")
    with pytest.raises(MissingExtraError, match=r"ACT on images.*\[train\]"):
        checkpoint.load(pictured)
    policy: Any = checkpoint.load(saved)
    assert policy.chunk(np.zeros(policy.manifest.signature.observation.shape), 0.0).shape == (6, 14)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"cameras": []}, "environment_state is 0"),
        ({"cameras": [], "environment_state": 94}, "it sees images, or else environment_state"),
        ({"environment_state": 94}, "it sees images, or else environment_state"),
        ({"height": 0}, "height is 0"),
        ({"width": 10**6}, "width is 1000000"),
        ({"height": 1080, "width": 1920, "cameras": ["front"] * 3}, "6120 tokens .* allowed are 4096"),
        ({"dim_model": 6}, "dim_model is 6: with images it must be a multiple of 4"),
        ({"dim_model": 4092, "dim_feedforward": 4096}, "allowed are 64000000"),
        ({"state": [4000] * 14}, "the indices of an observation are 0 to"),
    ],
)
def test_an_impossible_shape_with_images_is_refused(pictured: Path, change: dict[str, Any], message: str) -> None:
    text = (pictured / "manifest.json").read_text()
    try:
        edit(pictured, lambda value: value["network"].update(change))
        with pytest.raises(CheckpointError, match=message):
            checkpoint.read_manifest(pictured)
    finally:
        (pictured / "manifest.json").write_text(text)
