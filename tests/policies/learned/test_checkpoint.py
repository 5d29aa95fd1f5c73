"""Checkpoints: saving and loading."""

from __future__ import annotations

import dataclasses
import hashlib
import os
import re
import subprocess
import sys
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from typer.testing import CliRunner

import dual_ur10
from dual_ur10 import policies
from dual_ur10.cli import main as cli
from dual_ur10.envs import parallel_env
from dual_ur10.errors import ActionError, CheckpointError, UnknownNameError
from dual_ur10.policies import evaluate
from dual_ur10.policies.learned import checkpoint
from dual_ur10.policies.learned.network import NetworkShape, Normaliser
from tests.policies.learned.checkpoints import (
    KINDS,
    SINE,
    parts,
)

# Saving and loading.


@pytest.mark.parametrize("agents", KINDS)
@pytest.mark.parametrize("env_id", dual_ur10.ENV_IDS)
def test_a_saved_checkpoint_loads_bit_for_bit(env_id: str, agents: str, tmp_path: Path) -> None:
    networks, made = parts(env_id, agents, action_latency_ticks=5, randomization="mild")
    written = checkpoint.save(tmp_path / "x", networks, made)
    weights = (tmp_path / "x/policy.safetensors").read_bytes()
    assert written == dataclasses.replace(made, weights_sha256=hashlib.sha256(weights).hexdigest())
    found, layers, _ = checkpoint._read(tmp_path / "x")
    assert found == written
    assert checkpoint.read_manifest(tmp_path / "x") == written
    for one, other in zip(networks, layers, strict=True):
        for first, second in zip(one, other, strict=True):
            assert [each.tobytes() for each in first] == [each.tobytes() for each in second]
    policy = checkpoint.load(tmp_path / "x")
    assert policy.sha256 == written.weights_sha256
    assert isinstance(policy, policies.Policy)
    checkpoint.save(tmp_path / "again", layers, found)
    for name in ("policy.safetensors", "manifest.json"):
        assert (tmp_path / "again" / name).read_bytes() == (tmp_path / "x" / name).read_bytes()
    assert sorted(os.listdir(tmp_path)) == ["again", "x"]


@pytest.mark.parametrize("env_id", dual_ur10.ENV_IDS)
@pytest.mark.parametrize("agents", KINDS)
def test_two_agents_act_on_their_own_observations(env_id: str, agents: str, tmp_path: Path) -> None:
    networks, made = parts(env_id, agents)
    checkpoint.save(tmp_path / "x", networks, made)
    env = parallel_env(env_id)
    policy = checkpoint.load(tmp_path / "x", env)
    own, _ = env.reset(seed=1)
    both = env.state()
    action = policy(both)
    assert action.shape == (made.signature.action.shape[0],)
    assert action.dtype == np.float32
    if agents == "joint":
        with pytest.raises(UnknownNameError):
            policy.agent("left")
    else:
        for side, arm in enumerate(("left", "right")):
            half = policy.agent(arm)(own[arm])
            assert half.tobytes() == np.split(action, 2)[side].tobytes()
            # By hand, from what was saved: that the left network is the left arm's.
            x = np.clip(
                (own[arm] - made.normalisers[min(side, len(networks) - 1)].mean)
                / np.sqrt(np.array(made.normalisers[min(side, len(networks) - 1)].var) + 1e-8),
                -10,
                10,
            )
            (first, bias), (last, end) = networks[min(side, len(networks) - 1)]
            expected = np.clip(last @ np.tanh(first @ x + bias) + end, -1, 1)
            np.testing.assert_allclose(half, expected, atol=1e-5)
        with pytest.raises(UnknownNameError):
            policy.agent("middle")
    env.step(dict(zip(env.agents, np.split(action, 2), strict=True)))
    env.close()


