"""Benchmarks that nobody runs for a while still run."""

import functools
import importlib
import json
import pathlib
import sys

import pytest

from dual_ur10 import policies
from dual_ur10.envs.core.setup import EnvSetup
from dual_ur10.policies import evaluate
from dual_ur10.policies.training.settings import defaults

FOLDER = pathlib.Path(__file__).parent.parent / "benchmarks"


@pytest.mark.parametrize("n", [1, 3])
def test_throughput_is_measured_over_the_end_of_an_episode(monkeypatch, n):
    monkeypatch.syspath_prepend(FOLDER)  # they import each other
    throughput = importlib.import_module("throughput")
    found = throughput.measure("DualUR10/SyncCarry-v0", n, "random", 1, 40, 1)  # which random actions end at once
    assert found["efficiency"] > 0.0  # a ratio of times: on a busy machine one block may be off by any factor
    assert found["env_steps_per_s"] > 0.0


def test_a_worker_runs_blocks_of_the_checkout_that_was_named(monkeypatch, tmp_path):
    monkeypatch.syspath_prepend(FOLDER)
    interleaved = importlib.import_module("interleaved")
    monkeypatch.setattr(interleaved, "BLOCK_S", 0.01)
    python, case = pathlib.Path(sys.executable), {"task": "SineTracking", "envs": 2, "threads": 1}
    worker = interleaved.Worker(python, "dual_ur10_worker.py", case, FOLDER.parent)
    (blocks,) = interleaved.rounds_of([worker], 3)
    worker.close()
    assert interleaved.rate(blocks, "simulated_s", "env_steps") == pytest.approx(0.04)
    assert interleaved.ratio(blocks, blocks, "env_steps", "wall_s") == 1.0
    assert all(block["env_steps"] == 2 * worker.steps and block["cpu_s"] > 0.0 for block in blocks)
    with pytest.raises(SystemExit, match=r"imports dual_ur10 from|ended with code"):
        interleaved.Worker(python, "dual_ur10_worker.py", case, tmp_path)


def test_exploration_and_tools_that_are_too_low_are_led(monkeypatch):
    monkeypatch.syspath_prepend(FOLDER)
    exploration = importlib.import_module("exploration")
    found = exploration.explore("SineTracking", "joint_delta", exploration.towards, 4, 2, 25)
    assert found["refusals_per_1000_refuse"] > 10 * found["refusals_per_1000_lead"]
    assert found["led_share"] > 0.1
    assert exploration.too_low(20.0, "refuse", 2) == {"refused": 2, "led": 0, "episodes": 2}
    assert exploration.too_low(20.0, "lead", 2) == {"refused": 0, "led": 2, "episodes": 2}


def test_targets_of_splices_are_compared_with_the_limits(monkeypatch):
    monkeypatch.syspath_prepend(FOLDER)
    chunks = importlib.import_module("chunks")
    monkeypatch.setattr(chunks, "ROWS", 2)
    monkeypatch.setattr(chunks, "EPISODE_S", 6.0)
    found = chunks.splice(10, 0)
    assert found["splices"] >= 10
    assert (found["above_caps"], found["refused"]) == (0, 0)
    monkeypatch.setattr(chunks, "ROUNDING", 0.1)
    assert chunks.splice(1, 0)["above_caps"] > 0


def test_demonstrations_are_imitated_and_evaluated(monkeypatch):
    pytest.importorskip("torch")
    monkeypatch.syspath_prepend(FOLDER)
    learning = importlib.import_module("learning")
    asked = {"steps": 500, "keywords": {"duration_s": 1.0}, "changes": {"fit_steps": 20, "hidden": (8,)}}
    monkeypatch.setitem(learning.DEMONSTRATIONS, "DualUR10/SineTracking-v0", asked)
    found = learning.from_demonstrations("DualUR10/SineTracking-v0", 2)
    assert found["steps"] == 500
    assert found["minutes"] > 0.0
    assert 0.0 <= found["success"] <= 1.0


