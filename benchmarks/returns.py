"""Measure what policies earn that do nothing, something random, their task with a disturbance, or something else.

Rewards should order policies as people would. For each task one table has the mean return of:

    floor: zero actions, uniform ones, and normal ones with a standard deviation of 0.3.
    script: the scripted policy; `share` is the ratio of a return to its own.
    disturbed: the script with position errors, pauses, one arm only, and stopping part of the way.
    cheat: what may earn a reward without doing the task.

`without` is the share without the cost of refused motions. Episodes have the default keywords and the seeds 0, 1, ...

    python benchmarks/returns.py [--tasks SineTracking] [--seeds 4] [--json returns.json]
"""

from __future__ import annotations

import os

os.environ.setdefault("OMP_NUM_THREADS", "1")  # before numpy reads it
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import argparse
import json
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from dual_ur10 import policies
from dual_ur10.envs.api.vector_env import DualArmVectorEnv
from dual_ur10.ids import ENV_IDS
from dual_ur10.policies.evaluation.audit.episodes import (
    FLOORS,
    JOINTS,
    SCRIPT,
    Behaviour,
    Change,
    Job,
    RunningEpisode,
    hold,
    part,
    release,
    run,
    stage,
    until,
)

ERRORS_MM = (1, 2, 5, 8, 10, 20, 30, 50, 100)
PAUSES = (0.1, 0.25, 0.5)
PARTS = (0.25, 0.5, 0.75)
PAUSE_STEPS = 50


def shake(row: RunningEpisode) -> None:
    """Move all joints to and fro."""
    row.joints[:] = 0.3 * (-1.0) ** row.step


def cycle(row: RunningEpisode) -> None:
    """Stop all joints, and close and open the grippers in turn."""
    row.action[:] = -1.0 if row.step // 12 % 2 else 1.0
    hold(row)


def pausing(share: float) -> Callable[[RunningEpisode], bool]:
    """Return the condition of a pause, a share of each two seconds."""
    return lambda row: row.step % PAUSE_STEPS >= PAUSE_STEPS * (1.0 - share)


def waiting_after(steps: int) -> Callable[[RunningEpisode], bool]:
    """Return the condition that a stage was passed so many steps ago or fewer."""

    def waits(row: RunningEpisode) -> bool:
        now, (before, since) = row.info.get("stage", 0), row.memory.get("passed", (0, 0))
        if now > before:
            before, since = now, row.step
        row.memory["passed"] = before, since
        return bool(since > 0 and row.step < since + steps)

    return waits


def only(arm: int) -> Change:
    """Return a change that stops the other arm, and opens its gripper."""

    def act(row: RunningEpisode) -> None:
        row.action[1 - arm] = 0.0

    return act


def clock(time_s: float) -> Callable[[RunningEpisode], bool]:
    """Return the condition that the path's clock has come so far."""
    return lambda row: row.info.get("clock_s", -np.inf) >= time_s


def shifted(error_m: float, *names: str, common: bool = False) -> Change:
    """Return a change by which positions are seen with a constant error in a random direction."""

    def see(row: RunningEpisode) -> None:
        for name in names:
            row.fields[name][:] += error_m * row.direction(common=common)

    return see


def late(steps: int, *names: str) -> Change:
    """Return a change by which fields are seen some steps later."""

    def see(row: RunningEpisode) -> None:
        seen = row.memory.setdefault("seen", [])
        seen.append([row.fields[name].copy() for name in names])
        for name, value in zip(names, seen[max(0, len(seen) - 1 - steps)], strict=True):
            row.fields[name][:] = value

    return see


REFERENCES = "reference_base_m", "ahead_base_m"


def scaled(factor: Callable[[float], float]) -> Change:
    """Return a change by which references are seen elsewhere on their line, in metres from the centre."""

    def see(row: RunningEpisode) -> None:
        center, along = row.memory.setdefault("center", row.fields[REFERENCES[0]].copy()), row.to_base[:, :, 1]
        for name in REFERENCES:
            away_m = np.vecdot(row.fields[name] - center, along)
            row.fields[name][:] = center + along * np.array([factor(each) for each in away_m.tolist()])[:, None]

    return see


def waiting(arm: int) -> Change:
    """Return a change by which one arm sees its first references for ever."""

    def see(row: RunningEpisode) -> None:
        center = row.memory.setdefault("center", row.fields[REFERENCES[0]].copy())
        for name in REFERENCES:
            row.fields[name][arm] = center[arm]

    return see


