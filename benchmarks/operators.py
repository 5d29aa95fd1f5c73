"""Operators: from an input to motion, takeovers, tasks that synthetic persons finish, and what is learned from them.

python benchmarks/operators.py [--parts input,keys,takeovers,devices,controllers,demonstrations,corrections,page]
    [--episodes 20] [--devices spacemouse,leader,page] [--takeovers 1000] [--evaluated 300] [--json FILE]

Persons act by the reports of their devices: SpaceMice as raw reports in a pipe, leader arms as chains of servos on
pseudo terminals, the handles of a page in its shared memory.

input: Time from an input to the first motion, on a virtual cell, by the clock of its controllers.
keys: Stop keys that are lost among other keys and escape sequences, on a pseudo terminal.
takeovers: Takeovers and hand-backs at random instants, on virtual cells.
devices: Tasks that persons finish in simulation.
controllers: The same on emulated controllers in virtual time, a quarter of the episodes, on mild plants.
demonstrations: Behaviour cloning of 30 episodes of Handover by a person at the page whose hands tremble, who pauses and
    takes detours ("wide" plants).
corrections: Human-gated DAgger: a clone of `CLONED` scripted episodes of Handover, all of whose translations are then
    wrong by `SPOILED`, and the same after a person has corrected 10 episodes of it, at the page.
page: Cost of the page: that of live_page.py, on an emulated cell in real time.
"""

from __future__ import annotations

import os

for name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"):
    os.environ.setdefault(name, "1")

import argparse
import dataclasses
import json
import multiprocessing
import random
import sys
import tempfile
from concurrent.futures import ProcessPoolExecutor
from pathlib import Path
from typing import Any

import numpy as np
import pytest

sys.path.insert(0, str(Path(__file__).parent.parent))

import gymnasium as gym
import live_page

from dual_ur10.envs.core.options import AS_ON_CONTROLLERS
from dual_ur10.policies import evaluate
from dual_ur10.policies.learned import checkpoint
from dual_ur10.policies.operators import leader
from dual_ur10.policies.training.corrections import Person
from dual_ur10.policies.training.dataset import collect
from dual_ur10.policies.training.demonstrations import demonstrate, make_dataset
from dual_ur10.policies.training.settings import defaults
from dual_ur10.policies.training.train import train
from tests.policies.operators.hands import operator_of
from tests.policies.operators.key_streams import stops_lost
from tests.policies.operators.persons import (
    PERSONS,
    Corrector,
    ShakyPerson,
    Watched,
    successes,
    successes_on_controllers,
)
from tests.virtual import test_takeover
from tests.virtual.test_operator import Rig, input_to_motion_s

PARTS = ("input", "keys", "takeovers", "devices", "controllers", "demonstrations", "corrections", "page")
CELLS = 10
TASKS = {"handover": "Handover", "carry": "SyncCarry"}
INPUTS = 10
KEY_STREAMS = 10_000
LEARNED = "Handover"
KEYWORDS = {"action_latency_ticks": 5, "randomization": "wide"}
DEMONSTRATIONS, CLONED, CORRECTED = 30, 3, 10
CLONE, CORRECTION = {"fit_steps": 1500, "batch_size": 512}, {"fit_steps": 600, "batch_size": 256}
"""Settings of both trainings: samples are few."""
CHECKS = 4
SPOILED = 0.4
"""Addition to the translations of a spoiled policy, of its largest step: 4 mm in 40 ms."""


def input_to_motion_ms(family: str) -> float:
    """Return the 99th percentile of the time from an input, at any instant, to the first motion, at 125 Hz."""
    with tempfile.TemporaryDirectory() as folder, pytest.MonkeyPatch.context() as patch:
        rig = Rig(Path(folder), patch, family=family)
        waits = input_to_motion_s(rig, INPUTS)
        rig.close()
    instants = np.linspace(0.0, 0.008, 100)  # between two readings
    return float(1e3 * np.quantile(waits[:, None] + instants, 0.99))


