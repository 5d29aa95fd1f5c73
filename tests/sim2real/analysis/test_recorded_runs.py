"""What the records of rollouts, evaluations and replays say of themselves, and where they are."""

from __future__ import annotations

import hashlib
import json
import re
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from rich.console import Console

from dual_ur10.cli import options as cli_options
from dual_ur10.envs.core.core import Core
from dual_ur10.errors import CellFaulted, RecordingError, SettingsError, StartError
from dual_ur10.policies import evaluate
from dual_ur10.policies.registry import provenance, shipped_folder
from dual_ur10.sim2real.recording.reader import read_run
from dual_ur10.sim2real.recording.run import Run
from dual_ur10.sim2real.recording.run_folder import new_folder
from tests.cli.command import run
from tests.sim2real.recording.runs import header

SINE = "DualUR10/SineTracking-v0"
SHORT = ("--set", "duration_s=0.4")
CELL = "kind = 'emulated'\n[left]\nhost='127.0.0.2'\n[right]\nhost='127.0.0.3'\n"


@pytest.fixture(autouse=True)
def _somewhere_else(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)


def only_run(folder: str = "runs") -> Run:
    (found,) = Path(folder).iterdir()
    return read_run(found)


# Policy, hash, seed.


def test_a_rollout_records_policy_and_seed() -> None:
    assert run("rollout", "SineTracking", "-n", "2", "--seed", "41", *SHORT)[0] == 0
    made = only_run()
    assert (made.header.policy, made.header.policy_sha256, made.header.seed) == ("scripted", None, 41)
    assert [each.seed for each in made.episodes] == [41, 42]
    assert "record_about" not in made.header.kwargs


def test_a_checkpoint_is_identified_by_the_hash_of_its_manifest() -> None:
    more = ("--set", "action_latency_ticks=5", *SHORT)
    assert run("rollout", "SineTracking", "-p", "learned", "-n", "1", *more)[0] == 0
    folder = shipped_folder("learned", SINE)
    manifest = (folder / "manifest.json").read_bytes()
    made = only_run()
    assert made.header.policy == "learned"
    assert made.header.policy_sha256 == hashlib.sha256(manifest).hexdigest()
    assert (
        json.loads(manifest)["weights_sha256"]
        == hashlib.sha256((folder / "policy.safetensors").read_bytes()).hexdigest()
    )
    assert provenance(str(folder), SINE) == {"policy": str(folder), "policy_sha256": made.header.policy_sha256}
    assert provenance("zero", SINE) == {"policy": "zero"}


def test_a_replay_records_its_source() -> None:
    assert run("rollout", "SineTracking", "-n", "2", "--seed", "5", *SHORT)[0] == 0
    (first,) = Path("runs").iterdir()
    code, text = run("replay", str(first), "--episode", "1", "--record", "again")
    assert code == 0, text
    made = only_run("again")
    digest = hashlib.sha256((first / "run.mcap").read_bytes()).hexdigest()
    assert made.header.extra["replays"] == {"run": first.name, "sha256": digest, "episode": 1}
    assert made.header.policy == f"replay of {first.name}"


@pytest.mark.parametrize("value", ["scripted", {"policy": 3}, {3: "x"}, {"policy_sha256": b"x"}])
def test_values_that_json_cannot_hold_are_refused(value: Any) -> None:
    with pytest.raises(SettingsError, match="record_about"):
        gym.make(SINE, record_about=value)


# evaluate.


def test_an_evaluation_in_simulation_is_recorded_on_request() -> None:
    assert run("evaluate", "SineTracking", "-n", "2", *SHORT)[0] == 0
    assert not Path("runs").exists()
    arguments = ("evaluate", "SineTracking", "-n", "3", "--seed", "8", *SHORT)
    assert run(*arguments, "--json", "plain.json")[0] == 0
    assert run(*arguments, "--json", "recorded.json", "--record", "here")[0] == 0
    made = only_run("here")
    assert [each.seed for each in made.episodes] == [8, 9, 10]
    assert (made.header.policy, made.header.seed) == ("scripted", 8)
    # What is recorded changes no result.
    assert Path("plain.json").read_text() == Path("recorded.json").read_text()


def test_an_evaluation_with_an_own_policy_records_its_class(tmp_path: Path) -> None:
    class Mine:
        def reset(self) -> None:
            """There is nothing to forget."""

        def __call__(self, observation: Any) -> Any:
            return np.zeros((1, 12), dtype=np.float32)

    keywords = {"record": str(tmp_path / "here"), "duration_s": 0.4}
    found = evaluate(SINE, Mine(), episodes=1, num_envs=1, env_kwargs=keywords)
    assert found.kwargs == {"duration_s": 0.4}
    assert only_run("here").header.policy == "Mine"


def test_options_that_do_not_go_together_are_refused() -> None:
    code, text = run("evaluate", "SineTracking", "--record", "here", "--no-record")
    assert (code, "--record and --no-record" in text) == (2, True)
    for command in (("evaluate", "SineTracking"), ("replay", "somewhere"), ("rollout", "SineTracking")):
        code, text = run(*command, "--arm", "left")
        assert code == 2
        assert "--arm is for two controllers: name their cell file with --cell" in text
    assert run("rollout", "SineTracking", "-n", "1", *SHORT)[0] == 0
    (made,) = Path("runs").iterdir()
    for command in (("evaluate", "SineTracking"), ("replay", str(made))):
        code, text = run(*command, "--power-on")
        assert code == 2
        assert "--power-on is for two controllers" in text
        assert len(list(Path("runs").iterdir())) == 1


