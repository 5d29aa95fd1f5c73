"""Success rates of the learned policies that come with the package, and of a training from scratch.

python benchmarks/learning.py [--episodes 300] [--randomization mild,none] [--tasks SineTracking] [--json FILE]
python benchmarks/learning.py --parts from_scratch --tasks SineTracking --seeds 3 [--plot FILE]
python benchmarks/learning.py --parts stock --seeds 3 --episodes 100
python benchmarks/learning.py --parts ladder --trials FOLDER --seeds 5 [--json FILE]

Seeds begin at 0; trainings use other seeds to learn and to check their progress. The intervals are
Wilson's, of 95 %. On controllers in real time: `python -m dual_ur10 evaluate ENV --policy learned --cell FILE`.

Parts:
    shipped: every policy in the default environment, on plants of the presets.
    range: SineTracking on random paths ("mild"): any axis, amplitude, frequency and centre of its range.
    wide: every policy on "wide" plants.
    cell: every policy on emulated controllers in virtual time, with the task's range drawn at random (`CELL_RANGES`).
        Each episode has a cell of its own, whose plant ("mild") is drawn by its seed; only where it is named.
    from_scratch: PPO with the settings of `train`, one training after the other; only where it is named. Success,
        return and the ratio of episodes that pass each stage are of the default environment, with the training's
        action mode. The return is a ratio of the scripted policy's on the same seeds; steps and minutes are those of
        the first progress check that had half and 90 % of it. Minutes grow with the load of the machine; cpu_minutes
        are the processor time of all threads.
    stock: for each task the returns of zero, uniform and normal actions as ratios of the script's (`returns.py`), and
        `snippet`: Stable-Baselines3's PPO by itself, with what `examples/train_with_sb3.py` states. For SineTracking
        also `stock_sac` and `stock_td3`, and `stock_ppo`, with its defaults. The worst of all seeds; minutes without
        progress checks. Only where it is named.
    from_demonstrations: behaviour cloning of 20 episodes of the scripted policy under noise, evaluated in the
        environment of the training; only where it is named. Steps are those of the demonstrations.
    act: ACT of 50 episodes of the scripted policy under noise, evaluated in the environment of the training, with
        "mild" plants; Handover alone unless tasks are named; only where it is named. Minutes grow with the load of
        the machine.
    ladder: stock learners on rungs from one arm that lifts to whole tasks, `ladder.py`; only where it is named, and
        then alone. It has a JSON form of its own.
"""

import argparse
import json
import math
import os

for _name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"):
    os.environ.setdefault(_name, "1")

import sys
import tempfile
import time
from collections.abc import Iterable
from pathlib import Path
from typing import Any, Final

import numpy as np

import dual_ur10
from dual_ur10.envs.core.options import EnvOptions
from dual_ur10.errors import CellFaulted
from dual_ur10.policies import evaluate
from dual_ur10.policies.evaluation.results import Evaluation
from dual_ur10.policies.learned.checkpoint import read_manifest
from dual_ur10.policies.registry import names_for, shipped_folder, shipped_names
from dual_ur10.policies.training import state
from dual_ur10.policies.training.settings import defaults, task_settings
from dual_ur10.policies.training.train import resume, train

sys.path.append(str(Path(__file__).parents[1] / "examples"))

PARTS = ("shipped", "range", "wide", "cell", "from_scratch", "stock", "from_demonstrations", "act", "ladder")
STOCK: dict[str, dict[str, Any]] = {
    "snippet": {"algorithm": "PPO"},
    "stock_ppo": {"algorithm": "PPO", "steps": 500_000, "settings": {}, "number": 1},
    "stock_sac": {"algorithm": "SAC"},
    "stock_td3": {"algorithm": "TD3"},
}
"""Trainings of the part stock, as in `examples/train_with_sb3.py` but for what is stated here."""
DEMONSTRATIONS: dict[str, dict[str, Any]] = {
    "DualUR10/Handover-v0": {"steps": 5_600, "agents": "shared", "keywords": {"action_mode": "tcp_delta"}},
    "DualUR10/SyncCarry-v0": {"steps": 17_000},
}
"""Trainings of the part from_demonstrations; with these steps 20 episodes fit."""
ACT_TASKS: Final = ("Handover",)
"""Tasks of the part act, unless others are named."""
CELL_RANGES: dict[str, dict[str, Any]] = {
    "DualUR10/SineTracking-v0": {"random_path": True},
    "DualUR10/Handover-v0": {"object_range_m": 0.03, "object_turn_rad": math.pi / 4},
    "DualUR10/SyncCarry-v0": {"object_range_m": 0.03, "object_turn_rad": 0.075},
}
"""Keywords of the part cell: for the tasks with objects the ranges of "wide", 1.5 times the default ones."""

