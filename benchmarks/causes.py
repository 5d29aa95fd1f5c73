"""Measure the scripted policy of SineTracking on "wide" plants, all together and cause by cause.

`true` is the task's own error: of the true flanges, in the cell frame, at the time of the reference. A success is at
most 3 mm RMS. `measured` is the error that the sensors show: of the observed flange in the arm's own `base` frame.
They differ by what no sensor of the cell measures: where the bases really stand, and the age of an observation, which
looks like a latency of the arm. The same bound applies to both.

    python benchmarks/causes.py --json causes.json
"""

from __future__ import annotations

import os

os.environ.setdefault("OMP_NUM_THREADS", "1")  # before numpy reads it
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import argparse
import json
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np

from dual_ur10 import policies
from dual_ur10.cli.demo_report.sine import SINE_ID
from dual_ur10.envs.core.randomization import PRESETS, Randomization
from dual_ur10.envs.tasks.sine_tracking.settings import SineSettings
from dual_ur10.envs.tasks.sine_tracking.task import SineTracking
from dual_ur10.policies.evaluation.results import wilson_interval

WIDE, MILD = PRESETS["wide"], PRESETS["mild"]
BASES, AGE = ("base_shift_m", "base_turn_rad"), ("observation_delay_s",)
CAUSES = {
    "bases": BASES,
    "age of observations": AGE,
    "joint friction": ("joint_friction",),
    "masses": ("mass",),
    "lookahead": ("lookahead",),
    "latency and skew": ("latency_s", "skew_s"),
    "jitter": ("jitter_s",),
    "joint noise": ("joint_noise_rad", "joint_speed_noise_rad_s"),
}


def only(*names: str) -> Randomization:
    """Return the named deviations of "wide" alone."""
    values = asdict(WIDE)
    return Randomization(**{name: values[name] for name in names})


def without(*names: str) -> Randomization:
    """Return "wide" without the named deviations."""
    return replace(WIDE, **dict.fromkeys(names, 0.0))


def as_mild(*names: str) -> Randomization:
    """Return "wide" with the named deviations as small as in "mild"."""
    return replace(WIDE, **{name: asdict(MILD)[name] for name in names})


def measure(randomization: Randomization, episodes: int, **keywords: Any) -> dict[str, Any]:
    """Return the figures of one row, of the worse arm of each episode, which begins with its own seed from 0 on."""
    keywords = {"randomization": randomization, **keywords}
    env = gym.make_vec(SINE_ID, num_envs=episodes, **keywords)
    policy = policies.load("scripted", SINE_ID, **keywords)
    observation, _ = env.reset(seed=list(range(episodes)))
    squares, steps, failed = np.zeros((2, episodes, 2)), 0, np.zeros(episodes, dtype=bool)
    over = np.zeros(episodes, dtype=bool)
    while not over.any():
        observation, _, terminated, over, info = env.step(policy(observation))
        failed |= terminated
        fields = SineTracking.layout.split(observation)
        seen = np.linalg.norm(fields["reference_base_m"] - fields["flange_base_m"], axis=-1)
        squares += np.stack([info["flange_error_m"], seen]) ** 2
        steps += 1
    env.close()
    rms = np.sqrt(squares / steps).max(axis=-1)
    row: dict[str, Any] = {"episodes": episodes}
    for name, values in zip(("true", "measured"), rms, strict=True):
        successes = int(np.count_nonzero((values <= SineSettings().success_rms_m) & ~failed))
        row[name] = {
            "successes": successes,
            "interval": list(wilson_interval(successes, episodes)),
            "rms_median_mm": 1e3 * float(np.median(values)),
            "rms_max_mm": 1e3 * float(values.max()),
        }
    return row


def rows(episodes: int, causes: int) -> dict[str, tuple[Randomization, int, dict[str, Any]]]:
    """Return deviations, number of episodes and keywords of every row."""
    return {
        "wide": (WIDE, episodes, {}),
        "wide, bases and age exact": (without(*BASES, *AGE), episodes, {}),
        "wide, bases and age as mild": (as_mild(*BASES, *AGE), episodes, {}),
        "wide, random path": (WIDE, episodes, {"random_path": True}),
        "mild": (MILD, episodes, {}),
        **{f"{name} alone": (only(*names), causes, {}) for name, names in CAUSES.items()},
    }


def main() -> None:
    """Measure all rows, print each when it is done, and write the figures."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--json", type=Path, help="write the figures here")
    parser.add_argument("--episodes", type=int, default=300, help="episodes of the rows with several causes")
    parser.add_argument("--causes", type=int, default=100, help="episodes of the rows with one cause")
    arguments = parser.parse_args()
    print(f"{'':30}{'true':>12}{'RMS mm':>9}{'largest':>9}{'measured':>14}{'RMS mm':>9}{'largest':>9}")
    found = {}
    for name, (randomization, episodes, keywords) in rows(arguments.episodes, arguments.causes).items():
        found[name] = row = measure(randomization, episodes, **keywords)
        text = "".join(
            f"{each['successes']:>5} of {episodes:<4}{each['rms_median_mm']:>9.3f}{each['rms_max_mm']:>9.3f}"
            for each in (row["true"], row["measured"])
        )
        print(f"{name:30}{text}", flush=True)
    if arguments.json:
        arguments.json.write_text(json.dumps(found, indent=2) + "\n")


if __name__ == "__main__":
    main()
