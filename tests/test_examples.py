"""The scripts and notebooks of `examples/`, each in a process of its own."""

from __future__ import annotations

import functools
import json
from pathlib import Path

import pytest

from tests import scripts

FOLDER = Path(__file__).parent.parent / "examples"
ARGUMENTS = {
    "train_with_sb3": (("PPO", "--steps", "1024", "--out", "sine_ppo"), "stable_baselines3"),
    "ppo": (("1024", "sine_ppo", "0", "2"), "torch"),
    "ppo_with_torchrl": (("1024", "sine_ppo", "0", "2"), "torchrl"),
    "pettingzoo_loop": (("20",), "pettingzoo"),
    "evaluate_checkpoint": (("learned", "2"), "numpy"),
    "own_task": (("2",), "gymnasium"),
    "collect_dataset": (("2", "ur10/example-v0"), "minari"),
}
ELSEWHERE = {"rllib_two_agents"}  # `make test-rllib` runs it, in an environment of its own


def test_every_example_is_run():
    assert {each.stem for each in FOLDER.glob("*.py")} == {*ARGUMENTS, *ELSEWHERE}


@pytest.mark.parametrize("name", list(ARGUMENTS))
def test_it_runs(name, tmp_path):
    arguments, needs = ARGUMENTS[name]
    pytest.importorskip(needs)
    (tmp_path / "folder").mkdir()
    text = scripts.run(
        FOLDER / f"{name}.py",
        *arguments,
        folder=tmp_path / "folder",
        output=tmp_path / "output",
        MINARI_DATASETS_PATH=str(tmp_path / "datasets"),
    )
    assert text.strip()
    if "sine_ppo" in arguments:
        from dual_ur10.policies.learned.checkpoint import read_manifest

        assert read_manifest(tmp_path / "folder" / "sine_ppo").signature.env_id == "DualUR10/SineTracking-v0"
    if name == "collect_dataset":
        assert "2 episodes" in text


@pytest.mark.parametrize(
    ("arguments", "task"), [(("--task", "SyncCarry"), "SyncCarry"), (("SAC", "--lift"), "Handover")]
)
def test_stock_learners_train_the_tasks_with_objects_too(arguments, task, tmp_path):
    pytest.importorskip("stable_baselines3")
    run = functools.partial(scripts.run, FOLDER / "train_with_sb3.py", folder=tmp_path)
    text = run(*arguments, "--steps", "64", "--out", "made", output=tmp_path / "output")
    assert f"evaluate {task} --policy {tmp_path / 'made'} --set 'observation=" in text.splitlines()[-1]
    from dual_ur10.policies.learned.checkpoint import read_manifest

    assert read_manifest(tmp_path / "made").agents == "shared"


def test_the_result_of_td3_is_not_overwritten(tmp_path):
    pytest.importorskip("stable_baselines3")
    run = functools.partial(scripts.run, FOLDER / "train_with_sb3.py", folder=tmp_path, output=tmp_path / "output")
    (tmp_path / "mine.zip").write_text("an earlier one")
    with pytest.raises(AssertionError, match="nothing is overwritten"):
        run("TD3", "--steps", "8", "--out", "mine")
    assert (tmp_path / "mine.zip").read_text() == "an earlier one"
    run("TD3", "--steps", "8", "--out", "other")
    assert (tmp_path / "other.zip").exists()


@pytest.mark.parametrize("path", sorted(FOLDER.glob("*.py")), ids=lambda path: path.stem)
def test_it_says_how_to_run_it(path):
    assert f"python examples/{path.name}" in path.read_text().split('"""')[1]


@pytest.mark.parametrize("path", sorted(FOLDER.glob("*.ipynb")), ids=lambda path: path.stem)
def test_a_notebook_runs_from_its_first_cell_to_its_last(path, tmp_path):
    for needs in ("matplotlib", "safetensors", "greenlet", "rtde_control"):
        pytest.importorskip(needs)
    cells = json.loads(path.read_text())["cells"]
    assert not [each for each in cells if each.get("outputs")]
    script = tmp_path / f"{path.stem}.py"
    script.write_text("\n".join("".join(each["source"]) for each in cells if each["cell_type"] == "code"))
    (tmp_path / "folder").mkdir()
    text = scripts.run(script, folder=tmp_path / "folder", output=tmp_path / "output", MPLBACKEND="agg")
    assert text.count("success after") == 2