@pytest.mark.parametrize("agents", KINDS)
def test_a_batch_gives_the_bits_of_single_observations(agents: str, tmp_path: Path) -> None:
    checkpoint.save(tmp_path / "x", *parts(SINE, agents, hidden=256))
    policy = checkpoint.load(tmp_path / "x")
    batch = np.random.default_rng(0).normal(size=(9, 94))
    together = policy(batch)
    assert together.shape == (9, 12)
    assert [policy(row).tobytes() for row in batch] == [row.tobytes() for row in together]
    policy.reset()
    assert policy(batch).tobytes() == together.tobytes()


@pytest.mark.parametrize("shape", [(93,), (2, 95), (1, 2, 94), ()])
def test_malformed_observations_are_refused(saved: Path, shape: tuple[int, ...]) -> None:
    with pytest.raises(ActionError, match="an observation of"):
        checkpoint.load(saved)(np.zeros(shape))


def test_a_policy_is_found_by_its_path(saved: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    keywords = {"action_latency_ticks": 5, "amplitude_m": 0.08}
    observation = np.random.default_rng(0).normal(size=94)
    expected = checkpoint.load(saved)(observation)
    monkeypatch.chdir(saved.parent)
    for path in (saved, str(saved), "copy", "./copy"):
        assert policies.load(path, SINE, **keywords)(observation).tobytes() == expected.tobytes()
    with pytest.raises(CheckpointError, match="cannot be read"):
        policies.load("./none", SINE)
    with pytest.raises(UnknownNameError, match="the path of a checkpoint"):
        policies.load("none", SINE)
    for name in ("no\0ne", "a/no\0ne", ""):
        with pytest.raises(UnknownNameError):
            policies.load(name, SINE)
    with pytest.raises(CheckpointError, match="cannot be read"):
        policies.load(Path("a/no\0ne"), SINE)


def test_a_checkpoint_can_be_evaluated(saved: Path) -> None:
    keywords = {"action_latency_ticks": 5, "amplitude_m": 0.08, "duration_s": 0.4}
    policy = policies.load(saved, SINE, **keywords)
    found = [evaluate(SINE, policy, episodes=3, num_envs=n, env_kwargs=keywords).episodes for n in (1, 2)]
    assert found[0] == found[1]


def test_commands_take_the_folder_of_a_checkpoint(saved: Path, tmp_path: Path, monkeypatch: Any) -> None:
    monkeypatch.chdir(tmp_path)
    settings = ("--set", "action_latency_ticks=5", "--set", "amplitude_m=0.08", "--set", "duration_s=0.4")
    for command in (("rollout", "--no-record"), ("evaluate", "--envs", "1")):
        arguments = [command[0], "SineTracking", "-p", str(saved), "-n", "1", *command[1:], *settings]
        found = CliRunner().invoke(cli.app, arguments)
        assert found.exit_code == 0, found.output
    found = CliRunner().invoke(cli.app, ["rollout", "SineTracking", "-p", str(tmp_path / "none"), "--no-record"])
    assert found.exit_code == 2
    same = {"action_latency_ticks": 5, "amplitude_m": 0.08, "duration_s": 0.4}
    policy = policies.load(saved, SINE, **same)
    returns = [
        evaluate(SINE, each, episodes=2, num_envs=1, env_kwargs=same).mean_return for each in (str(saved), policy)
    ]
    assert returns[0] == returns[1]


def test_loading_needs_no_torch(saved: Path) -> None:
    script = (
        "import sys\nsys.modules['torch'] = sys.modules['stable_baselines3'] = None\nimport numpy as np\n"
        "from dual_ur10 import policies\n"
        f"policy = policies.load({str(saved)!r}, {SINE!r}, action_latency_ticks=5)\n"
        "print(policy(np.zeros(94)).shape)\n"
    )
    result = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, check=True)
    assert result.stdout == "(12,)\n"


