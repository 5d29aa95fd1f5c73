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
import dataclasses
import json
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from dual_ur10 import policies
from dual_ur10.envs.api.vector_env import DualArmVectorEnv
from dual_ur10.ids import ENV_IDS
from ur_core.kinematics.frames import Frames

Array = NDArray[np.float64]
JOINTS = 6
ERRORS_MM = (1, 2, 5, 8, 10, 20, 30, 50, 100)
PAUSES = (0.1, 0.25, 0.5)
PARTS = (0.25, 0.5, 0.75)
PAUSE_STEPS = 50


@dataclasses.dataclass
class Row:
    """One episode.

    Attributes:
        rng: Random numbers of this episode.
        to_base: (2, 3, 3) rotations from the cell frame to the bases.
        horizon: Steps of an episode.
        step: Steps so far.
        fields: Fields of the observation that the script sees, (2, field size) each, which may be changed.
        action: (2, size) action of both arms, which may be changed.
        info: Numbers of the last step's `info`.
        memory: What a behaviour remembers.
    """

    rng: np.random.Generator
    to_base: Array
    horizon: int
    step: int = 0
    fields: Mapping[str, Array] = dataclasses.field(default_factory=dict)
    action: Array = dataclasses.field(default_factory=lambda: np.zeros((2, JOINTS)))
    info: dict[str, Any] = dataclasses.field(default_factory=dict)
    memory: dict[str, Any] = dataclasses.field(default_factory=dict)

    @property
    def joints(self) -> Array:
        """(2, 6) part of the action that moves joints."""
        return self.action[:, :JOINTS]

    def direction(self, *, common: bool) -> Array:
        """Return a random horizontal direction in the bases, (2, 3): one for both arms, or one for each."""
        if "direction" not in self.memory:
            drawn = self.rng.normal(size=(1 if common else 2, 3)) * (1.0, 1.0, 0.0)
            drawn = np.broadcast_to(drawn / np.linalg.norm(drawn, axis=1, keepdims=True), (2, 3))
            self.memory["direction"] = np.einsum("aij,aj->ai", self.to_base, drawn)
        found: Array = self.memory["direction"]
        return found


Change = Callable[[Row], None]


def _nothing(row: Row) -> None:
    """Change nothing."""


@dataclasses.dataclass(frozen=True)
class Behaviour:
    """The scripted policy with changes of what it sees and of what it does.

    Attributes:
        group: Part of the table.
        acts: Change of the action.
        sees: Change of the observation that the script sees.
        waits: True in steps in which all joints stop, and the script is not asked.
    """

    group: str
    acts: Change = _nothing
    sees: Change = _nothing
    waits: Callable[[Row], bool] = lambda row: False


def zero(row: Row) -> None:
    """Act with zeros."""
    row.action[:] = 0.0


def uniform(row: Row) -> None:
    """Act at random."""
    row.action[:] = row.rng.uniform(-1.0, 1.0, row.action.shape)


def normal(row: Row) -> None:
    """Act at random, less widely."""
    row.action[:] = row.rng.normal(0.0, 0.3, row.action.shape)


def hold(row: Row) -> None:
    """Stop all joints; the grippers keep their commands."""
    row.joints[:] = 0.0


def release(row: Row) -> None:
    """Stop all joints and open the grippers."""
    row.action[:] = 1.0
    hold(row)


def shake(row: Row) -> None:
    """Move all joints to and fro."""
    row.joints[:] = 0.3 * (-1.0) ** row.step


def cycle(row: Row) -> None:
    """Stop all joints, and close and open the grippers in turn."""
    row.action[:] = -1.0 if row.step // 12 % 2 else 1.0
    hold(row)


def pausing(share: float) -> Callable[[Row], bool]:
    """Return the condition of a pause, a share of each two seconds."""
    return lambda row: row.step % PAUSE_STEPS >= PAUSE_STEPS * (1.0 - share)


def waiting_after(steps: int) -> Callable[[Row], bool]:
    """Return the condition that a stage was passed so many steps ago or fewer."""

    def waits(row: Row) -> bool:
        now, (before, since) = row.info.get("stage", 0), row.memory.get("passed", (0, 0))
        if now > before:
            before, since = now, row.step
        row.memory["passed"] = before, since
        return bool(since > 0 and row.step < since + steps)

    return waits


def only(arm: int) -> Change:
    """Return a change that stops the other arm, and opens its gripper."""

    def act(row: Row) -> None:
        row.action[1 - arm] = 0.0

    return act


def until(over: Callable[[Row], bool], instead: Change) -> Change:
    """Return a change that does something else from when a condition is first true."""

    def act(row: Row) -> None:
        row.memory["over"] = row.memory.get("over", False) or over(row)
        if row.memory["over"]:
            instead(row)

    return act


def part(share: float) -> Callable[[Row], bool]:
    """Return the condition that a share of the episode is over."""
    return lambda row: row.step >= share * row.horizon


