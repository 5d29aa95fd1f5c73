"""Measure the scripts of all tasks: success under each randomization, peak force, success on a virtual cell, cheats.

Seeds are 0, 1, ...; a refused motion ends an episode, as on two controllers. Results are written after every part, so
that the command can be stopped and continues where it was. The peak force is the largest of successful episodes under
"mild", at the ends of their steps. Cheats of `cheats.py`, those of one arm alone apart, are tried with seed 0.

    python benchmarks/tasks.py --json tasks.json
    python benchmarks/tasks.py --json tasks.json --task BoxLift --episodes 20 --virtual 1
"""

from __future__ import annotations

import os

for _name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"):
    os.environ.setdefault(_name, "1")

import argparse
import json
import sys
from pathlib import Path
from typing import Any

sys.path.insert(0, str(Path(__file__).parent.parent))

from benchmarks.cheats import CHEATS, tried
from dual_ur10.ids import ENV_IDS, TASKS, env_id_of
from dual_ur10.policies import evaluate, load
from dual_ur10.testing import VirtualCell

RANDOMIZATIONS = {"nominal": "none", "mild": "mild", "wide": "wide"}
KEYWORDS: dict[str, dict[str, Any]] = {"DualUR10/PegInsertion-v0": {"clearance_m": 5e-4}}
PART = 20
"""Episodes after which results are written."""

Result = dict[str, Any]


def add_episodes(env_id: str, name: str, result: Result, most: int) -> None:
    """Add the next part of the episodes with a randomization to a task's result."""
    successes, of = result.setdefault(name, [0, 0])
    keywords = {**KEYWORDS.get(env_id, {}), "randomization": RANDOMIZATIONS[name], "on_refusal": "terminate"}
    count = min(PART, most - of)
    found = evaluate(env_id, "scripted", episodes=count, num_envs=count, seed=of, env_kwargs=keywords).episodes
    result[name] = [successes + sum(each.success for each in found), of + len(found)]
    failed = [[each.seed, each.end_reason or "time", each.best_stage] for each in found if not each.success]
    result.setdefault("failed", {}).setdefault(name, []).extend(failed)
    if name == "mild":
        forces = [each.peak[key] for each in found if each.success for key in each.peak if key.startswith("force_n/")]
        if forces:
            result["peak_force_n"] = round(max([*forces, result.get("peak_force_n", 0.0)]), 1)


def add_virtual(env_id: str, result: Result) -> None:
    """Add the next episode on a virtual cell to a task's result."""
    successes, of = result.setdefault("virtual", [0, 0])
    given = KEYWORDS.get(env_id, {})
    with VirtualCell(task=env_id, settings=given, plant="mild") as cell:
        env, policy = cell.make(env_id, **given), load("scripted", env_id, cell=cell, **given)
        observation, info = env.reset(seed=of)
        over = False
        while not over:
            observation, _, terminated, truncated, info = env.step(policy(observation))
            over = terminated or truncated
        env.close()
    result["virtual"] = [successes + bool(info["is_success"]), of + 1]
    if not info["is_success"]:
        result.setdefault("failed", {}).setdefault("virtual", []).append([of, info["end_reason"], str(cell.fault)])


def add_cheats(env_id: str, name: str, result: Result) -> None:
    """Add those that succeed, and the number, of a task's cheats: its arms alone, and all others."""
    cheats = CHEATS.get(name, {})
    for kind, alone in (("one_arm", True), ("cheats", False)):
        tries = {each: cheat for each, cheat in cheats.items() if each.endswith(" alone") == alone}
        if tries and kind not in result:
            ends = tried(env_id, tries)
            succeeded = [[each, *end[1:]] for each, end in ends.items() if end[0]]
            result[kind] = [len(succeeded), len(ends)]
            result.setdefault("failed", {})[kind] = succeeded


def main() -> None:
    """Run the measurement from the command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--task", action="append", help="one of the tasks; may be repeated")
    parser.add_argument("--episodes", type=int, default=300, help="episodes with each randomization")
    parser.add_argument("--virtual", type=int, default=20, help="episodes on a virtual cell")
    parser.add_argument("--json", type=Path, required=True, help="results, continued if they exist")
    arguments = parser.parse_args()
    results: dict[str, Result] = json.loads(arguments.json.read_text()) if arguments.json.exists() else {}
    for env_id in map(env_id_of, arguments.task or [each for each in ENV_IDS if TASKS[each].scripted]):
        result = results.setdefault(env_id.partition("/")[2], {})
        for name in RANDOMIZATIONS:
            while result.get(name, [0, 0])[1] < arguments.episodes:
                add_episodes(env_id, name, result, arguments.episodes)
                arguments.json.write_text(json.dumps(results, indent=2) + "\n")
        while result.get("virtual", [0, 0])[1] < arguments.virtual:
            add_virtual(env_id, result)
            arguments.json.write_text(json.dumps(results, indent=2) + "\n")
        add_cheats(env_id, env_id.partition("/")[2].partition("-v")[0], result)
        arguments.json.write_text(json.dumps(results, indent=2) + "\n")
        print(env_id, json.dumps(result), flush=True)


if __name__ == "__main__":
    main()
