"""The commands `train` and `collect`."""

from __future__ import annotations

import os
import re
import signal
import time

import pytest
from typer.testing import CliRunner

from dual_ur10.cli.main import app
from tests import scripts

SMALL = ("--envs", "2", "--set", "duration_s=0.4", "--hyperparameter", "hidden=[8]", "--hyperparameter", "fit_steps=5")
ROUND = 20  # steps of two episodes


def run(*arguments):
    return CliRunner().invoke(app, [str(each) for each in arguments])


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ((), "name an environment"),
        (("Lift",), "unknown environment"),
        (("SineTracking", "--algo", "td3"), "unknown algorithm 'td3': use one of 'ppo', 'sac', 'bc', 'dagger', 'act'"),
        (("SineTracking", "--agents", "both"), "unknown agents"),
        (("SineTracking", "--hyperparameter", "rounds=2"), "unknown hyperparameter of dagger 'rounds'"),
        (("SineTracking", "--hyperparameter", "hidden=many"), "hidden is 'many'"),
        (("SineTracking", "--hyperparameter", "unseen=[3]"), "unseen[0] is 3"),
        (("SineTracking", "--set", "speed=2"), "speed"),
        (("SineTracking", "--resume", "x"), "leave out ENV."),
        (("--resume", "x", "--seed", 5, "--steps", 9, "--set", "a=1"), "leave out --seed, --set. Only --steps and"),
        (("--resume", "no_such_folder"), "is no folder of a training"),
        (("SineTracking", "--algo", "ppo", "--dataset", "a/b-v0"), "learns from no dataset"),
        (("SineTracking", "--operator", "keyboard"), "there is none to begin with: name a checkpoint with --init, or"),
        (("SineTracking", "--operator", "keyboard", "--dataset", "a/b-v0", "--envs", 4), "one person leads one cell"),
        (("SineTracking", "--operator", "keyboard", "--init", "x", "--algo", "ppo"), "ppo learns from no operator"),
        (("SineTracking", "--operator", "keyboard", "--dataset", "a/b-v0", "--algo", "bc"), "collect --operator makes"),
        (("SineTracking", "--operator", "mouse", "--init", "x"), "unknown operator 'mouse'"),
        (("SineTracking", "--operator", "keyboard", "--init", "x", "--set", "cell=echo"), "training is in simulation"),
    ],
)
def test_a_bad_argument_is_one_line(arguments, message, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    result = run("train", *arguments)
    assert result.exit_code == 2
    assert message in result.stderr
    assert result.stderr.startswith("error:")
    assert result.stdout == ""
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (("--init", "nowhere"), "nowhere cannot be read"),
        (("--hyperparameter", "hidden=[2100,2100]"), "hidden is (2100, 2100): the network has 4"),
    ],
)
def test_a_bad_setting_is_refused_before_a_folder_is_made(arguments, message, tmp_path, monkeypatch):
    pytest.importorskip("stable_baselines3")
    monkeypatch.chdir(tmp_path)
    result = run("train", "SineTracking", *arguments)
    assert result.exit_code == 2
    assert result.stdout == ""
    assert message in result.stderr
    assert not list(tmp_path.iterdir())


def test_a_training_prints_its_result_and_the_policy_runs(tmp_path):
    pytest.importorskip("stable_baselines3")
    out = tmp_path / "out"
    result = run("train", "SineTracking", *SMALL, "--steps", ROUND, "--out", out)
    assert result.exit_code == 0, result.output
    assert re.search(r"^training in .*\n\d+ of \d+, ", result.stdout), result.stdout  # without waiting half a minute
    assert f"policy  {out / 'policy'}" in result.stdout
    assert "95 % interval" in result.stdout
    shown = run(
        "rollout", "SineTracking", "--policy", out / "policy", "-n", 1, "--no-record", "--set", "duration_s=0.4",
    )  # fmt: skip
    assert shown.exit_code == 0, shown.output
    latency = ("--set", "action_latency_ticks=4")
    other = run("rollout", "SineTracking", "--policy", out / "policy", "-n", 1, "--no-record", *latency)
    assert other.exit_code == 2
    assert "latency_ticks" in other.stderr
    again = run("train", "SineTracking", *SMALL, "--steps", ROUND, "--out", out)
    assert again.exit_code == 2
    assert "not empty" in again.stderr


def test_collect_makes_a_dataset(tmp_path, monkeypatch):
    minari = pytest.importorskip("minari")
    monkeypatch.setenv("MINARI_DATASETS_PATH", str(tmp_path))
    arguments = ("SineTracking", "-n", 2, "--envs", 2, "--set", "duration_s=2.0", "--randomization", "mild")
    result = run("collect", *arguments)
    assert result.exit_code == 0, result.output
    assert "2 episodes, 2 of them successful, 100 steps" in result.stdout
    dataset = minari.load_dataset("dual-ur10/sinetracking/scripted-v0")
    assert dataset.total_episodes == 2
    assert run("collect", *arguments).exit_code == 2


def test_ctrl_c_saves_and_prints_the_command_to_resume(tmp_path):
    pytest.importorskip("stable_baselines3")
    out = tmp_path / "out"
    script = tmp_path / "train.py"
    script.write_text("import runpy\nrunpy.run_module('dual_ur10', run_name='__main__')\n")
    arguments = ["train", "SineTracking", *SMALL, "--out", str(out), "--steps", "1000000"]
    process = scripts.start(script, *arguments, folder=tmp_path, output=tmp_path / "output", COLUMNS="200")
    try:
        end = time.monotonic() + 120.0
        while not (out / "samples-0001.safetensors").exists():
            assert process.is_alive()
            assert time.monotonic() < end
            time.sleep(0.05)
        for _ in range(2):  # as a person would: Python drops an interrupt that comes in a destructor
            os.kill(process.pid, signal.SIGINT)
            process.join(60.0)
            if not process.is_alive():
                break
    finally:
        process.kill()
        process.join()
    text = (tmp_path / "output").read_text()
    assert process.exitcode == 130, text
    assert f"dual-ur10 train --resume {out}" in text
    assert "Traceback" not in text
    rounds = len(list(out.glob("samples-*.safetensors")))
    result = run("train", "--resume", out, "--steps", ROUND * (rounds + 1))
    assert result.exit_code == 0, result.output
    assert (out / "policy" / "manifest.json").exists()
    assert len(list(out.glob("samples-*.safetensors"))) == rounds + 1