@pytest.mark.parametrize("command", ["evaluate", "replay"])
def test_on_two_controllers_power_comes_first_and_no_bar_hides_a_question(
    command: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    Path("lab.toml").write_text(CELL)
    assert run("rollout", "SineTracking", "-n", "1", "--record", "before", *SHORT)[0] == 0
    (before,) = Path("before").iterdir()
    order: list[Any] = []

    class Asked(Exception):
        pass

    def act(*arguments: Any, **named: Any) -> None:
        keywords = named.get("env_kwargs") or named["keywords"]
        order.append((keywords["record"], keywords["arm"], named.get("num_envs", 1)))
        order.append(list(cli_options.console._live_stack))  # what is drawn again and again
        raise Asked

    monkeypatch.setattr("dual_ur10.policies.evaluation.evaluate.evaluate", act)
    monkeypatch.setattr("dual_ur10.sim2real.analysis.replay.replay", act)
    for module in ("evaluate", "records"):
        monkeypatch.setattr(f"dual_ur10.cli.{module}.power_on", order.append)
    monkeypatch.setattr(Console, "is_terminal", True)
    arguments = ("SineTracking",) if command == "evaluate" else (str(before),)
    with pytest.raises(Asked):
        run(command, *arguments, "--cell", "lab.toml", "--arm", "right", "--power-on")
    assert order == [Path("lab.toml"), ("runs", "right", 1), []]


# Events.


@pytest.mark.parametrize(("error", "kind"), [(StartError, "not begun"), (CellFaulted, "fault")])
def test_an_episode_that_could_not_begin_is_an_event(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, error: type[Exception], kind: str
) -> None:
    env = gym.make(SINE, record=str(tmp_path / "here"))
    core: Core = env.unwrapped.core  # type: ignore[attr-defined]  # Gymnasium knows only Env

    def refuse(*_: Any, **__: Any) -> None:
        raise error("nobody confirmed it")

    monkeypatch.setattr(core.cell, "reset", refuse)
    with pytest.raises(error):
        env.reset(seed=1)
    env.close()
    (event,) = only_run("here").events
    assert (event.kind, event.text) == (kind, "nobody confirmed it")


def test_late_actions_are_counted_where_a_run_is_summed_up(monkeypatch: pytest.MonkeyPatch) -> None:
    assert "late action" not in run("rollout", "SineTracking", "-n", "1", *SHORT)[1]
    late = 20
    monkeypatch.setattr(Core, "late_actions", property(lambda _: late, lambda *_: None), raising=False)
    assert ", 20 late actions\n" in run("rollout", "SineTracking", "-n", "1", *SHORT)[1]
    late = 1
    assert ", 1 late action\n" in run("rollout", "SineTracking", "-n", "1", *SHORT)[1]
    runs = sorted(Path("runs").iterdir())
    assert "in every bit, 1 late action\n" in run("replay", str(runs[0]), "--no-record")[1]


def test_late_actions_of_an_evaluation_are_in_its_table_and_file() -> None:
    import dataclasses

    found = evaluate(SINE, "zero", episodes=1, num_envs=1, env_kwargs={"duration_s": 0.4})
    assert found.late_actions == 0  # in simulation time waits
    assert "late_actions" not in found.summary()
    late = dataclasses.replace(found, late_actions=3)
    assert late.summary()["late_actions"] == 3
    console = Console(width=120)
    with console.capture() as shown:
        console.print(late.as_table())
    assert re.search(r"late actions, both arms stopped[ │]+3", shown.get())


# Folders.


def test_a_run_that_cannot_be_recorded_leaves_no_folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    with pytest.raises(RecordingError, match="MiB are free"):
        new_folder(tmp_path / "full", header(), least_free_bytes=2**62)
    assert not list((tmp_path / "full").iterdir())

    def refuse(*_: Any, **__: Any) -> None:
        raise RecordingError("no right to write")

    monkeypatch.setattr("dual_ur10.sim2real.recording.simulation.SimulationRecord", refuse)
    with pytest.raises(RecordingError, match="no right"):
        gym.make(SINE, record=str(tmp_path / "runs"))
    assert not list((tmp_path / "runs").iterdir())


@pytest.mark.parametrize("name", ["/dev/full", "file"])
def test_records_need_a_folder(name: str, tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    with pytest.raises(RecordingError, match="it is no folder"):
        gym.make(SINE, record=name)


def test_a_folder_of_runs_names_them(tmp_path: Path) -> None:
    for _ in range(7):
        assert gym.make(SINE, record=str(tmp_path / "runs")).close() is None
    names = sorted((each.name for each in (tmp_path / "runs").iterdir()), reverse=True)
    with pytest.raises(RecordingError, match="it is a folder of runs") as found:
        read_run("runs")
    assert all(name in str(found.value) for name in names[:5])
    assert "and 2 more" in str(found.value)
    (tmp_path / "empty").mkdir()
    with pytest.raises(RecordingError, match=r"there is no run\.mcap in it"):
        read_run("empty")


def test_a_link_to_a_run_names_what_it_points_to(tmp_path: Path) -> None:
    gym.make(SINE, record=str(tmp_path / "runs")).close()
    (made,) = (tmp_path / "runs").iterdir()
    (tmp_path / "link").symlink_to(made)
    with pytest.raises(RecordingError, match="links are not followed") as found:
        read_run("link")
    assert f"Name what it points to: {made}" in str(found.value)
