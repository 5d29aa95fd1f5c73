"""The command `evaluate`."""

from __future__ import annotations

import io
import json
import re
from pathlib import Path
from typing import Any

import pytest
from rich.console import Console

from dual_ur10 import ids, policies
from dual_ur10.cli import evaluate as cli_evaluate
from dual_ur10.policies import registry
from dual_ur10.policies.evaluation import evaluate as module
from dual_ur10.policies.evaluation import failures
from dual_ur10.policies.evaluation.results import EpisodeResult, Evaluation
from tests.cli import command


def run(*arguments: str) -> tuple[int, str]:
    return command.run("evaluate", *arguments)


SHORT = ("SineTracking", "-n", "5", "--set", "duration_s=0.4")


def test_command_prints_a_table_and_writes_files(tmp_path: Path) -> None:
    code, text = run(*SHORT, "--seed", "2", "--json", str(tmp_path / "x.json"), "--csv", str(tmp_path / "x.csv"))
    assert code == 0
    assert "5 of 5, 100.0 %" in text
    assert "running" not in text  # no bar without a terminal
    data = json.loads((tmp_path / "x.json").read_text())
    assert [each["seed"] for each in data["episodes"]] == [2, 3, 4, 5, 6]
    assert data["kwargs"] == {"duration_s": 0.4}
    assert len((tmp_path / "x.csv").read_text().splitlines()) == 6


def test_command_knows_perturbed_and_the_number_of_envs(tmp_path: Path) -> None:
    found = []
    for more in ((), ("--envs", "2"), ("--perturbed",)):
        code, _ = run(*SHORT, *more, "--json", str(tmp_path / "x.json"))
        assert code == 0
        found.append(json.loads((tmp_path / "x.json").read_text())["episodes"])
    assert found[0] == found[1]
    assert found[0][0]["peak"]["flange_error_m/left"] < 1e-5 < found[2][0]["peak"]["flange_error_m/left"]


@pytest.mark.parametrize(("policy", "wanted", "expected"), [("zero", "0.5", 1), ("zero", "0", 0), ("scripted", "1", 0)])
def test_too_few_successes_are_exit_code_1(policy: str, wanted: str, expected: int, tmp_path: Path) -> None:
    path = tmp_path / "x.json"
    code, text = run(
        "SineTracking", "-n", "3", "--set", "duration_s=2", "-p", policy, "--min-success", wanted, "--json", str(path)
    )
    assert code == expected
    assert ("nothing succeeded: 0 of 3 are a rate of 0, required 0.5 or more" in text) == bool(expected)
    assert path.exists()


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (("Juggling",), "unknown environment 'Juggling'"),
        (
            ("SineTracking", "-p", "psychic"),
            "unknown policy 'psychic': use one of 'scripted', 'learned', 'learned-two-agents', 'random', 'zero'",
        ),
        (
            ("SineTracking", "--set", "amplitud=0.1"),
            "SineTracking-v0 got an unexpected keyword argument 'amplitud'",
        ),
        (("SineTracking", "--set", "amplitude_m"), "write it as KEY=VALUE"),
        (("SineTracking", "--set", "num_envs=3"), "keyword num_envs"),
        (("SineTracking", "--episodes", "0"), "episodes is 0: it must be a whole number, 1 or more"),
        (("SineTracking", "--envs", "0"), "num_envs is 0"),
        (("SineTracking", "--min-success", "1.5"), "--min-success is 1.5: it must be a rate from 0 to 1"),
        (("SineTracking", "--min-success", "nan"), "--min-success is nan"),
        (("SineTracking", "--randomization", "x", "--set", "randomization=y"), "randomization is set twice"),
        (("SineTracking", "--json", "none/x.json"), "cannot write none/x.json"),
        (("SineTracking", "--json", "x", "--csv", "./x"), "--json and --csv both name x"),
        (("SineTracking", "Handover", "--csv", "x"), "--csv is for one task, found DualUR10/SineTracking-v0, Dual"),
        (("SineTracking", "Handover", "--cell", "lab.toml"), "--cell is for one task"),
        (("SineTracking", "DualUR10/SineTracking-v0"), "SineTracking-v0 is named twice"),
        (("SineTracking", "--failures", "none/x"), "the folder none/x cannot be made"),
        (("SineTracking", "--failures", ".", "--cell", "lab.toml"), "--failures is for simulation"),
        (("SineTracking", "-p", "remote:ws://127.0.0.1:9"), "127.0.0.1:9"),
    ],
)
def test_a_bad_argument_is_one_line_and_exit_code_2(arguments: tuple[str, ...], message: str) -> None:
    code, text = run(*arguments)
    assert code == 2
    assert text.startswith("error: ")
    assert message in text
    assert text.count("\n") == 1


