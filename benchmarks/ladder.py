"""The ladder: steps and minutes until learners succeed, from one arm that lifts to whole tasks.

python benchmarks/learning.py --parts ladder --trials FOLDER [--rungs NAME ...] [--by ppo sac dagger bc] [--json FILE]

A trial is one training of one learner with one seed on one rung, and then `EPISODES` episodes without exploration that
nothing was learned from, all from the normal start. Each has its JSON file in the folder of the trials, beside its
checkpoint, and is not run again while the file is there: a ladder that was ended goes on with the same command, and
`--first-seed 3 --seeds 1` runs one trial. Without `--rungs` those of `LADDER` are climbed; `RUNGS` has further ones,
each of which differs from another in one thing. Minutes are those of the training; of ppo and sac, without its checks.
"""

from __future__ import annotations

import dataclasses
import json
import os
import shutil
import time
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any, Final

import stable_baselines3  # noqa: F401  # an error before the first trial, not in it
import train_with_sb3 as example

from dual_ur10.policies import evaluate
from dual_ur10.policies.evaluation.results import Evaluation
from dual_ur10.policies.learned import checkpoint
from dual_ur10.policies.training import state
from dual_ur10.policies.training.settings import defaults
from dual_ur10.policies.training.train import train

EPISODES: Final = 100
BY: Final = ("ppo", "sac", "dagger", "bc")
REACHED: Final = 0.9  # of the episodes of a check


_STARTS: Final = dict.fromkeys(("lift", "present", "mutual_grasp", "release"), 0.1)
_IMITATED: Final = {"DAGGER": 23_040, "BC": 23_040}  # steps; the whole task has 460,800 and 115,200
_SINE, _LIFT, _CARRY, _HANDOVER = (example.RECIPES[name] for name in ("SineTracking", "lift", "SyncCarry", "Handover"))


def but(recipe: example.Recipe, changes: dict[str, Any] | None = None, **others: Any) -> example.Recipe:
    """Return a recipe with other keywords of the environment (`changes`), or other settings."""
    return dataclasses.replace(recipe, keywords={**recipe.keywords, **(changes or {})}, **others)


RUNGS: Final[dict[str, example.Recipe]] = {
    "SineTracking-v0": _SINE,
    "Handover-v0/lift": but(_LIFT, steps=_LIFT.steps | _IMITATED),
    "Handover-v0/lift/25 Hz": but(_LIFT, {"policy_rate_hz": 25.0}, short=200),
    "Handover-v0/lift/turned": but(_LIFT, {"action_mode": "tcp_delta", "object_turn_rad": 0.5236}),
    "Handover-v0/lift/progress": but(_LIFT, {"progress_weight": 20.0}),
    "SyncCarry-v0": _CARRY,
    "SyncCarry-v0/all seen": but(_CARRY, seen=()),
    "SyncCarry-v0/no path speed": but(_CARRY, {"path_speed": False}),
    "Handover-v0/held": but(_HANDOVER, starts=_STARTS),
    "Handover-v0": _HANDOVER,
    "Handover-v0/in step": but(_HANDOVER, staggered=False),
    "Handover-v0/value of goals": but(_HANDOVER, {"observation": "goals"}, scaled=False),
    "Handover-v0/rewards of states": but(_HANDOVER, differences=False),
    **{f"{task}-v0": example.recipe_of(task) for task in ("TrayBalance", "LidAndPlace", "PegInsertion")},
}
"""Rungs by name, each a task as a recipe has it, or one that differs from another in one thing."""

LADDER: Final = ("SineTracking-v0", "Handover-v0/lift", "SyncCarry-v0", "Handover-v0")


def climb(
    folder: Path, rungs: Iterable[str], by: Sequence[str], seeds: Iterable[int], episodes: int = EPISODES
) -> dict[str, dict[str, Any]]:
    """Run the trials that have no result yet, and return all that the folder has, by rung and learner."""
    seeds = list(seeds)
    folder.mkdir(parents=True, exist_ok=True)
    for name in rungs:
        for learner in by:
            for seed in seeds:
                trial = _place(folder, name, learner, seed)
                if not trial.with_suffix(".json").exists():
                    for left in (trial, _training(trial)):  # by one that was ended
                        shutil.rmtree(left, ignore_errors=True)
                    print(f"{name}, {learner}, seed {seed}, load {os.getloadavg()[0]:.1f}", flush=True)
                    _write(trial.with_suffix(".json"), run(RUNGS[name], learner, seed, trial, episodes))
    return results(folder)