def pauses() -> dict[str, Behaviour]:
    """Return pauses at any time, at which arms near a table stop too far down."""
    return {f"pauses {100 * each:g} %": Behaviour("disturbed", waits=pausing(each)) for each in PAUSES}


def sine_tracking() -> dict[str, Behaviour]:
    """Return what is measured in SineTracking."""
    found = pauses() | {
        f"{each} mm beside": Behaviour("disturbed", sees=shifted(1e-3 * each, *REFERENCES)) for each in ERRORS_MM
    }
    found |= {f"{each} periods late": Behaviour("disturbed", sees=late(each, *REFERENCES)) for each in (1, 2, 5)}
    found |= {
        f"{each} of the amplitude": Behaviour("disturbed", sees=scaled(lambda away_m, each=each: each * away_m))
        for each in (0.9, 0.75, 0.5)
    }
    extreme = scaled(lambda away_m: 0.1)
    return {
        **found,
        "left arm only": Behaviour("disturbed", sees=waiting(1)),
        "right arm only": Behaviour("disturbed", sees=waiting(0)),
        "at the extreme": Behaviour("cheat", sees=extreme),
        "at 0.7 of the extreme": Behaviour("cheat", sees=scaled(lambda away_m: 0.07)),
        "from extreme to extreme": Behaviour("cheat", sees=scaled(lambda away_m: 0.1 if away_m > 0 else -0.1)),
        "the other way": Behaviour("cheat", sees=scaled(lambda away_m: -away_m)),
        "shaking at the centre": Behaviour("cheat", shake),
        "shaking at the extreme": Behaviour(
            "cheat", lambda row: shake(row) if row.step > PAUSE_STEPS else None, extreme
        ),
    }


def handover() -> dict[str, Behaviour]:
    """Return what is measured in Handover."""
    objects = "block_base_m", "target_base_m"
    found = {
        f"{each} mm beside": Behaviour("disturbed", sees=shifted(1e-3 * each, *objects, common=True))
        for each in ERRORS_MM
    }
    found |= {
        f"{each} mm beside the target": Behaviour("disturbed", sees=shifted(1e-3 * each, "target_base_m", common=True))
        for each in (20, 50, 100)
    }
    found |= {
        f"waits {each * 0.04:.1f} s at each stage": Behaviour("disturbed", waits=waiting_after(each))
        for each in (5, 15, 40)
    }
    found |= {f"holds at stage {each}": Behaviour("disturbed", until(stage(each), hold)) for each in range(1, 7)}
    return {
        **found,
        **{f"releases at stage {each}": Behaviour("cheat", until(stage(each), release)) for each in range(1, 7)},
        **{f"opens and closes at stage {each}": Behaviour("cheat", until(stage(each), cycle)) for each in (1, 2, 3)},
        **{f"shakes at stage {each}": Behaviour("cheat", until(stage(each), shake)) for each in (0, 1, 3, 4)},
    }


def sync_carry() -> dict[str, Behaviour]:
    """Return what is measured in SyncCarry."""

    def beside(error_m: float) -> Change:
        def see(row: RunningEpisode) -> None:
            grown = float(np.clip(row.info.get("clock_s", -1.0) / 2.0, 0.0, 1.0))
            row.fields["ahead_base_m"][:] += grown * error_m * row.direction(common=True)

        return see

    def empty(row: RunningEpisode) -> None:
        row.action[:, JOINTS:] = 1.0

    found = pauses() | {f"{each} mm beside": Behaviour("disturbed", sees=beside(1e-3 * each)) for each in ERRORS_MM}
    found |= {
        f"grips {each} mm beside": Behaviour("disturbed", sees=shifted(1e-3 * each, "bar_base_m", common=True))
        for each in (10, 20, 50, 100)
    }
    return {
        **found,
        "holds the bar on the table": Behaviour("cheat", until(clock(-0.2), hold)),
        "shakes the bar on the table": Behaviour("cheat", until(clock(-0.2), shake)),
        "opens and closes": Behaviour("cheat", until(clock(-0.5), cycle)),
        "follows with open fingers": Behaviour("cheat", empty),
        "hovers": Behaviour("cheat", until(clock(-1.5), release)),
        "releases half-way": Behaviour("cheat", until(part(0.5), release)),
        "shakes half-way": Behaviour("cheat", until(part(0.5), shake)),
        "shakes": Behaviour("cheat", shake),
    }