def test_act_is_trained_once_and_evaluated(monkeypatch, tmp_path):
    pytest.importorskip("torch")
    monkeypatch.syspath_prepend(FOLDER)
    learning = importlib.import_module("learning")
    changes = {"demonstrations": 2, "fit_steps": 20, "check_steps": 20, "dim_model": 8}
    short = {"envs": 2, "keywords": {"duration_s": 0.4}, "changes": changes}
    monkeypatch.setattr(learning, "defaults", lambda *given, **asked: defaults(*given, **asked, **short))
    command = ["", "--parts", "act", "--tasks", "SineTracking", "--episodes", "2", "--act", str(tmp_path / "act")]
    results = []
    for number in range(2):
        monkeypatch.setattr("sys.argv", [*command, "--json", str(tmp_path / f"{number}.json")])
        learning.main()
        results.append(json.loads((tmp_path / f"{number}.json").read_text())["SineTracking-v0"]["act"])
    assert results[0] == results[1]
    assert results[0].keys() == {"successes", "episodes", "minutes"}


def test_stock_learners_are_measured(monkeypatch):
    pytest.importorskip("stable_baselines3")
    monkeypatch.syspath_prepend(FOLDER)
    monkeypatch.syspath_prepend(FOLDER.parent / "examples")
    learning, returns = importlib.import_module("learning"), importlib.import_module("returns")
    example = importlib.import_module("train_with_sb3")
    monkeypatch.setattr(returns, "measure", functools.partial(returns.measure, max_episode_steps=20))
    monkeypatch.setitem(example.RECIPES["SineTracking"].keywords, "duration_s", 0.4)
    for name in learning.STOCK:
        monkeypatch.setitem(learning.STOCK[name], "steps", 128)
    found = learning.stock("DualUR10/SineTracking-v0", 2, 1, ["snippet", "stock_td3"])
    assert set(found) == {"zero_ratio", "uniform_ratio", "normal_ratio", "snippet", "stock_td3"}
    assert found["snippet"]["steps"] == 1024  # one update
    assert found["stock_td3"]["steps"] == 128
    assert found["snippet"]["return_ratio"] < found["zero_ratio"]  # of an episode of 10 steps
    assert found["snippet"]["error_mm"] > 0.0


def test_a_ladder_goes_on_where_it_was_ended(monkeypatch, tmp_path):
    pytest.importorskip("stable_baselines3")
    monkeypatch.syspath_prepend(FOLDER)
    monkeypatch.syspath_prepend(FOLDER.parent / "examples")
    ladder = importlib.import_module("ladder")
    sine = ladder.but(ladder.RUNGS["SineTracking-v0"], {"duration_s": 0.4}, steps={"PPO": 128}, short=5)
    monkeypatch.setitem(ladder.RUNGS, "SineTracking-v0", sine)
    folder = tmp_path / "trials"  # that is not there yet
    found = ladder.climb(folder, ["SineTracking-v0"], ["ppo"], [3], episodes=2)
    row = json.loads((folder / "SineTracking-v0-ppo-3.json").read_text())
    assert (row["of"], row["steps"]) == (2, 1024)
    assert found["SineTracking-v0"]["ppo"]["successes"] == [row["successes"]]
    assert policies.load(folder / "SineTracking-v0-ppo-3", "SineTracking", **sine.keywords)
    seeds = []
    monkeypatch.setattr(ladder, "run", lambda rung, learner, seed, *_: {**row, "seed": seeds.append(seed) or seed})
    again = ladder.climb(folder, ["SineTracking-v0"], ["ppo"], [2, 3, 4], episodes=2)
    assert seeds == [2, 4]
    assert again["SineTracking-v0"]["ppo"]["seeds"] == [2, 3, 4]
    assert len(again["SineTracking-v0"]["ppo"]["minutes"]) == 3
    for rung in ladder.RUNGS.values():
        assert EnvSetup.resolve(rung.task, {**rung.keywords, "starts": rung.starts}).options.concise or rung.seen