def results(folder: Path) -> dict[str, dict[str, Any]]:
    """Return the results in a folder of trials: {"Handover-v0/held": {"ppo": {"successes": [...], ...}}}."""
    found: dict[str, dict[str, Any]] = {}
    for name in RUNGS:
        for learner in BY:
            paths = sorted(folder.glob(f"{_place(folder, name, learner, 0).name.removesuffix('0')}*.json"))
            trials = [json.loads(path.read_text()) for path in paths]
            if not trials:
                continue
            rows = sorted(trials, key=lambda each: each["seed"])
            found.setdefault(name, {})[learner] = {
                "seeds": [each["seed"] for each in rows],
                "successes": [each["successes"] for each in rows],
                "of": rows[0]["of"],
                "steps": max(each["steps"] for each in rows),
                "minutes": [each["minutes"] for each in rows],
                "steps_to_90": [each["steps_to_90"] for each in rows],
                "minutes_to_90": [each["minutes_to_90"] for each in rows],
                "curves": [each["curve"] for each in rows],
            }
    return found


def run(rung: example.Recipe, learner: str, seed: int, place: Path, episodes: int = EPISODES) -> dict[str, Any]:
    """Run one trial, save its checkpoint to a new folder and return its result."""
    steps, minutes, success, curve = (_imitated if learner in ("dagger", "bc") else _stock)(
        rung, learner, seed, place, episodes
    )
    reached = next((each for each in curve if each["success"] >= REACHED), None)
    row = {
        "seed": seed,
        "successes": round(success * episodes),
        "of": episodes,
        "steps": steps,
        "minutes": minutes,
        "steps_to_90": None if reached is None else reached["steps"],
        "minutes_to_90": None if reached is None else reached["minutes"],
    }
    print(json.dumps(row), flush=True)
    return row | {"curve": curve}


def _stock(
    rung: example.Recipe, learner: str, seed: int, place: Path, episodes: int
) -> tuple[int, float, float, list[dict[str, float]]]:
    """Train Stable-Baselines3; return steps, minutes, the ratio of successes, and the curve."""
    algorithm, curve = learner.upper(), list[dict[str, float]]()
    model, steps, minutes = example.train(rung, algorithm, seed, curve=curve)
    found = example.measure(rung, algorithm, model, episodes, 0)
    example.save(rung, algorithm, model, place)
    return steps, minutes, float(found["success"]), curve


def _imitated(
    rung: example.Recipe, learner: str, seed: int, place: Path, episodes: int
) -> tuple[int, float, float, list[dict[str, float]]]:
    """Imitate the scripted policy, which sees all fields; return steps, minutes, successes, and the curve."""
    keywords = {name: value for name, value in rung.keywords.items() if name != "observation"}
    asked = defaults(
        _env_id(rung), learner, "shared", seed=seed, steps=rung.steps.get(learner.upper()), keywords=keywords
    )
    begin_s, training = time.monotonic(), _training(place)
    train(asked, training)
    minutes = (time.monotonic() - begin_s) / 60
    policy = checkpoint.load(training / "policy")
    found: Evaluation = evaluate(_env_id(rung), str(training / "policy"), episodes=episodes, env_kwargs=asked.keywords)
    checkpoint.save(place, policy.layers, policy.manifest)
    values = state.load(training / "state")[1]
    curve = [
        {"steps": each["steps"], "minutes": each["seconds"] / 60, "success": each["success_rate"]}
        for each in values["checks"]
    ]
    return values["steps"], minutes, found.success_rate, curve


def _env_id(rung: example.Recipe) -> str:
    return f"DualUR10/{rung.task}-v0"


def _place(folder: Path, name: str, learner: str, seed: int) -> Path:
    return folder / f"{name.replace('/', ' ').replace(' ', '_')}-{learner}-{seed}"


def _training(place: Path) -> Path:
    """Return the folder of a training of this package."""
    return place.with_name(f"{place.name}-training")


def _write(path: Path, value: object) -> None:
    """Write a result as a whole or not at all."""
    path.parent.mkdir(parents=True, exist_ok=True)
    part = path.with_suffix(".part")
    part.write_text(json.dumps(value, indent=1) + "\n")
    part.replace(path)