def test_environments_of_every_interface_are_accepted(tmp_path: Path) -> None:
    keywords: dict[str, Any] = {"action_latency_ticks": 5, "amplitude_m": 0.08}
    saved = tmp_path / "x"
    checkpoint.save(saved, *parts(SINE, "shared", **keywords))
    for env in (
        gym.make(SINE, **keywords),
        gym.make_vec(SINE, num_envs=2, vectorization_mode="vector_entry_point", **keywords),
        parallel_env(SINE, **keywords),
    ):
        state = getattr(env, "unwrapped", env).core.task.n
        policy = checkpoint.load(saved, env)
        policy(np.zeros((5, 94)))
        assert getattr(env, "unwrapped", env).core.task.n == state
        with pytest.raises(CheckpointError, match="keywords were given"):
            checkpoint.load(saved, env, amplitude_m=0.1)
        env.close()
    with pytest.raises(CheckpointError, match="no environment"):
        checkpoint.load(saved, object())


def test_a_policy_for_other_actions_of_the_tools_is_refused(tmp_path: Path) -> None:
    handover = "DualUR10/Handover-v0"
    checkpoint.save(tmp_path / "x", *parts(handover, action_mode="tcp_translation"))
    with pytest.raises(CheckpointError, match="action_mode='tcp_translation'"):
        policies.load(tmp_path / "x", handover, action_mode="tcp_delta")
    assert policies.load(tmp_path / "x", handover, action_mode="tcp_translation")


# Atomic saving.


@pytest.mark.parametrize(
    ("trained", "keywords"),
    [
        ({"action_latency_ticks": 5}, "action_latency_ticks=5"),
        (
            {"action_latency_ticks": 3, "policy_rate_hz": 12.5, "compensate_lag": False},
            "policy_rate_hz=12.5, action_latency_ticks=3, compensate_lag=False",
        ),
        ({"action_mode": "tcp_delta"}, "action_mode='tcp_delta'"),
        ({"action_scale": 0.3}, "action_scale=0.3"),
        ({"action_scale": {"joints": 0.3}}, "action_scale={'joints': 0.3}"),
    ],
)
def test_keywords_of_the_training_are_named_as_to_type_them(
    trained: dict[str, Any], keywords: str, tmp_path: Path
) -> None:
    checkpoint.save(tmp_path / "x", *parts(SINE, **trained))
    with pytest.raises(CheckpointError) as caught:
        policies.load(tmp_path / "x", SINE)
    call = f"'{SINE}', {keywords}"
    assert str(caught.value).endswith(f"pass what it was trained with to both, gym.make({call}) and load(..., {call})")
    # What it says works.
    arguments = dict(eval(f"dict({keywords})"))
    env = gym.make(SINE, **arguments)
    policy = policies.load(tmp_path / "x", SINE, **arguments)
    assert policy(env.reset(seed=0)[0]).shape == env.action_space.shape
    env.close()


def test_nothing_is_overwritten(saved: Path, tmp_path: Path) -> None:
    before = {path.name: path.read_bytes() for path in saved.iterdir()}
    (tmp_path / "file").write_text("mine")
    (tmp_path / "dangling").symlink_to(tmp_path / "nowhere")
    (tmp_path / "empty").mkdir()
    for name in ("copy", "file", "dangling", "empty"):
        with pytest.raises(CheckpointError, match="exists"):
            checkpoint.save(tmp_path / name, *parts())
    assert {path.name: path.read_bytes() for path in saved.iterdir()} == before
    assert (tmp_path / "file").read_text() == "mine"
    assert sorted(os.listdir(tmp_path)) == ["copy", "dangling", "empty", "file"]


