"""Baselines of all tasks: script, DAgger, behaviour cloning, ACT and PPO on nominal, mild and wide plants.

Seeds are 0, 1, ...; trainings learn from others. Results are written after every part, so that the command can be
stopped and continues where it was; a result of an older script or checkpoint is not measured again unless its entry is
removed. The page of the documentation shows the JSON.

    python benchmarks/baselines.py --json docs/reference/baselines.json
    python benchmarks/baselines.py --json FILE --task BoxLift --learner script --episodes 20

Learners:
    script: the scripted policy.
    dagger: the learned policy that comes with the package; none where none comes.
    bc: behaviour cloning of 50 episodes of the script under noise, with the general settings of `train`.
    act: ACT of 50 episodes of the script under noise, with the settings of `train`.
    ppo: Stable-Baselines3's PPO as `examples/train_with_sb3.py` has it for the task; 200,000 steps where it has none.
"""

from __future__ import annotations

import os

for _name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"):
    os.environ.setdefault(_name, "1")

import argparse
import json
import subprocess
import sys
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

from dual_ur10.ids import ENV_IDS, TASKS, env_id_of
from dual_ur10.policies import evaluate
from dual_ur10.policies.learned import checkpoint
from dual_ur10.policies.registry import shipped_folder, shipped_names
from dual_ur10.policies.training import state
from dual_ur10.policies.training.settings import defaults
from dual_ur10.policies.training.train import resume, train

ROOT = Path(__file__).parents[1]
RANDOMIZATIONS = {"nominal": "none", "mild": "mild", "wide": "wide"}
PART = 100
"""Episodes after which results are written."""

DEMONSTRATIONS = 50
PPO_STEPS = 200_000
"""Environment steps of PPO on tasks that have no recipe of their own in the example."""

Policy = tuple[str, dict[str, Any], dict[str, Any]]
"""Name or folder of a policy, keywords of its environment, and figures of its training."""


def script(env_id: str, folder: Path) -> Policy | None:
    """Return the scripted policy."""
    return "scripted", {}, {}


def dagger(env_id: str, folder: Path) -> Policy | None:
    """Return the learned policy that comes with the package, for both arms."""
    if "learned" not in shipped_names(env_id):
        return None
    path = shipped_folder("learned", env_id)
    manifest = checkpoint.read_manifest(path)
    latency = {"action_latency_ticks": manifest.signature.rate.latency_ticks}
    return str(path), latency, {"steps": manifest.training["steps"], "seed": manifest.seed}


def cloned(algorithm: str, env_id: str, folder: Path) -> Policy | None:
    """Imitate 50 demonstrations of the script, unless that has been done."""
    asked = defaults(env_id, algorithm, envs=DEMONSTRATIONS, changes={"demonstrations": DEMONSTRATIONS})
    path = folder / algorithm
    if not (path / "policy").exists():
        resume(path) if path.exists() else train(asked, path)
    values = state.load(path / "state")[1]
    found = {"steps": values["steps"], "demonstrations": DEMONSTRATIONS, "seed": 0, "minutes": values["seconds"] / 60}
    return str(path / "policy"), {"action_latency_ticks": asked.keywords["action_latency_ticks"]}, found


def ppo(env_id: str, folder: Path) -> Policy | None:
    """Train stock PPO, unless that has been done."""
    sys.path.append(str(ROOT / "examples"))
    import train_with_sb3 as example

    task, path = env_id.partition("/")[2].rpartition("-v")[0], folder / "ppo"
    recipe = example.recipe_of(task)
    found: dict[str, Any] = {"seed": 0}
    if not path.exists():
        model, steps, minutes = example.train(recipe, "PPO", 0, 0 if task in example.RECIPES else PPO_STEPS)
        (folder / "ppo.json").write_text(json.dumps({"steps": steps, "minutes": minutes}))
        example.save(recipe, "PPO", model, path)  # last: what is there is whole
    return str(path), recipe.keywords, found | json.loads((folder / "ppo.json").read_text())


LEARNERS: dict[str, Callable[[str, Path], Policy | None]] = {
    "script": script,
    "dagger": dagger,
    "bc": partial(cloned, "bc"),
    "act": partial(cloned, "act"),
    "ppo": ppo,
}


def commit() -> str:
    """Return the commit of the repository."""
    command = ["git", "-C", str(ROOT), "rev-parse", "--short", "HEAD"]
    return subprocess.run(command, capture_output=True, text=True, check=True).stdout.strip()


def main() -> None:
    """Run the measurement from the command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--task", action="append", help="one of the tasks; may be repeated")
    parser.add_argument("--learner", action="append", choices=list(LEARNERS), help="may be repeated")
    parser.add_argument("--episodes", type=int, default=300, help="episodes with each randomization")
    parser.add_argument("--json", type=Path, required=True, help="results, continued if they exist")
    parser.add_argument("--out", type=Path, default=ROOT / "out" / "baselines", help="folder of the trained policies")
    arguments = parser.parse_args()
    results: dict[str, Any] = json.loads(arguments.json.read_text()) if arguments.json.exists() else {}
    for env_id in map(env_id_of, arguments.task or [each for each in ENV_IDS if TASKS[each].scripted]):
        folder = arguments.out / env_id.partition("/")[2]
        folder.mkdir(parents=True, exist_ok=True)
        for name in arguments.learner or LEARNERS:
            found = LEARNERS[name](env_id, folder)
            if found is None:
                continue
            policy, keywords, training = found
            row = results.setdefault(env_id.partition("/")[2], {}).setdefault(name, {**training, "commit": commit()})
            for title, preset in RANDOMIZATIONS.items():
                while (count := row.setdefault(title, [0, 0]))[1] < arguments.episodes:
                    part = evaluate(
                        env_id,
                        policy,
                        episodes=min(PART, arguments.episodes - count[1]),
                        seed=count[1],
                        num_envs=PART,
                        env_kwargs={**keywords, "randomization": preset},
                    )
                    row[title] = [count[0] + part.successes, count[1] + len(part.episodes)]
                    arguments.json.write_text(json.dumps(results, indent=1) + "\n")
            print(f"{env_id}, {name}: {json.dumps(row)}", flush=True)


if __name__ == "__main__":
    main()
