"""Models of Stable-Baselines3 as checkpoints."""

from __future__ import annotations

import os
import pickle
import zipfile
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pytest

import dual_ur10
from dual_ur10.errors import CheckpointError, UnknownNameError
from dual_ur10.policies.learned import checkpoint
from dual_ur10.policies.learned.from_sb3 import converted, from_sb3, network_of, normaliser_of

torch = pytest.importorskip("torch")
sb3 = pytest.importorskip("stable_baselines3")

SINE = dual_ur10.ENV_IDS[0]
HANDOVER = dual_ur10.ENV_IDS[2]
KEYWORDS: dict[str, Any] = {"action_latency_ticks": 5}


class Spaces(gym.Env[Any, Any]):
    """Environment with spaces alone, for models that are never stepped."""

    def __init__(self, inputs: int, outputs: int) -> None:
        self.observation_space = gym.spaces.Box(-10, 10, (inputs,), np.float64)
        self.action_space = gym.spaces.Box(-1, 1, (outputs,), np.float32)

    def reset(self, **_: Any) -> Any:
        return np.zeros(self.observation_space.shape), {}


def model_of(algorithm: str, inputs: int = 94, outputs: int = 12, seed: int = 0, **policy: Any) -> Any:
    kind = {"ppo": sb3.PPO, "sac": sb3.SAC}[algorithm]
    own: dict[str, Any] = {"n_steps": 8, "batch_size": 8} if algorithm == "ppo" else {"buffer_size": 10}
    own["use_sde"] = policy.pop("use_sde", False)
    model = kind("MlpPolicy", Spaces(inputs, outputs), policy_kwargs=policy, seed=seed, device="cpu", **own)
    with torch.no_grad():  # the last layer begins almost at zero
        for parameter in model.policy.parameters():
            parameter.mul_(2.0)
        if algorithm == "ppo":
            model.policy.action_net.weight.mul_(20.0)
    return model


def test_a_normaliser_that_is_left_out_is_refused() -> None:
    from stable_baselines3.common.vec_env import DummyVecEnv, VecNormalize

    around = VecNormalize(DummyVecEnv([lambda: Spaces(94, 12)]))
    model = sb3.PPO("MlpPolicy", around, n_steps=8, batch_size=8, device="cpu")
    with pytest.raises(CheckpointError, match="vec_normalize is None"):
        converted(model, SINE)
    around.norm_obs = False
    assert converted(model, SINE)[1].normalisers == ()


@pytest.mark.parametrize(
    ("algorithm", "policy"),
    [
        ("ppo", {}),
        ("ppo", {"net_arch": [256, 256], "activation_fn": torch.nn.ReLU}),
        ("ppo", {"net_arch": {"pi": [32], "vf": [64, 64]}}),
        ("ppo", {"net_arch": []}),
        ("sac", {}),
        ("sac", {"net_arch": [32, 16, 8], "activation_fn": torch.nn.Tanh}),
    ],
)
def test_a_converted_policy_acts_as_the_model(algorithm: str, policy: Any, tmp_path: Path) -> None:
    model = model_of(algorithm, **dict(policy))
    checkpoint.save(tmp_path / "x", *converted(model, SINE, **KEYWORDS))
    loaded = checkpoint.load(tmp_path / "x", SINE, **KEYWORDS)
    observation = np.random.default_rng(0).normal(size=(100, 94)) * 2
    expected, _ = model.predict(observation, deterministic=True)
    np.testing.assert_allclose(loaded(observation), expected, atol=1e-5)
    assert np.abs(expected).max() > 0.5


def test_actions_of_another_mode_are_refused() -> None:
    """Steps of joints would be taken for their positions."""
    with pytest.raises(CheckpointError, match=r"low of the model's actions is \[-1.0, .*action_mode"):
        converted(model_of("ppo"), SINE, action_mode="joint_position")