COMMON = {
    **FLOORS,
    "script": SCRIPT,
    "left arm only": Behaviour("disturbed", only(0)),
    "right arm only": Behaviour("disturbed", only(1)),
    **{f"stops after {100 * each:g} %": Behaviour("disturbed", until(part(each), hold)) for each in PARTS},
}
OF_TASKS = {"SineTracking": sine_tracking, "Handover": handover, "SyncCarry": sync_carry}


def behaviours_of(env_id: str) -> dict[str, Behaviour]:
    """Return what is measured in a task, by name."""
    own = OF_TASKS[env_id.partition("/")[2].partition("-")[0]]()
    found = {**COMMON, **own}
    return {name: found[name] for group in ("floor", "script", "disturbed", "cheat") for name in _of(found, group)}


def _of(behaviours: Mapping[str, Behaviour], group: str) -> list[str]:
    return [name for name, each in behaviours.items() if each.group == group]


def measure(
    env_id: str,
    behaviours: Mapping[str, Behaviour],
    seeds: Sequence[int],
    max_episode_steps: int | None = None,
    **keywords: Any,
) -> dict[str, dict[str, Any]]:
    """Run an episode of each behaviour with each seed, all in one batch.

    Returns:
        For each behaviour arrays (seeds,): `return`, `refusals` (what refused motions cost), `steps`, `success`, and
        means over the steps of numbers in `info` that have one or two values.
    """
    env = DualArmVectorEnv(
        len(behaviours) * len(seeds),
        env_id,
        autoreset_mode="Disabled",
        max_episode_steps=max_episode_steps,
        **keywords,
    )
    jobs = [Job(name, behaviour, seed) for name, behaviour in behaviours.items() for seed in seeds]
    refusal = env.core.weights.get("refusal", 0.0)
    horizon = max_episode_steps or env.core.task.horizon or 0
    episodes = run(env, jobs, lambda: policies.load("scripted", env_id), horizon)
    env.close()
    found: dict[str, dict[str, Any]] = {}
    for name in behaviours:
        own = [each for each in episodes if each.name == name]
        figures = {
            "return": [each.earned for each in own],
            "refusals": [refusal * each.numbers["reward/refusal"].sum() for each in own],
            "steps": [each.steps for each in own],
            "success": [each.success for each in own],
            **{key: [each.numbers[key].mean(axis=0) for each in own] for key in own[0].numbers},
        }
        found[name] = {key: np.array(values, dtype=np.float64) for key, values in figures.items()}
    return found


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--tasks", default="", help="names, with commas between them; all without")
    parser.add_argument("--seeds", type=int, default=4)
    parser.add_argument("--json", type=Path)
    args = parser.parse_args()
    results: dict[str, Any] = {}
    for env_id in ENV_IDS:
        task = env_id.partition("/")[2]
        if task.partition("-")[0] not in OF_TASKS:
            continue  # Free has no reward
        if args.tasks and task.partition("-")[0] not in args.tasks.split(","):
            continue
        behaviours = behaviours_of(env_id)
        found = measure(env_id, behaviours, range(args.seeds))
        script = float(found["script"]["return"].mean())
        results[task] = {"script": script, "behaviours": {}}
        print(f"{env_id}: the script earns {script:.1f}")
        print(f"{'':32}{'return':>8}{'share':>8}{'without':>9}{'steps':>7}{'success':>9}  terms")
        for name, row in found.items():
            mean = {key: float(np.mean(value)) for key, value in row.items()}
            mean |= {"share": mean["return"] / script, "without": (mean["return"] - mean["refusals"]) / script}
            results[task]["behaviours"][name] = {"group": behaviours[name].group, **mean}
            terms = ", ".join(f"{key[7:]} {value:.3f}" for key, value in mean.items() if key.startswith("reward/"))
            print(
                f"{name:32}{mean['return']:8.1f}{100 * mean['share']:7.1f}%{100 * mean['without']:8.1f}%"
                f"{mean['steps']:7.0f}{mean['success']:9.2f}  {terms}",
                flush=True,
            )
    if args.json is not None:
        args.json.write_text(json.dumps(results, indent=1) + "\n")


if __name__ == "__main__":
    main()
