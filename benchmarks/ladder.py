"""The ladder: steps and minutes until learners succeed, from one arm that lifts to whole tasks.

python benchmarks/learning.py --parts ladder --trials FOLDER [--rungs NAME ...] [--by ppo sac dagger bc] [--json FILE]

A trial is one training of one learner with one seed on one rung, and then `EPISODES` episodes without exploration that
nothing was learned from, all from the normal start. Each has its JSON file in the folder of the trials, beside its
checkpoint, and is not run again while the file is there: a ladder that was ended goes on with the same command, and
`--first-seed 3 --seeds 1` runs one trial. Without `--rungs` those of `LADDER` are climbed; `RUNGS` has further ones,
each of which differs from another in one thing. Minutes are those of the training without its checks.
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
from dual_ur10.policies.learned.from_sb3 import converted
from dual_ur10.policies.learned.manifest import AgentsKind
from dual_ur10.policies.training import state
from dual_ur10.policies.training.settings import defaults
from dual_ur10.policies.training.train import train

EPISODES: Final = 100
BY: Final = ("ppo", "sac", "dagger", "bc")
REACHED: Final = 0.9  # of the episodes of a check


@dataclasses.dataclass(frozen=True, kw_only=True)
class Rung:
    """Task and keywords that learners are given.

    Attributes:
        task: Short name of the task.
        keywords: Keywords of the environment, in training and evaluation.
        starts: Ratios of the training's episodes that begin after stages.
        steps: Steps of a training by learner; others have those of `train`.
        short: Steps after which an episode of stock learners is truncated.
        unseen: Fields that the policies of stock learners do not see.
        differences: Stock learners earn what a step has changed.
    """

    task: str
    keywords: dict[str, Any]
    starts: dict[str, float] | None = None
    steps: dict[str, int]
    short: int = 500
    unseen: tuple[str, ...] = ()
    differences: bool = False

    def but(self, **changes: Any) -> Rung:
        """Return the rung with other keywords of the environment."""
        return dataclasses.replace(self, keywords={**self.keywords, **changes})


_GOALS: Final = {"observation": "goals", "action_mode": "tcp_delta"}
_LIFT: Final = Rung(
    task="Handover",
    keywords=example.LIFT,
    steps={"ppo": example.LIFT_STEPS, "sac": 100_000},
    short=example.LIFT_SHORT,
)
_HANDOVER: Final = Rung(
    task="Handover",
    keywords=example.HANDOVER,
    steps={"ppo": example.HANDOVER_STEPS, "sac": 1_000_000},
    short=example.HANDOVER_SHORT,
    unseen=example.HANDOVER_UNSEEN,
    differences=True,
)
_HELD: Final = dataclasses.replace(_HANDOVER, starts=example.HELD)
_CARRY: Final = Rung(
    task="SyncCarry",
    keywords=example.CARRY,
    steps={"ppo": example.OBJECTS_STEPS["SyncCarry"], "sac": 500_000},
    short=example.OBJECTS_SHORT["SyncCarry"],
    unseen=example.CARRY_UNSEEN,
)


def _led(task: str) -> Rung:
    return Rung(task=task, keywords=_GOALS, steps={"ppo": 1_500_000, "sac": 500_000})


RUNGS: Final[dict[str, Rung]] = {
    "SineTracking-v0": Rung(task=example.SINE, keywords=example.SEEN, steps=example.STEPS, short=example.SHORT),
    "Handover-v0/lift": _LIFT,
    "Handover-v0/lift/25 Hz": dataclasses.replace(_LIFT.but(policy_rate_hz=25.0), short=200),
    "Handover-v0/lift/turned": _LIFT.but(action_mode="tcp_delta", object_turn_rad=0.5236),
    "Handover-v0/lift/progress": _LIFT.but(progress_weight=20.0),
    "SyncCarry-v0": _CARRY,
    "SyncCarry-v0/all seen": dataclasses.replace(_CARRY, unseen=()),
    "SyncCarry-v0/no path speed": _CARRY.but(path_speed=False),
    "Handover-v0/held": _HELD,
    "Handover-v0/held/all seen": dataclasses.replace(_HELD, unseen=()),
    "Handover-v0/held/rewards of states": dataclasses.replace(_HELD, differences=False),
    "Handover-v0/held/25 Hz": dataclasses.replace(_HELD.but(policy_rate_hz=25.0), short=500),
    "Handover-v0": _HANDOVER,
    "TrayBalance-v0": _led("TrayBalance"),
    "LidAndPlace-v0": _led("LidAndPlace"),
    "PegInsertion-v0": _led("PegInsertion"),
}
LADDER: Final = ("SineTracking-v0", "Handover-v0/lift", "SyncCarry-v0", "Handover-v0/held", "Handover-v0")


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


def run(rung: Rung, learner: str, seed: int, place: Path, episodes: int = EPISODES) -> dict[str, Any]:
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
    rung: Rung, learner: str, seed: int, place: Path, episodes: int
) -> tuple[int, float, float, list[dict[str, float]]]:
    """Train Stable-Baselines3; return steps, minutes, the ratio of successes, and the curve."""
    algorithm, curve = learner.upper(), list[dict[str, float]]()
    settings = example.settings_of(rung.task, algorithm)
    if rung.task != example.SINE and algorithm != "PPO":
        settings = {**settings, "gamma": example.settings_of(rung.task)["gamma"]}
    model, steps, minutes = example.train(
        algorithm,
        seed,
        rung.steps.get(learner, rung.steps.get(algorithm, 0)),
        settings,
        task=rung.task,
        short=rung.short,
        curve=curve,
        starts=rung.starts,
        unseen=rung.unseen,
        differences=rung.differences,
        **rung.keywords,
    )
    found = example.measure(rung.task, algorithm, model, episodes, 0, **rung.keywords)
    agents: AgentsKind = "joint" if rung.task == example.SINE and algorithm == "PPO" else "shared"
    checkpoint.save(place, *converted(model, _env_id(rung), agents=agents, **rung.keywords))
    return steps, minutes, float(found["success"]), curve


def _imitated(
    rung: Rung, learner: str, seed: int, place: Path, episodes: int
) -> tuple[int, float, float, list[dict[str, float]]]:
    """Imitate the scripted policy, which sees all fields; return steps, minutes, successes, and the curve."""
    keywords = {name: value for name, value in rung.keywords.items() if name != "observation"}
    asked = defaults(_env_id(rung), learner, "shared", seed=seed, steps=rung.steps.get(learner), keywords=keywords)
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


def _env_id(rung: Rung) -> str:
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