def test_a_folder_made_meanwhile_is_not_overwritten(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Another program makes the folder while the files are written."""
    write = checkpoint._write

    def slow(path: Path, data: bytes) -> None:
        write(path, data)
        (tmp_path / "x").mkdir(exist_ok=True)
        (tmp_path / "x/theirs").write_text("theirs")

    monkeypatch.setattr(checkpoint, "_write", slow)
    with pytest.raises(CheckpointError, match="cannot write"):
        checkpoint.save(tmp_path / "x", *parts())
    assert os.listdir(tmp_path) == ["x"]
    assert os.listdir(tmp_path / "x") == ["theirs"]


@pytest.mark.parametrize("name", [".hidden", "-x", "a b", "ä", "x" * 65, "a\n", "a;b"])
def test_illegal_folder_names_are_refused(name: str, tmp_path: Path) -> None:
    with pytest.raises(CheckpointError, match="no name of a checkpoint"):
        checkpoint.save(tmp_path / name, *parts())
    assert not os.listdir(tmp_path)


def test_an_absent_parent_folder_is_reported(tmp_path: Path) -> None:
    with pytest.raises(CheckpointError, match="No such file"):
        checkpoint.save(tmp_path / "none" / "x", *parts())


def test_a_full_disk_changes_nothing(saved: Path, tmp_path: Path) -> None:
    before = {path.name: path.read_bytes() for path in saved.iterdir()}
    script = (
        "import os, resource\n"
        "from dual_ur10.policies.learned import checkpoint\nfrom dual_ur10.errors import CheckpointError\n"
        f"found, weights, _ = checkpoint._read(checkpoint.Path({str(saved)!r}))\n"
        "for most in (0, 10, 1000, 4000):\n"
        "    resource.setrlimit(resource.RLIMIT_FSIZE, (most, resource.RLIM_INFINITY))\n"
        "    try:\n"
        f"        checkpoint.save({str(tmp_path / 'new')!r}, weights, found)\n"
        "    except CheckpointError as error:\n"
        f"        print(os.listdir({str(tmp_path)!r}), error)\n"
    )
    result = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, check=False)
    assert result.returncode == 0, result.stderr
    assert len(re.findall(r"^\['copy'\] .*cannot write.*File too large", result.stdout, re.MULTILINE)) == 4
    assert os.listdir(tmp_path) == ["copy"]
    assert {path.name: path.read_bytes() for path in saved.iterdir()} == before


def test_weights_that_contradict_the_manifest_are_refused(tmp_path: Path) -> None:
    networks, made = parts()
    (weight, bias), last = networks[0]
    nan = weight.copy()
    nan[0, 0] = np.nan
    for wrong, message in (
        ([[(nan, bias), last]], "NaN or infinity"),
        ([[(weight.astype(np.float64), bias), last]], "must be float32"),
        ([[(weight.T, bias), last]], "of shape"),
        ([[(weight, bias)]], "layers"),
        (networks * 2, "layers"),
        ([], "layers"),
    ):
        with pytest.raises(CheckpointError, match=message):
            checkpoint.save(tmp_path / "x", wrong, made)
    assert not os.listdir(tmp_path)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"training": {"f": print}}, "cannot be written"),
        ({"training": {"f": float("nan")}}, "finite"),
        ({"training": {"a\nb": 1}}, "key"),
        ({"training": {"a": 10**30}}, "64 bits"),
        ({"seed": 0.5}, "seed"),
        ({"evaluation": []}, "evaluation"),
    ],
)
def test_unreadable_manifests_are_not_written(changes: Any, message: str, tmp_path: Path) -> None:
    networks, made = parts()
    with pytest.raises(CheckpointError, match=message):
        checkpoint.save(tmp_path / "x", networks, dataclasses.replace(made, **changes))
    assert not os.listdir(tmp_path)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"normalisers": (Normaliser((0.0,), (1.0,)),)}, "means for"),
        ({"normalisers": (Normaliser((0.0,) * 94, (1.0,) * 94),) * 2}, "normalisers for"),
        ({"network": NetworkShape((67, 12), "tanh", "clip"), "normalisers": ()}, "67 inputs"),
        ({"network": NetworkShape((94, 13), "tanh", "clip")}, "outputs"),
        ({"agents": "shared"}, "outputs"),
        ({"versions": {}}, "versions"),
        ({"versions": {"dual_ur10": "one"}}, "versions"),
        ({"weights_sha256": "x"}, "64 digits"),
    ],
)
def test_inconsistent_manifests_are_refused(changes: Any, message: str) -> None:
    with pytest.raises(CheckpointError, match=message):
        dataclasses.replace(parts()[1], **changes)
