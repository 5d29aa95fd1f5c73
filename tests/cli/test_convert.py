"""The command `convert`, and what is expected of files in place of checkpoints."""

from __future__ import annotations

import base64
import io
import json
import os
import pickle
import shlex
import sys
import zipfile
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from typer.testing import CliRunner

import dual_ur10
from dual_ur10 import policies
from dual_ur10.cli.main import app
from dual_ur10.errors import CheckpointError, SettingsError, UnknownNameError
from dual_ur10.policies.learned import checkpoint, from_sb3
from dual_ur10.policies.learned.from_sb3 import inspect_model
from dual_ur10.policies.learned.learned_policy import LearnedPolicy

SINE, CARRY = dual_ur10.ENV_IDS[:2]
LATENCY = ("--set", "action_latency_ticks=5")


def run(*arguments: object) -> Any:
    return CliRunner().invoke(app, [str(each) for each in arguments])


def refused(result: Any, expected: str) -> None:
    """Check for an error of one line with this message, and no traceback."""
    assert result.exit_code == 2, result.output
    assert isinstance(result.exception, SystemExit)
    assert result.stderr.startswith("error:")
    assert result.stderr.count("\n") == 1
    assert expected in result.stderr


class Payload:
    """Makes a folder when it is unpickled."""

    def __init__(self, sentinel: Path) -> None:
        self.sentinel = sentinel

    def __reduce__(self) -> tuple[Any, ...]:
        return os.mkdir, (str(self.sentinel),)


def hostile(sentinel: Path, data: bytes | None = None) -> bytes:
    """Return a file of Stable-Baselines3 with the payload wherever it unpickles; `data` replaces its JSON."""
    payload = pickle.dumps(Payload(sentinel))
    item = {":type:": "<class 'x'>", ":serialized:": base64.b64encode(payload).decode()}
    good = dict.fromkeys(("policy_class", "action_space", "clip_range", "policy_kwargs", "lr_schedule"), item)
    content = json.dumps({**good, "observation_space": {**item, "_shape": [94]}}).encode() if data is None else data
    archive = io.BytesIO()
    with zipfile.ZipFile(archive, "w") as zipped:
        zipped.writestr("data", content)
        for name in ("policy.pth", "pytorch_variables.pth", "policy.optimizer.pth"):
            zipped.writestr(name, payload)
        zipped.writestr("_stable_baselines3_version", "2.9.2")
    return archive.getvalue()


def zipped(**members: str) -> bytes:
    archive = io.BytesIO()
    with zipfile.ZipFile(archive, "w", zipfile.ZIP_DEFLATED) as made:
        for name, content in members.items():
            made.writestr(name, content)
    return archive.getvalue()


def described(**more: Any) -> str:
    return json.dumps({"policy_class": {}, "observation_space": {"_shape": [94]}, **more})


# Models.


@pytest.fixture(scope="module")
def sb3() -> Any:
    pytest.importorskip("torch")
    return pytest.importorskip("stable_baselines3")


@pytest.fixture
def made(sb3: Any) -> Any:
    from tests.policies.learned.test_from_sb3 import model_of

    return model_of


@pytest.mark.parametrize("algorithm", ["ppo", "sac"])
@pytest.mark.parametrize("named", [False, True])
@pytest.mark.parametrize(("agents", "inputs", "outputs"), [("joint", 94, 12), ("shared", 47, 6)])
def test_the_checkpoint_acts_as_the_model_does(
    algorithm: str, named: bool, agents: str, inputs: int, outputs: int, made: Any, tmp_path: Path
) -> None:
    model = made(algorithm, inputs, outputs)
    model.save(tmp_path / "model.zip")
    before = (tmp_path / "model.zip").read_bytes()
    options = ("--algo", algorithm, "--agents", agents) if named else ()
    out = tmp_path / "out"
    result = run("convert", tmp_path / "model.zip", "SineTracking", "--out", out, "--trust-pickle", *LATENCY, *options)
    assert result.exit_code == 0, result.output
    policy = policies.load(out, SINE, action_latency_ticks=5)
    assert isinstance(policy, LearnedPolicy)
    assert policy.manifest.agents == agents
    assert sorted(os.listdir(out)) == ["manifest.json", "policy.safetensors"]
    assert sorted(os.listdir(tmp_path)) == ["model.zip", "out"]
    assert (tmp_path / "model.zip").read_bytes() == before
    for line in (
        f"model   {tmp_path / 'model.zip'}: {algorithm}, {agents}",
        f"policy  {out}",
        f"sha256  {policy.sha256}",
        f"dual-ur10 evaluate SineTracking --policy {out} --set action_latency_ticks=5",
    ):
        assert line in result.stdout
    own = np.random.default_rng(0).normal(size=(50, inputs)) * 2
    expected = model.predict(own, deterministic=True)[0]
    assert np.abs(expected).max() > 0.5
    actor = policy if agents == "joint" else policy.agent("right")
    np.testing.assert_allclose(actor(own), expected, atol=1e-5)