def test_several_tasks_are_written_as_a_list_after_each(tmp_path: Path) -> None:
    path, few = tmp_path / "x.json", ("-n", "2", "--set", "duration_s=0.4", "--set", "amplitude_m=0.05")
    code, text = run("SineTracking", "Handover", *few, "--json", str(path))
    assert (code, "Handover-v0 got an unexpected keyword argument" in text) == (2, True)
    (found,) = json.loads(path.read_text())
    assert (found["env_id"], found["summary"]["successes"]) == ("DualUR10/SineTracking-v0", 2)


def test_all_are_the_tasks_that_have_the_policy(monkeypatch: pytest.MonkeyPatch) -> None:
    seen: list[str] = []

    def found(env_id: str, *_: Any, **__: Any) -> Any:
        seen.append(env_id)
        episodes = [EpisodeResult(seed, seed < len(seen), 0.0, 1, 1.0) for seed in range(4)]
        return Evaluation(env_id, "learned", {}, 0, (), tuple(episodes), {})

    monkeypatch.setattr(module, "evaluate", found)
    code, text = run("all", "-p", "learned", "-n", "4", "--min-success", "0.5")
    assert seen == [each for each in ids.TASKS if "learned" in ids.TASKS[each].learned]
    assert (code, "SineTracking-v0: too few successes: 1 of 4" in text) == (1, True)
    seen.clear()
    run("all", "-p", "my_module:Mine")
    assert seen == [each for each in ids.TASKS if ids.TASKS[each].scripted]


def test_failed_episodes_are_filmed(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    pytest.importorskip("imageio_ffmpeg")
    filmed: list[tuple[str, Any]] = []
    monkeypatch.setattr(failures, "film", lambda path, shown, **_: filmed.append((path.name, shown)))
    folder = tmp_path / "failed"
    arguments = ("-n", "3", "--set", "duration_s=0.4", "--failures", str(folder), "--seed", "5")
    code, text = run("SineTracking", "-p", "random", *arguments, "--json", str(tmp_path / "x.json"))
    assert (code, f"video  3 of 3 failed episodes: {folder}" in text) == (0, True)
    assert folder.is_dir()
    assert [name for name, _ in filmed] == [f"SineTracking-v0-{seed}.mp4" for seed in (5, 6, 7)]
    episodes = json.loads((tmp_path / "x.json").read_text())["episodes"]
    for (_, shown), episode in zip(filmed, episodes, strict=True):
        assert shown.infos[-1]["flange_rms_m"].tolist() == list(episode["last"].values())[2:4]
    assert "video  no failed episode" in run("SineTracking", *arguments)[1]


def test_a_failed_run_leaves_an_old_file_alone(tmp_path: Path) -> None:
    path = tmp_path / "x.json"
    path.write_text("before")
    assert run("SineTracking", "--set", "axis=w", "--json", str(path))[0] == 2
    assert path.read_text() == "before"


def test_randomization_is_a_keyword_of_the_environment(monkeypatch: pytest.MonkeyPatch) -> None:
    seen: dict[str, Any] = {}

    def record(*_: Any, **arguments: Any) -> None:
        seen.update(arguments)
        raise KeyboardInterrupt

    monkeypatch.setattr(module, "evaluate", record)
    code, text = run("SineTracking", "--randomization", "plant", "--set", "randomize=false")
    assert (code, text) == (130, "interrupted after 0 of 300 episodes, whose result was not written\n")
    assert seen["env_kwargs"] == {"randomization": "plant", "randomize": False}
    assert (seen["episodes"], seen["seed"], seen["num_envs"], seen["move_to_start"]) == (300, 0, 8, False)
    run("SineTracking", "--cell", "lab.toml", "--no-record")
    assert seen["move_to_start"] is True


def test_ctrl_c_prints_the_episodes_so_far(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    path = tmp_path / "x.json"
    path.write_text("before")
    load, calls = policies.load, []

    def interrupted(*arguments: Any, **keywords: Any) -> Any:
        policy = load(*arguments, **keywords)

        class Interrupted:
            reset = policy.reset

            def __call__(self, observation: Any) -> Any:
                calls.append(1)
                if len(calls) == 25:
                    raise KeyboardInterrupt
                return policy(observation)

        return Interrupted()

    monkeypatch.setattr(registry, "load", interrupted)
    code, text = run("SineTracking", "-n", "50", "--envs", "2", "--set", "duration_s=0.4", "--json", str(path))
    assert code == 130
    assert "4 of 4, 100.0 %" in text
    assert "interrupted after 4 of 50 episodes" in text
    assert path.read_text() == "before"


def test_a_terminal_sees_a_bar(monkeypatch: pytest.MonkeyPatch) -> None:
    screen = Console(file=io.StringIO(), force_terminal=True, width=160)
    monkeypatch.setattr(cli_evaluate, "console", screen)
    assert run(*SHORT)[0] == 0
    assert "success 100.0 %" in re.sub(r"\x1b\[[0-9;?]*[A-Za-z]", "", screen.file.getvalue())  # type: ignore[attr-defined]