CELL_ERRORS = {
    "DualUR10/SineTracking-v0": "flange_rms_m",
    "DualUR10/Handover-v0": "object_error_m",
    "DualUR10/SyncCarry-v0": "relative_error_m",
}
"""Values of `info` at the end of an episode that the part cell reports, in mm."""


def main() -> None:
    """Evaluate and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--episodes", type=int, default=300)
    parser.add_argument("--parts", nargs="+", choices=PARTS, default=PARTS[:3])
    parser.add_argument("--randomization", default="mild,none", help="presets of the part shipped, with commas")
    parser.add_argument("--cells", type=int, default=20, help="episodes of the part cell")
    parser.add_argument("--seeds", type=int, default=3, help="trainings of the parts from_scratch and stock")
    parser.add_argument("--learners", nargs="*", choices=list(STOCK), default=list(STOCK), help="of the part stock")
    parser.add_argument("--plot", type=Path, help="draw the curves of the part from_scratch to this PNG file")
    parser.add_argument("--tasks", default="", help="names, with commas between them; all without")
    parser.add_argument("--json", type=Path)
    parser.add_argument("--act", type=Path, help="folder of the training of the part act, which goes on if it exists")
    further = parser.add_argument_group("part ladder")
    further.add_argument("--trials", type=Path, help="folder of the trials, which go on where they were ended")
    further.add_argument("--rungs", nargs="+", help="names of `ladder.RUNGS`; without, the ladder")
    further.add_argument("--by", nargs="+", choices=("ppo", "sac", "dagger", "bc"), default=("ppo",))
    further.add_argument("--first-seed", type=int, default=0)
    args = parser.parse_args()
    print(f"load {os.getloadavg()[0]:.2f}")
    if "ladder" in args.parts:
        found = climbed(parser, args)
        if args.json is not None:
            args.json.write_text(json.dumps(found, indent=1) + "\n")
        return
    results: dict[str, dict[str, Any]] = {}
    for env_id in dual_ur10.ENV_IDS:
        task = env_id.split("/")[1]
        if "scripted" not in names_for(env_id):
            continue  # Free has no reward
        if args.tasks and task.rsplit("-v", 1)[0] not in args.tasks.split(","):
            continue
        for name in shipped_names(env_id):
            key = task if name == "learned" else f"{task}/{name}"
            found = results.setdefault(key, {})
            if "shipped" in args.parts:
                for preset in args.randomization.split(","):
                    row = measured(env_id, name, preset, preset, args.episodes)
                    if preset == "mild":
                        found.update(row)
                    else:
                        results[f"{key}/{preset}"] = row
            if "range" in args.parts and "random_path" in task_settings(env_id).keywords:
                found["range"] = measured(env_id, name, "range", "mild", args.episodes, random_path=True)
            if "wide" in args.parts:
                found["wide"] = measured(env_id, name, "wide", "wide", args.episodes)
            if "cell" in args.parts:
                found["cell"] = on_cells(env_id, name, args.cells)
        if "from_scratch" in args.parts:
            results.setdefault(task, {})["from_scratch"] = from_scratch(env_id, args.episodes, args.seeds, args.plot)
        if "stock" in args.parts:
            results.setdefault(task, {}).update(stock(env_id, args.episodes, args.seeds, args.learners))
        if "from_demonstrations" in args.parts and env_id in DEMONSTRATIONS:
            results.setdefault(task, {})["from_demonstrations"] = from_demonstrations(env_id, args.episodes)
        if "act" in args.parts and (args.tasks or task.rsplit("-v", 1)[0] in ACT_TASKS):
            results.setdefault(task, {})["act"] = act(env_id, args.episodes, args.act)
    if args.json is not None:
        args.json.write_text(json.dumps({task: row for task, row in results.items() if row}, indent=1) + "\n")


def climbed(parser: argparse.ArgumentParser, args: argparse.Namespace) -> dict[str, Any]:
    """Run the trials of the part ladder, and return their results."""
    import ladder

    if args.trials is None or len(args.parts) > 1:
        parser.error("the part ladder is run alone, and needs --trials FOLDER")
    unknown = [name for name in args.rungs or () if name not in ladder.RUNGS]
    if unknown:
        parser.error(f"there is no rung {unknown[0]!r}: there are {', '.join(map(repr, ladder.RUNGS))}")
    seeds = range(args.first_seed, args.first_seed + args.seeds)
    return ladder.climb(args.trials, args.rungs or ladder.LADDER, args.by, seeds)


def measured(
    env_id: str, name: str, title: str, randomization: str, episodes: int, **keywords: object
) -> dict[str, Any]:
    """Evaluate a shipped policy on plants of a preset, print the row and return it."""
    folder = shipped_folder(name, env_id)
    signature = read_manifest(folder).signature
    begin = time.monotonic()
    found = evaluate(
        env_id,
        str(folder),
        episodes=episodes,
        num_envs=64,
        env_kwargs={
            "action_latency_ticks": signature.rate.latency_ticks,
            "randomization": randomization,
            **keywords,
        },
    )
    low, high = found.interval
    row: dict[str, Any] = {
        "success": found.success_rate,
        "low": low,
        "high": high,
        "episodes": episodes,
        "median_time_s": found.median_time_s,
    }
    if found.episodes[0].last.get("flange_rms_m/left") is not None:
        row["rms_mm"] = rms_mm(found)
    text = f", flange RMS {row['rms_mm']:.2f} mm" if "rms_mm" in row else ""
    print(
        f"{f'{env_id} {name}':44} {title:6} {found.successes:4} of {episodes} "
        f"({100 * low:.1f} to {100 * high:.1f} %){text}, {time.monotonic() - begin:.0f} s",
        flush=True,
    )
    return row


def on_cells(env_id: str, name: str, episodes: int) -> dict[str, Any]:
    """Evaluate a shipped policy on virtual cells, print the row and return it."""
    from dual_ur10.testing import VirtualCell

    begin, found = time.monotonic(), []
    for seed in range(episodes):
        with VirtualCell(task=env_id, seed=seed) as cell:
            keywords = {"cell": cell, **CELL_RANGES[env_id]}
            try:
                found += evaluate(env_id, name, episodes=1, seed=seed, num_envs=1, env_kwargs=keywords).episodes
            except CellFaulted as error:
                print(f"seed {seed}: {error}", flush=True)
    successes = sum(each.success for each in found)
    row: dict[str, Any] = {"success": successes / episodes, "episodes": episodes}
    error = CELL_ERRORS[env_id]
    values = [1e3 * abs(value or 0.0) for each in found for key, value in each.last.items() if key.startswith(error)]
    row |= {f"{error[:-1]}mm_median": float(np.median(values)), f"{error[:-1]}mm_max": max(values)} if values else {}
    print(
        f"{f'{env_id} {name}':44} cell   {successes:4} of {episodes}, {json.dumps(row)}, "
        f"{time.monotonic() - begin:.0f} s",
        flush=True,
    )
    return row


def from_scratch(env_id: str, episodes: int, seeds: int, plot: Path | None) -> dict[str, Any]:
    """Train by PPO, evaluate in the default environment, print each training, draw all, and return the figures."""
    mode = {"action_mode": defaults(env_id, "ppo").keywords.get("action_mode", EnvOptions.action_mode)}
    script = evaluate(env_id, "scripted", episodes=episodes, num_envs=64, env_kwargs=mode).mean_return
    rows = []
    for seed in range(seeds):
        with tempfile.TemporaryDirectory() as folder:
            path, begin_s = Path(folder) / "training", time.process_time()
            train(defaults(env_id, "ppo", seed=seed), path)
            cpu = {"cpu_minutes": (time.process_time() - begin_s) / 60}
            found = evaluate(env_id, str(path / "policy"), episodes=episodes, num_envs=64, env_kwargs=mode)
            rows.append({"seed": seed} | cpu | figures_of(path, found, script))
        told = {key: value for key, value in rows[-1].items() if key != "curve"}
        print(f"{env_id}, PPO from scratch: {json.dumps(told)}", flush=True)
    if plot is not None:
        draw(plot, env_id, rows)
    return {
        "success": min(row["success"] for row in rows),
        "of_script": min(row["of_script"] for row in rows),
        "minutes": max(row["minutes"] for row in rows),
        "cpu_minutes": max(row["cpu_minutes"] for row in rows),
        "steps": rows[0]["steps"],
        "seeds": rows,
    }


def stock(env_id: str, episodes: int, seeds: int, learners: Iterable[str]) -> dict[str, Any]:
    """Measure the floors of a task and what stock learners reach; print the rows and return them."""
    import returns
    import train_with_sb3 as example

    floors = {name: each for name, each in returns.COMMON.items() if each.group in ("floor", "script")}
    earned = {name: float(row["return"].mean()) for name, row in returns.measure(env_id, floors, range(2)).items()}
    script = earned.pop("script")
    result: dict[str, Any] = {f"{name}_ratio": each / script for name, each in earned.items()}
    print(f"{env_id}: {json.dumps(result)}", flush=True)
    task = env_id.split("/")[1].rsplit("-v", 1)[0]
    for name in learners:
        if task != example.SINE and name != "snippet":
            continue
        rows, recipe = [], example.recipe_of(task)
        for seed in range(seeds):
            print(f"{env_id}, {name}, seed {seed}, load {os.getloadavg()[0]:.1f}", flush=True)
            model, steps, minutes = example.train(recipe, seed=seed, **STOCK[name])
            means = example.measure(recipe, STOCK[name]["algorithm"], model, episodes, 0)
            found = {key: float(each) for key, each in means.items()}
            found |= {"return_ratio": found["return"] / script, "minutes": minutes, "steps": steps}
            print(json.dumps(found), flush=True)
            rows.append(found)
        worst = {"steps": max, "minutes": max, "error_mm": max}
        result[name] = {key: worst.get(key, min)(row[key] for row in rows) for key in rows[0]} | {"seeds": rows}
    return result


def from_demonstrations(env_id: str, episodes: int) -> dict[str, Any]:
    """Imitate 20 episodes of the scripted policy, evaluate, print the row and return it."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "training"
        asked = defaults(env_id, "bc", envs=20, **DEMONSTRATIONS[env_id])
        begin_s = time.monotonic()
        train(asked, path)
        minutes = (time.monotonic() - begin_s) / 60
        found = evaluate(env_id, str(path / "policy"), episodes=episodes, num_envs=64, env_kwargs=asked.keywords)
        steps = state.load(path / "state")[1]["steps"]
    row = {"success": found.success_rate, "minutes": minutes, "steps": steps}
    print(f"{env_id}, from 20 demonstrations: {json.dumps(row)}", flush=True)
    return row