def test_observations_are_normalised_as_in_training() -> None:
    from stable_baselines3.common.vec_env import DummyVecEnv, VecNormalize

    around = VecNormalize(DummyVecEnv([lambda: Spaces(94, 12)]), clip_obs=1.5)
    rng = np.random.default_rng(0)
    around.obs_rms.mean, around.obs_rms.var = rng.normal(size=94), rng.uniform(0.1, 3, size=94)
    model = model_of("ppo")
    networks, manifest = converted(model, SINE, vec_normalize=around, **KEYWORDS)
    loaded = checkpoint.LearnedPolicy(manifest, networks)
    observation = rng.normal(size=(50, 94)) * 3
    expected, _ = model.predict(around.normalize_obs(observation), deterministic=True)
    np.testing.assert_allclose(loaded(observation), expected, atol=1e-5)
    around.norm_obs = False
    assert normaliser_of(around) is None


def test_two_models_convert_for_independent_agents() -> None:
    models = [model_of("sac", 79, 7, seed) for seed in range(2)]
    networks, manifest = converted(models, HANDOVER, agents="independent", **KEYWORDS)
    loaded = checkpoint.LearnedPolicy(manifest, networks)
    observation = np.random.default_rng(0).normal(size=158)
    agents = np.split(observation, 2)
    for half, model, own in zip(np.split(loaded(observation), 2), models, agents, strict=True):
        np.testing.assert_allclose(half, model.predict(own, deterministic=True)[0], atol=1e-5)
    with pytest.raises(CheckpointError, match="look different"):
        converted([models[0], model_of("sac", 79, 7, net_arch=[8])], HANDOVER, agents="independent", **KEYWORDS)
    with pytest.raises(CheckpointError, match="models"):
        converted(models[:1], HANDOVER, agents="independent", **KEYWORDS)


@pytest.mark.parametrize("algorithm", ["ppo", "sac"])
def test_a_trusted_file_is_read(algorithm: Any, tmp_path: Path) -> None:
    model = model_of(algorithm)
    model.save(tmp_path / "model.zip")
    loaded = from_sb3(tmp_path / "model.zip", SINE, algorithm=algorithm, trust_pickle=True, **KEYWORDS)
    observation = np.random.default_rng(0).normal(size=(10, 94))
    np.testing.assert_allclose(loaded(observation), model.predict(observation, deterministic=True)[0], atol=1e-5)


def test_a_file_that_is_not_trusted_runs_no_code(tmp_path: Path) -> None:
    sentinel = tmp_path / "sentinel"

    class Payload:
        def __reduce__(self) -> tuple[Any, ...]:
            return os.mkdir, (str(sentinel),)

    data = pickle.dumps(Payload())
    (tmp_path / "x.pkl").write_bytes(data)
    with zipfile.ZipFile(tmp_path / "x.zip", "w") as archive:
        for name in ("data", "policy.pth", "pytorch_variables.pth"):
            archive.writestr(name, data)
    for trust in (False, None, 1, "yes"):
        with pytest.raises(CheckpointError, match="--trust-pickle"):
            from_sb3(tmp_path / "x.zip", SINE, vec_normalize=tmp_path / "x.pkl", trust_pickle=trust)  # type: ignore[arg-type]  # as users may
    with pytest.raises(CheckpointError):
        checkpoint.load(tmp_path / "x.zip")
    assert not sentinel.exists()


def test_unreadable_files_and_unknown_names_are_refused(tmp_path: Path) -> None:
    (tmp_path / "x.zip").write_bytes(b"PK")
    for path in (tmp_path / "x.zip", tmp_path / "none.zip"):
        with pytest.raises(CheckpointError, match="cannot be read"):
            from_sb3(path, SINE, trust_pickle=True)
    with pytest.raises(UnknownNameError):
        from_sb3(tmp_path / "x.zip", SINE, algorithm="dqn", trust_pickle=True)  # type: ignore[arg-type]  # as users may


def test_networks_of_another_kind_are_refused() -> None:
    for model in (model_of("ppo", activation_fn=torch.nn.ELU), model_of("sac", use_sde=True)):
        with pytest.raises(CheckpointError, match="the network is"):
            network_of(model)
    with pytest.raises(CheckpointError, match="PPO or SAC"):
        network_of(sb3.TD3("MlpPolicy", Spaces(3, 2), buffer_size=10))
    with pytest.raises(CheckpointError, match="outputs"):
        converted(model_of("ppo", 94, 11), SINE)