def test_the_printed_command_runs(made: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Also where the folder has the name of a policy."""
    monkeypatch.chdir(tmp_path)
    made("ppo").save("model.zip")
    settings = (*LATENCY, "--set", "duration_s=0.4")
    result = run("convert", "model.zip", "SineTracking", "--out", "learned", "--trust-pickle", *settings)
    assert result.exit_code == 0, result.output
    words = shlex.split(result.stdout.split("dual-ur10 ")[1])
    assert words[:4] == ["evaluate", "SineTracking", "--policy", "./learned"]
    shown = run(*words, "-n", "1", "--envs", "1")
    assert shown.exit_code == 0, shown.output


def test_a_normaliser_that_does_not_fit_is_refused(made: Any, tmp_path: Path) -> None:
    """Its numbers are those of tests/policies/learned/test_from_sb3.py."""
    from stable_baselines3.common.vec_env import DummyVecEnv, VecNormalize

    from tests.policies.learned.test_from_sb3 import Spaces

    around: Any = VecNormalize(DummyVecEnv([lambda: Spaces(94, 12)]))
    around.save(str(tmp_path / "around.pkl"))
    made("sac").save(tmp_path / "model.zip")
    arguments = ("convert", tmp_path / "model.zip", "SineTracking", "--trust-pickle", *LATENCY, "--out")
    result = run(*arguments, tmp_path / "out", "--vec-normalize", tmp_path / "around.pkl")
    assert result.exit_code == 0, result.output
    assert checkpoint.read_manifest(tmp_path / "out").normalisers
    (tmp_path / "other.pkl").write_bytes(pickle.dumps({"norm_obs": True}))
    (tmp_path / "damaged.pkl").write_bytes((tmp_path / "around.pkl").read_bytes()[:100])
    small: Any = VecNormalize(DummyVecEnv([lambda: Spaces(47, 6)]))
    small.save(str(tmp_path / "small.pkl"))
    small.obs_rms.mean = small.obs_rms.var = np.ones((94, 2))
    small.save(str(tmp_path / "image.pkl"))
    for name, expected in (
        ("none.pkl", "none.pkl cannot be read: there is no such file"),
        ("other.pkl", "other.pkl holds dict, and no VecNormalize"),
        ("damaged.pkl", "damaged.pkl cannot be read"),
        ("image.pkl", "or of images: observation must be 'state'"),
        ("small.pkl", "a normaliser has 47 means for 94 inputs"),
    ):
        refused(run(*arguments, tmp_path / "new", "--vec-normalize", tmp_path / name), expected)
        assert not (tmp_path / "new").exists()


@pytest.mark.parametrize(
    ("algorithm", "sizes", "env", "options", "expected"),
    [
        ("ppo", (170, 14), "SineTracking", (), "observes 170 numbers; in DualUR10/SineTracking-v0"),
        ("sac", (94, 12), "SyncCarry", (), "observes 94 numbers; in DualUR10/SyncCarry-v0 both arms together (joint)"),
        ("ppo", (94, 12), "SineTracking", ("--agents", "shared"), "(shared) 47: name the environment"),
        ("ppo", (47, 6), "SineTracking", ("--agents", "joint"), "observes 47 numbers"),
        ("ppo", (94, 11), "SineTracking", (), "the network has 11 outputs"),
        ("ppo", (47, 7), "SineTracking", (), "the network has 7 outputs"),
        ("ppo", (94, 12), "SineTracking", ("--algo", "sac"), "is a model of ppo, but --algo is sac"),
        ("sac", (94, 12), "SineTracking", ("--algo", "ppo"), "is a model of sac, but --algo is ppo"),
    ],
)
def test_a_model_of_another_environment(
    algorithm: str, sizes: tuple[int, int], env: str, options: Any, expected: str, made: Any, tmp_path: Path
) -> None:
    made(algorithm, *sizes).save(tmp_path / "model.zip")
    refused(run("convert", tmp_path / "model.zip", env, "--out", tmp_path / "x", "--trust-pickle", *options), expected)
    assert os.listdir(tmp_path) == ["model.zip"]


def test_a_file_with_a_false_observation_size(made: Any, tmp_path: Path) -> None:
    """The network decides, not the size in the file."""
    made("ppo", 50, 6).save(tmp_path / "true.zip")
    for size, expected in ((94, "the network has 6 outputs: joint"), (47, "the network has 50 inputs")):
        with zipfile.ZipFile(tmp_path / "true.zip") as old, zipfile.ZipFile(tmp_path / "lie.zip", "w") as new:
            for name in old.namelist():
                data = old.read(name)
                if name == "data":
                    value = json.loads(data)
                    value["observation_space"]["_shape"] = [size]
                    data = json.dumps(value).encode()
                new.writestr(name, data)
        out = tmp_path / "x"
        refused(run("convert", tmp_path / "lie.zip", "SineTracking", "--out", out, "--trust-pickle"), expected)
        assert not out.exists()


@pytest.mark.parametrize("kind", ["TD3", "A2C"])
def test_models_of_other_algorithms(kind: str, sb3: Any, tmp_path: Path) -> None:
    from tests.policies.learned.test_from_sb3 import Spaces

    own: dict[str, Any] = {"buffer_size": 10} if kind == "TD3" else {}
    getattr(sb3, kind)("MlpPolicy", Spaces(94, 12), device="cpu", **own).save(tmp_path / "model.zip")
    assert inspect_model(tmp_path / "model.zip") == (None, 94)
    arguments = ("convert", tmp_path / "model.zip", "SineTracking", "--out", tmp_path / "x", "--trust-pickle")
    refused(run(*arguments), "does not specify PPO or SAC")
    assert not (tmp_path / "x").exists()


def test_truncated_anywhere(made: Any, tmp_path: Path) -> None:
    made("ppo").save(tmp_path / "model.zip")
    data = (tmp_path / "model.zip").read_bytes()
    arguments = ("convert", tmp_path / "model.zip", "SineTracking", "--out", tmp_path / "x", "--trust-pickle")
    for length in (0, 1, 100, len(data) // 2, len(data) - 30, len(data) - 1):
        (tmp_path / "model.zip").write_bytes(data[:length])
        # A model has zips in it: half of one may end with a whole one.
        refused(run(*arguments), "is no file of Stable-Baselines3, or is damaged")
    (tmp_path / "model.zip").write_bytes(data[1000:])
    refused(run(*arguments), "is damaged")
    middle = data.index(b"policy.pth") + 2000
    (tmp_path / "model.zip").write_bytes(data[:middle] + bytes(500) + data[middle + 500 :])
    refused(run(*arguments), "model.zip cannot be read")
    assert os.listdir(tmp_path) == ["model.zip"]


# No code is run that is not trusted.


def test_the_hostile_file_runs_its_code_when_unpickled(sb3: Any, tmp_path: Path) -> None:
    """Check the premise of the tests below: with trust, the code of the file runs."""
    (tmp_path / "x.zip").write_bytes(hostile(tmp_path / "sentinel"))
    arguments = ("convert", tmp_path / "x.zip", "SineTracking", "--out", tmp_path / "out", "--trust-pickle")
    refused(run(*arguments), "cannot be read")
    assert (tmp_path / "sentinel").is_dir()
    assert not (tmp_path / "out").exists()


def test_nothing_is_unpickled_without_trust(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    sentinel = tmp_path / "sentinel"
    model, around, out = tmp_path / "x.zip", tmp_path / "x.pkl", tmp_path / "out"
    around.write_bytes(pickle.dumps(Payload(sentinel)))
    unpickled: list[object] = []

    def seen(*arguments: object, **_: object) -> None:
        unpickled.append(arguments)

    for name in ("load", "loads", "Unpickler"):
        monkeypatch.setattr(pickle, name, seen)
    model.write_bytes(hostile(sentinel))
    for options in ((), ("--algo", "ppo"), ("--agents", "joint"), ("--vec-normalize", around)):
        refused(run("convert", model, "SineTracking", "--out", out, *options), "--trust-pickle")
    assert inspect_model(model) == ("ppo", 94)
    for data in (around.read_bytes(), b"\x80\x04", json.dumps({"py/reduce": [{"py/function": "os.mkdir"}]}).encode()):
        model.write_bytes(hostile(sentinel, data))
        for trusted in ((), ("--trust-pickle",), ("--algo", "ppo", "--trust-pickle")):
            refused(run("convert", model, "SineTracking", "--out", out, *trusted), "is no file of Stable-Baselines3")
    for command in ("rollout", "evaluate", "view"):
        model.write_bytes(hostile(sentinel))
        more = ("--no-record",) if command == "rollout" else ()
        refused(run(command, "SineTracking", "--policy", model, *more), "--trust-pickle")
    assert not unpickled
    assert not sentinel.exists()
    assert sorted(os.listdir(tmp_path)) == ["x.pkl", "x.zip"]


def test_no_code_runs_before_the_arguments_are_checked(sb3: Any, tmp_path: Path) -> None:
    """Whatever can be refused without the file's code is refused before that runs."""
    sentinel, model, out = tmp_path / "sentinel", tmp_path / "x.zip", tmp_path / "out"
    model.write_bytes(hostile(sentinel))
    (tmp_path / "there").mkdir()
    for arguments, expected in (
        (("SineTracking", "--out", tmp_path / "there"), "exists, and nothing is overwritten"),
        (("SineTracking", "--out", tmp_path / "a b"), "is no name of a checkpoint"),
        (("SyncCarry", "--out", out), "observes 94 numbers"),
        (("SineTracking", "--out", out, "--algo", "sac"), "is a model of ppo"),
        (("SineTracking", "--out", out, "--algo", "dqn"), "unknown algorithm 'dqn': use one of 'ppo', 'sac'"),
        (("SineTracking", "--out", out, "--agents", "independent"), "unknown agents 'independent': use one of 'joint'"),
        (
            ("SineTracking", "--out", out, "--set", "colour=red"),
            "unexpected keyword argument 'colour'",
        ),
        (("SineTracking", "--out", out, "--set", "path=x"), "unexpected keyword argument 'path'"),
        (("SineTracking", "--out", out, "--set", "amplitude_m=much"), "amplitude_m is 'much'"),
        (("SineTracking", "--out", out, "--set", "center_m=7"), "center_m"),
        (("SineTracking", "--out", out, "--set", "action_latency_ticks=x"), "action_latency_ticks is 'x'"),
        (("SineTracking", "--out", out, "--set", "action_latency_ticks=1e400"), "action_latency_ticks is inf"),
        (("SineTracking", "--out", out, "--set", "policy_rate_hz=x"), "policy rate is 'x'"),
        (("SineTracking", "--out", out, "--set", "policy_rate_hz=1e400"), "policy rate is inf"),
        (("SineTracking", "--out", out, "--vec-normalize", tmp_path / "none"), "none cannot be read"),
        (("Juggling", "--out", out), "unknown environment 'Juggling'"),
    ):
        refused(run("convert", model, *arguments, "--trust-pickle"), expected)
        assert not sentinel.exists(), arguments
    assert sorted(os.listdir(tmp_path)) == ["there", "x.zip"]
    assert not os.listdir(tmp_path / "there")


def test_nothing_is_overwritten(made: Any, tmp_path: Path) -> None:
    made("ppo").save(tmp_path / "model.zip")
    arguments = ("convert", tmp_path / "model.zip", "SineTracking", "--out", tmp_path / "x", "--trust-pickle")
    assert run(*arguments).exit_code == 0
    before = {path.name: path.read_bytes() for path in (tmp_path / "x").iterdir()}
    refused(run(*arguments), "exists, and nothing is overwritten")
    refused(run(*arguments[:4], tmp_path / "model.zip", "--trust-pickle"), "exists, and nothing is overwritten")
    assert {path.name: path.read_bytes() for path in (tmp_path / "x").iterdir()} == before


def test_it_needs_stable_baselines3(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "stable_baselines3", None)
    (tmp_path / "x.zip").write_bytes(hostile(tmp_path / "sentinel"))
    arguments = ("convert", tmp_path / "x.zip", "SineTracking", "--out", tmp_path / "out", "--trust-pickle")
    refused(run(*arguments), 'pip install "dual-ur10[train]"')
    assert os.listdir(tmp_path) == ["x.zip"]


# Files that are no models.


@pytest.mark.parametrize(
    ("content", "expected"),
    [
        (None, "there is no such file"),
        (b"", "is no zip file"),
        (b"PK", "is no zip file"),
        (b"text\n" * 100, "is no zip file"),
        (zipped(), "There is no item named 'data'"),
        (zipped(readme="hello"), "There is no item named 'data'"),
        (zipped(data="hello"), "JSONDecodeError"),
        (zipped(data="\udcff".encode("utf-8", "surrogatepass").decode("latin-1")), "is no file of Stable-Baselines3"),
        (zipped(data="[" * 100_000), "is no file of Stable-Baselines3"),
        (zipped(data="null"), "describes no model"),
        (zipped(data="[1]"), "describes no model"),
        (zipped(data='{"clip_range": 1}'), "describes no model"),
        (zipped(data=described()), "does not specify PPO or SAC"),
        (zipped(data=described(clip_range=1, target_entropy=1)), "does not specify PPO or SAC"),
        (zipped(data=described(clip_range=1, observation_space={"_shape": [10**30]})), "observes 1000000000"),
    ],
)
def test_a_file_that_is_no_model(content: bytes | None, expected: str, tmp_path: Path) -> None:
    model = tmp_path / "model.zip"
    if content is not None:
        model.write_bytes(content)
    for trust in ((), ("--trust-pickle",)):
        refused(run("convert", model, "SineTracking", "--out", tmp_path / "x", *trust), expected)
    assert not (tmp_path / "x").exists()


def test_a_file_that_is_not_regular(tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "pipe")  # opening it would wait for a writer
    for model in (tmp_path, tmp_path / "pipe", "/dev/null"):
        refused(run("convert", model, "SineTracking", "--out", tmp_path / "x", "--trust-pickle"), "no such file")


@pytest.mark.parametrize("space", [None, [94], {}, {"_shape": None}, {"_shape": [3, 4]}, {"_shape": [True]}])
def test_a_model_without_an_observation_space(space: Any, tmp_path: Path) -> None:
    (tmp_path / "x.zip").write_bytes(zipped(data=described(target_entropy=-12.0, observation_space=space)))
    assert inspect_model(tmp_path / "x.zip") == ("sac", None)
    result = run("convert", tmp_path / "x.zip", "SineTracking", "--out", tmp_path / "x")
    refused(result, "--trust-pickle")


def test_large_data_are_not_read(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    text = described(clip_range=1)
    (tmp_path / "x.zip").write_bytes(zipped(data=text))
    monkeypatch.setattr(from_sb3, "_MOST_DATA", len(text))
    assert inspect_model(tmp_path / "x.zip") == ("ppo", 94)
    monkeypatch.setattr(from_sb3, "_MOST_DATA", 10)
    with pytest.raises(CheckpointError, match="no model needs so many"):
        inspect_model(tmp_path / "x.zip")


# What is expected of files in place of checkpoints.


def test_a_file_in_place_of_a_checkpoint(tmp_path: Path) -> None:
    (tmp_path / "text").write_text("hello")
    (tmp_path / "my model.zip").write_bytes(zipped(data="x"))
    (tmp_path / "link").symlink_to(tmp_path / "my model.zip")
    for name, model in (("text", False), ("my model.zip", True), ("link", True)):
        path = tmp_path / name
        quoted = f"'{path}'" if " " in name else path
        expected = f"`dual-ur10 convert {quoted} ENV --out FOLDER --trust-pickle` makes a checkpoint of it"
        messages = [
            " ".join(run(command, "SineTracking", "--policy", path, *more).stderr.split())
            for command, more in (("rollout", ("--no-record",)), ("evaluate", ()), ("view", ()))
        ]
        for arguments in ((path,), (str(path), SINE)):
            with pytest.raises(CheckpointError) as caught:
                policies.load(*arguments)
            messages.append(str(caught.value))
        for message in messages:
            assert f"{path} cannot be read as a checkpoint: it is a file. A checkpoint is a folder" in message
            assert (expected in message) == model
            assert ("if you know who made it" in message) == model
            assert "Errno" not in message
    for path in (tmp_path / "none", Path("/dev/null")):
        with pytest.raises(CheckpointError, match=r"Errno .* A checkpoint is a folder") as caught:
            policies.load(path)
        assert "convert" not in str(caught.value)


# Policies without an environment's id.


def test_a_checkpoint_stores_its_environment(tmp_path: Path) -> None:
    from tests.policies.learned.checkpoints import parts

    checkpoint.save(tmp_path / "x", *parts(CARRY, action_latency_ticks=5))
    observation = np.random.default_rng(0).normal(size=170)
    expected = policies.load(tmp_path / "x", CARRY, action_latency_ticks=5)(observation)
    for found in (policies.load(tmp_path / "x"), policies.load(str(tmp_path / "x"), action_latency_ticks=5)):
        assert found(observation).tobytes() == expected.tobytes()
    with pytest.raises(CheckpointError, match="latency_ticks 5, the environment has 4"):
        policies.load(tmp_path / "x", action_latency_ticks=4)
    with pytest.raises(CheckpointError, match="cannot be read"):
        policies.load(tmp_path / "none")


@pytest.mark.parametrize("name", policies.NAMES)
def test_a_name_needs_an_environment(name: str) -> None:
    with pytest.raises(SettingsError, match=f"policy '{name}' needs an environment: name one of {SINE}, {CARRY}"):
        policies.load(name)
    with pytest.raises(UnknownNameError, match="unknown policy 'psychic'"):
        policies.load("psychic")