def act(env_id: str, episodes: int, folder: Path | None) -> dict[str, Any]:
    """Train ACT, evaluate it, print the row and return it."""
    with tempfile.TemporaryDirectory() as temporary:
        path = folder or Path(temporary) / "training"
        asked = defaults(env_id, "act", randomization="mild")
        if not (path / "policy").exists():
            resume(path) if path.exists() else train(asked, path)
        found = evaluate(env_id, str(path / "policy"), episodes=episodes, num_envs=64, env_kwargs=asked.keywords)
        minutes = state.load(path / "state")[1]["seconds"] / 60
    row = {"successes": found.successes, "episodes": episodes, "minutes": minutes}
    print(f"{env_id}, ACT: {json.dumps(row)}, {found.stage_scores}", flush=True)
    return row


def figures_of(path: Path, found: Evaluation, script: float) -> dict[str, Any]:
    """Return the figures of a finished training.

    Args:
        path: Folder of the training.
        found: Evaluation of its policy.
        script: Mean return of the scripted policy.
    """
    values = state.load(path / "state")[1]
    curve = [
        (each["steps"], each["seconds"] / 60, each["mean_return"] / script, each["success_rate"])
        for each in values["checks"]
    ]
    row: dict[str, Any] = {
        "success": found.success_rate,
        "of_script": found.mean_return / script,
        "stages": found.stage_scores,
        "minutes": values["seconds"] / 60,
        "steps": values["steps"],
    }
    for share in (0.5, 0.9):
        steps, minutes, *_ = next((each for each in curve if each[2] >= share), (None, None))
        row |= {f"steps_to_{share}": steps, f"minutes_to_{share}": minutes}
    return row | {"curve": curve}


def draw(path: Path, env_id: str, rows: list[dict[str, Any]]) -> None:
    """Draw success and return of all trainings over their steps."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(7.0, 4.2), layout="constrained")
    axes: Any = figure.subplots(2, 1, sharex=True)
    for row in rows:
        steps, _, share, success = np.array(row["curve"], dtype=float).T
        for each, values in zip(axes, (success, share), strict=True):
            each.plot(steps / 1e6, 100 * values, "o-", markersize=3, label=f"seed {row['seed']}")
    axes[0].set(ylabel="success, %", ylim=(-3, 103), title=f"{env_id}, PPO from scratch")
    axes[1].set(ylabel="return, % of the script's", xlabel="million steps of the environment", ylim=(-3, 103))
    axes[0].legend(loc="best", fontsize="small")
    for each in axes:
        each.grid(alpha=0.3)
    figure.savefig(path, dpi=110)


def rms_mm(found: Evaluation) -> float:
    """Return the RMS error of both flanges in mm, over all steps of all episodes."""
    values = [each.last[f"flange_rms_m/{arm}"] or 0.0 for each in found.episodes for arm in ("left", "right")]
    return 1e3 * float(np.sqrt(np.mean(np.square(values))))


if __name__ == "__main__":
    main()
