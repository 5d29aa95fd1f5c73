"""Checkpoints: saving, loading, and refusal of everything that was not saved."""

from __future__ import annotations

import base64
import copy
import dataclasses
import hashlib
import io
import json
import logging
import os
import pickle
import shutil
import stat
import subprocess
import sys
import zipfile
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from safetensors.numpy import save as serialised
from typer.testing import CliRunner

import dual_ur10
from dual_ur10 import policies
from dual_ur10.cli import main as cli
from dual_ur10.envs import parallel_env
from dual_ur10.errors import ActionError, CheckpointError, SettingsError, UnknownNameError
from dual_ur10.policies.evaluation.evaluate import evaluate
from dual_ur10.policies.learned import checkpoint, schema
from dual_ur10.policies.learned.manifest import Manifest
from dual_ur10.policies.learned.network import NetworkShape, Normaliser
from dual_ur10.policies.learned.signature import view_of
from tests.soak import SOAK

SINE, CARRY, HANDOVER = dual_ur10.ENV_IDS
KINDS = ("joint", "shared", "independent")


def parts(env_id: str = SINE, agents: str = "joint", hidden: int = 4, **keywords: Any) -> tuple[list[Any], Manifest]:
    rng = np.random.default_rng(KINDS.index(agents))
    view = view_of(env_id, keywords)
    signature = view.signature
    size = signature.observation.shape[0] if agents == "joint" else view.agent_size
    shape = NetworkShape((size, hidden, signature.action.shape[0] // (1 if agents == "joint" else 2)), "tanh", "clip")
    count = 2 if agents == "independent" else 1
    networks = [
        [
            (rng.normal(size=(out, into)).astype(np.float32) / 8, rng.normal(size=out).astype(np.float32) / 8)
            for into, out in shape.pairs
        ]
        for _ in range(count)
    ]
    made = Manifest(
        signature=signature,
        agents=agents,  # type: ignore[arg-type]  # one of KINDS
        network=shape,
        normalisers=tuple(
            Normaliser(tuple(rng.normal(size=size).tolist()), tuple(rng.random(size).tolist())) for _ in range(count)
        ),
        training={"algorithm": "ppo", "steps": 100, "rates": [0.1, 1e-300], "nested": {"clip": None, "ok": True}},
        seed=3,
        evaluation={"success": 0.1 + 0.2},
    )
    return networks, made


@pytest.fixture(scope="module")
def master(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("checkpoints") / "sine"
    checkpoint.save(folder, *parts(action_latency_ticks=5, amplitude_m=0.08))
    return folder


@pytest.fixture
def saved(master: Path, tmp_path: Path) -> Path:
    return Path(shutil.copytree(master, tmp_path / "copy"))


def sealed(value: dict[str, Any]) -> bytes:
    """Return a manifest's text with a valid checksum."""
    value = {name: each for name, each in value.items() if name != "sha256"}
    text = json.dumps(value, sort_keys=True, separators=(",", ":"), ensure_ascii=True)
    return json.dumps({**value, "sha256": hashlib.sha256(text.encode()).hexdigest()}).encode()


def content(folder: Path) -> dict[str, Any]:
    value: dict[str, Any] = json.loads((folder / "manifest.json").read_text())
    return value


def edit(folder: Path, change: Callable[[dict[str, Any]], object]) -> None:
    value = content(folder)
    change(value)
    (folder / "manifest.json").write_bytes(sealed(value))


def exchange_weights(folder: Path, data: bytes) -> None:
    (folder / "policy.safetensors").write_bytes(data)
    edit(folder, lambda value: value.update(weights_sha256=hashlib.sha256(data).hexdigest()))


def leaves(value: Any, path: tuple[Any, ...] = ()) -> Iterator[tuple[Any, ...]]:
    yield path
    items = value.items() if isinstance(value, dict) else enumerate(value) if isinstance(value, list) else ()
    for name, each in items:
        yield from leaves(each, (*path, name))


def at(value: Any, path: tuple[Any, ...]) -> Any:
    for name in path:
        value = value[name]
    return value


def put(value: Any, path: tuple[Any, ...], new: Any) -> Any:
    result = copy.deepcopy(value)
    at(result, path[:-1])[path[-1]] = new
    return result


# Saving and loading.


@pytest.mark.parametrize("agents", KINDS)
@pytest.mark.parametrize("env_id", dual_ur10.ENV_IDS)
def test_a_saved_checkpoint_loads_bit_for_bit(env_id: str, agents: str, tmp_path: Path) -> None:
    networks, made = parts(env_id, agents, action_latency_ticks=5, randomization="mild")
    written = checkpoint.save(tmp_path / "x", networks, made)
    weights = (tmp_path / "x/policy.safetensors").read_bytes()
    assert written == dataclasses.replace(made, weights_sha256=hashlib.sha256(weights).hexdigest())
    found, layers = checkpoint._read(tmp_path / "x")
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
    batch = np.random.default_rng(0).normal(size=(9, 68))
    together = policy(batch)
    assert together.shape == (9, 12)
    assert [policy(row).tobytes() for row in batch] == [row.tobytes() for row in together]
    policy.reset()
    assert policy(batch).tobytes() == together.tobytes()


@pytest.mark.parametrize("shape", [(67,), (2, 69), (1, 2, 68), ()])
def test_malformed_observations_are_refused(saved: Path, shape: tuple[int, ...]) -> None:
    with pytest.raises(ActionError, match="an observation of"):
        checkpoint.load(saved)(np.zeros(shape))


def test_a_policy_is_found_by_its_path(saved: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    keywords = {"action_latency_ticks": 5, "amplitude_m": 0.08}
    observation = np.random.default_rng(0).normal(size=68)
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
        "print(policy(np.zeros(68)).shape)\n"
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
        policy(np.zeros((5, 68)))
        assert getattr(env, "unwrapped", env).core.task.n == state
        with pytest.raises(CheckpointError, match="keywords were given"):
            checkpoint.load(saved, env, amplitude_m=0.1)
        env.close()
    with pytest.raises(CheckpointError, match="no environment"):
        checkpoint.load(saved, object())


# Atomic saving.


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


@pytest.mark.parametrize("most", [0, 10, 1000, 4000])
def test_a_full_disk_changes_nothing(most: int, saved: Path, tmp_path: Path) -> None:
    before = {path.name: path.read_bytes() for path in saved.iterdir()}
    script = (
        "import resource, sys\n"
        "from dual_ur10.policies.learned import checkpoint\nfrom dual_ur10.errors import CheckpointError\n"
        f"found, weights = checkpoint._read(checkpoint.Path({str(saved)!r}))\n"
        f"resource.setrlimit(resource.RLIMIT_FSIZE, ({most}, {most}))\n"
        "try:\n"
        f"    checkpoint.save({str(tmp_path / 'new')!r}, weights, found)\n"
        "except CheckpointError as error:\n"
        "    print(error)\n"
    )
    result = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, check=False)
    assert result.returncode == 0, result.stderr
    assert "cannot write" in result.stdout
    assert "File too large" in result.stdout
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
        ({"normalisers": (Normaliser((0.0,) * 68, (1.0,) * 68),) * 2}, "normalisers for"),
        ({"network": NetworkShape((67, 12), "tanh", "clip"), "normalisers": ()}, "67 inputs"),
        ({"network": NetworkShape((68, 13), "tanh", "clip")}, "outputs"),
        ({"agents": "shared"}, "outputs"),
        ({"versions": {}}, "versions"),
        ({"versions": {"dual_ur10": "one"}}, "versions"),
        ({"weights_sha256": "x"}, "64 digits"),
    ],
)
def test_inconsistent_manifests_are_refused(changes: Any, message: str) -> None:
    with pytest.raises(CheckpointError, match=message):
        dataclasses.replace(parts()[1], **changes)


# Damage.


@pytest.mark.parametrize("resealed", [False, True])
@pytest.mark.parametrize("name", ["manifest.json", "policy.safetensors"])
def test_files_truncated_at_any_length_are_refused(name: str, resealed: bool, saved: Path) -> None:
    data = (saved / name).read_bytes()
    if name == "manifest.json":
        data = data.rstrip()  # without its last line break it says the same
    for length in range(0, len(data), 1 if SOAK else 20):
        if resealed and name == "policy.safetensors":
            exchange_weights(saved, data[:length])
        else:
            (saved / name).write_bytes(data[:length])
        with pytest.raises(CheckpointError):
            checkpoint.load(saved)


def test_any_changed_byte_of_the_weights_is_refused(saved: Path) -> None:
    path = saved / "policy.safetensors"
    data = path.read_bytes()
    for k in range(0, len(data), 1 if SOAK else 20):
        changed = bytearray(data)
        changed[k] ^= 1 << k % 8
        path.write_bytes(changed)
        with pytest.raises(CheckpointError, match="is not the file that was saved"):
            checkpoint.load(saved)


def test_any_changed_value_of_the_manifest_is_refused(saved: Path) -> None:
    value = content(saved)
    found = [path for path in leaves(value) if path and not isinstance(at(value, path), dict | list)]
    for path in found[:: 1 if SOAK else 5] + [each for each in found if not isinstance(each[-1], int)]:
        old = at(value, path)
        new = not old if isinstance(old, bool) else f"{old}x" if isinstance(old, str) else (old or 0) + 1
        (saved / "manifest.json").write_text(json.dumps(put(value, path, new)))
        with pytest.raises(CheckpointError, match=r"changed since|not of format"):
            checkpoint.load(saved)


def test_any_value_of_another_type_is_refused(saved: Path) -> None:
    value = content(saved)
    free = ("kwargs", "training", "evaluation")
    found = [path for path in leaves(value) if path and not any(name in path[:-1] for name in free)]
    for path in [each for k, each in enumerate(found) if SOAK or k % 5 == 0 or not isinstance(each[-1], int)]:
        old = at(value, path)
        for new in ("1", 7, True, [], {}, 0.5, 2**70):
            same = type(new) is type(old) or {type(new), type(old)} <= {int, float}
            if path[-1] in free and isinstance(new, dict):
                continue
            if same and new != 2**70:
                continue
            if new == 2**70 and isinstance(old, float):
                continue
            (saved / "manifest.json").write_bytes(sealed(put(value, path, new)))
            if path == ("normalisers",) and new == []:
                continue
            if path[0] == "sha256":
                continue
            with pytest.raises(CheckpointError):
                checkpoint.load(saved)


def test_missing_and_unknown_keys_are_refused(saved: Path) -> None:
    value = content(saved)
    for path in leaves(value):
        here = at(value, path)
        if not isinstance(here, dict) or any(name in path for name in ("kwargs", "training", "evaluation", "versions")):
            continue
        for name in here:
            less = copy.deepcopy(value)
            del at(less, path)[name]
            if name == "sha256":
                continue
            (saved / "manifest.json").write_bytes(sealed(less))
            with pytest.raises(CheckpointError, match=rf"has no|{name}|format"):
                checkpoint.load(saved)
        more = copy.deepcopy(value)
        at(more, path)["surprise"] = 1
        (saved / "manifest.json").write_bytes(sealed(more))
        with pytest.raises(CheckpointError, match="surprise"):
            checkpoint.load(saved)


def test_all_findings_are_reported_with_their_paths(saved: Path) -> None:
    def change(value: dict[str, Any]) -> None:
        value["signature"]["rate"]["tick_s"] = "fast"
        value["network"]["activation"] = "gelu"
        value["normalisers"][0]["mean"][3] = None
        value["training"]["text"] = "x" * 3000
        value["training"]["steps"] = 2**70
        del value["seed"], value["evaluation"]
        value["surprise"] = 1

    edit(saved, change)
    with pytest.raises(CheckpointError) as found:
        checkpoint.load(saved)
    for text in (
        "manifest.json.signature.rate.tick_s is 'fast': it must be a valid number",
        "manifest.json.network.activation is 'gelu': it must be 'tanh' or 'relu'",
        "manifest.json.normalisers[0].mean[3] is None",
        "manifest.json.training.text has 3000 characters: at most 2000 are allowed",
        "manifest.json.training.steps is 1180591620717411303424: it must be a whole number of 64 bits",
        "manifest.json.surprise is unknown: remove it",
    ):
        assert text in str(found.value)
    shutil.rmtree(saved)
    checkpoint.save(saved, *parts())
    edit(saved, lambda value: (value.pop("seed"), value["normalisers"][0].pop("clip")))
    with pytest.raises(CheckpointError, match=r"normalisers\[0\].clip is missing.*; .*seed is missing: write it down"):
        checkpoint.load(saved)


@pytest.mark.parametrize(
    "text",
    [
        b"",
        b"null",
        b"[]",
        b"{}",
        b"\xff\xfe",
        b'{"format": "dual-ur10 policy 2"}',
        b'{"format": NaN}',
        b'{"a": 1, "a": 2}',
        b"[" * 200_000,
        b'{"a":' * 100_000,
        b"1" * 100_000,
        b" " * (2 << 20),
    ],
)
def test_malformed_manifests_are_refused(text: bytes, saved: Path) -> None:
    (saved / "manifest.json").write_bytes(text)
    with pytest.raises(CheckpointError):
        checkpoint.load(saved)


def test_duplicate_keys_are_refused(saved: Path) -> None:
    """Python takes the last value, other readers the first."""
    path = saved / "manifest.json"
    path.write_text(path.read_text().replace("{", '{"seed": 9,', 1))
    with pytest.raises(CheckpointError, match="a key twice"):
        checkpoint.load(saved)


@pytest.mark.parametrize("number", ["NaN", "Infinity", "-Infinity", "1e999"])
def test_non_finite_numbers_are_refused(number: str, saved: Path) -> None:
    text = sealed(put(content(saved), ("normalisers", 0, "clip"), 987654.25)).decode()
    bare = text.replace("987654.25", number)
    (saved / "manifest.json").write_text(bare)
    with pytest.raises(CheckpointError):
        checkpoint.load(saved)
    with pytest.raises(CheckpointError, match="finite"):
        schema.read(Normaliser, {"mean": [1.0], "var": [1.0], "clip": float("inf"), "epsilon": 1.0}, "x")


def test_weights_of_another_layout_are_refused(saved: Path) -> None:
    _, layers = checkpoint._read(saved)
    good = {
        f"policy.{k}.{kind}": array
        for k, layer in enumerate(layers[0])
        for kind, array in zip(("weight", "bias"), layer, strict=True)
    }
    bias = good["policy.0.bias"]
    bad: list[tuple[dict[str, Any], str]] = [
        ({**good, "more": bias}, "holds"),
        ({name: each for name, each in good.items() if name != "policy.0.bias"}, "holds"),
        ({**good, "policy.0.bias": bias.astype(np.float64)}, "F64"),
        ({**good, "policy.0.bias": bias.view(np.int32)}, "I32"),
        ({**good, "policy.0.bias": bias[:-1]}, "of shape"),
        ({**good, "policy.0.bias": bias[None]}, "of shape"),
        ({**good, "policy.0.weight": np.ascontiguousarray(good["policy.0.weight"].T)}, "of shape"),
        ({**good, "policy.0.bias": bias + np.float32(np.inf)}, "NaN or infinity"),
        ({**good, "policy.0.bias": bias * np.float32(np.nan)}, "NaN or infinity"),
    ]
    exchange_weights(saved, serialised(good))
    checkpoint.load(saved)
    for tensors, message in bad:
        exchange_weights(saved, serialised(tensors))
        with pytest.raises(CheckpointError, match=message):
            checkpoint.load(saved)


def test_files_that_announce_huge_sizes_are_refused(saved: Path) -> None:
    """The sizes stand in the header, or are those of a sparse file."""
    header = json.dumps({"policy.0.bias": {"dtype": "F32", "shape": [2**40], "data_offsets": [0, 2**42]}}).encode()
    for data in (
        len(header).to_bytes(8, "little") + header,
        (2**63 - 1).to_bytes(8, "little") + header,
        (2**64 - 1).to_bytes(8, "little"),
        b"\0" * 8,
    ):
        exchange_weights(saved, data)
        with pytest.raises(CheckpointError, match="safetensors"):
            checkpoint.load(saved)
    with (saved / "policy.safetensors").open("wb") as file:
        file.truncate(2**40)
    with pytest.raises(CheckpointError, match="nothing was read"):
        checkpoint.load(saved)
    edit(saved, lambda value: value["network"].update(layers=[68, 10**9, 12]))
    with pytest.raises(CheckpointError, match="the network has"):
        checkpoint.load(saved)
    with (saved / "manifest.json").open("wb") as file:
        file.truncate(2**40)
    with pytest.raises(CheckpointError, match="nothing was read"):
        checkpoint.load(saved)


@pytest.mark.parametrize("name", ["manifest.json", "policy.safetensors"])
def test_links_and_special_files_are_not_followed(name: str, saved: Path) -> None:
    path = saved / name
    aside = saved.parent / "aside"
    path.rename(aside)
    path.symlink_to(aside)
    with pytest.raises(CheckpointError, match="links are not followed"):
        checkpoint.load(saved)
    path.unlink()
    os.mkfifo(path)
    with pytest.raises(CheckpointError, match="no regular file"):
        checkpoint.load(saved)
    path.unlink()
    path.mkdir()
    with pytest.raises(CheckpointError, match="no regular file"):
        checkpoint.load(saved)
    path.rmdir()
    with pytest.raises(CheckpointError, match="cannot be read"):
        checkpoint.load(saved)
    os.link(aside, path)
    checkpoint.load(saved)


def test_a_path_that_is_no_folder_is_refused(saved: Path) -> None:
    link = saved.parent / "link"
    link.symlink_to(saved)
    for path in (link, saved / "manifest.json", saved.parent / "none", Path("/dev/null")):
        with pytest.raises(CheckpointError, match="cannot be read as a checkpoint"):
            checkpoint.load(path)


# No code.


class Payload:
    """Make a folder when unpickled."""

    def __init__(self, sentinel: Path) -> None:
        self.sentinel = sentinel

    def __reduce__(self) -> tuple[Any, ...]:
        return os.mkdir, (str(self.sentinel),)


def corpus(sentinel: Path) -> dict[str, bytes]:
    """Return files of all kinds that run code if a reader trusts them."""
    payload = Payload(sentinel)
    found = {f"pickle {protocol}": pickle.dumps(payload, protocol) for protocol in range(6)}
    found["in a dict"] = pickle.dumps({"state_dict": {"weight": payload}})
    archive = io.BytesIO()
    with zipfile.ZipFile(archive, "w") as zipped:
        for name in ("archive/data.pkl", "data", "policy.pth", "pytorch_variables.pth", "archive/version"):
            zipped.writestr(name, found["pickle 2"])
    found["zip"] = archive.getvalue()
    array = io.BytesIO()
    np.save(array, np.array([payload], dtype=object), allow_pickle=True)
    found["npy"] = array.getvalue()
    call = f"__import__('os').mkdir({str(sentinel)!r})"
    found["python"] = call.encode()
    found["yaml"] = f"!!python/object/apply:os.mkdir ['{sentinel}']".encode()
    found["json"] = json.dumps({"py/reduce": [{"py/function": "os.mkdir"}, {"py/tuple": [str(sentinel)]}]}).encode()
    found["sb3"] = json.dumps({":type:": "x", ":serialized:": base64.b64encode(found["pickle 4"]).decode()}).encode()
    return found


def test_the_payloads_run_code_where_they_are_trusted(tmp_path: Path) -> None:
    """Otherwise the tests below would prove nothing."""
    sentinel = tmp_path / "sentinel"
    found = corpus(sentinel)
    for name in ("pickle 0", "pickle 5", "in a dict", "python"):
        eval(found[name]) if name == "python" else pickle.loads(found[name])
        assert sentinel.is_dir()
        sentinel.rmdir()
    np.load(io.BytesIO(found["npy"]), allow_pickle=True)
    assert sentinel.is_dir()


def test_no_file_runs_code(saved: Path, tmp_path: Path) -> None:
    sentinel = tmp_path / "sentinel"
    for name, data in corpus(sentinel).items():
        for file in ("manifest.json", "policy.safetensors"):
            folder = Path(shutil.copytree(saved, tmp_path / "hostile"))
            (folder / file).write_bytes(data)
            for resealed in (False, True):
                if resealed and file == "policy.safetensors":
                    exchange_weights(folder, data)
                with pytest.raises(CheckpointError):
                    checkpoint.load(folder)
                assert not sentinel.exists(), (name, file)
            shutil.rmtree(folder)
    for name, data in corpus(sentinel).items():
        for file in ("policy.pkl", "vecnormalize.pkl", "policy.pth", "__init__.py", "sitecustomize.py", "policy.zip"):
            (saved / file).write_bytes(data)
        checkpoint.load(saved)
        assert not sentinel.exists(), name


def test_no_field_runs_code(saved: Path, tmp_path: Path) -> None:
    """A payload in any field or name is refused, or kept as plain text."""
    sentinel = tmp_path / "sentinel"
    value = content(saved)
    found = [path for path in leaves(value) if path and path[0] != "sha256"]
    texts = [base64.b64encode(data).decode() for data in corpus(sentinel).values()]
    texts += [data.decode("latin-1") for data in corpus(sentinel).values()]
    texts += [
        f"${{{texts[0]}}}",
        f"file://{sentinel}",
        "os.mkdir",
        f"$(mkdir {sentinel})",
        f"{{0.__class__}}{sentinel}",
    ]
    refused = kept = 0
    for k, path in enumerate(each for each in found if SOAK or not isinstance(each[-1], int) or each[-1] < 2):
        for text in texts if SOAK else [texts[(k + j) % len(texts)] for j in range(3)]:
            for new in (put(value, path, text), put(value, path, {text[:64]: text}), put(value, path, [text])):
                (saved / "manifest.json").write_bytes(sealed(new))
                try:
                    checkpoint.load(saved)
                    kept += 1
                except CheckpointError:
                    refused += 1
    assert not sentinel.exists()
    assert refused > kept
    (saved / "manifest.json").write_bytes(sealed(value))
    _, layers = checkpoint._read(saved)
    for text in texts:
        exchange_weights(saved, serialised({text: layers[0][0][0]}))
        with pytest.raises(CheckpointError):
            checkpoint.load(saved)
    assert not sentinel.exists()


def test_keywords_from_the_file_open_nothing(saved: Path, tmp_path: Path) -> None:
    """Keywords with paths and cells come from the caller alone."""
    pipe = tmp_path / "lab.toml"
    os.mkfifo(pipe)  # reading it would never end
    for name, new in (
        ("cell", str(pipe)),
        ("record", str(tmp_path / "new")),
        ("confirm", True),
        ("task", "x"),
        ("arm", "left"),
    ):
        edit(saved, lambda value, name=name, new=new: value["signature"].update(kwargs={name: new}))
        with pytest.raises(CheckpointError, match="unknown"):
            checkpoint.load(saved)
    assert sorted(os.listdir(tmp_path)) == ["copy", "lab.toml"]
    assert stat.S_ISFIFO(pipe.stat().st_mode)
    for kwargs in (
        {"amplitude_m": "x"},
        {"amplitude_m": -1},
        {"amplitude_m": [1]},
        {"randomization": "x"},
        {"center_m": {}},
    ):
        edit(saved, lambda value, kwargs=kwargs: value["signature"].update(kwargs=kwargs))
        with pytest.raises(CheckpointError):
            checkpoint.load(saved)


# Another environment.


@pytest.mark.parametrize(
    ("env_id", "keywords", "message"),
    [
        (CARRY, {}, "is of DualUR10/SineTracking-v0"),
        (SINE, {"policy_rate_hz": 12.5}, "period_ticks 5, the environment has 10: set policy_rate_hz"),
        (SINE, {"action_latency_ticks": 0}, "latency_ticks 5, the environment has 0: set action_latency_ticks"),
        (SINE, {"action_mode": "joint_position"}, "actions.mode 'joint_delta', the environment has 'joint_position'"),
        (SINE, {"compensate_lag": False}, "compensate_lag True, the environment has False"),
        (SINE, {"cell": dual_ur10.CellConfig(speed_rad_s=0.9)}, "joint_step_rad"),
        (SINE, {"cell": dual_ur10.CellConfig(servoj=dual_ur10.ServojProfile(lookahead_s=0.05))}, "lookahead_s"),
        (SINE, {"cell": dual_ur10.CellConfig(servoj=dual_ur10.ServojProfile(gain=1500))}, "gain"),
        (SINE, {"cell": dual_ur10.CellConfig(servoj=dual_ur10.ServojProfile("e-series"))}, "tick_s 0.008"),
    ],
)
def test_a_checkpoint_of_another_environment(saved: Path, env_id: str, keywords: dict[str, Any], message: str) -> None:
    keywords = {"action_latency_ticks": 5, **keywords}
    with pytest.raises(CheckpointError, match=message):
        policies.load(saved, env_id, **keywords)
    if "policy_rate_hz" not in keywords:
        env = gym.make(env_id, **keywords)
        with pytest.raises(CheckpointError):
            checkpoint.load(saved, env)
        env.close()


def test_illegal_keywords_are_refused(saved: Path) -> None:
    with pytest.raises(UnknownNameError, match="colour"):
        policies.load(saved, SINE, colour="red")
    with pytest.raises(SettingsError):
        policies.load(saved, SINE, policy_rate_hz=33.0)
    with pytest.raises(UnknownNameError):
        policies.load(saved, "DualUR10/Juggling-v0")


@pytest.mark.parametrize("version", ["0.2.0", "1.1.0", "0.10.0", "9.9"])
def test_a_checkpoint_of_another_version(version: str, saved: Path) -> None:
    edit(saved, lambda value: value["versions"].update(dual_ur10=version))
    with pytest.raises(CheckpointError, match=f"made with dual_ur10 {version}, this is {dual_ur10.__version__}"):
        checkpoint.load(saved)
    edit(saved, lambda value: value["versions"].update(dual_ur10=f"{dual_ur10.__version__.rpartition('.')[0]}.99"))
    checkpoint.load(saved)


@pytest.mark.parametrize(
    ("path", "new"),
    [
        (("env_id",), HANDOVER),
        (("env_id",), "CartPole-v1"),
        (("rate", "tick_s"), 0.002),
        (("rate", "period_ticks"), 4),
        (("rate", "latency_ticks"), 4),
        (("actions", "mode"), "tcp_delta"),
        (("actions", "gripper"), True),
        (("actions", "compensate_lag"), False),
        (("actions", "joint_step_rad", 3), 0.05),
        (("actions", "joint_step_rad"), []),
        (("robot", "model"), "UR5"),
        (("robot", "family"), "e-series"),
        (("robot", "lookahead_s"), 0.04),
        (("robot", "gain"), 1999.0),
        (("observation", "low", 5), -6.4),
        (("observation", "high", 5), 6.4),
        (("observation", "dtype"), "float32"),
        (("observation", "shape", 0), 66),
        (("action", "low", 11), -0.9),
        (("action", "high", 0), 0.9),
        (("action", "dtype"), "float64"),
    ],
)
def test_a_false_signature_is_refused(path: tuple[Any, ...], new: Any, saved: Path) -> None:
    """Every single wrong value is refused, although all others are right."""
    (saved / "manifest.json").write_bytes(sealed(put(content(saved), ("signature", *path), new)))
    with pytest.raises(CheckpointError):
        policies.load(saved, SINE, action_latency_ticks=5, amplitude_m=0.08)
    if path[-1] not in ("lookahead_s", "gain"):  # of which an environment of its own can be made
        with pytest.raises(CheckpointError):
            checkpoint.load(saved)


def test_the_networks_of_two_agents_must_fit_their_observations(tmp_path: Path) -> None:
    networks, made = parts(SINE, "shared")
    checkpoint.save(tmp_path / "x", networks, made)
    edit(tmp_path / "x", lambda value: value["network"].update(layers=[40, 4, 6]))
    edit(tmp_path / "x", lambda value: value.update(normalisers=[]))
    exchange_weights(
        tmp_path / "x",
        serialised(
            {
                "policy.0.weight": np.zeros((4, 40), np.float32),
                "policy.0.bias": np.zeros(4, np.float32),
                "policy.1.weight": np.zeros((6, 4), np.float32),
                "policy.1.bias": np.zeros(6, np.float32),
            }
        ),
    )
    with pytest.raises(CheckpointError, match="each agent observes 41"):
        checkpoint.load(tmp_path / "x")


def test_differences_without_effect_are_warnings(saved: Path, caplog: pytest.LogCaptureFixture) -> None:
    with caplog.at_level(logging.WARNING):
        policies.load(saved, SINE, action_latency_ticks=5, amplitude_m=0.08, randomization="mild")
        assert not caplog.records
        policies.load(saved, SINE, action_latency_ticks=5)
    assert "amplitude_m" in caplog.text
    caplog.clear()
    mount = dual_ur10.CellConfig().left
    off = dataclasses.replace(mount.dh, theta_rad=(1e-3, 0.0, 0.0, 0.0, 0.0, 0.0))
    policies.load(
        saved,
        SINE,
        action_latency_ticks=5,
        amplitude_m=0.08,
        cell=dual_ur10.CellConfig(left=dataclasses.replace(mount, dh=off)),
    )
    assert "calibrated" in caplog.text


def test_a_checkpoint_of_another_family_loads_without_keywords(tmp_path: Path) -> None:
    profile = dual_ur10.ServojProfile("e-series", gain=1800.0)
    networks, made = parts(HANDOVER, "shared", cell=dual_ur10.CellConfig(servoj=profile), action_latency_ticks=20)
    checkpoint.save(tmp_path / "x", networks, made)
    assert checkpoint.load(tmp_path / "x").manifest.signature.robot.gain == 1800.0