def test_every_stock_learner_climbs_a_rung_with_rewards_for_changes(monkeypatch, tmp_path):
    pytest.importorskip("stable_baselines3")
    monkeypatch.syspath_prepend(FOLDER)
    monkeypatch.syspath_prepend(FOLDER.parent / "examples")
    ladder = importlib.import_module("ladder")
    rung = ladder.but(ladder.RUNGS["Handover-v0"], {"duration_s": 0.4}, steps={"PPO": 64, "SAC": 64}, short=5)
    monkeypatch.setitem(ladder.RUNGS, "Handover-v0", rung)
    found = ladder.climb(tmp_path, ["Handover-v0"], ["ppo", "sac"], [0], episodes=2)["Handover-v0"]
    assert {name: row["successes"] for name, row in found.items()} == {"ppo": [0], "sac": [0]}


def test_baselines_are_measured_and_continued(monkeypatch, tmp_path):
    pytest.importorskip("torch")
    monkeypatch.syspath_prepend(FOLDER)
    baselines = importlib.import_module("baselines")
    seeds = []

    def short(env_id, policy, *, env_kwargs, seed, **keywords):
        seeds.append(seed)
        return evaluate(env_id, policy, seed=seed, env_kwargs={**env_kwargs, "duration_s": 0.4}, **keywords)

    def asked(env_id, algorithm, *, changes, **keywords):
        small = {"hidden": (8,)} if algorithm == "bc" else {"dim_model": 8, "check_steps": 20}
        changes = {**changes, "fit_steps": 20, **small}
        return defaults(env_id, algorithm, changes=changes, keywords={"duration_s": 0.4}, **keywords)

    monkeypatch.setattr(baselines, "evaluate", short)
    monkeypatch.setattr(baselines, "defaults", asked)
    monkeypatch.setattr(baselines, "DEMONSTRATIONS", 2)
    path = tmp_path / "baselines.json"
    for episodes in (2, 3):
        command = ["", "--task", "SineTracking", *(f"--learner={each}" for each in ("script", "bc", "act"))]
        command += ["--episodes", str(episodes), "--json", str(path), "--out", str(tmp_path)]
        monkeypatch.setattr("sys.argv", command)
        baselines.main()
    found = json.loads(path.read_text())["SineTracking-v0"]
    assert [found[name][preset][1] for name in found for preset in baselines.RANDOMIZATIONS] == [3] * 9
    assert [found[name]["demonstrations"] for name in ("bc", "act")] == [2, 2]
    assert seeds == [0] * 9 + [2] * 9


def test_an_export_is_measured(monkeypatch):
    monkeypatch.syspath_prepend(FOLDER)
    found = importlib.import_module("lerobot_export").measure(0.5, "ur10")
    assert found["frames"] == 750
    assert found["record_mib"] > 1.0


def test_policies_are_measured_on_both_sides_and_continued(monkeypatch, tmp_path):
    pytest.importorskip("rtde_control")
    monkeypatch.syspath_prepend(FOLDER)
    agreement, path = importlib.import_module("agreement"), tmp_path / "policies.csv"
    monkeypatch.setitem(agreement.KEYWORDS, "DualUR10/SineTracking-v0", {"duration_s": 0.4})
    noisy = ["--task", "SineTracking", "--policy", "script, noise 0.04", "--csv", str(path)]
    for episodes in (1, 2):
        monkeypatch.setattr(sys, "argv", ["agreement.py", *noisy, "--simulation", str(episodes), "--cell", "1"])
        agreement.main()
        (found,) = agreement.read_policies(path)
        assert (found.task, found.policy, found.cell.episodes) == ("SineTracking", "script, noise 0.04", 1)
        assert found.simulation.episodes == episodes
