"""Chunk policies of a transformer: their network, checkpoints and execution."""

from __future__ import annotations

import dataclasses
import json
import os
import pickle
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from safetensors.numpy import load_file

from dual_ur10 import policies
from dual_ur10.errors import ActionError, CheckpointError
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
    from dual_ur10.policies.training.act_fit import chunks_of

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
