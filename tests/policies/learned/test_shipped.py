"""The learned policies that come with the package."""

from __future__ import annotations

import re

import gymnasium as gym
import numpy as np
import pytest

import dual_ur10
from dual_ur10 import policies
from dual_ur10.errors import CheckpointError, UnknownNameError
from dual_ur10.policies import evaluate
from dual_ur10.policies.learned import checkpoint
from dual_ur10.policies.registry import shipped_folder, shipped_names
from tests.soak import SOAK

ALL = [(name, env_id) for env_id in dual_ur10.ENV_IDS for name in shipped_names(env_id)]
KEYWORDS = {"action_latency_ticks": 5}
MODES = {"DualUR10/TrayBalance-v0": "tcp_delta", "DualUR10/LidAndPlace-v0": "tcp_delta"}


def test_shipped_policies_cover_one_agent_and_two():
    kinds = {checkpoint.read_manifest(shipped_folder(*each)).agents for each in ALL}
    assert "joint" in kinds
    assert kinds & {"shared", "independent"}


@pytest.mark.parametrize(("name", "env_id"), ALL)
def test_the_card_agrees_with_the_manifest(name, env_id):
    folder = shipped_folder(name, env_id)
    manifest, card = checkpoint.read_manifest(folder), (folder / "card.md").read_text()
    assert manifest.signature.env_id == env_id
    assert manifest.signature.rate.latency_ticks > 0
    assert manifest.weights_sha256 in card
    assert f"--seed {manifest.seed}" in card
    assert re.search(r"python -m dual_ur10 train \w+", card)
    assert f"{manifest.training['steps']:,} steps" in card
    assert (folder / "curve.png").read_bytes()[:4] == b"\x89PNG"
    assert sum(each.stat().st_size for each in folder.glob("*.safetensors")) < 1_000_000
    assert {each.name for each in folder.iterdir()} == {"policy.safetensors", "manifest.json", "card.md", "curve.png"}


@pytest.mark.parametrize(("name", "env_id"), ALL)
def test_a_shipped_policy_loads_by_name_and_acts(name, env_id):
    mode = {"action_mode": MODES[env_id]} if env_id in MODES else {}
    policy = policies.load(name, env_id, **KEYWORDS, **mode)
    env = gym.make(env_id, **KEYWORDS, **mode)
    observation, _ = env.reset(seed=0)
    for _ in range(3):
        observation, *_ = env.step(policy(observation))
    env.close()
    assert np.isfinite(observation).all()
    with pytest.raises(CheckpointError, match="latency_ticks"):
        policies.load(name, env_id, **mode)


@pytest.mark.parametrize(("name", "env_id"), ALL)
def test_a_shipped_policy_succeeds(name, env_id):
    episodes = 300 if SOAK else 1 if "SyncCarry" in env_id else 4  # its physics is the slowest
    keywords = checkpoint.read_manifest(shipped_folder(name, env_id)).signature.kwargs  # what it was trained for
    found = evaluate(env_id, name, episodes=episodes, num_envs=64, env_kwargs=dict(keywords))
    assert found.successes >= (0.9 if SOAK else 0.75) * episodes


def test_unknown_names_are_refused():
    with pytest.raises(UnknownNameError, match="learned"):
        policies.load("learnt", dual_ur10.ENV_IDS[0])
    without = [env_id for env_id in dual_ur10.ENV_IDS if "learned-two-agents" not in shipped_names(env_id)]
    for env_id in without:
        with pytest.raises(UnknownNameError, match="unknown policy of"):
            policies.load("learned-two-agents", env_id, **KEYWORDS)