def stage(number: int) -> Callable[[Row], bool]:
    """Return the condition that a number of stages is passed."""
    return lambda row: row.info.get("stage", 0) >= number


def clock(time_s: float) -> Callable[[Row], bool]:
    """Return the condition that the path's clock has come so far."""
    return lambda row: row.info.get("clock_s", -np.inf) >= time_s


def shifted(error_m: float, *names: str, common: bool = False) -> Change:
    """Return a change by which positions are seen with a constant error in a random direction."""

    def see(row: Row) -> None:
        for name in names:
            row.fields[name][:] += error_m * row.direction(common=common)

    return see


def late(steps: int, *names: str) -> Change:
    """Return a change by which fields are seen some steps later."""

    def see(row: Row) -> None:
        seen = row.memory.setdefault("seen", [])
        seen.append([row.fields[name].copy() for name in names])
        for name, value in zip(names, seen[max(0, len(seen) - 1 - steps)], strict=True):
            row.fields[name][:] = value

    return see


REFERENCES = "reference_base_m", "ahead_base_m"


def scaled(factor: Callable[[float], float]) -> Change:
    """Return a change by which references are seen elsewhere on their line, in metres from the centre."""

    def see(row: Row) -> None:
        center, along = row.memory.setdefault("center", row.fields[REFERENCES[0]].copy()), row.to_base[:, :, 1]
        for name in REFERENCES:
            away_m = np.vecdot(row.fields[name] - center, along)
            row.fields[name][:] = center + along * np.array([factor(each) for each in away_m.tolist()])[:, None]

    return see


def waiting(arm: int) -> Change:
    """Return a change by which one arm sees its first references for ever."""

    def see(row: Row) -> None:
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
        def see(row: Row) -> None:
            grown = float(np.clip(row.info.get("clock_s", -1.0) / 2.0, 0.0, 1.0))
            row.fields["ahead_base_m"][:] += grown * error_m * row.direction(common=True)

        return see

    def empty(row: Row) -> None:
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
    "zero": Behaviour("floor", zero),
    "uniform": Behaviour("floor", uniform),
    "normal": Behaviour("floor", normal),
    "script": Behaviour("script"),
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
    each = [(behaviour, seed) for behaviour in behaviours.values() for seed in seeds]
    env = DualArmVectorEnv(
        len(each), env_id, autoreset_mode="Disabled", max_episode_steps=max_episode_steps, **keywords
    )
    core = env.core
    to_base = Frames((core.config.left, core.config.right)).rotation
    horizon = max_episode_steps or core.task.horizon
    rows = [Row(np.random.default_rng(seed), to_base, horizon) for _, seed in each]
    layout = core.task.layout
    scripts = [policies.load("scripted", env_id) for _ in each]  # one that waits is not asked in every step
    observation, _ = env.reset(seed=[seed for _, seed in each])
    totals: dict[str, Array] = {}
    refusal = core.weights.get("refusal", 0.0)
    live, steps, success = np.ones(len(each), dtype=bool), np.zeros(len(each)), np.zeros(len(each))
    earned, count = np.zeros((2, len(each))), len(seeds)
    action = np.zeros((len(each), *core.action_space.shape))
    while live.any():
        for k, (row, script, (behaviour, _)) in enumerate(zip(rows, scripts, each, strict=True)):
            row.action = action[k].reshape(2, -1)
            if not live[k] or behaviour.waits(row):
                hold(row)
                continue
            seen = observation[k].copy()
            row.fields = layout.split(seen)
            behaviour.sees(row)
            action[k] = script(seen)
            behaviour.acts(row)
        observation, reward, terminated, truncated, info = env.step(action.astype(np.float32))
        numbers = {name: value for name, value in info.items() if getattr(value, "dtype", None) == np.float64}
        numbers |= {name: info[name] for name in ("stage",) if name in info}
        earned += live * np.array([reward, refusal * info["reward/refusal"]])
        steps += live
        for name, value in numbers.items():
            if value.ndim < 3 and value.shape[1:] in ((), (2,)):
                kept = live.reshape(-1, *[1] * (value.ndim - 1))
                totals[name] = totals.get(name, 0.0) + np.where(kept, value, 0.0)
        for k, row in enumerate(rows):
            row.step += 1
            row.info = {name: value[k] for name, value in numbers.items()}
        over = terminated | truncated
        success = np.where(live & over, info["is_success"], success)
        live &= ~over
        if over.any() and live.any():
            observation, _ = env.reset(options={"reset_mask": over})
    env.close()
    found = {"return": earned[0], "refusals": earned[1], "steps": steps, "success": success}
    found |= {name: value / (steps if value.ndim == 1 else steps[:, None]) for name, value in totals.items()}
    return {
        name: {key: value[k * count : (k + 1) * count] for key, value in found.items()}
        for k, name in enumerate(behaviours)
    }


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