def takeovers(count: int) -> dict[str, float]:
    """Return the figures of takeovers and hand-backs at random instants on virtual cells, at 125 Hz."""
    above, off_mm, delays_ms, late = 0, 0.0, [], 0
    # A stretch has a virtual clock of its own, which other processes do not slow down.
    with ProcessPoolExecutor(os.cpu_count(), multiprocessing.get_context("spawn")) as pool:
        for seed, found in enumerate(pool.map(stretch, [count // CELLS] * CELLS, range(CELLS))):
            above, off_mm, delays_ms = above + found[0], max(off_mm, found[1]), [*delays_ms, *found[2]]
            late += found[3]
            done = (seed + 1) * (count // CELLS)
            print(f"{done} takeovers: {above} above a cap, {late} late, {off_mm:.2f} mm off", flush=True)
    return {
        "takeovers": CELLS * (count // CELLS),
        "takeover_above_caps": above,
        "takeover_late_actions": late,
        "takeover_off_path_mm": round(float(off_mm), 2),
        "takeover_delay_ms_most": round(float(max(delays_ms)), 1),
        "takeover_delays": len(delays_ms),
    }


def stretch(count: int, seed: int) -> tuple[int, float, list[float], int]:
    """Return the figures of takeovers on one cell; see `tests.virtual.test_takeover.takeovers`."""
    with pytest.MonkeyPatch.context() as patch:
        found: tuple[int, float, list[float], int] = test_takeover.takeovers(patch, count, seed)
    return found


def finished(device: str, episodes: int, of: Any = successes) -> dict[str, list[int]]:
    """Return the numbers of successes and of episodes of each task."""
    found = {}
    for name, task in TASKS.items():
        with tempfile.TemporaryDirectory() as folder:
            found[name] = [int(of(device, task, range(episodes), Path(folder))), episodes]
        print(f"{device}, {name}, {of.__name__}: {found[name][0]} of {episodes}", flush=True)
    return found


def demonstrations(folder: Path, evaluated: int) -> dict[str, Any]:
    """Return the success of a clone of demonstrations by an unsteady person at the page."""
    keywords, dataset = {"action_mode": "tcp_delta", **KEYWORDS}, "ur10/handover/shaky-v0"
    person = ShakyPerson(folder, LEARNED, **KEYWORDS)
    env = gym.make(f"DualUR10/{LEARNED}-v0", record=str(folder / "runs"), **AS_ON_CONTROLLERS, **keywords)
    ends: list[Any] = []
    demonstrate(
        Watched(env, person),
        operator_of(person.device, LEARNED, **keywords),
        episodes=DEMONSTRATIONS,
        seed=100_000,
        on_end=ends.append,
        wait=lambda time_s: None,
    )
    env.close()
    person.close()
    steps = make_dataset(folder / "runs", dataset).total_steps
    print(f"{DEMONSTRATIONS} demonstrations of {len(ends)}, {steps} steps", flush=True)
    policy = _trained(folder / "clone", "bc", CLONE, dataset=dataset)
    return {"demonstrated": [DEMONSTRATIONS, len(ends)], "cloned": _succeeds(policy, evaluated, "clone")}


def corrections(folder: Path, evaluated: int) -> dict[str, Any]:
    """Return the successes of a policy that was spoiled, before and after a person has corrected it."""
    keywords, dataset = {"action_mode": "tcp_delta", **KEYWORDS}, "ur10/handover/few-v0"
    collect(LEARNED, dataset, episodes=CLONED, envs=CLONED, seed=100_000, env_kwargs=keywords)
    clone = _trained(folder / "clone", "bc", CORRECTION, dataset=dataset)
    return corrected(folder, clone, evaluated)


def corrected(folder: Path, clone: Path, evaluated: int) -> dict[str, Any]:
    """Spoil a policy, let a person correct it, and return the successes before and after."""
    good = checkpoint.load(clone)
    for layers in good.layers:
        layers[-1][1][:3] += SPOILED  # steps of a tool along x, y and z
    checkpoint.save(folder / "spoiled", good.layers, good.manifest)
    people: list[Corrector] = []

    def meet(training: Any) -> Person:
        people.append(Corrector(folder, LEARNED, **KEYWORDS))
        operator = operator_of(people[0].device, LEARNED, action_mode="tcp_delta", **KEYWORDS)
        return Person(operator, shown=lambda env: Watched(env, people[0]), wait=lambda time_s: None)

    changes = CORRECTION | {"corrected": CORRECTED}
    given = {"init": str(folder / "spoiled"), "operator": "page", "steps": 1}
    policy = _trained(folder / "corrected", "dagger", changes, meet, **given)
    people[0].close()
    print(f"{people[0].corrections} corrections in {CORRECTED} episodes kept", flush=True)
    found = {"after": _succeeds(policy, evaluated, "corrected")}
    found["before"] = _succeeds(folder / "spoiled", evaluated, "spoiled")
    return {"corrected": found | {"corrections": people[0].corrections}}


def _trained(out: Path, algorithm: str, changes: dict[str, int], meet: Any = None, **given: Any) -> Path:
    """Return the policy of a training."""
    keywords = {"action_mode": "tcp_delta", **KEYWORDS}
    asked = defaults(LEARNED, algorithm, "shared", keywords=keywords, changes=changes, **given)
    return train(dataclasses.replace(asked, checks=CHECKS), out, meet=meet)


def _succeeds(policy: Path, episodes: int, what: str) -> list[int]:
    """Return the numbers of successes and of episodes of a policy."""
    keywords = {"action_mode": "tcp_delta", **KEYWORDS}
    found = evaluate(
        f"DualUR10/{LEARNED}-v0", str(policy), episodes=episodes, num_envs=100, seed=0, env_kwargs=keywords
    )
    successes = sum(each.success for each in found.episodes)
    print(f"{what}: {successes} of {episodes}", flush=True)
    return [successes, episodes]


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--parts", default=",".join(PARTS))
    parser.add_argument("--episodes", type=int, default=20)
    parser.add_argument("--devices", default=",".join(PERSONS))
    parser.add_argument("--takeovers", type=int, default=1000, help="a multiple of 10; 0: none")
    parser.add_argument("--evaluated", type=int, default=300, help="episodes that evaluate a learned policy")
    parser.add_argument("--stretches", type=int, default=6, help="stretches of 10 s with a page; 0: no page")
    parser.add_argument("--json", type=Path, help="write the figures to this file")
    arguments = parser.parse_args()
    parts = arguments.parts.split(",")
    unknown = [each for each in parts if each not in PARTS]
    if unknown:
        parser.error(f"unknown part {unknown[0]!r}: use some of {', '.join(PARTS)}")
    devices = [each for each in arguments.devices.split(",") if each]
    leader._WAIT_S = 0.2  # the emulated servos answer from a thread of this process
    figures: dict[str, Any] = {}
    if "input" in parts:
        for key, family in (("input_to_motion_ms_p99", "e-series"), ("input_to_motion_cb3_ms_p99", "cb3")):
            figures[key] = round(input_to_motion_ms(family), 1)
            print(f"{family}: input to motion, 99th percentile {figures[key]} ms", flush=True)
    if "keys" in parts:
        figures |= {"key_streams": KEY_STREAMS, "stop_keys_lost": stops_lost(KEY_STREAMS, random.Random(0))}
        print(f"stop keys lost: {figures['stop_keys_lost']} of {KEY_STREAMS}", flush=True)
    if "takeovers" in parts and arguments.takeovers:
        figures |= takeovers(arguments.takeovers)
    if "devices" in parts:
        figures["devices"] = {each: finished(each, arguments.episodes) for each in devices}
    if "controllers" in parts:
        episodes = max(1, arguments.episodes // 4)
        figures["controllers"] = {each: finished(each, episodes, successes_on_controllers) for each in devices}
    for name, measure in (("demonstrations", demonstrations), ("corrections", corrections)):
        if name in parts:
            with tempfile.TemporaryDirectory() as folder, pytest.MonkeyPatch.context() as patch:
                patch.setenv("MINARI_DATASETS_PATH", str(Path(folder) / "datasets"))
                figures |= measure(Path(folder), arguments.evaluated)
    if "page" in parts and arguments.stretches:
        figures |= live_page.figures_of(10.0, arguments.stretches)
        print(f"page_late_extra {figures['page_late_extra']}", flush=True)
    if arguments.json:
        arguments.json.write_text(json.dumps(figures, indent=2) + "\n")


if __name__ == "__main__":
    main()
