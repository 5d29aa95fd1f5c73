"""How far nominal arms run past, or stay beside, commands of several kinds, and the adapter's time.

python benchmarks/adapter.py [--rate 25] [--json FILE]

One joint is commanded positions, at the hard limits of a UR10, for CB3 and e-Series controllers with the default
settings of servoj. The arm is the law's response to the targets. All cases are seeded. The time is that of one action
of both arms, in the kernel, for random steps of all joints.
"""

import argparse
import json
import os
import time
from pathlib import Path

import numpy as np

from dual_ur10.assets.settings import HOME_Q_RAD
from dual_ur10.kinematics.ur10 import NOMINAL_DH
from dual_ur10.sim2real.control.adapter import ServojAdapter
from dual_ur10.sim2real.control.limits import MotionLimits
from dual_ur10.sim2real.control.servoj import ServojLaw, ServojProfile

JOINT = 5  # of the left arm: no Cartesian limit binds


def cases(period_s: float, fastest_rad_s: float) -> dict[str, np.ndarray]:
    """Return commands relative to the start, (n, periods), by kind."""
    rng, number = np.random.default_rng(0), np.arange(1 + round(4.0 / period_s))
    speed = np.concatenate([np.linspace(0.0, 0.1, 201)[1:], np.linspace(0.1, fastest_rad_s, 120)])[:, None]
    tremble = [np.zeros(60)]
    for _ in number[1:]:
        tremble.append(0.0006 * rng.standard_normal(60))
    steps = rng.uniform(-0.1, 0.1, (60, len(number))) * fastest_rad_s * period_s
    return {
        "constant speed from rest": speed * number * period_s,
        "trembling, 0.6 mrad": np.array(tremble).T,
        "random steps of a tenth of full speed": np.cumsum(steps, axis=1) - steps[:, :1],
        "steps of 0.1 to 400 mrad": np.where(number > 4, np.geomspace(1e-4, 0.4, 80)[:, None], 0.0),
        "stop": np.geomspace(1e-3, fastest_rad_s, 80)[:, None] * np.minimum(number, len(number) // 2) * period_s,
    }


def arms(profile: ServojProfile, limits: MotionLimits, ticks: int, commands: np.ndarray) -> np.ndarray:
    """Return the way of the arm at each tick, (n, periods - 1, ticks), relative to the start."""
    n = len(commands)
    adapter = ServojAdapter(profile, limits, ticks, n=n, mode="joint_position", dh=[NOMINAL_DH] * 2)
    start = np.tile(HOME_Q_RAD, (n, 1, 1))
    adapter.reset(start)
    transition = ServojLaw(profile.lookahead_s, profile.gain).transition(profile.tick_s)
    state, way = np.zeros((2, n)), []
    for command in commands[:, 1:].T:
        action = start.copy()
        action[:, 0, JOINT] -= command  # the longer side of its range
        for target in adapter(action).targets_rad[:, :, 0, JOINT].T:
            offset = np.stack([HOME_Q_RAD[0, JOINT] - target, np.zeros(n)])
            state = offset + transition @ (state - offset)
            way.append(state[0])
    return np.stack(way, axis=1).reshape(n, -1, ticks)


def measure(family: str, rate_hz: float) -> dict[str, dict[str, float]]:
    """Return the figures of each kind of commands, in mrad."""
    profile, limits = ServojProfile(family), MotionLimits()
    ticks = profile.ticks_per_action(rate_hz)
    figures = {}
    for kind, commands in cases(ticks * profile.tick_s, min(limits.speed_rad_s)).items():
        way = arms(profile, limits, ticks, commands)
        beside = np.abs(way[:, :, -1] - commands[:, 1:])
        ahead = way - commands[:, 1:, None]
        if kind.startswith(("stop", "steps")):
            beyond = (way - commands[:, -1, None, None]).reshape(len(commands), -1)
            back = [-row[row.argmax() :].min() for row in beyond]
            figures[kind] = {"past": beyond.max(), "back": max(0.0, *back)}
        else:
            figures[kind] = {"past": ahead.max(), "largest": beside.max(), "rms": np.sqrt((beside**2).mean())}
    return {kind: {name: 1e3 * float(value) for name, value in each.items()} for kind, each in figures.items()}


def kernel_us(family: str, rate_hz: float, size: float, n: int = 200) -> float:
    """Return the least time of an action of a cell, µs, over 30 periods of random steps."""
    profile = ServojProfile(family)
    adapter = ServojAdapter(profile, MotionLimits(), profile.ticks_per_action(rate_hz), n=n, dh=[NOMINAL_DH] * 2)
    adapter.reset(np.tile(HOME_Q_RAD, (n, 1, 1)))
    rng, times = np.random.default_rng(0), []
    for _ in range(30):
        action = rng.uniform(-size, size, (n, 2, 6))
        begin = time.perf_counter()
        adapter(action)
        times.append(time.perf_counter() - begin)
    return 1e6 * min(times[6:]) / n


def main() -> None:
    """Measure, print and write the figures."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--rate", type=float, default=25.0, help="actions per second")
    parser.add_argument("--json", type=Path)
    options = parser.parse_args()
    result = {}
    for family in ("cb3", "e-series"):
        figures = measure(family, options.rate)
        figures["time, us"] = {
            f"steps of {size:g}": kernel_us(family, options.rate, size) for size in (0.002, 0.1, 1.0)
        }
        result[family] = figures
        for kind, each in figures.items():
            print(f"{family:9}{kind:40}" + "  ".join(f"{name} {value:.3f}" for name, value in each.items()))
    print(f"mrad; load {os.getloadavg()[0]:.1f}")
    if options.json:
        options.json.write_text(json.dumps(result, indent=1))


if __name__ == "__main__":
    main()
